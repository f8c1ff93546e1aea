"""Lines over time, as Rerun draws them: one entity a plot where it can, broken where a value is missing."""

from __future__ import annotations

from functools import cache

import numpy as np
import rerun as rr

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space
from viz_estim.recording import schema
from viz_estim.recording.columns import Column, Times, drawn, send, send_still, still
from viz_estim.recording.ranges import Ranges

Series = tuple[str, schema.Colour, Array]  # name, colour, values (N,)


class Lines:
    """Draws series into the plots of a stream, and styles each plot once. ranges: learns the values of each plot."""

    def __init__(self, stream: rr.RecordingStream, ranges: Ranges) -> None:
        self._stream, self._ranges = stream, ranges
        self._styled: set[str] = set()
        self._known: dict[str, bool] = {}  # by broken line: whether it has a value last

    def draw(
        self, path: str, at: Times, unit: str, series: list[Series], variance: Array | None = None,
        plot: str | None = None,
    ) -> None:  # fmt: skip
        """Lines in one plot, the last on top; the variance (N,) is that one's, drawn as a band. plot: its path, where
        these are some of its lines."""
        self._style(path, unit, series)
        drawn_values = np.empty((len(at), len(series)))
        for i, (_, _, line) in enumerate(series):
            drawn_values[:, i] = line
        self._ranges.learn(plot or path, drawn_values)
        components = {"values": drawn_values}
        if variance is not None:
            components["variances"] = np.zeros_like(drawn_values)
            components["variances"][:, -1] = variance
        columns = drawn(rr.Measurements, len(series), len(at), **components)
        send(self._stream, path, at, columns)

    def within(self, path: str, at: Times, unit: str, line: Series, variance: Array, *, gapless: bool) -> None:
        """A value between the lines at ±3σ that it should stay within. gapless: it is known in every row of the run,
        so that all three can be one entity (a plot refuses rows of several lengths)."""
        unit, scale = shown(unit)
        bound = 3 * scale * np.sqrt(np.maximum(variance, 0))
        bounds: list[Series] = [("+3σ", schema.BAND, bound), ("−3σ", schema.BAND, -bound)]
        scaled = (line[0], line[1], scale * line[2])
        if gapless:
            self.draw(path, at, unit, [*bounds, scaled])
        else:
            self.draw(path, at, unit, bounds)
            self.broken(f"{path}/value", at, unit, scaled, path)

    def broken(self, path: str, at: Times, unit: str, series: Series, plot: str | None = None) -> None:
        """One line that is broken where its value is NaN: by a row without a value, where the gap begins. plot: the
        path of the plot, where this is one of its lines."""
        name, colour, values = series
        known = np.isfinite(values)
        before = np.concatenate([[self._known.get(path, False)], known[:-1]])
        self._known[path] = bool(known[-1])
        rows = np.flatnonzero(known | before)
        if len(rows):
            at, drawn_values = (at, values) if len(rows) == len(at) else (at.pick(rows), values[rows])
            counts = np.isfinite(drawn_values)
            self._ranges.learn(plot or path, drawn_values[:, None])
            self._style(path, unit, [(name, colour, drawn_values)])
            columns = drawn(rr.Measurements, counts.astype(int), len(at), values=drawn_values[counts])
            send(self._stream, path, at, columns)

    def _style(self, path: str, unit: str, series: list[Series]) -> None:
        if path not in self._styled:
            self._styled.add(path)
            names, colours, _ = zip(*series, strict=True)
            send_still(self._stream, path, _style(names, colours, unit))


@cache
def _style(names: tuple[str, ...], colours: tuple[schema.Colour, ...], unit: str) -> list[Column]:
    """Made once for all plots that look alike: it takes longer than a hundred rows."""
    units = [unit] * len(names)
    return still(rr.Measurements.from_fields(names=names, colors=colours, units=units, aggregation_policy="MinMax"))


def shown(unit: str) -> tuple[str, float]:
    """The unit in which a quantity is drawn, and the factor to it: angles in degrees."""
    return ("deg", 180 / np.pi) if unit == "rad" else (unit, 1.0)


def sigma_plots(name: str, part: Space) -> dict[str, list[int]]:
    """The plots that show the σ of a part of the state, and the directions in each: one a unit, for a metre and a
    degree have no scale in common."""
    units = list(dict.fromkeys(part.axis_units))
    names = {unit: name if len(units) == 1 else f"{name}.{shown(unit)[0] or 1}" for unit in units}
    return {names[unit]: [i for i, of in enumerate(part.axis_units) if of == unit] for unit in units}
