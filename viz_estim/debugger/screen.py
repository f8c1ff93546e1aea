"""The viewer beside a session. A thread of its own tells it where to stand: a window that is slow to draw holds up no
command, and catches up with the last one."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from viz_estim.recording.viewer import Viewer, ViewerError

_SHOWN_S = 10.0  # the longest wait until a window shows a recording that was begun, or the place that was asked for
# A recording's view is sent anew when it comes to know a stage, which puts the cursor back: while it is new, the cursor
# is looked at again.
_NEW, _BLUEPRINT_S = 3, 0.15
_LEAVE_S = 2.0  # the longest wait until the cursor stands where the session ended


class _Job(NamedTuple):
    branch: int | None  # that it moves in
    do: Callable[[Viewer], None]


class Screen:
    """The viewer beside a session, as long as there is one; what becomes of it is told once."""

    def __init__(self, viewer: Viewer | None) -> None:
        self._viewer = viewer
        self._locations: dict[int, str] = {}  # by branch
        self._seeks: dict[int, int] = {}  # how many, by branch
        self._behind = False  # told that the cursor did not follow
        self._jobs: deque[_Job] = deque()
        self._busy = False
        self._changed = threading.Condition(threading.RLock())
        if viewer:
            threading.Thread(target=self._follow, daemon=True).start()

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
        viewer = self._viewer
        if viewer and not viewer.alive:
            self.lose()
            return None
        return viewer.url if viewer else None

    def lose(self) -> None:
        """The viewer is gone, or does not answer."""
        with self._changed:
            viewer, self._viewer = self._viewer, None
            if viewer:
                _tell("the viewer is gone; going on without it")
            self._changed.notify_all()
        if viewer:
            with contextlib.suppress(Exception):
                viewer.close()

    def open(self, path: Path) -> None:
        """Shows a recording."""
        self._ask(_Job(None, lambda viewer: viewer.open(path)))

    def seek(self, branch: int, place: int) -> None:
        """Moves the cursor, in the branch's recording; places that it has not reached are passed over."""

        def move(viewer: Viewer) -> None:
            if branch in self._locations:
                viewer.show(self._locations[branch])
            else:  # its recording has just begun: it is the one that has come to the front
                self._locations[branch] = viewer.front(self._locations.values(), _SHOWN_S)
            viewer.seek("stage", place, _SHOWN_S)
            self._seeks[branch] = self._seeks.get(branch, 0) + 1
            if self._seeks[branch] <= _NEW:
                time.sleep(_BLUEPRINT_S)
                viewer.seek("stage", place, _SHOWN_S)

        self._ask(_Job(branch, move))

    def settle(self, seconds: float = _LEAVE_S) -> bool:
        """Waits until the viewer stands where it should; whether it does."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._viewer or not (self._jobs or self._busy), seconds)

    def leave(self) -> None:
        """Leaves the viewer to the person."""
        self.settle()
        with self._changed:
            viewer, self._viewer = self._viewer, None
            self._changed.notify_all()
        if viewer:
            viewer.detach()

    def _ask(self, job: _Job) -> None:
        with self._changed:
            if self._viewer:
                # Of branches that the viewer knows the last move alone matters; others are to be found first.
                self._jobs = deque(one for one in self._jobs if one.branch not in self._locations)
                self._jobs.append(job)
                self._changed.notify_all()

    def _follow(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or not self._viewer)
                viewer = self._viewer
                if not viewer:
                    return
                job, self._busy = self._jobs.popleft(), True
            try:
                job.do(viewer)
            except Exception as error:  # it costs the viewer, not the session
                self._failed(viewer, error)
            with self._changed:
                self._busy = False
                self._changed.notify_all()

    def _failed(self, viewer: Viewer, error: Exception) -> None:
        if viewer is not self._viewer:  # it was left, or lost, meanwhile
            return
        if not viewer.alive:
            self.lose()
        elif not self._behind and not self._jobs:  # it is slow, or shows something else: the next stop may do better
            self._behind = True
            _tell(f"the viewer's cursor did not follow ({error})")


def _tell(text: str) -> None:
    print(f"viz-estim: {text}", file=sys.stderr, flush=True)
