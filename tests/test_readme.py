"""The README holds what it says: its table is the schema's, its filter runs, its sample opens."""

import io
import re
import shlex
from pathlib import Path

import pytest

import viz_estim
from viz_estim.cli import main
from viz_estim.diagnosis.finding import CODES
from viz_estim.recording import schema
from viz_estim.scenarios import SCENARIOS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_its_table_of_entities_is_made_from_the_schema() -> None:
    assert schema.table() in README


def test_its_filter_runs_is_recorded_and_stepped_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = [code for code in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if "def walk" in code]
    (tmp_path / "walk.py").write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["run", "walk.py:walk"]) == 0
    run = viz_estim.load("recordings/walk-seed0.rrd")
    assert len(run.step) == 200
    assert run.summary()["metrics"]["position_rmse_m"] < 0.4
    assert 0.8 < run.summary()["nees"]["inside"] <= 1.0
    monkeypatch.setattr("sys.stdin", io.StringIO("step 3\nwhere\nquit\n"))
    assert main(["debug", "walk.py:walk", "--no-viewer"]) == 0
    assert "step 3  update" in capsys.readouterr().out


def test_its_comparison_says_what_it_quotes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    section = README.split("## Two runs side by side")[1].split("\n## ")[0]
    commands, quoted = re.findall(r"```(?:sh)?\n(.*?)```", section, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    codes = [main(shlex.split(line, comments=True)[1:]) for line in commands.splitlines()]
    assert codes == [0, 0, 1]
    told = capsys.readouterr().out.splitlines()
    assert [line for line in quoted.splitlines() if line != "…"] == [
        line for line in told if line in quoted.split("\n")
    ]


SAMPLES = sorted((ROOT / "recordings").glob("*-sample.rrd"))


def test_every_scenario_has_a_small_sample() -> None:
    assert {path.name.removesuffix("-sample.rrd") for path in SAMPLES} == set(SCENARIOS)
    assert sum(path.stat().st_size for path in SAMPLES) <= 12_000_000


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_a_committed_sample_opens_as_arrays(path: Path) -> None:
    run = viz_estim.load(path)
    assert path.stat().st_size <= 2_000_000
    assert run.complete
    assert run.error is None
    assert run.properties["scenario"] == path.name.removesuffix("-sample.rrd")
    told = run.properties["result"]
    found = run.summary()
    assert found["metrics"] == pytest.approx(told["metrics"])
    assert (found["nis"], found["nees"]) == (told["nis"], pytest.approx(told["nees"]) if told["nees"] else None)


def test_the_generated_set_is_what_simulate_writes(tmp_path: Path) -> None:
    assert main(["simulate", "imu", "--seed", "8", "--out", str(tmp_path)]) == 0
    from viz_estim.scenarios import imu_files

    made, kept = (imu_files.load(*imu_files.find_sets([folder])[0]) for folder in (tmp_path, ROOT / "data" / "imu"))
    assert (made.gyro == kept.gyro).all()
    assert (made.truth_stamps == kept.truth_stamps).all()


def test_its_table_of_codes_is_that_of_diagnose() -> None:
    assert all(f"| `{code}` | {meaning} |" in README for code, meaning in CODES.items())
