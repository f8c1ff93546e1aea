"""What several test files share: the command line in process, one short recorded run, the real data where it is."""

import contextlib
import functools
import gc
import io
import json
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from viz_estim.cli import main
from viz_estim.recording.viewer import Viewer, ViewerError

# Half a second of work: still, then turning, then the gyro freezes while it turns.
SHORT = ["data.duration=6", "data.still=1", "data.freeze=1.5"]
# The same as short as the story can be.
SHORTEST = ["data.duration=3.5", "data.still=0.5", "data.freeze=1.5"]


class Result(NamedTuple):
    """What a command left: its exit code and its two outputs."""

    code: int
    out: str
    err: str


Cli = Callable[..., Result]


def run_main(*arguments: object) -> Result:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings(record=True) as told:
        code = main([str(argument) for argument in arguments])
    # Outside of tests a warning is two lines on stderr.
    shown = [f"{w.filename}: {w.message}\n" for w in told if not issubclass(w.category, DeprecationWarning)]
    return Result(code, out.getvalue(), err.getvalue() + "".join(shown))


def strict(done: Result) -> dict[str, Any]:
    """The one JSON object that a command printed; NaN and infinity are no JSON."""

    def no(text: str) -> None:
        raise AssertionError(f"{text} is no JSON")

    assert (done.code, done.err) == (0, "")
    value = json.loads(done.out, parse_constant=no)
    assert isinstance(value, dict)
    return value


@pytest.fixture(scope="session")
def cli() -> Cli:
    """`cli("show", path, "--json")` runs the command line in this process."""
    return run_main


@pytest.fixture(scope="session")
def short() -> list[str]:
    """Options of `run` that make its simulated data short."""
    return [*(f"--set={setting}" for setting in SHORT), "--seed", "3"]


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory, short: list[str]) -> Path:
    """A short run of imu-ukf, written by the command line."""
    path = tmp_path_factory.mktemp("recording") / "short.rrd"
    done = run_main("run", "imu-ukf", *short, "--out", path)
    assert (done.code, done.err) == (0, "")
    return path


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of measurements that nobody here made up; it is no part of the project."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no real data beside the project")
    return folder


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    yield
    assert "DISPLAY" not in os.environ


@functools.cache
def _why_nothing_draws() -> str | None:
    try:
        Viewer.start(headless=True, size=(200, 200)).close()
    except ViewerError as error:
        return str(error)
    return None


def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores: tests of the viewer and of other processes wait for them."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return cores + 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long tests begin first: begun last, one would keep a single worker busy when all others have ended."""
    items.sort(key=lambda item: item.get_closest_marker("long") is None)


def pytest_collection_finish() -> None:
    """What is imported stays: the garbage collector need not go through it again and again (4 % of all time)."""
    gc.collect()
    gc.freeze()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Tests that draw are skipped where no graphics adapter is, but not in CI: there that is a failure."""
    draws = item.get_closest_marker("draws") is not None
    if draws and not os.environ.get("CI") and (why := _why_nothing_draws()):
        pytest.skip(why)
