"""A recorded run again with other parameters: its first steps to the bit, and what it refuses and why."""

import io
import json
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli
from test_debugger import WALK

import viz_estim
from viz_estim.core.run import run
from viz_estim.debugger import forking
from viz_estim.debugger.live import Live
from viz_estim.debugger.session import debug
from viz_estim.recording.reader import Run
from viz_estim.recording.recorder import Recorder
from viz_estim.running import plan, recorded
from viz_estim.scenarios import SCENARIOS


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, cli: Cli) -> Path:
    """A run of some 250 steps, in which the gyro freezes: many of these tests run it several times."""
    path = tmp_path_factory.mktemp("fork") / "short.rrd"
    settings = [f"--set=data.{one}" for one in ("duration=2.4", "still=0.4", "freeze=0.5")]
    assert cli("run", "imu-ukf", *settings, "--seed", 3, "--out", path).code == 0
    return path


def fork(cli: Cli, path: Path, step: int, *settings: str, out: Path) -> Run:
    done = cli("fork", path, "--at", step, *(f"--set={one}" for one in settings), "--out", out)
    assert (done.code, done.err) == (0, "")
    assert done.out.splitlines()[-1] == f"viz-estim open {out}"
    return viz_estim.load(out)


def assert_same_until(one: Run, other: Run, step: int) -> None:
    """All numbers of the first steps are equal to the bit, and some after them are not."""
    np.testing.assert_array_equal(one.step, other.step)
    for name, values in one.ends.items():
        assert values[:step].tobytes() == other.ends[name][:step].tobytes()
        assert (values[step:] != other.ends[name][step:]).any()
    for name, table in one.stages.items():
        rows, theirs = table.step < step, other.stages[name].step < step
        for key, values in table.values.items():
            assert values[rows].tobytes() == other.stages[name].values[key][theirs].tobytes(), (name, key)


def test_its_first_steps_are_the_original_s(cli: Cli, recording: Path, tmp_path: Path) -> None:
    original = viz_estim.load(recording)
    forked = fork(cli, recording, 60, "gyro_noise=0.05", out=tmp_path / "a.rrd")
    assert_same_until(original, forked, 60)
    assert forked.properties["params"]["gyro_noise"] == 0.05
    again = fork(cli, tmp_path / "a.rrd", 90, "accel_noise=1", "frozen=reject", out=tmp_path / "b.rrd")
    assert_same_until(forked, again, 90)
    assert [part["at"] for part in again.properties["forks"]] == [0, 60, 90]
    # From 75 on it is a third run, which shares 60 steps with the first and 75 with the second.
    third = fork(cli, tmp_path / "b.rrd", 75, "accel_noise=1", out=tmp_path / "c.rrd")
    assert_same_until(forked, third, 75)
    whole = fork(cli, recording, 0, "initial=truth", out=tmp_path / "d.rrd")
    assert whole.properties["params"]["initial"] == "truth"
    assert (whole.mean[0] != original.mean[0]).any()


def test_chance_is_the_same_from_there_on(cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "pf.rrd"
    assert cli("run", "beacons-pf", "--out", path).code == 0
    forked = fork(cli, path, 20, "range_noise=0.9", out=tmp_path / "a.rrd")
    assert_same_until(viz_estim.load(path), forked, 20)


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_is_found_again_from_its_recording(name: str, tmp_path: Path) -> None:
    made = plan(name, data=None, calibration=None, settings=[], seed=None)
    scenario = made.build()
    with Recorder(tmp_path / "run.rrd", scenario, made.properties(scenario)) as recorder:
        recorded(islice(run(scenario, made.seed), 12), scenario, recorder, lambda done, total: None)
    found = viz_estim.load(tmp_path / "run.rrd")
    forking.check_same(found, forking.live(forking.revive(found)), len(found.step))


REFUSED = {
    "data.still=2": "data.still belongs to the data",
    "initial=truth": "initial belongs to the start, which is past at step 9",
    "initial_rate_std=0.2": "belongs to the start",
    "gyro_nois=1": "no parameter gyro_nois; did you mean gyro_noise?",
    "gyro_noise=big": "expected number",
    "gyro_noise": "expected NAME=VALUE",
    "gyro_noise=-1": "gyro_noise",
}  # fmt: skip


@pytest.mark.parametrize("setting", REFUSED)
def test_what_may_not_be_set_is_one_line(setting: str, cli: Cli, recording: Path, tmp_path: Path) -> None:
    done = cli("fork", recording, "--at", 9, "--set", setting, "--out", tmp_path / "a.rrd")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert REFUSED[setting] in done.err
    assert not list(tmp_path.iterdir())


def test_a_fork_is_not_written_over_what_it_forks(cli: Cli, recording: Path) -> None:
    before = recording.read_bytes()
    done = cli("fork", recording, "--at", 5, "--set", "gyro_noise=0.1", "--out", recording)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert "is the recording itself" in done.err
    assert recording.read_bytes() == before


def test_a_branch_is_not_saved_over_the_recording_that_is_looked_into(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before, told = recording.read_bytes(), io.StringIO()
    typed = io.StringIO(f"step 2\nset gyro_noise=0.1\nsave {recording}\nquit\n")
    plain: dict[str, Any] = {"data": None, "calibration": None, "settings": [], "seed": None, "viewer": False}
    debug(str(recording), **plain, stdin=typed, stdout=told)
    assert "is the recording that is looked into; choose another name" in told.getvalue()
    assert recording.read_bytes() == before


@pytest.mark.parametrize("step", [-1, 10_000])
def test_a_step_that_is_not_there_is_one_line(step: int, cli: Cli, recording: Path) -> None:
    done = cli("fork", recording, "--at", step, "--set", "gyro_noise=1")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert "holds steps 0 to" in done.err


def test_data_and_code_must_be_what_they_were(cli: Cli, tmp_path: Path) -> None:
    folder, out = tmp_path / "data", tmp_path / "run.rrd"
    assert cli("simulate", "parameter", "--out", folder).code == 0
    assert cli("run", "parameter-ekf", "--data", folder, "--out", out).code == 0

    def refused(words: str) -> None:
        done = cli("fork", out, "--at", 5, "--set", "process_noise=2", "--out", tmp_path / "fork.rrd")
        assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
        assert words in done.err
        assert not (tmp_path / "fork.rrd").exists()

    fork(cli, out, 5, "process_noise=2", out=tmp_path / "fine.rrd")
    (path,) = [one for one in folder.rglob("*") if one.is_file()]
    content = path.read_bytes()
    path.write_bytes(content + b"\n")
    refused("has changed since")
    path.unlink()
    refused("is gone")
    path.write_bytes(content)
    fork(cli, out, 5, "process_noise=2", out=tmp_path / "fine.rrd")


def test_a_person_s_own_scenario_must_be_what_it_was(cli: Cli, tmp_path: Path) -> None:
    own, out = tmp_path / "own.py", tmp_path / "run.rrd"
    own.write_text(WALK)
    assert cli("run", f"{own}:walk", "--seed", 1, "--out", out).code == 0
    assert_same_until(viz_estim.load(out), fork(cli, out, 9, "r=1", out=tmp_path / "a.rrd"), 9)
    for text, words in {
        WALK.replace("0.01 * rng", "0.02 * rng"): "comes out different from what was recorded",
        WALK.replace("q: float", "quick: float").replace("Walk(q,", "Walk(quick,"): "no parameter q any more",
        "def other(): pass": "its scenario is gone",
        None: "its scenario is gone",
    }.items():  # fmt: skip
        own.unlink(missing_ok=True)
        if text:
            own.write_text(text)
        done = cli("fork", out, "--at", 9, "--set", "r=1", "--out", tmp_path / "b.rrd")
        assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
        assert words in done.err


def test_a_parameter_of_both_the_start_and_the_filter_may_be_set(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(WALK.replace("np.full((1, 1), start)", "np.full((1, 1), start + r)"))
    out = tmp_path / "run.rrd"
    assert cli("run", f"{tmp_path}/own.py:walk", "--seed", 1, "--out", out).code == 0
    assert_same_until(viz_estim.load(out), fork(cli, out, 9, "r=1", out=tmp_path / "a.rrd"), 9)


def test_a_live_run_of_several_parts_is_as_if_it_had_run_at_once(cli: Cli, recording: Path) -> None:
    parts = forking.revive(viz_estim.load(recording))
    straight: Live = forking.live(parts)
    straight.span(80)
    parts = forking.changed(parts, 30, ["gyro_noise=0.1"], straight)
    parts = forking.changed(parts, 60, ["accel_noise=2"], forking.live(parts))
    stepped, jumped = forking.live(parts), forking.live(parts)
    jumped.span(80)
    for k in (*range(81), 70, 20, 55):
        assert stepped.step(k).stages[-1].belief.mean.tobytes() == jumped.step(k).stages[-1].belief.mean.tobytes()
    assert json.dumps(forking.properties(parts)["forks"][1]["params"]["gyro_noise"]) == "0.1"
