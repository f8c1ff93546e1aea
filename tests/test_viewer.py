"""A real headless viewer: what it opens, where its cursor stands, what it draws, where it listens, how it ends."""

import io
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil  # type: ignore[import-untyped]
import pytest
import rerun as rr
import rerun.blueprint as rrb
from PIL import Image

from viz_estim.recording import viewer as viewer_module
from viz_estim.recording.viewer import Viewer, ViewerError, open_files, snapshot

pytestmark = pytest.mark.draws

SIZE = (600, 409)
STEPS = 200
Picture = Callable[[str, float], bytes]
BAD_FILES = {
    "missing": "no such file",
    "cut": "was cut off before any data",
    "header": "has no data",
    "empty": "has no data",
    "noise": "(Not an RRD file",
}


def write_recording(path: Path) -> Path:
    """A point that circles while its height is plotted; two stages a step, so that step 100 is stage 201 and 10 s."""
    views = [rrb.Spatial3DView(origin="/world", name="World"), rrb.TimeSeriesView(origin="/plot", name="Plot")]
    blueprint = rrb.Blueprint(rrb.Horizontal(*views), rrb.TimePanel(timeline="step"), auto_views=False)
    k = np.arange(STEPS)
    turn = k * 2 * np.pi / STEPS
    timelines = [
        rr.TimeColumn("step", sequence=k),
        rr.TimeColumn("time", duration=(k * 100_000_000).astype("timedelta64[ns]")),
        rr.TimeColumn("stage", sequence=2 * k + 1),
    ]
    positions = np.stack([np.cos(turn), np.sin(turn), turn], axis=-1).astype(np.float32)
    with rr.RecordingStream("viz_estim_test_viewer", recording_id="circle") as stream:
        stream.save(path, default_blueprint=blueprint)
        points = rr.Points3D.columns(positions=positions, radii=np.full(STEPS, 0.2))
        stream.send_columns("/world/point", indexes=timelines, columns=points)
        stream.send_columns("/plot/height", indexes=timelines, columns=rr.Scalars.columns(scalars=turn))
        stream.flush()
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("viewer") / "circle.rrd")


@pytest.fixture(scope="module")
def viewer(recording: Path) -> Iterator[Viewer]:
    display = {name: os.environ.pop(name) for name in ("DISPLAY", "WAYLAND_DISPLAY") if name in os.environ}
    with Viewer.start(headless=True, size=SIZE) as started:
        started.open(recording)
        yield started
    os.environ.update(display)


@pytest.fixture
def picture(viewer: Viewer, recording: Path, tmp_path: Path) -> Picture:
    def take(timeline: str, value: float) -> bytes:
        viewer.seek(timeline, value)
        assert viewer.snapshot(tmp_path / "now.png")
        return (tmp_path / "now.png").read_bytes()

    return take


def assert_one_line(error: pytest.ExceptionInfo[ViewerError], *words: str) -> None:
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 300
    for word in words:
        assert word in text


def share_that_differs(one: bytes, other: bytes) -> float:
    """The share of pixels that differ visibly."""
    a, b = (np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), dtype=int) for png in (one, other))
    return float((np.abs(a - b).max(-1) > 24).mean())


def assert_same_picture(one: bytes, other: bytes) -> None:
    # The renderer may smooth an edge or place a label differently from frame to frame.
    assert share_that_differs(one, other) < 0.0005


def gone(process: psutil.Process) -> bool:
    """An orphan that nobody has waited for yet counts as gone."""
    try:
        return bool(process.status() == psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return True


def processes_of(viewer: Viewer) -> list[psutil.Process]:
    root = psutil.Process(viewer._process.pid)
    return [root, *root.children(recursive=True)]


@pytest.mark.parametrize(("timeline", "one", "other"), [("step", 20, 120), ("time", 2.0, 12.0), ("stage", 41, 241)])
def test_a_moment_has_one_picture(picture: Picture, timeline: str, one: float, other: float) -> None:
    first, second, again = picture(timeline, one), picture(timeline, other), picture(timeline, one)
    assert_same_picture(first, again)
    assert share_that_differs(first, second) > 0.001


def test_none_is_the_end(viewer: Viewer, picture: Picture, tmp_path: Path) -> None:
    at_the_end = picture("step", STEPS - 1)
    viewer.seek("step", 3)
    viewer.seek("step")
    viewer.snapshot(tmp_path / "end.png")
    assert_same_picture((tmp_path / "end.png").read_bytes(), at_the_end)


def test_picture_has_the_asked_size_and_leaves_nothing_beside_it(viewer: Viewer, tmp_path: Path) -> None:
    assert viewer.snapshot(tmp_path / "a.png")
    content = (tmp_path / "a.png").read_bytes()
    assert content.startswith(b"\x89PNG")
    assert struct.unpack(">II", content[16:24]) == SIZE
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_picture_that_cannot_be_written(viewer: Viewer, tmp_path: Path) -> None:
    with pytest.raises(ViewerError) as error:
        viewer.snapshot(tmp_path / "nowhere" / "a.png")
    assert_one_line(error, "nowhere/a.png", "cannot be written")


def test_views_draw_without_problems(viewer: Viewer, picture: Picture) -> None:
    picture("step", 50)
    assert sorted(viewer.views()) == [("Plot", "TimeSeries", True), ("World", "3D", True)]
    assert viewer.problems() == []


@pytest.mark.parametrize(
    ("timeline", "value", "words"), [("tick", 3, "'tick'; choose from: "), ("time", 99.0, "0 to 19.9")]
)
def test_a_moment_that_is_not_there(viewer: Viewer, timeline: str, value: float, words: str) -> None:
    with pytest.raises(ViewerError) as error:
        viewer.seek(timeline, value)
    assert_one_line(error, words)


def test_listens_on_this_machine_alone(viewer: Viewer) -> None:
    connections = [c for process in processes_of(viewer) for c in process.net_connections(kind="inet")]
    listening = [c.laddr for c in connections if c.status == psutil.CONN_LISTEN]
    assert {address.ip for address in listening} == {"127.0.0.1"}
    assert f":{listening[0].port}/" in viewer.url


def test_a_live_run_is_followed(recording: Path) -> None:
    with Viewer.start(headless=True, size=(400, 300)) as viewer:
        stream = rr.RecordingStream("viz_estim_test_live")
        stream.connect_grpc(viewer.url)
        for step in range(3):
            indexes = [rr.TimeColumn("step", sequence=[step])]
            stream.send_columns("/plot/x", indexes=indexes, columns=rr.Scalars.columns(scalars=[float(step)]))
            viewer.seek("step", step)
        stream.disconnect()


def test_files_that_are_no_recordings(
    viewer: Viewer, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(viewer_module, "LOAD_S", 1e9)  # that a file has no data is not found by waiting
    (tmp_path / "cut.rrd").write_bytes(recording.read_bytes()[:3000])
    (tmp_path / "header.rrd").write_bytes(recording.read_bytes()[:12])
    (tmp_path / "empty.rrd").write_bytes(b"")
    (tmp_path / "noise.rrd").write_bytes(np.random.default_rng(0).bytes(4000))
    for name, words in BAD_FILES.items():
        with pytest.raises(ViewerError) as error:
            viewer.open(tmp_path / f"{name}.rrd")
        assert_one_line(error, f"{name}.rrd", words)
    assert any("noise.rrd" in problem and "\n" not in problem for problem in viewer.problems())
    viewer.open(recording)  # which is still there
    assert viewer.problems() == []


def test_snapshot_and_close_leave_no_process(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started = []

    class Popen(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            started.append(psutil.Process(self.pid))

    monkeypatch.setattr(subprocess, "Popen", Popen)
    assert snapshot(recording, tmp_path / "b.png", timeline="time", value=2.0, size=(640, 480)) == []
    assert struct.unpack(">II", (tmp_path / "b.png").read_bytes()[16:24]) == (640, 480)
    assert started
    assert not any(process.is_running() for process in started)


def test_viewer_killed_behind_our_back(recording: Path) -> None:
    viewer = Viewer.start(headless=True, size=(400, 300))
    viewer.open(recording)
    family = processes_of(viewer)
    assert viewer.alive
    os.killpg(viewer._process.pid, signal.SIGKILL)
    with pytest.raises(ViewerError) as error:
        viewer.seek("step", 3)
    assert_one_line(error, "ended", "start it again")
    assert not viewer.alive
    viewer.close()
    viewer.close()
    assert all(gone(process) for process in family)
    with pytest.raises(ViewerError, match="closed"):
        viewer.views()


def test_viewer_goes_when_its_owner_is_killed() -> None:
    code = "v = Viewer.start(headless=True); print(v._process.pid, flush=True); input()"
    command = [sys.executable, "-c", f"from viz_estim.recording.viewer import Viewer; {code}"]
    owner = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert owner.stdout is not None
    process = psutil.Process(int(owner.stdout.readline()))
    owner.kill()
    owner.communicate()
    deadline = time.monotonic() + 5
    while not gone(process) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert gone(process)


def test_detached_viewer_outlives_its_owner() -> None:
    code = "v = Viewer.start(headless=True); v.detach(); v.close(); print(v._process.pid)"
    command = [sys.executable, "-c", f"from viz_estim.recording.viewer import Viewer; {code}"]
    process = psutil.Process(int(subprocess.run(command, capture_output=True, check=True).stdout))
    try:
        time.sleep(0.3)
        assert not gone(process)
    finally:
        process.kill()


def test_no_graphics_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setenv(variable, "/nonexistent")
    monkeypatch.setenv("WGPU_BACKEND", "vulkan")
    with pytest.raises(ViewerError) as error:
        Viewer.start(headless=True)
    assert_one_line(error, "apt-get install mesa-vulkan-drivers")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems always have a display")
def test_open_files_without_a_display(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerError) as error:
        open_files([recording])
    assert_one_line(error, "--web", "viz-estim snapshot")
    monkeypatch.setenv("DISPLAY", ":9999")  # one that nobody serves
    with pytest.raises(ViewerError) as error:
        open_files([recording])
    assert_one_line(error, "--web", "viz-estim snapshot")


def test_open_files_on_the_web(recording: Path) -> None:
    code = "import sys; from viz_estim.recording.viewer import open_files; open_files(sys.argv[1:], web=True)"
    command = [sys.executable, "-c", code, str(recording)]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"BROWSER": "true"})
    try:
        assert server.stdout is not None
        address = server.stdout.readline()
        assert address.startswith("http://127.0.0.1:")
        family = psutil.Process(server.pid).children(recursive=True)
        connections = [c for p in family for c in p.net_connections(kind="inet")]
        assert {c.laddr.ip for c in connections if c.status == psutil.CONN_LISTEN} == {"127.0.0.1"}
        server.send_signal(signal.SIGINT)
        server.communicate(timeout=10)
        assert server.returncode == 0
        assert all(gone(process) for process in family)
    finally:  # were it left behind, it would take a core for itself
        server.kill()
        server.wait()
