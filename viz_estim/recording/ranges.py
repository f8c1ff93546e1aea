"""What part of its values a plot's axis shows: most of them, and at least two numbers to read them by.

A plot left to itself shows all. Then a filter's first σ, or one outlier, flattens everything after it; and the viewer
names powers of ten alone where a plot is low, so that an axis from −5 to 5 says 0 and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import rerun.blueprint as rrb

from viz_estim.core.quaternions import Array

_Range = tuple[float, float]
# Of how many steps of a power of ten are named, and how many are in a small window.
_Find = Callable[[float, float], _Range | None]
_ASIDE = 0.02  # of the values at either end may be out of sight
_CALM = 2.5  # all is shown where it is no more than this, by what most need
_ROOM = 0.25  # of what most need, above and below it
_KEPT = 4096  # rows of a plot, at most; more are thinned evenly
_NUMBERS, _ROWS = 7.0, 3  # steps of a power of ten that are still named on a low plot, one of so many rows
_EDGE = 0.03  # of the axis, beyond the last value
_SMALLER = 0.58  # times as many are named in a window 720 high, with an edge, where four lanes stand below
_HALF_A_NUMBER = 0.1  # of the axis of such a plot: a number nearer to its upper end is cut off


class Ranges:
    """Learns the values of plots by their paths, in bounded memory, and says which axis shows them.

    Not `fixed` as long as more is to come: then each plot shows all, as the viewer does by itself. Axes that follow
    would take a new view each time, with which the cursor of who watches jumps.
    """

    def __init__(self, fixed: bool = True) -> None:
        self.fixed = fixed
        self._seen: dict[str, _Seen] = {}
        self._find: dict[str, _Find] = {}  # by plots whose axis was asked for

    def learn(self, path: str, values: Array) -> None:
        """Takes in lines (N, k) of a plot, which nobody may change any more; what is not finite is none."""
        seen = self._seen.get(path)
        if seen is None:
            seen = self._seen[path] = _Seen()
        seen.add(values)

    def ask(self, path: str, calm: float = _CALM) -> None:
        """Asks for the axis of a plot. calm: all is shown where it is no more than so many times what most need."""
        if path in self._seen:
            self._find[path] = partial(self._seen[path].range, calm)

    def asked(self, path: str, rows: float = _ROWS, small: float | None = None) -> rrb.ScalarAxis | None:
        """The axis that was asked for of a plot, one of so many rows: on a high plot more numbers are named. small: how
        many steps are in a small window. None where nothing is known, or all is one value."""
        if not self.fixed or path not in self._find:
            return None
        numbers = _ROWS * _NUMBERS / rows
        found = self._find[path](numbers, small or _SMALLER * numbers)
        return rrb.ScalarAxis(range=found) if found else None

    def axis(self, path: str, calm: float = _CALM, rows: float = _ROWS) -> rrb.ScalarAxis | None:
        """Both at once."""
        self.ask(path, calm)
        return self.asked(path, rows)

    def upward(self, path: str, top: float) -> rrb.ScalarAxis:
        """The axis from 0 to `top` of a plot that has level lines, or as far up as its values are, where most of them
        would be out of sight."""
        if path in self._seen:
            self._find[path] = partial(self._seen[path].upward, top)
        return self.asked(path) or rrb.ScalarAxis(range=(0.0, top))


class _Seen:
    """The rows of a plot: the lowest and the highest value of each, thinned, and of all."""

    def __init__(self) -> None:
        self._low, self._high = np.empty(0), np.empty(0)
        self._all = (np.inf, -np.inf)
        self._stride, self._count = 1, 0
        self._waiting: list[Array] = []  # many at once take less time
        self._held = 0  # rows of these

    def add(self, values: Array) -> None:
        if len(values):
            self._waiting.append(values)
        self._held += len(values)
        if self._held > _KEPT:
            self._take_in()

    def _take_in(self) -> None:
        waiting, self._waiting, self._held = self._waiting, [], 0
        if not waiting:
            return
        lows, highs = [self._low], [self._high]
        for values in waiting:
            least, most = float(values.min()), float(values.max())
            if not np.isfinite(most - least):
                values = values[np.isfinite(values).all(axis=1)]
                if not len(values):
                    continue
                least, most = float(values.min()), float(values.max())
            self._all = min(self._all[0], least), max(self._all[1], most)
            chosen = values[-self._count % self._stride :: self._stride].T
            self._count += len(values)
            lows.append(np.minimum.reduce(chosen))
            highs.append(np.maximum.reduce(chosen))
        self._low, self._high = np.concatenate(lows), np.concatenate(highs)
        while len(self._low) > _KEPT:
            self._low, self._high, self._stride = self._low[::2], self._high[::2], 2 * self._stride

    def upward(self, top: float, numbers: float, _small: float) -> _Range | None:
        self._take_in()
        if not len(self._high):
            return None
        at = [int(share * (len(self._high) - 1)) for share in (0.75, 1 - _ASIDE)]
        middle, most = np.partition(self._high, at)[at].tolist()  # with a level line each half of them is that line's
        return (0.0, top) if middle <= top else (0.0, readable(0.0, most, numbers)[1])

    def range(self, calm: float, numbers: float, small: float) -> _Range | None:
        self._take_in()
        if not len(self._low):
            return None
        least, most = self._all
        aside = int(_ASIDE * len(self._low))
        top = len(self._high) - 1 - aside
        low, high = float(np.partition(self._low, aside)[aside]), float(np.partition(self._high, top)[top])
        core = high - low
        if most - least > calm * core > 0:
            least, most = max(least, low - _ROOM * core), min(most, high + _ROOM * core)
        if most - least <= 1e-9 * max(abs(least), abs(most)):
            return None
        # Less of the room about what most need, where then numbers are named in a small window too.
        length = most - least
        less = length - small * step_of(length, numbers)
        if 0 < less < 0.9 * (length - core) and length < (1 + 2 * _ROOM + 1e-9) * core:
            share = less / (length - core)
            least, most = least + share * (low - least), most - share * (most - high)
        return readable(least, most, numbers)


def step_of(length: float, numbers: float) -> float:
    """The least power of ten whose multiples are named on an axis of that length."""
    return float(10.0 ** np.ceil(np.log10(length / numbers)))


def readable(low: float, high: float, numbers: float = _NUMBERS) -> _Range:
    """The same range, made longer where fewer than two multiples of a power of ten would be named on it; numbers: so
    many steps of one are still named."""
    step = step_of(high - low, numbers)
    above, below = (np.floor(high / step) + 1) * step, (np.ceil(low / step) - 1) * step
    while (above - below) / step < 2.5:  # they are the next ones outside
        if above - high <= 1.5 * (low - below):  # about as far: upwards, as in the plots beside it
            high, above = above, above + step
        else:
            low, below = below, below - step
    length = high - low
    above = high - np.floor(high / step) * step
    room = max(_EDGE * length, _HALF_A_NUMBER * _NUMBERS / numbers * length - above)
    return float(low - _EDGE * length), float(high + room)
