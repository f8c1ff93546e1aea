"""One Rerun viewer process (POSIX): nothing else knows `rerun.experimental.ViewerClient` and the rerun program."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import rerun_cli
from rerun.experimental import ViewerClient, ViewerState

from viz_estim.errors import one_line
from viz_estim.recording import links
from viz_estim.recording.moments import goal_of, polls
from viz_estim.recording.rescue import has_rows, whole

# The longest waits, for slow machines: until it answers, for a moment that is not there yet, until a file is loaded.
ANSWER_S, SEEK_S, LOAD_S, LOAD_BYTES_PER_S = 30.0, 2.0, 10.0, 10e6
SETTLING_FRAMES = 8  # before a picture that may be the last one; most layouts are done after three

# What it logs also pops up in the picture for seconds. Let through are the lines with its address, warnings and errors,
# but not the warnings at its start, which are about the machine: no graphics card, a container.
QUIET = "egui_wgpu=error,re_renderer::context=error,re_viewer::native=error"
LOG = f"warn,re_grpc_server=info,re_sdk::web_viewer=info,{QUIET}"
_RETAKEN = "Failed to render screenshot"  # on a machine that is too busy: another was taken
Size = tuple[int, int]  # width, height in pixels


class ViewerError(RuntimeError):
    """The viewer could not do what was asked: one line, with the remedy."""


class Viewer(contextlib.AbstractContextManager["Viewer"]):
    """A viewer that lives as long as its context: `with Viewer.start(headless=True) as viewer: viewer.open(path)`."""

    _client: ViewerClient

    def __init__(self, *arguments: str, ready: str) -> None:
        """Starts rerun and waits until it prints `ready`, a pattern whose group is its address."""
        # The native program, for `rerun` on the path is a script with a child. Port 0: the system picks a free one.
        program = next(Path(rerun_cli.__file__).parent.rglob("[Rr]erun"), "rerun")
        command = [str(program), "--bind", "127.0.0.1", "--port", "0", *arguments]
        self._closed, self._seen = False, 0  # the last of the viewer's log entries that we don't report
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the viewer
        streams: dict[str, Any] = {"stdout": self._log, "stderr": self._log, "start_new_session": True}
        environment = os.environ | {"RUST_LOG": LOG, "NO_COLOR": "1"}
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, env=environment, **streams)
        # Were we killed, nobody would call close: the guard ends the viewer when our end of its pipe goes away.
        guard = ["/bin/sh", "-c", 'read line || kill -s KILL -- "-$0"', str(self._process.pid)]
        self._guard: subprocess.Popen[bytes] = subprocess.Popen(guard, stdin=subprocess.PIPE, **streams)
        for _ in polls(ANSWER_S):
            if (found := re.search(ready, self._printed())) or not self.alive:
                break
        if not found:
            problem = self._ended()
            self.close()
            raise problem
        self.url = found[1]  # for a run that goes on: `stream.connect_grpc(viewer.url)`

    @classmethod
    def start(cls, *, headless: bool, size: Size = (1600, 1000)) -> "Viewer":
        """Starts a viewer of `size` (width, height) pixels, with no window if `headless`, and waits for its answer."""
        options = ["--window-size", f"{size[0]}x{size[1]}", "--hide-welcome-screen"] + ["--headless"] * headless
        with contextlib.ExitStack() as undo:
            viewer = undo.enter_context(cls(*options, ready=r"Listening for gRPC .*`rerun --connect (\S+)`"))
            viewer._client = viewer._ask(ViewerClient.connect, viewer.url)
            viewer._state()  # answered by the window's loop
            undo.pop_all()
        return viewer

    @property
    def alive(self) -> bool:
        """Whether the viewer's process runs."""
        return self._process.poll() is None

    def open(self, *paths: str | Path) -> None:
        """Opens recordings, waits until each has loaded, and stops the cursor, for the viewer plays what it opens."""
        for path in map(_existing, paths):
            with whole(path) as sound:  # of a run that was killed, what is sound
                self._load(path, sound)

    def _load(self, path: Path, sound: Path) -> None:
        nothing = f"{path}: has no data on any timeline; is it a recording?"
        if not has_rows(sound):  # the viewer would never say so
            was_cut = f"{path}: was cut off before any data was written; record it again"
            raise ViewerError(nothing if sound == path else was_cut)
        self._forget()
        known = {recording.store_id for recording in self._state().recordings}
        opened = self._ask(self._client.open, str(sound)).store_ids
        for _ in polls(LOAD_S + path.stat().st_size / LOAD_BYTES_PER_S):
            state = self._state()
            new = [r for r in state.recordings if (r.store_id in opened if opened else r.store_id not in known)]
            # A recording is listed from its first message on, and has timelines only once its data is there.
            if new and not state.loading and all(recording.timelines for recording in new):
                break
            if not new and (errors := self._logged("ERROR")):  # "Failed to … File path: P: CAUSE File path: P"
                cause = errors[-1].removesuffix(f" File path: {sound}").split(f"{sound}: ")[-1]
                raise ViewerError(f"{path}: damaged or not a recording ({cause}); record it again")
        else:
            raise ViewerError(nothing)
        self._ask(self._client.set_time, play_state="paused")
        for recording in new:
            blueprint = self._ask(self._client.get_blueprint, store_id=recording.store_id).blueprint
            if linked := links.moving(blueprint, state.catalog_url or "", recording.store_id):
                self._ask(self._client.set_blueprint, linked, store_id=recording.store_id)

    def seek(self, timeline: str, value: float | None = None, seconds: float = SEEK_S) -> None:
        """Moves the front recording's cursor, and waits until it is there; a moment still on its way is waited for.

        `step` and `stage` are counted from 0, `time` is in seconds; None is the timeline's end. seconds: the longest
        wait for a moment that is not there yet; one that is there is gone to however slow the viewer draws.
        """
        sent = None
        for waited in polls(max(seconds, ANSWER_S)):
            state = self._state()
            goal, at, problem = goal_of(state, timeline, value)
            if goal is None and waited >= seconds:
                break
            if goal is not None:
                if sent == goal == at:
                    return
                # `sequence` passes the integer as it is, on timelines of every kind.
                self._ask(self._client.set_time, timeline, sequence=goal[1], play_state="paused")
                sent = goal
        raise ViewerError(problem)

    def front(self, but: Collection[str] = (), seconds: float = LOAD_S) -> str:
        """The location of the recording in front, for `show`; waits until it has data and is none of `but`."""
        for _ in polls(seconds):
            with contextlib.suppress(ViewerError):  # nothing is open yet
                state = self._state()
                there = any(one.store_id == state.active_recording and one.timelines for one in state.recordings)
                location: str = self._ask(self._client.get_location) if there else ""
                if location and location not in but:
                    return location
            if not self.alive:
                raise self._ended()
        raise ViewerError("the viewer does not show the recording")

    def show(self, location: str) -> None:
        """Brings a recording to the front."""
        self._ask(self._client.set_location, location)

    def cursor(self) -> tuple[str | None, int | None]:
        """The timeline of the recording in front, and where on it the cursor stands: a count, or nanoseconds."""
        state = self._state()
        fronts = [one for one in state.recordings if one.store_id == state.active_recording]
        return (fronts[0].current_timeline, fronts[0].current_time) if fronts else (None, None)

    def problems(self) -> list[str]:
        """What views could not draw, and what the viewer warned of since the newest `open`: a line each."""
        reports = [(view.name, report) for view in self._state().views for report in view.reports]
        lines = [f"{name}: {report.severity}: {report.summary} {report.details or ''}" for name, report in reports]
        return [one_line(line) for line in lines] + self._logged("WARN", "ERROR")

    def views(self) -> list[tuple[str, str, bool]]:
        """Name, class (`3D`, `TimeSeries`, …) and visibility of each view of the blueprint in front."""
        return [(view.name, view.view_class, view.visible) for view in self._state().views]

    def snapshot(self, path: str | Path, settle: float = 30.0) -> bool:
        """Writes the whole viewer as a PNG, whole or not at all; False if it still changed after `settle` seconds."""
        png, path, part = b"", Path(path), Path(f"{path}.{os.getpid()}.part")
        for _ in polls(settle):
            self._pass_frames()
            before, png = png, self._ask(self._client.take_screenshot)
            if still := png == before and not self._state().loading:
                break
        try:
            part.write_bytes(png)
            part.replace(path)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise ViewerError(f"{path}: cannot be written ({error.strerror}); choose another place") from error
        return still

    def detach(self) -> None:
        """Leaves the viewer to a person: it outlives us."""
        self._guard.communicate(b"\n")  # a line, and not the pipe's end: the guard goes without a kill
        self._closed = True
        self._log.close()

    def close(self, *exception: object) -> None:
        """Ends the viewer with all its processes; it may be dead already, or closed."""
        if not self._closed:
            self._closed = True
            self._guard.kill()
            self._guard.communicate()
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._log.close()

    __exit__ = close

    def _ask(self, method: Callable[..., Any], *arguments: object, **options: object) -> Any:
        if self._closed:
            raise ViewerError("the viewer was closed; start another")
        began = time.monotonic()
        try:
            while True:
                try:
                    return method(*arguments, **options)
                except TimeoutError:  # it is busy drawing
                    if not self.alive or time.monotonic() > began + ANSWER_S:
                        raise
        except (OSError, RuntimeError, ValueError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):  # a connection breaks before its process has ended
                self._process.wait(1.0)
            refused = ViewerError(f"the viewer refused ({str(error).splitlines()[0]}); try again")
            raise (refused if self.alive else self._ended()) from error

    def _state(self) -> ViewerState:
        return self._ask(self._client.get_state)

    def _pass_frames(self) -> None:
        """Lets the viewer load chunks and lay out plots, which it does over several frames.

        A frame that nobody takes a picture of is not rendered: without a graphics card that is a fiftieth of the work.
        """
        for _ in range(SETTLING_FRAMES):
            self._state()
            time.sleep(0.02)

    def _forget(self) -> None:
        self._seen = max((entry.sequence for entry in self._ask(self._client.get_logs)), default=0)

    def _logged(self, *levels: str) -> list[str]:
        known = [entry for entry in self._ask(self._client.get_logs, self._seen) if entry.level in levels]
        entries = [entry for entry in known if not entry.message.startswith(_RETAKEN)]
        return [one_line(f"viewer: {entry.level.lower()}: {entry.message}") for entry in entries]

    def _printed(self) -> str:
        return os.pread(self._log.fileno(), 1 << 20, 0).decode(errors="replace")  # seek would move the viewer's offset

    def _ended(self) -> ViewerError:
        log = self._printed()
        if "No graphics adapter was found" in log or "Failed to get render context" in log:
            return ViewerError("the viewer found no graphics driver: apt-get install mesa-vulkan-drivers")
        if "EventLoopError" in log:
            return ViewerError("the viewer cannot reach the display: use --web, or viz-estim snapshot for a picture")
        lines = [line for line in log.splitlines() if re.match("Error|.*(panicked| ERROR )", line)]
        return ViewerError(
            f"the viewer has ended ({lines[-1] if lines else 'it was killed or closed'}); start it again"
        )


def snapshot(
    recording: Path, png: Path, *, timeline: str = "step", value: float | None = None, size: Size = (1600, 1000)
) -> list[str]:
    """Draws one moment of a recording (`Viewer.seek`) without a display; returns `Viewer.problems`."""
    with Viewer.start(headless=True, size=size) as viewer:
        viewer.open(recording)
        viewer.seek(timeline, value)
        still = viewer.snapshot(png)
        return viewer.problems() + ([] if still else ["viewer: warning: the picture had not settled when it was taken"])


def open_files(paths: list[Path], *, web: bool = False) -> None:
    """Opens recordings for a person: in a window that outlives us, or with `web` in a page served until Ctrl-C."""
    files = [_existing(path) for path in paths]
    if web:
        with contextlib.ExitStack() as stack:
            sound = [str(stack.enter_context(whole(file))) for file in files]
            options = ["--web-viewer", "--web-viewer-port", "0", *sound]
            server = stack.enter_context(Viewer(*options, ready=r"Hosting a web-viewer .* connect at (\S+)"))
            print(f"{server.url}\nCtrl-C ends it", flush=True)
            with contextlib.suppress(KeyboardInterrupt):
                server._process.wait()
                raise server._ended()
    elif sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError("there is no display: use --web for a browser, or viz-estim snapshot for a picture")
    else:
        with Viewer.start(headless=False) as viewer:
            viewer.open(*files)
            viewer.detach()


def _existing(path: str | Path) -> Path:
    if Path(path).is_dir():
        raise ViewerError(f"{path}: is a folder, expected a recording")
    if not Path(path).is_file():
        raise ViewerError(f"{path}: no such file; viz-estim run writes recordings")
    return Path(path).resolve()
