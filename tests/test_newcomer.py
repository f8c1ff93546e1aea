"""What a newcomer stumbles over: files that are none, runs cut short at once, numbers that are none."""

import contextlib
import io
import runpy
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from conftest import Cli
from rerun.chunk import RrdReader

import viz_estim
from viz_estim.cli import entry
from viz_estim.recording.rescue import whole


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a person's own loop."""
    path = tmp_path_factory.mktemp("told") / "mine.rrd"
    with viz_estim.record(path, {"x": "m", "v": "m/s"}) as rec:
        for k in range(30):
            rec.stage("update", mean=[k, 1], cov=np.eye(2))
            rec.step(time=0.1 * k, truth=[k, 2])
    return path


def test_show_says_nothing_of_data_that_it_knows_nothing_of(told: Path, cli: Cli) -> None:
    done = cli("show", told)
    assert (done.code, done.err) == (0, "")
    assert "seed" not in done.out
    assert "set:" not in done.out
    assert "state_rmse_m             0\n" in done.out
    assert "state_rmse_mps           1\n" in done.out


@pytest.mark.filterwarnings("ignore::rerun.error_utils.RerunWarning")  # a file that was cut has no footer
def test_a_run_cut_off_before_its_first_stages_says_so(told: Path, tmp_path: Path, cli: Cli) -> None:
    content, cut = told.read_bytes(), tmp_path / "cut.rrd"
    end = next(n for n in range(10_000, len(content), 500) if _has_steps_alone(content[:n], cut))
    cut.write_bytes(content[:end])
    for command in (["show"], ["diagnose"], ["compare", told]):
        done = cli(*command, cut)
        assert (done.code, done.out) == (2, "")
        assert f"{cut}: the run was cut off before its first steps were written" in done.err


@pytest.mark.parametrize(("stages", "where"), [([], "before its first stage"), (["predict"], "after predict")])
def test_where_a_run_failed_is_told_in_words(stages: list[str], where: str, tmp_path: Path, cli: Cli) -> None:
    with contextlib.suppress(ZeroDivisionError), viz_estim.record(tmp_path / "a.rrd", ["x"]) as rec:
        for k in range(3):
            for stage in ["predict"] if k < 2 else stages:
                rec.stage(stage, mean=[0.0], cov=[[1.0]])
            rec.step(time=-1 / (k - 2))
    for command in ("show", "diagnose"):
        assert f"step 2, {where}: ZeroDivisionError" in cli(command, tmp_path / "a.rrd").out


def _has_steps_alone(content: bytes, path: Path) -> bool:
    path.write_bytes(content)
    with whole(path) as sound:
        entities = {chunk.entity_path for chunk in RrdReader(sound).stream()}
    return "/steps" in entities and not any(entity.startswith("/stages") for entity in entities)


@pytest.mark.parametrize("command", [["show"], ["diagnose"], ["snapshot", "-o", "a.png"], ["open"], ["debug"]])
def test_a_folder_is_no_recording(command: list[str], tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "runs.rrd").mkdir()
    done = cli(command[0], tmp_path / "runs.rrd", *command[1:])
    assert (done.code, done.out) == (2, "")
    assert "runs.rrd: is a folder, expected a recording" in done.err


def test_what_is_no_number_is_named(tmp_path: Path) -> None:
    rec = viz_estim.record(tmp_path / "a.rrd")
    with pytest.raises(ValueError, match="stage update: note: expected numbers, got 'turning'"):
        rec.stage("update", mean=[1], cov=[[1]], note="turning")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="stage update: mean: expected numbers, got 'fast'"):
        rec.stage("update", mean="fast", cov=[[1]])  # type: ignore[arg-type]
    rec.stage("update", mean=[1], cov=[[1]])
    with pytest.raises(ValueError, match="step 0: expected a time in seconds, got ndarray"):
        rec.step(time=np.arange(2.0))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="step 0: expected a time in seconds, got datetime"):
        rec.step(time=datetime(2026, 1, 1))  # type: ignore[arg-type]


def test_a_time_may_be_an_array_of_one(tmp_path: Path) -> None:
    with viz_estim.record(tmp_path / "a.rrd") as rec:
        for time in (np.array(0.5), np.array([0.75])):
            rec.stage("update", mean=np.array(1), cov=np.array(2))
            rec.step(time=time)  # type: ignore[arg-type]
    assert viz_estim.load(tmp_path / "a.rrd").time.tolist() == [0.5, 0.75]


def test_the_stamps_of_a_clock_are_told_in_full(tmp_path: Path, cli: Cli) -> None:
    with viz_estim.record(tmp_path / "a.rrd") as rec:
        for k in range(3):
            rec.stage("update", mean=[1], cov=[[1]])
            rec.step(time=1.7e9 + 0.5 * k)
    assert "no step at 0.5 s; it holds 1700000000 to 1700000001 s" in cli("show", tmp_path / "a.rrd", "--time", 0.5).err


def test_a_trajectory_without_a_number_is_refused(tmp_path: Path, cli: Cli) -> None:
    with viz_estim.record(tmp_path / "a.rrd", {"x": "m", "y": "m"}) as rec:
        rec.stage("update", mean=[np.nan] * 2, cov=np.eye(2))
        rec.step(time=0)
    done = cli("export", tmp_path / "a.rrd", "--to", "tum", "-o", tmp_path / "a.tum")
    assert (done.code, done.out) == (2, "")
    assert "no trajectory" in done.err


@pytest.fixture(scope="module")
def told_in_greek(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of which commands say σ and ×."""
    path = tmp_path_factory.mktemp("greek") / "a.rrd"
    with viz_estim.record(path, {"x": "m"}) as rec:
        for k in range(40):
            rec.stage("update", mean=[0], cov=[[1]], residual=[9.0], residual_cov=[[1]], gain=[[0.1]])
            rec.step(time=k)
    return path


@pytest.mark.parametrize("command", [["show", "--step", "1"], ["diagnose"], ["compare"]])
@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252"])
def test_a_terminal_of_another_alphabet_shows_what_it_can(
    command: list[str], encoding: str, told_in_greek: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [told_in_greek] * (2 if command == ["compare"] else 1)
    more = ["--out", tmp_path / "b.rrd"] if command == ["compare"] else []
    arguments = [command[0], *files, *command[1:], *more]
    monkeypatch.setattr(sys, "argv", ["viz-estim", *(str(argument) for argument in arguments)])
    streams = {name: io.TextIOWrapper(io.BytesIO(), encoding=encoding) for name in ("stdout", "stderr")}
    for name, stream in streams.items():
        monkeypatch.setattr(sys, name, stream)
    with pytest.raises(SystemExit) as ended:
        entry()
    assert ended.value.code in (0, 1)
    streams["stdout"].seek(0)
    assert "?" in streams["stdout"].read() or command == ["compare"]


def test_the_package_is_a_program(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["viz-estim", "show", "nowhere.rrd"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("viz_estim", run_name="__main__")
    assert ended.value.code == 2
    assert "nowhere.rrd: no such recording" in capsys.readouterr().err


PRESSED = """
import signal, sys
class Pressed:
    def find_spec(self, name, *rest):
        if name == "numpy":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Pressed())
sys.argv = ["viz-estim", "list"]
"""


@pytest.mark.parametrize(
    "how",
    ["import viz_estim.__main__ as m; m.entry()", "import runpy; runpy.run_module('viz_estim', run_name='__main__')"],
)
def test_ctrl_c_while_modules_are_read_is_as_quiet_as_later(how: str) -> None:
    done = subprocess.run([sys.executable, "-c", PRESSED + how], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "viz-estim: interrupted\n")
