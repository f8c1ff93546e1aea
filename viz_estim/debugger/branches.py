"""The branches of a session: a run, or what came of it with other parameters from some step on. Each that runs is
recorded as it goes, so that a kill leaves its file, and a viewer shows it."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from viz_estim.core.consistency import Tally
from viz_estim.core.run import Step
from viz_estim.debugger.forking import Part, properties
from viz_estim.debugger.live import Live
from viz_estim.debugger.recorded import Recorded
from viz_estim.debugger.screen import Screen
from viz_estim.debugger.sources import Source
from viz_estim.recording.recorder import Recorder, partial_of


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
        self._recorder.partial.unlink(missing_ok=True)  # the severed stream may hold it, and must not write into ours
        self._begin()
        for step in self._source.steps():
            self._take(step)

    def _begin(self) -> None:
        last = self._parts[-1]
        scenario = last.scenario
        self._tally = Tally(scenario.space, max(scenario.beliefs), scenario.facts)
        self._count = self._stages = 0
        url = self._screen.url
        self._watched = url is not None
        try:
            self._recorder = Recorder(self.path, scenario, properties(self._parts), live=url)
        except RuntimeError:  # the viewer has just gone
            if not self._watched:
                raise
            self._screen.lose()
            partial_of(self.path).unlink(missing_ok=True)  # as above
            self._begin()

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
    path, again = Path("recordings") / f"{title}.rrd", 1
    while partial_of(path).exists():  # of another session: it goes on, or was killed
        path, again = path.with_name(f"{title}_{again + 1}.rrd"), again + 1
    file = File(path, parts, screen, source)
    for step in source.steps():
        file.add(step)
    source.told = file.add
    return Branch(number, about, last.first, parent, source, parts, file)
