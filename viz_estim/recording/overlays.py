"""What all runs did over time, one plot a quantity, and how each differs from the first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import rerun as rr

from viz_estim.core.alignment import on_stamps
from viz_estim.core.consistency import band, nis
from viz_estim.core.descriptions import describe
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO3, Euclidean, Product, Space
from viz_estim.recording import schema
from viz_estim.recording.columns import Times
from viz_estim.recording.compared import Clock, Compared, is_figure, shared_parts
from viz_estim.recording.layout import as_product
from viz_estim.recording.lines import Lines, Series, shown
from viz_estim.recording.tables import StageTable

_BOUNDED = 2  # runs at most whose ±3σ are drawn: more lines than that hide each other


class Plot(NamedTuple):
    """A plot that was drawn: where, on which tab, in which row of it, under which title."""

    path: str
    tab: str
    row: str
    title: str
    top: float | None = None  # the axis from 0 to here, where it is known


class Overlays:
    """Draws the runs' numbers into one stream. `plots` lists what was drawn."""

    def __init__(self, stream: rr.RecordingStream, runs: list[Compared]) -> None:
        self._lines = Lines(stream)
        self._runs, self._first = runs, runs[0]
        self._clocks = [Clock(self._first, one) for one in runs]
        self._known: dict[str, Plot] = {}
        self._ends = [self._times_of_ends(i) for i in range(len(runs))]

    @property
    def plots(self) -> list[Plot]:
        return list(self._known.values())

    def draw(self) -> None:
        self._draw_differences()
        if self._first.run.labels:
            self._draw_probabilities()
        for name, part, holders in self._quantities([one.space for one in self._runs]):
            self._draw_errors(name, part, holders)
        for name, part, holders in self._quantities([one.space for one in self._runs]):
            self._draw_states(name, part, holders)
        for name, part, holders in self._quantities([one.space for one in self._runs]):
            self._draw_sigmas(name, part, holders)
        self._draw_innovations()
        self._draw_figures()

    def _times_of_ends(self, place: int) -> Times:
        one = self._runs[place]
        return self._clocks[place].times(one.ends, one.run.step)

    def _quantities(self, spaces: list[Product]) -> Iterator[tuple[str, Space, list[int]]]:
        """Each part of any of the spaces once, with the places of those that have the same."""
        seen: list[tuple[str, object]] = []
        for space in spaces:
            for name, part in space.parts.items():
                kind = (name, describe(part))
                if kind not in seen:
                    seen.append(kind)
                    yield (
                        name,
                        part,
                        [i for i, s in enumerate(spaces) if name in shared_parts(Product(**{name: part}), s)],
                    )

    def _draw_differences(self) -> None:
        """Log(a⁻¹b) on the first run's stamps where both were running: an attitude's is the turn between the two."""
        first, a = self._first, self._first.run
        at = self._ends[0]
        for other in self._runs[1:]:
            self._draw_sigmas_apart(other, at)
        for other in self._runs[1:]:
            b = other.run
            if a.labels and a.labels == b.labels:
                moved = on_stamps(Euclidean(a.labels), b.time, np.exp(b.ends["log_probabilities"]), a.time)
                moved -= np.exp(a.ends["log_probabilities"])
                for i, label in enumerate(a.labels):
                    title = f"p({label}) − {first.name}"
                    self._line("difference", label, "", other, at, moved[:, i], "probability", title)
            for name in shared_parts(first, other):
                part = first.space.parts[name]
                x = a.mean[:, first.space.at[name]]
                y = on_stamps(part, b.time, b.mean[:, other.space.at[name]], a.time)
                with np.errstate(invalid="ignore"):
                    delta = part.minus(y, x)
                if len(part.axes) > 1 and len(set(part.axis_units)) == 1:
                    unit, scale = shown(part.axis_units[0])
                    title = f"{name}: {'turn' if isinstance(part, SO3) else 'distance'} to {first.name}"
                    length = scale * np.linalg.norm(delta, axis=1)
                    self._line("difference", f"{name}.length", unit, other, at, length, name, title)
                self._per_axis("difference", name, part, other, at, delta, "− " + first.name)

    def _draw_sigmas_apart(self, other: Compared, at: Times) -> None:
        """How far it is from the first in the first's σ, in the direction where this is most."""
        first, a, b = self._first, self._first.run, other.run
        apart = np.full(len(a.time), -np.inf)
        for name in shared_parts(first, other):
            part, axes = first.space.parts[name], first.space.axes_at[name]
            y = on_stamps(part, b.time, b.mean[:, other.space.at[name]], a.time)
            sigma = np.sqrt(np.maximum(np.diagonal(a.cov, axis1=1, axis2=2)[:, axes], np.finfo(float).tiny))
            with np.errstate(invalid="ignore", over="ignore"):
                apart = np.fmax(apart, np.abs(part.minus(y, a.mean[:, first.space.at[name]]) / sigma).max(1))
        apart[~np.isfinite(apart)] = np.nan
        if np.isfinite(apart).any():
            title = f"Distance to {first.name} in its σ, in the direction where it is largest"
            self._line("difference", "sigmas", "σ", other, at, apart, "σ", title)

    def _draw_probabilities(self) -> None:
        for i, label in enumerate(self._first.run.labels):
            for one, at in zip(self._runs, self._ends, strict=True):
                if label in one.run.labels:
                    p = np.exp(one.run.ends["log_probabilities"][:, one.run.labels.index(label)])
                    self._line("belief", label, "", one, at, p, str(i), f"p({label})", top=1.0)

    def _draw_errors(self, name: str, part: Space, holders: list[int]) -> None:
        for i in holders:
            one = self._runs[i]
            where, axes = one.space.at[name], one.space.axes_at[name]
            truth = one.run.truth[:, where]
            if np.isfinite(truth).all(1).any():
                with np.errstate(invalid="ignore"):
                    error = part.minus(one.run.mean[:, where], truth)
                variance = np.diagonal(one.run.cov, axis1=1, axis2=2)[:, axes]
                bounds = 3 * np.sqrt(np.maximum(variance, 0)) if len(self._runs) <= _BOUNDED else None
                self._per_axis("error", name, part, one, self._ends[i], error, "error", bounds)

    def _draw_states(self, name: str, part: Space, holders: list[int]) -> None:
        first = holders[0]
        reference: tuple[Array, Array] | None = None
        for i in holders:
            one = self._runs[i]
            x, truth = (values[:, one.space.at[name]] for values in (one.run.mean, one.run.truth))
            if isinstance(part, SO3):  # q and −q are one attitude: all are shown on the side of the first run's
                x = _continuous(x) if reference is None else _beside(x, one.run.time, *reference)
                reference = reference or (one.run.time, x)
                truth = _beside(truth, one.run.time, *reference)
            for c, component in enumerate(part.names):
                unit, scale = shown(part.units[c])
                title = _titled(name, component, unit)
                key = f"{name}.{component}"
                if i == first and np.isfinite(truth[:, c]).any():
                    self._line("state", key, unit, None, self._ends[i], scale * truth[:, c], name, title)
                self._line("state", key, unit, one, self._ends[i], scale * x[:, c], name, title)

    def _draw_sigmas(self, name: str, part: Space, holders: list[int]) -> None:
        for i in holders:
            one = self._runs[i]
            variance = np.diagonal(one.run.cov, axis1=1, axis2=2)[:, one.space.axes_at[name]]
            self._per_axis("sigma", name, part, one, self._ends[i], np.sqrt(np.maximum(variance, 0)), "σ")

    def _draw_innovations(self) -> None:
        """Residuals by component, and NIS between χ²'s 95 % bounds, which are drawn once."""
        for group in ("innovation", "nis"):
            for i, one in enumerate(self._runs):
                for table in one.run.stages.values():
                    if "innovation.residual" in table.values:
                        at = self._clocks[i].times(table.place, table.step)
                        space = as_product(table.spaces["innovation"])
                        (self._draw_residuals if group == "innovation" else self._draw_nis)(one, table, space, at)

    def _draw_residuals(self, one: Compared, table: StageTable, space: Product, at: Times) -> None:
        residual, S = table.values["innovation.residual"], table.values["innovation.cov"]
        for name, part in space.parts.items():
            axes = space.axes_at[name]
            bounds = None
            if len(self._runs) <= _BOUNDED:
                bounds = 3 * np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2)[:, axes], 0))
            self._per_axis("innovation", name, part, one, at, residual[:, axes], "innov.", bounds)

    def _draw_nis(self, one: Compared, table: StageTable, space: Product, at: Times) -> None:
        values = (table.values[f"innovation.{k}"] for k in ("residual", "cov", "offered"))
        residual, S, offered = values
        for name, found in nis(space, residual, S, offered.astype(bool)).items():
            low, high = band(found.dof)
            path, title = schema.plot("nis", name), f"NIS {name}: {found.dof} expected"
            if path not in self._known:
                bounds: list[Series] = [
                    ("97.5 %", schema.BAND, np.full(len(at), high)), ("2.5 %", schema.BAND, np.full(len(at), low)),
                ]  # fmt: skip
                self._lines.draw(path, at, "", bounds)
            self._line("nis", name, "", one, at, found.values, "NIS", title, top=4 * high)

    def _draw_figures(self) -> None:
        """The single numbers of stages, such as a cloud's effective size."""
        for i, one in enumerate(self._runs):
            for table in one.run.stages.values():
                for name, values in table.values.items():
                    if is_figure(name, values) and np.isfinite(values).any():
                        at = self._clocks[i].times(table.place, table.step)
                        self._line(
                            "figure", f"{table.name}.{name}", "", one, at, values, table.name, f"{table.name}: {name}"
                        )

    def _per_axis(
        self, group: str, name: str, part: Space, one: Compared, at: Times, values: Array, what: str,
        bounds: Array | None = None,
    ) -> None:  # fmt: skip
        for c, axis in enumerate(part.axes):
            unit, scale = shown(part.axis_units[c])
            key = f"{name}.{axis}"
            title = _titled(name, axis, unit, what)
            if bounds is not None:
                red, green, blue = one.colour
                for sign, mark in ((1, "+3σ"), (-1, "−3σ")):
                    line = (f"{mark} {one.name}", (red // 2, green // 2, blue // 2), sign * scale * bounds[:, c])
                    self._lines.broken(f"{schema.plot(group, key)}/{one.part}/{mark}", at, unit, line)
            self._line(group, key, unit, one, at, scale * values[:, c], name, title)

    def _line(
        self, group: str, key: str, unit: str, one: Compared | None, at: Times, values: Array, row: str, title: str,
        *, top: float | None = None,
    ) -> None:  # fmt: skip
        """One run's line, or the truth's, in the plot of a quantity."""
        name, colour = (one.name, one.colour) if one else ("truth", schema.TRUTH)
        path = schema.plot(group, key)
        if np.isfinite(values).any():
            self._known.setdefault(path, Plot(path, group, row, title, top))
            # Lines are drawn in the order of their names: the truth lies beneath the runs.
            self._lines.broken(f"{path}/{one.part if one else '-truth'}", at, unit, (name, colour, values))


def _titled(name: str, axis: str, unit: str, what: str = "") -> str:
    words = [name, "" if axis in (name.partition("/")[0], "angle") else axis, what, f"[{unit}]" if unit else ""]
    return " ".join(word for word in words if word)


def _continuous(q: Array) -> Array:
    """The same attitudes (N, 4), each on the side of the one before."""
    dots = np.einsum("ni,ni->n", q[1:], q[:-1])
    return q * np.cumprod(np.concatenate([[1.0], np.where(dots < 0, -1.0, 1.0)]))[:, None]


def _beside(q: Array, times: Array, reference_times: Array, reference: Array) -> Array:
    """The same attitudes (N, 4), each on the side of the reference's at about its time."""
    row = np.clip(np.searchsorted(reference_times, times + 5e-10, side="right") - 1, 0, None)
    return q * np.where(np.einsum("ni,ni->n", q, reference[row]) < 0, -1.0, 1.0)[:, None]
