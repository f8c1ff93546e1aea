"""Batches of steps, written by a thread of its own while the filter goes on: numpy and a search in a tree leave a
second core to it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

from viz_estim.core.run import Step

_WAITING = 1  # batches at most; a filter that is faster than its recording waits for that


class Writer:
    """Gathers steps into batches of `limit`, or of what came within `patience` seconds, and calls write(steps) with
    each in turn; settle() when none is left for the moment.

    What either of them raises comes out of the next `add`, or of `stop`.
    """

    def __init__(
        self, write: Callable[[list[Step]], None], settle: Callable[[], None], limit: int, patience: float
    ) -> None:
        self.limit = limit
        self._write, self._settle, self._patience = write, settle, patience
        self._steps: list[Step] = []
        self._oldest = 0.0  # when the first of them came
        self._due: deque[list[Step]] = deque()
        self._changed = threading.Condition()
        self._failed: Exception | None = None
        self._stopped = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def add(self, step: Step) -> None:
        """Takes in a step."""
        with self._changed:
            if not self._steps:
                self._oldest = time.monotonic()
            self._steps.append(step)
            if len(self._steps) >= self.limit:
                self._hand_over()
                self._changed.wait_for(lambda: len(self._due) <= _WAITING or self._failed)
            self._raise()

    def stop(self) -> None:
        """Writes what is left; nothing may be added after it."""
        with self._changed:
            self._stopped = True
            self._hand_over()
        self._thread.join()
        self._raise()

    def _hand_over(self) -> None:
        if self._steps:
            self._due.append(self._steps)
            self._steps = []
        self._changed.notify_all()

    def _raise(self) -> None:
        if self._failed:
            raise self._failed

    def _work(self) -> None:
        settled = True
        try:
            while (batch := self._next()) is not None:
                if batch:
                    self._write(batch)
                    settled = False
                    with self._changed:
                        self._due.popleft()
                        self._changed.notify_all()
                elif not settled:
                    self._settle()
                    settled = True
        except Exception as error:  # told in the thread that can act on it
            with self._changed:
                self._failed = error
                self._changed.notify_all()

    def _next(self) -> list[Step] | None:
        """The batch that is due; an empty one where none is, None where none will be."""
        with self._changed:
            if not self._due and not self._stopped:
                self._changed.wait(self._patience / 8)
            if not self._due and self._steps and time.monotonic() - self._oldest >= self._patience:
                self._hand_over()
            if self._due:
                return self._due[0]
            return None if self._stopped else []
