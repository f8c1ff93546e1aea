"""The branches of a session: a run, or what came of it with other parameters from some step on. Each that runs is
recorded as it goes, so that a kill leaves its file, and a viewer shows it."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from viz_estim.core.consistency import Tally
from viz_estim.core.run import Step
from viz_estim.debugger.forking import Part, properties
from viz_estim.debugger.live import Live
from viz_estim.debugger.recorded import Recorded
from viz_estim.debugger.sources import Source
from viz_estim.recording.recorder import Recorder
from viz_estim.recording.viewer import Viewer, ViewerError

_SHOWN_S = 5.0  # the longest wait until a viewer shows a recording that was begun


class Screen:
    """The viewer beside a session, as long as there is one; what becomes of it is told once."""

    def __init__(self, viewer: Viewer | None) -> None:
        self._viewer = viewer
        self._locations: dict[int, str] = {}  # by branch
        self._behind = False  # told that the cursor did not follow

    @classmethod
    def start(cls) -> Screen:
        """A viewer's window, or none and a word about it where it cannot be had."""
        try:
            return cls(Viewer.start(headless=False))
        except ViewerError as error:
            _tell(f"going on without a viewer: {error}")
            return cls(None)

    @property
    def url(self) -> str | None:
        """Where recordings are streamed to."""
        if self._viewer and not self._viewer.alive:
            self.lose()
        return self._viewer.url if self._viewer else None

    def lose(self) -> None:
        """The viewer is gone, or does not answer."""
        if self._viewer:
            with contextlib.suppress(Exception):
                self._viewer.close()
            self._viewer = None
            _tell("the viewer is gone; going on without it")

    def open(self, path: Path) -> None:
        """Shows a recording."""
        with self._attempt() as viewer:
            viewer.open(path)

    def seek(self, branch: int, place: int) -> None:
        """Moves the cursor, in the branch's recording."""
        with self._attempt() as viewer:
            if branch in self._locations:
                viewer.show(self._locations[branch])
            else:
                self._locations[branch] = viewer.front(self._locations.values(), _SHOWN_S)
            viewer.seek("stage", place)

    def leave(self) -> None:
        """Leaves the viewer to the person."""
        if self._viewer:
            self._viewer.detach()
            self._viewer = None

    @contextlib.contextmanager
    def _attempt(self) -> Iterator[Any]:
        """A context whose failure costs the viewer, not the session. Without a viewer nothing in it is done."""
        try:
            yield self._viewer or _Nobody()
        except ViewerError as error:
            if self._viewer and self._viewer.alive:  # it is slow, or shows something else: the next stop may do better
                if not self._behind:
                    _tell(f"the viewer's cursor did not follow ({error})")
                self._behind = True
            else:
                self.lose()


class _Nobody:
    """Stands for a viewer that is not there: takes every call."""

    def __getattr__(self, name: str) -> Any:
        return self

    def __call__(self, *arguments: object) -> str:
        return ""


class File:
    """The recording of a branch while it runs. Losing the viewer, it is written anew without it."""

    def __init__(self, path: Path, parts: list[Part], screen: Screen, source: Live) -> None:
        self.path, self._parts, self._screen, self._source = path, parts, screen, source
        path.parent.mkdir(parents=True, exist_ok=True)
        self._begin()

    def add(self, step: Step) -> None:
        """Takes in a step."""
        if self._watched and self._screen.url is None:
            self._anew()
        try:
            for missed in range(self._count, step.index):  # by an interrupt
                self._take(self._source.step(missed))
            self._take(step)
        except RuntimeError:  # Rerun's: the connection was severed
            if not self._watched:
                raise
            self._screen.lose()
            self._anew()

    def close(self) -> None:
        """Ends it well, with its figures."""
        try:
            self._recorder.close(self._result())
        except RuntimeError:
            if not self._watched:
                raise
            self._screen.lose()
            self._anew()
            self._recorder.close(self._result())

    def _anew(self) -> None:
        """Begins again, without the viewer; the steps so far are done again."""
        with contextlib.suppress(Exception):
            self._recorder.abort()
        self._recorder.partial.unlink(
            missing_ok=True
        )  # the severed stream may still hold it, and must not write into ours
        self._begin()
        for step in self._source.steps():
            self._take(step)

    def _begin(self) -> None:
        last = self._parts[-1]
        scenario = last.scenario
        url = self._screen.url
        self._watched = url is not None
        self._tally = Tally(scenario.space, max(scenario.beliefs), scenario.facts)
        self._count = self._stages = 0
        self._recorder = Recorder(self.path, scenario, properties(self._parts), live=url)

    def _take(self, step: Step) -> None:
        if step.index < self._count:  # taken already, with those before it, when the file was begun again
            return
        self._recorder.add(step)
        self._tally.add(step)
        self._count, self._stages = self._count + 1, self._stages + len(step.stages)

    def _result(self) -> dict[str, Any]:
        ticks, error = self._parts[-1].scenario.ticks, self._source.failure
        return {
            "steps": self._count,
            "stages": self._stages,
            "duration_s": ticks[max(self._count - 1, 0)].time - ticks[0].time,
            "error": {"step": error.step, "stage": error.stage, "message": error.message} if error else None,
            **self._tally.summary(),
        }


@dataclass
class Branch:
    """One of the runs of a session: what it is, since which step it differs from its parent, what it goes through.

    parts: how it is run again; None for a recording whose scenario nobody has looked for yet.
    """

    number: int
    about: str
    first: int
    parent: int | None
    source: Source
    parts: list[Part] | None = None
    file: File | None = None


def of_recording(path: Path, screen: Screen) -> Branch:
    """The branch that a recording is."""
    source = Recorded(path)
    screen.open(path)
    return Branch(1, f"{path}, as recorded", 0, None, source)


def of_parts(number: int, about: str, parts: list[Part], source: Live, screen: Screen, parent: int | None) -> Branch:
    """A branch that runs, and is recorded in `recordings/` as it does."""
    last = parts[-1]
    title = f"{last.plan.title()}-debug{'' if number == 1 else f'-{number}'}"
    file = File(Path("recordings") / f"{title}.rrd", parts, screen, source)
    for step in source.steps():
        file.add(step)
    source.told = file.add
    return Branch(number, about, last.first, parent, source, parts, file)


def _tell(text: str) -> None:
    print(f"viz-estim: {text}", file=sys.stderr, flush=True)
