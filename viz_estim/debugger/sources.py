"""What a debugger moves through, run or recorded.

A place is a moment's number on the `stage` timeline; each kind of source gives the frame that stands there.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.run import Failure
from viz_estim.debugger.quantities import Frame


class NoSuchPlace(ValueError):
    """The run has no such moment: one line that says what it has."""


class Source(Protocol):
    """A run as a debugger sees it; steps count from 0, places from 0 over all stages."""

    def span(self, step: int) -> range:
        """The places of a step's stages; one where it has none. NoSuchPlace where the run ends before."""
        ...

    def step_at(self, time: float) -> int:
        """The last step at or before a time (s)."""
        ...

    def frame(self, place: int) -> Frame:
        """The stage at a place; its name is empty where the step has none."""
        ...

    def ahead(self, place: int) -> Iterator[list[Frame]]:
        """The frames after a place, block by block; those of a block are of several stages and come in no order."""
        ...

    def behind(self, place: int) -> Iterator[list[Frame]]:
        """The frames before a place, the last block first."""
        ...

    @property
    def times(self) -> Array:
        """The stamps of all steps that may come (s)."""
        ...

    @property
    def reached(self) -> int:
        """The last step that is known so far."""
        ...

    @property
    def failure(self) -> Failure | None:
        """What ended the run, if it failed and is known to have."""
        ...


def step_at(times: Array, time: float) -> int:
    """The last step at or before a time; NoSuchPlace a second beyond the stamps."""
    step = int(np.searchsorted(times, time + 5e-10, side="right")) - 1  # recorded stamps are whole nanoseconds
    if step < 0 or time > times[-1] + 1.0:
        raise NoSuchPlace(f"no step at {time:g} s: the run is from {times[0]:g} to {times[-1]:g} s")
    return step
