"""The names that people give: with blanks, empty, or spelled in two ways."""

import re
from pathlib import Path

import pytest
from conftest import Cli, strict

import viz_estim
from viz_estim.core.spaces import Euclidean, Product

SCENARIO = """
import dataclasses
import numpy as np
from viz_estim.scenarios.landmarks import landmarks, landmarks_ekf
from viz_estim.core.run import Tick

class Renamed:
    def __init__(self, filter, name):
        self.filter, self.name = filter, name

    def step(self, belief, tick, rng):
        for stage in self.filter.step(belief, tick, rng):
            yield dataclasses.replace(stage, name=self.name) if stage.name == "update" else stage

def named(rng, *, name="update"):
    scenario = landmarks_ekf(landmarks(None, rng, duration=3.0))
    return dataclasses.replace(scenario, estimator=Renamed(scenario.estimator, name))

def twice(rng):
    scenario = landmarks_ekf(landmarks(None, rng, duration=3.0))
    ticks = [dataclasses.replace(t, measurements={k + "/": z for k, z in t.measurements.items()})
             for t in scenario.ticks]
    return dataclasses.replace(scenario, ticks=ticks)
"""


@pytest.fixture
def own(tmp_path: Path) -> Path:
    (tmp_path / "own.py").write_text(SCENARIO)
    return tmp_path / "own.py"


@pytest.mark.parametrize("name", ["take in range", "", "Messung/größe", "50 % (α)"])
def test_a_stage_of_any_name_is_read_back(name: str, own: Path, cli: Cli) -> None:
    out = own.with_name("out.rrd")
    done = cli("run", f"{own}:named", f"--set=name={name}", "--out", out)
    assert done.code == 0, done.err
    run = viz_estim.load(out)
    assert name in run.stages
    assert list(strict(cli("show", out, "--json"))["nis"]) == ["range"]
    shown = strict(cli("show", out, "--step", 5, "--json"))
    assert [stage["name"] for stage in shown["stages"]] == ["predict", name]


@pytest.mark.parametrize(("name", "instead"), [("gps/1/", "'gps/1'"), ("/gps", "'gps'"), ("a//b", "'a/b'"), (" ", "")])
def test_a_part_has_one_spelling(name: str, instead: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"part {name!r}: ") + f".*{instead}"):
        Product(**{name: Euclidean(["x"])})


def test_a_reading_has_one_spelling(own: Path, cli: Cli) -> None:
    done = cli("run", f"{own}:twice", "--out", own.with_name("out.rrd"))
    assert (done.code, done.out) == (2, "")
    assert "reading 'range/': a name has no empty part" in done.err
    assert "call it 'range'" in done.err
    assert not own.with_name("out.rrd").exists()
