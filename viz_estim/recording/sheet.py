"""A sheet of plots over time that runs share: in each plot one line a run, in the run's colour."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import rerun as rr

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space
from viz_estim.recording import plot_tabs, schema
from viz_estim.recording.columns import Times
from viz_estim.recording.compared import Clock, Compared
from viz_estim.recording.lines import Lines, Series, shown
from viz_estim.recording.ranges import Ranges

_BOUNDED = 2  # runs at most whose ±3σ are drawn: more lines than that hide each other
_READING: schema.Colour = (150, 150, 160)
# What is drawn once: beneath the runs, for lines are drawn in the order of their entities.
ONCE: dict[str, schema.Colour] = {"-reading": _READING, "-truth": schema.TRUTH}


class Plot(NamedTuple):
    """A plot that was drawn: where, on which tab, in which row of it, under which title; runs: whose lines it has."""

    path: str
    tab: str
    row: str
    title: str
    top: float | None  # the axis from 0 to here, where it is known
    runs: set[int]


class Sheet:
    """Draws lines of runs, the first of which has the clock. plots: what was drawn, by its path; ranges: its axes."""

    def __init__(self, stream: rr.RecordingStream, runs: list[Compared]) -> None:
        self.ranges = Ranges()
        self._lines = Lines(stream, self.ranges)
        self.runs = runs
        self.bounded = len(runs) <= _BOUNDED
        self._clocks = [Clock(runs[0], one) for one in runs]
        self.ends = [self.times(one, one.ends, one.run.step) for one in runs]  # by run the ends of its steps
        self.plots: dict[str, Plot] = {}

    def times(self, one: Compared, place: np.ndarray, step: np.ndarray) -> Times:
        """Rows of a run, by their places and steps (M,), on the first run's clock."""
        return self._clocks[one.place].times(place, step)

    def plot(self, tab: str, key: str, row: str, title: str, *, top: float | None = None) -> tuple[str, bool]:
        """The path of the plot with this title, and whether it is new. One key has several, if it is not one quantity:
        an accelerometer read as a vector by one filter, and as a direction by another."""
        path, count = schema.plot(tab, key), 1
        while path in self.plots and self.plots[path].title != title:
            count += 1
            path = schema.plot(tab, f"{key}-{count}")
        new = path not in self.plots
        self.plots.setdefault(path, Plot(path, tab, row, title, top, set()))
        return path, new

    def line(
        self, tab: str, key: str, one: Compared, at: Times, values: Array, row: str, title: str,
        *, top: float | None = None,
    ) -> None:  # fmt: skip
        """A run's line in the plot of a quantity, if there is any value."""
        if np.isfinite(values).any():
            path, _ = self.plot(tab, key, row, title, top=top)
            self.plots[path].runs.add(one.place)
            self._lines.broken(f"{path}/{one.part}", at, "", (one.name, one.colour, values), path)

    def once(self, tab: str, key: str, what: str, name: str, at: Times, values: Array, row: str, title: str) -> None:
        """What no run has for itself, as `-truth`, beneath them."""
        if np.isfinite(values).any():
            path, _ = self.plot(tab, key, row, title)
            self._lines.broken(f"{path}/{what}", at, "", (name, ONCE[what], values), path)

    def band(self, path: str, at: Times, bounds: list[tuple[str, float]]) -> None:
        """Level lines by name, over these times."""
        series: list[Series] = [(name, schema.BAND, np.full(len(at), value)) for name, value in bounds]
        self._lines.draw(path, at, "", series)

    def per_axis(
        self, tab: str, name: str, part: Space, one: Compared, at: Times, values: Array, what: str,
        bounds: Array | None = None,
    ) -> None:  # fmt: skip
        """A plot for each direction of a part: values (M, d), and of few runs the ± bounds (M, d)."""
        for c, axis in enumerate(part.axes):
            unit, scale = shown(part.axis_units[c])
            key, title = f"{name}.{axis}", titled(name, axis, unit, what)
            if bounds is not None and np.isfinite(values[:, c]).any():
                red, green, blue = one.colour
                path, _ = self.plot(tab, key, name, title)
                for sign, mark in ((1, "+3σ"), (-1, "−3σ")):
                    line = (f"±3σ {one.name}", (red // 2, green // 2, blue // 2), sign * scale * bounds[:, c])
                    self._lines.broken(f"{path}/{one.part}/{mark}", at, "", line, path)
            self.line(tab, key, one, at, scale * values[:, c], name, title)


def titled(name: str, axis: str, unit: str, what: str = "") -> str:
    """`attitude x error [deg]`, but `heading error [deg]` where the axis adds nothing."""
    words = [plot_tabs.titled(name, axis), what, f"[{unit}]" if unit else ""]
    return " ".join(word for word in words if word)
