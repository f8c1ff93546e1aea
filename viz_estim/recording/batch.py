"""Some steps at once, as arrays: each quantity is gathered once, whoever wants it."""

from __future__ import annotations

from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.run import Step
from viz_estim.core.stages import Stage
from viz_estim.recording.columns import Times


class StageRows:
    """All rows of one stage in a batch: its records, their times, their steps' rows, and which ended their step."""

    def __init__(self, name: str, stages: list[Stage], at: Times, rows: np.ndarray, last: np.ndarray) -> None:
        self.name, self.stages, self.at, self.rows, self.last = name, stages, at, rows, last
        self._gathered: dict[str, Any] = {}

    def values(self, path: str) -> Array | list[Array]:
        """A quantity by its attribute path, such as `innovation.residual`: (M, …), or a list where shapes differ."""
        if path not in self._gathered:
            found = list(map(attrgetter(path), self.stages))
            try:
                self._gathered[path] = np.array(found, dtype=float)
            except ValueError:
                self._gathered[path] = found
        gathered: Array | list[Array] = self._gathered[path]
        return gathered

    def array(self, path: str) -> Array:
        """The same, of a quantity that has one shape in all rows."""
        return np.asarray(self.values(path))


class Batch:
    """Steps, with `times` of their first stages, `names` of their stages, and `stages` as rows by name.

    first: the place on the stage timeline of the first step; `end` is the next batch's.
    """

    def __init__(self, steps: list[Step], first: int) -> None:
        self.steps = steps
        self.names = [tuple([stage.name for stage in step.stages]) for step in steps]
        # A step without any stage (it failed at once) still takes a place on the stage timeline.
        counts = np.array([len(names) or 1 for names in self.names])
        places = first + np.concatenate([[0], np.cumsum(counts)])
        self.end = int(places[-1])
        self.times = Times(
            np.array([step.index for step in steps]), np.array([step.tick.time for step in steps]), places[:-1]
        )
        alike: dict[tuple[str, ...], list[int]] = {}
        for row, names in enumerate(self.names):
            alike.setdefault(names, []).append(row)
        found: dict[str, list[tuple[np.ndarray, int, bool]]] = {}
        for names, members in alike.items():
            for i, name in enumerate(names):
                found.setdefault(name, []).append((np.array(members), i, i == len(names) - 1))
        self.stages = [self._rows_of(name, groups) for name, groups in found.items()]

    def _rows_of(self, name: str, groups: list[tuple[np.ndarray, int, bool]]) -> StageRows:
        rows = np.concatenate([members for members, _, _ in groups])
        offsets = np.concatenate([np.full(len(members), i) for members, i, _ in groups])
        last = np.concatenate([np.full(len(members), ends) for members, _, ends in groups])
        places = self.times.stage[rows] + offsets
        if len(groups) > 1:
            order = np.argsort(places)
            rows, offsets, last, places = rows[order], offsets[order], last[order], places[order]
        steps = self.steps
        stages = [steps[row].stages[i] for row, i in zip(rows.tolist(), offsets.tolist(), strict=True)]
        return StageRows(name, stages, Times(self.times.step[rows], self.times.time[rows], places), rows, last)

    @cached_property
    def truth(self) -> Array:
        """The truth (N, n), NaN where there is none; of a run that has one."""
        size = next((len(step.truth) for step in self.steps if step.truth is not None), 0)
        nothing = np.full(size, np.nan)
        return np.array([nothing if step.truth is None else step.truth for step in self.steps])
