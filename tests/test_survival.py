"""How recordings end: well, by a failure, by a kill; and files that are none. What was there before stays."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import rerun as rr
import rerun_cli  # type: ignore[import-untyped]
from conftest import Cli
from rerun.chunk import RrdReader

import viz_estim
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.run import Scenario, Step, Tick
from viz_estim.core.spaces import Euclidean
from viz_estim.core.stages import Stage
from viz_estim.errors import BadInput
from viz_estim.files import claimed
from viz_estim.recording.reader import load
from viz_estim.recording.recorder import Recorder, partial_of
from viz_estim.recording.rescue import last_whole, whole
from viz_estim.recording.tables import StageTable

FAILING = """
import numpy as np
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.spaces import Euclidean
from viz_estim.core.stages import Stage

class Walk:
    def __init__(self, fate):
        self.fate = fate

    def step(self, belief, tick, rng):
        belief = Gaussian(belief.space, belief.mean + 1, belief.cov)
        yield Stage("predict", belief)
        late = tick.time >= 7
        if late and self.fate == "raises":
            np.linalg.cholesky(-belief.cov)
        yield Stage("correct", Gaussian(belief.space, belief.mean * (np.nan if late else 1), belief.cov))

def walk(*, fate: str = "raises") -> Scenario:
    ticks = [Tick(float(k), 1.0) for k in range(20)]
    return Scenario(Walk(fate), {0: Gaussian(Euclidean(["x", "y"], "m"), np.zeros(2), np.eye(2))}, ticks)
"""


@pytest.mark.parametrize(
    ("fate", "stages", "where", "words"),
    [
        ("raises", ["predict"], "after predict", "LinAlgError: "),
        ("is NaN", ["predict", "correct"], "correct", "NotFinite: "),
    ],
)
def test_a_failure_is_the_recording_s_last_step(
    cli: Cli, tmp_path: Path, fate: str, stages: list[str], where: str, words: str
) -> None:
    (tmp_path / "my.py").write_text(FAILING)
    out = tmp_path / "failed.rrd"
    done = cli("run", f"{tmp_path}/my.py:walk", "--set", f"fate={fate}", "--out", out, "--json")
    assert (done.code, done.err) == (0, "")
    result = json.loads(done.out)
    error = result["error"]
    assert result["steps"] == 8
    assert {k: error[k] for k in ("step", "stage")} == {"step": 7, "stage": where}
    assert error["message"].startswith(words)
    run = viz_estim.load(out)
    assert run.complete
    assert run.error == f"step 7, {'' if where.startswith('after') else 'in '}{where}: {error['message']}"
    assert run.properties["result"]["error"] == error
    assert [table.name for table, _ in run.at(7)] == stages
    shown = json.loads(cli("show", out, "--step", 7, "--json").out)
    assert shown["error"] == error
    assert [stage["name"] for stage in shown["stages"]] == stages
    assert json.loads(cli("show", out, "--step", 6, "--json").out)["error"] is None
    assert json.loads(cli("show", out, "--json").out)["error"] == error
    for text in (cli("show", out).out, cli("show", out, "--step", 7).out):
        assert "FAILED" in text
        assert error["message"] in text


def test_a_run_that_ends_leaves_one_file(recording: Path) -> None:
    assert [path.name for path in recording.parent.iterdir()] == [recording.name]


def test_a_seed_gives_one_recording(cli: Cli, tmp_path: Path) -> None:
    short = ["--set=data.duration=2.5", "--set=data.still=0.5", "--set=data.freeze=0.5", "--seed", "3"]
    program = next(Path(rerun_cli.__file__).parent.rglob("[Rr]erun"))
    paths = []
    for folder, options in (("a", []), ("b", []), ("c", ["--seed", "4"])):
        (tmp_path / folder).mkdir()
        paths.append(tmp_path / folder / "run.rrd")
        # Not a slow filter: batches are cut by time too, where a kill would lose more than a second of steps.
        assert cli("run", "imu-gyro", *short, *options, "--out", paths[-1]).code == 0
    same, other = (subprocess.run([program, "rrd", "compare", paths[0], b], capture_output=True) for b in paths[1:])
    assert same.returncode == 0, same.stderr.decode()[-300:]
    assert other.returncode != 0


class Killed(NamedTuple):
    """A run that was killed: its partial file, the last step that had ended a second before, and the target."""

    partial: Path
    ended: int
    target: Path


CHILD = """
import os, sys, time
from viz_estim.cli import main
from viz_estim.recording import recorder
add = recorder.Recorder.add
log = os.open(sys.argv[1], os.O_WRONLY | os.O_CREAT)
def told(self, step):
    add(self, step)
    os.write(log, f"{step.index} {time.monotonic()}\\n".encode())
recorder.Recorder.add = told
main(["run", "imu-ukf", "--set", "data.duration=60", "--seed", "3", "--out", sys.argv[2]])
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Killed:
    folder = tmp_path_factory.mktemp("killed")
    target, partial, log = folder / "run.rrd", folder / "run.partial.rrd", folder / "log"
    target.write_bytes(b"precious")
    child = subprocess.Popen([sys.executable, "-c", CHILD, log, target])
    deadline = time.monotonic() + 60
    while not (partial.exists() and partial.stat().st_size > 3e5) and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(1.2)
    child.send_signal(signal.SIGKILL)
    at = time.monotonic()
    assert child.wait() == -signal.SIGKILL, "the run ended before it was killed"
    told = [line.split() for line in log.read_text().splitlines()]
    return Killed(partial, max(int(index) for index, when in told if float(when) < at - 1.0), target)


def test_a_kill_costs_a_second_at_most(killed: Killed) -> None:
    run = viz_estim.load(killed.partial)
    assert not run.complete
    assert killed.ended > 50
    assert run.step[-1] >= killed.ended
    np.testing.assert_array_equal(run.step, np.arange(len(run.step)))
    for step in range(1, killed.ended + 1):
        assert [table.name for table, _ in run.at(step)] == ["predict", "update"]
    assert np.isfinite(run.mean[: killed.ended + 1]).all()


def test_a_killed_run_overwrites_nothing(killed: Killed) -> None:
    assert killed.target.read_bytes() == b"precious"


@pytest.mark.draws
def test_every_command_reads_what_a_kill_left(killed: Killed, cli: Cli, tmp_path: Path) -> None:
    shown = cli("show", killed.partial, "--json")
    assert (shown.code, shown.err) == (0, "")
    overview = json.loads(shown.out)
    assert overview["complete"] is False
    assert overview["nis"].keys() == {"accel", "gyro"}
    assert "cut off" in cli("show", killed.partial).out
    assert json.loads(cli("show", killed.partial, "--step", killed.ended, "--json").out)["step"] == killed.ended
    for kind in ("tum", "csv", "npz"):
        assert cli("export", killed.partial, "--to", kind, "-o", tmp_path / f"out.{kind}").code == 0
    with np.load(tmp_path / "out.npz") as arrays:
        assert arrays["step"][-1] == overview["last_step"]
    taken = cli("snapshot", killed.partial, "--step", killed.ended, "--size", "500x400", "-o", tmp_path / "a.png")
    assert (taken.code, taken.err) == (0, "")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("ended", ["killed", "well"])
def test_a_file_cut_anywhere_holds_what_came_before(
    request: pytest.FixtureRequest, recording: Path, ended: str, tmp_path: Path
) -> None:
    path = recording if ended == "well" else request.getfixturevalue("killed").partial
    content = path.read_bytes()
    offsets = np.sort(np.random.default_rng(0).integers(0, len(content), 20))
    cut = tmp_path / "cut.rrd"
    lengths = []
    for offset in [*offsets, len(content) - 1]:
        cut.write_bytes(content[:offset])
        refused = ""
        try:
            lengths.append(len(load(cut, points=bool(offset % 2)).step))
        except BadInput as error:
            refused = str(error)
        assert "\n" not in refused
        assert not (refused and lengths), f"{offset}: less was readable than of a shorter piece"
        assert cut.read_bytes() == content[:offset]
    assert len(lengths) > 10
    assert lengths == sorted(lengths)


def test_a_whole_file_is_read_where_it_lies_and_a_cut_one_from_a_copy(recording: Path, tmp_path: Path) -> None:
    with whole(recording) as path:
        assert path == recording
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(recording.read_bytes()[:-7])
    with whole(cut) as path:
        assert path != cut
        assert path.stat().st_size <= cut.stat().st_size
    assert not path.exists()


def foreign(path: Path) -> None:
    with rr.RecordingStream("another program") as stream:
        stream.save(path)
        stream.set_time("step", sequence=0)
        stream.log("steps", rr.Scalars([1.0]))
        stream.log("stages/predict", rr.Points3D([[0, 0, 0]]))
        stream.flush()


@pytest.mark.parametrize("kind", ["garbage", "empty", "header", "foreign", "folder", "missing"])
def test_a_file_that_is_no_run_is_one_line(kind: str, cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "file.rrd"
    if kind == "foreign":
        foreign(path)
    elif kind == "folder":
        path.mkdir()
    elif kind != "missing":
        noise = np.random.default_rng(0).bytes(5000)
        path.write_bytes({"garbage": noise, "empty": b"", "header": b"RRF2" + noise}[kind])
    with pytest.raises(BadInput) as error:
        viz_estim.load(path)
    assert "\n" not in str(error.value)
    for arguments in (("show", path), ("snapshot", path, "-o", tmp_path / "a.png"),
                      ("export", path, "--to", "npz", "-o", tmp_path / "a.npz")):  # fmt: skip
        done = cli(*arguments)
        assert (done.code, done.out) == (2, "")
        assert done.err.startswith(f"viz-estim: {path}: ")
        assert done.err.count("\n") == 1
    assert sorted(os.listdir(tmp_path)) == ([] if kind == "missing" else ["file.rrd"])


def test_a_run_that_was_cut_off_has_whole_steps_alone(cli: Cli, tmp_path: Path) -> None:
    out, cut = tmp_path / "a.rrd", tmp_path / "cut.rrd"
    assert cli("run", "underwater-bayes", "--seed", 1, "--out", out).code == 0
    whole_run, content = load(out), out.read_bytes()
    lengths = set()
    for end in np.linspace(0.1, 0.95, 18):
        cut.write_bytes(content[: int(end * len(content))])
        if cli("show", cut).code:
            continue
        run = load(cut)
        lengths.add(len(run.step))
        for step in {int(run.step[0]), int(run.step[-1])}:
            assert [t.name for t, _ in run.at(step)] == [t.name for t, _ in whole_run.at(step)]
        for name, values in run.ends.items():
            np.testing.assert_array_equal(values, whole_run.ends[name][: len(run.step)])
        assert cli("diagnose", cut).code == 0
    assert lengths


@pytest.mark.parametrize(
    ("places", "last"),
    [
        ([[0, 2, 4], [1, 3, 5]], 2),
        ([[0, 2, 4], [1, 3]], 2),  # the last step may have had one stage
        ([[0, 2, 4], [1]], 0),
        ([[0], [1]], 0),
        ([[], []], 0),
    ],
)
def test_a_step_that_lacks_a_stage_is_not_whole(places: list[list[int]], last: int) -> None:
    tables = [
        StageTable(name, np.arange(len(at)), np.array(at, int), {}, {})
        for name, at in zip(("predict", "update"), places, strict=True)
    ]
    assert last_whole([np.array([0]), np.array([1, 2])], tables) == last
    assert last_whole([np.array([0, 1, 2])], tables) == (2 if last == 2 else -1)


@pytest.mark.parametrize("ended", ["well", "by an exception"])
def test_a_run_too_short_for_a_second_batch_has_its_view(ended: str, tmp_path: Path) -> None:
    space = Euclidean(["x"], "m")
    beliefs = [Gaussian(space, np.full(1, float(k)), np.eye(1)) for k in range(3)]
    scenario = Scenario(None, {0: beliefs[0]}, [Tick(float(k), 1.0) for k in range(3)])  # type: ignore[arg-type]
    fate = contextlib.nullcontext() if ended == "well" else pytest.raises(KeyError)
    path = tmp_path / "a.rrd"
    with fate, Recorder(path, scenario, {}) as recorder:
        for k, belief in enumerate(beliefs):
            recorder.add(Step(k, scenario.ticks[k], (Stage("think", belief),)))
        if ended != "well":
            raise KeyError
    assert len(RrdReader(path if ended == "well" else partial_of(path)).blueprints()) == 1


def test_two_runs_do_not_write_one_file(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "a.rrd"
    with claimed(partial_of(out)):
        done = cli("run", "underwater-bayes", "--out", out)
        assert (done.code, done.out) == (2, "")
        assert done.err.startswith(f"viz-estim: {partial_of(out)}: another run is recording there")
    assert not out.exists()
    assert cli("run", "underwater-bayes", "--out", out).code == 0
    assert not partial_of(out).exists()


def test_a_disk_that_is_full_is_one_line(cli: Cli, short: list[str], tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")  # not on every system
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, before[1]))
    try:
        done = cli("run", "imu-gyro", *short, "--out", tmp_path / "a.rrd")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (done.code, done.out) == (2, "")
    assert "is the disk full?" in done.err
    assert not (tmp_path / "a.rrd").exists()
