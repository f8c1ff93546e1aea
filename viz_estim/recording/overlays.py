"""What all runs did over time, one plot a quantity, and how each differs from the first."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import rerun as rr

from viz_estim.core.alignment import on_stamps
from viz_estim.core.descriptions import describe
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO3, Euclidean, Product, Space
from viz_estim.recording import overlaid_stages
from viz_estim.recording.columns import Times
from viz_estim.recording.compared import Compared, shared_parts
from viz_estim.recording.layout import as_product
from viz_estim.recording.lines import shown
from viz_estim.recording.ranges import Ranges
from viz_estim.recording.sheet import Plot, Sheet, titled


class Overlays:
    """Draws the runs' numbers into one stream. `plots` lists what was drawn, `ranges` knows their values."""

    def __init__(self, stream: rr.RecordingStream, runs: list[Compared]) -> None:
        self._sheet = Sheet(stream, runs)
        self._runs, self._first = runs, runs[0]

    @property
    def plots(self) -> list[Plot]:
        return list(self._sheet.plots.values())

    @property
    def ranges(self) -> Ranges:
        return self._sheet.ranges

    def draw(self) -> None:
        self._draw_differences()
        if self._first.run.labels:
            self._draw_probabilities()
        for name, part, holders in self._quantities():
            self._draw_errors(name, part, holders)
        for name, part, holders in self._quantities():
            self._draw_states(name, part, holders)
        for name, part, holders in self._quantities():
            self._draw_sigmas(name, part, holders)
        overlaid_stages.draw(self._sheet)

    def _quantities(self) -> Iterator[tuple[str, Space, list[Compared]]]:
        """Each part of any of the runs' states once, with the runs that have the same."""
        seen: list[tuple[str, object]] = []
        for run in self._runs:
            for name, part in run.space.parts.items():
                if (name, describe(part)) not in seen:
                    seen.append((name, describe(part)))
                    alone = Product(**{name: part})
                    yield name, part, [one for one in self._runs if shared_parts(alone, one)]

    def _draw_differences(self) -> None:
        """Log(a⁻¹b) on the first run's stamps where both were running: an attitude's is the turn between the two."""
        first, a, sheet = self._first, self._first.run, self._sheet
        at = sheet.ends[0]
        for other in self._runs[1:]:
            self._draw_sigmas_apart(other, at)
        for other in self._runs[1:]:
            b = other.run
            if a.labels and a.labels == b.labels:
                moved = on_stamps(Euclidean(a.labels), b.time, np.exp(b.ends["log_probabilities"]), a.time)
                moved -= np.exp(a.ends["log_probabilities"])
                for i, label in enumerate(a.labels):
                    sheet.line("difference", label, other, at, moved[:, i], "probability", f"p({label}) − {first.name}")
            for name in shared_parts(first, other):
                part = first.space.parts[name]
                x = a.mean[:, first.space.at[name]]
                y = on_stamps(part, b.time, b.mean[:, other.space.at[name]], a.time)
                with np.errstate(invalid="ignore"):
                    delta = part.minus(y, x)
                what = f"{'turn' if isinstance(part, SO3) else 'distance'} to {first.name}"
                self._draw_length("difference", name, part, other, at, delta, what)
                sheet.per_axis("difference", name, part, other, at, delta, "− " + first.name)

    def _draw_length(
        self, tab: str, name: str, part: Space, one: Compared, at: Times, delta: Array, what: str
    ) -> None:  # fmt: skip
        """The length of differences (N, d), where all directions have one unit."""
        if len(part.axes) > 1 and len(set(part.axis_units)) == 1:
            unit, scale = shown(part.axis_units[0])
            length = scale * np.linalg.norm(delta, axis=1)
            self._sheet.line(tab, f"{name}.length", one, at, length, name, f"{name}: {what} [{unit}]")

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
        title = f"Distance to {first.name} in its σ, in the direction where it is largest"
        self._sheet.line("difference", "sigmas", other, at, apart, "σ", title)

    def _draw_probabilities(self) -> None:
        for i, label in enumerate(self._first.run.labels):
            for one, at in zip(self._runs, self._sheet.ends, strict=True):
                if label in one.run.labels:
                    p = np.exp(one.run.ends["log_probabilities"][:, one.run.labels.index(label)])
                    self._sheet.line("belief", label, one, at, p, str(i), f"p({label})", top=1.0)

    def _draw_errors(self, name: str, part: Space, holders: list[Compared]) -> None:
        for one in holders:
            where, axes = one.space.at[name], one.space.axes_at[name]
            truth, at = one.run.truth[:, where], self._sheet.ends[one.place]
            if np.isfinite(truth).all(1).any():
                with np.errstate(invalid="ignore"):
                    error = part.minus(one.run.mean[:, where], truth)
                variance = np.diagonal(one.run.cov, axis1=1, axis2=2)[:, axes]
                bounds = 3 * np.sqrt(np.maximum(variance, 0)) if self._sheet.bounded else None
                what = f"{'turn' if isinstance(part, SO3) else 'distance'} from the truth"
                self._draw_length("error", name, part, one, at, error, what)
                self._sheet.per_axis("error", name, part, one, at, error, "error", bounds)

    def _draw_states(self, name: str, part: Space, holders: list[Compared]) -> None:
        """Each component, with the truth and the reading of it of the first that has the part."""
        first, sheet = holders[0], self._sheet
        reference: tuple[Array, Array] | None = None
        reading = _direct_reading(first, part)
        for one in holders:
            x, truth = (values[:, one.space.at[name]] for values in (one.run.mean, one.run.truth))
            at = sheet.ends[one.place]
            if isinstance(part, SO3):  # q and −q are one attitude: all are shown on the side of the first run's
                x = _continuous(x) if reference is None else _beside(x, one.run.time, *reference)
                reference = reference or (one.run.time, x)
                truth = _beside(truth, one.run.time, *reference)
            for c, component in enumerate(part.names):
                unit, scale = shown(part.units[c])
                key, title = f"{name}.{component}", titled(name, component, unit)
                if one is first:
                    if reading:
                        read = (f"{reading[0]} reading", at, scale * reading[1][:, c])
                        sheet.once("state", key, "-reading", *read, name, title)
                    sheet.once("state", key, "-truth", "truth", at, scale * truth[:, c], name, title)
                sheet.line("state", key, one, at, scale * x[:, c], name, title)

    def _draw_sigmas(self, name: str, part: Space, holders: list[Compared]) -> None:
        for one in holders:
            variance = np.diagonal(one.run.cov, axis1=1, axis2=2)[:, one.space.axes_at[name]]
            sigma = np.sqrt(np.maximum(variance, 0))
            self._sheet.per_axis("sigma", name, part, one, self._sheet.ends[one.place], sigma, "σ")


def _direct_reading(one: Compared, part: Space) -> tuple[str, Array] | None:
    """The sensor that reads a part of the state as it is (a gyro reads the rate), and its readings by step."""
    for table in one.run.stages.values():
        for sensor, space in as_product(table.spaces.get("innovation")).parts.items():
            itself = isinstance(part, Euclidean) and any(part.units) and describe(space) == describe(part)
            if itself and (read := one.run.inputs.get(f"z.{sensor}")) is not None:
                return sensor, read
    return None


def _continuous(q: Array) -> Array:
    """The same attitudes (N, 4), each on the side of the one before."""
    dots = np.einsum("ni,ni->n", q[1:], q[:-1])
    return q * np.cumprod(np.concatenate([[1.0], np.where(dots < 0, -1.0, 1.0)]))[:, None]


def _beside(q: Array, times: Array, reference_times: Array, reference: Array) -> Array:
    """The same attitudes (N, 4), each on the side of the reference's at about its time."""
    row = np.clip(np.searchsorted(reference_times, times + 5e-10, side="right") - 1, 0, None)
    return q * np.where(np.einsum("ni,ni->n", q, reference[row]) < 0, -1.0, 1.0)[:, None]
