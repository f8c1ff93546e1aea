"""What part of its values a plot's axis shows: most of them, and at least two numbers to read them by.

A plot left to itself shows all. Then a filter's first σ, or one outlier, flattens everything after it; and the viewer
names powers of ten alone where a plot is low, so that an axis from −5 to 5 says 0 and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import rerun.blueprint as rrb

from viz_estim.core.quaternions import Array

_Range = tuple[float, float]
_Find = Callable[[float], _Range | None]  # of how many steps of a power of ten are named
_ASIDE = 0.02  # of the values at either end may be out of sight
_CALM = 2.5  # all is shown where it is no more than this, by what most need
_ROOM = 0.25  # of what most need, above and below it
_KEPT = 1024  # rows of a plot, at most; more are thinned evenly
_NUMBERS, _ROWS = 7.0, 3  # steps of a power of ten that are still named on a low plot, one of so many rows
_EDGE = 0.03  # of the axis, beyond the last value


class _Shown(NamedTuple):
    """An axis that was asked for, and how it is found anew."""

    range: _Range
    find: _Find
    numbers: float


class Ranges:
    """Learns the values of plots by their paths, in bounded memory, and says which axis shows them.

    Not `fixed` while someone watches a run: then each plot shows all, as the viewer does by itself, for axes that
    follow what comes take a new view, with which the cursor jumps.
    """

    def __init__(self) -> None:
        self.fixed = True
        self._seen: dict[str, _Seen] = {}
        self._shown: dict[str, _Shown] = {}
        self._rows = self._looked = 0

    def learn(self, path: str, values: Array) -> None:
        """Takes in lines (N, k) of a plot; what is not finite is none."""
        least, most = (float(values.min()), float(values.max())) if len(values) else (np.nan, np.nan)
        if not np.isfinite(least + most):
            values = values[np.isfinite(values).all(1)]
            if not len(values):
                return
            least, most = float(values.min()), float(values.max())
        self._rows += len(values)
        self._seen.setdefault(path, _Seen()).add(values, least, most)

    def axis(self, path: str, calm: float = _CALM) -> rrb.ScalarAxis | None:
        """The axis of a plot; none where nothing is known, or all is one value. calm: all is shown where it is no more
        than so many times what most need."""
        return self._axis(path, partial(self._seen[path].range, calm)) if path in self._seen else None

    def high(self, path: str, rows: int) -> rrb.ScalarAxis | None:
        """The axis that was asked for of a plot, where it is one of so few rows that more numbers are named on it."""
        return self._axis(path, self._shown[path].find, _ROWS * _NUMBERS / rows) if path in self._shown else None

    def upward(self, path: str, top: float) -> rrb.ScalarAxis:
        """The axis from 0 to `top` of a plot that has level lines, or as far up as its values are, where most of them
        would be out of sight."""
        axis = self._axis(path, partial(self._seen[path].upward, top)) if path in self._seen else None
        return axis or rrb.ScalarAxis(range=(0.0, top))

    def _axis(self, path: str, find: _Find, numbers: float = _NUMBERS) -> rrb.ScalarAxis | None:
        found = find(numbers) if self.fixed else None
        if found is None:
            return None
        self._shown[path] = _Shown(found, find, numbers)
        return rrb.ScalarAxis(range=found)

    def outgrown(self, more: float = 1.0) -> bool:
        """Whether an axis that was asked for is to be another by now. more: looks again when there are so many times
        the rows that there were the last time, for it takes a while."""
        if not self._shown or self._rows < more * self._looked:
            return False
        self._looked = self._rows
        for (low, high), find, numbers in self._shown.values():
            span, now = high - low, find(numbers)
            if now and (max(low - now[0], now[1] - high) > 0.08 * span or now[1] - now[0] < 0.6 * span):
                return True
        return False


class _Seen:
    """The rows of a plot: the lowest and the highest value of each, thinned, and of all."""

    def __init__(self) -> None:
        self._low, self._high = np.empty(0), np.empty(0)
        self._all = (np.inf, -np.inf)
        self._stride, self._count = 1, 0

    def add(self, values: Array, least: float, most: float) -> None:
        self._all = min(self._all[0], least), max(self._all[1], most)
        chosen = values[-self._count % self._stride :: self._stride]
        self._count += len(values)
        self._low, self._high = np.append(self._low, chosen.min(1)), np.append(self._high, chosen.max(1))
        while len(self._low) > _KEPT:
            self._low, self._high, self._stride = self._low[::2], self._high[::2], 2 * self._stride

    def upward(self, top: float, numbers: float) -> _Range:
        ordered = np.sort(self._high)  # with a level line each half of them is that line's
        middle, most = (float(ordered[int(share * (len(ordered) - 1))]) for share in (0.75, 0.98))
        return (0.0, top) if middle <= top else (0.0, readable(0.0, most, numbers)[1])

    def range(self, calm: float, numbers: float) -> _Range | None:
        least, most = self._all
        aside = int(_ASIDE * len(self._low))
        low, high = float(np.sort(self._low)[aside]), float(np.sort(self._high)[-1 - aside])
        core = high - low
        if most - least > calm * core > 0:
            least, most = max(least, low - _ROOM * core), min(most, high + _ROOM * core)
        return readable(least, most, numbers) if most - least > 1e-9 * max(abs(least), abs(most)) else None


def readable(low: float, high: float, numbers: float = _NUMBERS) -> _Range:
    """The same range, made longer where fewer than two multiples of a power of ten would be named on it; numbers: so
    many steps of one are still named."""
    step = 10.0 ** np.ceil(np.log10((high - low) / numbers))
    above, below = (np.floor(high / step) + 1) * step, (np.ceil(low / step) - 1) * step
    while (above - below) / step < 2.5:  # they are the next ones outside
        if above - high <= 1.5 * (low - below):  # about as far: upwards, as in the plots beside it
            high, above = above, above + step
        else:
            low, below = below, below - step
    edge = _EDGE * (high - low)
    return float(low - edge), float(high + edge)
