"""A person's own scenario whose parts do not fit: one line says which, before anything is written."""

from pathlib import Path

import pytest
from conftest import Cli

OWN = """
import dataclasses
import numpy as np
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.spaces import Euclidean
from viz_estim.core.stages import Stage

class Still:
    def step(self, belief, tick, rng):
        yield Stage("update", belief)

def made(rng, *, what="fine"):
    space, T = Euclidean(["x", "y"], "m"), 5
    ticks = [Tick(float(k), float(k > 0), measurements={"gps": np.zeros(2)}) for k in range(T)]
    fine = Scenario(Still(), {0: Gaussian(space, np.zeros(2), np.eye(2))}, ticks, np.zeros((T, 2)))
    changed = {
        "fine": {},
        "no belief": {"beliefs": {0: np.zeros(2)}},
        "a mean too long": {"beliefs": {0: Gaussian(space, np.zeros(3), np.eye(3))}},
        "a list for a mean": {"beliefs": {0: Gaussian(space, [0.0, 0.0], np.eye(2))}},
        "no ticks": {"ticks": [(0.0, 0.0)]},
        "a short truth": {"truth": np.zeros((3, 2))},
        "a wide truth": {"truth": np.zeros((T, 3))},
        "a list for the truth": {"truth": [[0.0, 0.0]] * T},
    }
    return dataclasses.replace(fine, **changed[what])
"""
WORDS = {
    "no belief": "the belief at step 0: expected a Gaussian, Particles or Categorical of viz_estim.core.beliefs, got",
    "a mean too long": "the belief at step 0: mean: expected an array (2,), got (3,)",
    "a list for a mean": "the belief at step 0: mean: expected an array (2,), got list",
    "no ticks": "ticks: expected Ticks of viz_estim.core.run, got tuple",
    "a short truth": "truth: expected an array (5, 2), a row a tick (x, y), got (3, 2)",
    "a wide truth": "truth: expected an array (5, 2), a row a tick (x, y), got (5, 3)",
    "a list for the truth": "truth: expected an array (5, 2), a row a tick (x, y), got list",
}


@pytest.mark.parametrize("what", WORDS)
def test_what_does_not_fit_is_refused_before_it_runs(what: str, tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "own.py").write_text(OWN)
    done = cli("run", f"{tmp_path}/own.py:made", "--set", f"what={what}", "--out", tmp_path / "out.rrd")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert f"own.py:made: {WORDS[what]}" in done.err
    assert [path.name for path in tmp_path.glob("*.rrd")] == []


def test_what_fits_runs(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "own.py").write_text(OWN)
    assert cli("run", f"{tmp_path}/own.py:made", "--out", tmp_path / "out.rrd").code == 0
