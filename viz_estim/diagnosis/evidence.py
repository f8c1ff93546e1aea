"""What the checks look at: each sensor's readings in the order in which they came, and the belief before each stage."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from viz_estim.core.consistency import squared_distance
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product, Space
from viz_estim.diagnosis.rounding import sound
from viz_estim.recording.layout import as_product
from viz_estim.recording.reader import Run
from viz_estim.recording.tables import StageTable

T = TypeVar("T")


@dataclass(frozen=True)
class Readings:
    """All M readings of one sensor that count, of its several targets too, by its own block of S.

    step, time, interval (M,): interval is the time in s since the step before; target (M,): which of the sensor's
    targets; z, predicted (M, n); residual (M, m), cov S, noise R (M, m, m); used (M,).
    """

    name: str
    space: Space
    step: np.ndarray
    time: Array
    target: np.ndarray
    z: Array
    predicted: Array
    residual: Array
    cov: Array
    noise: Array
    used: np.ndarray

    def __len__(self) -> int:
        return len(self.step)

    @property
    def dof(self) -> int:
        return len(self.space.axes)

    @cached_property
    def nis(self) -> Array:
        """(M,)"""
        return squared_distance(self.residual, self.cov)

    @cached_property
    def white(self) -> Array:
        """L⁻¹·ν (M, m), S = L·Lᵀ: independent and N(0, 1) if the filter is right."""
        return np.asarray(np.linalg.solve(np.linalg.cholesky(self.cov), self.residual[..., None])[..., 0], float)

    @cached_property
    def scaled(self) -> Array:
        """νᵢ/√Sᵢᵢ (M, m): each N(0, 1) if the filter is right."""
        return self.residual / np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    @property
    def steps(self) -> tuple[int, int]:
        return int(self.step[0]), int(self.step[-1])

    def pick(self, rows: np.ndarray) -> Readings:
        """Some of the readings: by their rows, or where a mask is True."""
        names = ("step", "time", "target", "z", "predicted", "residual", "cov", "noise", "used")
        return Readings(self.name, self.space, *(getattr(self, name)[rows] for name in names))


def sensors(run: Run, without: np.ndarray) -> dict[str, Readings]:
    """By sensor its readings that were offered, from the first step that counts on, but for the steps `without`."""
    pieces: dict[str, list[Readings]] = {}
    first = run.properties.get("first", 0)
    for table in run.stages.values():
        if "innovation.residual" not in table.values:
            continue
        space = table.spaces["innovation"]
        assert isinstance(space, Product)
        get = {k.removeprefix("innovation."): v for k, v in table.values.items() if k.startswith("innovation.")}
        for i, (name, part) in enumerate(space.parts.items()):
            at, axes = space.at[name], space.axes_at[name]
            rows = (get["offered"][:, i] > 0) & (table.step >= first) & ~np.isin(table.step, without)
            variance = np.diagonal(get["cov"], axis1=1, axis2=2)[:, axes]
            rows &= np.isfinite(get["residual"][:, axes]).all(1) & (variance > 0).all(1)
            rows &= np.nan_to_num(np.linalg.eigvalsh(np.nan_to_num(get["cov"][:, axes, axes])))[:, 0] > 0
            place = np.minimum(np.searchsorted(run.step, table.step), len(run.step) - 1)
            sensor, _, _target = name.partition("/")
            known = pieces.setdefault(sensor, [])
            piece = Readings(
                sensor, part, table.step[rows], run.time[place][rows], np.full(rows.sum(), len(known)),
                get["z"][rows, at], get["predicted"][rows, at], get["residual"][rows, axes],
                get["cov"][rows, axes, axes], get["noise"][rows, axes, axes], get["used"][rows, i] > 0,
            )  # fmt: skip
            known.append(piece)
    return {name: joined for name, found in pieces.items() if len(joined := _joined(found))}


def _joined(pieces: list[Readings]) -> Readings:
    """Several targets' readings as one sensor's, by time; only those of one space."""
    first = pieces[0]
    pieces = [piece for piece in pieces if piece.space.axes == first.space.axes]
    if len(pieces) == 1:
        return first
    names = ("step", "time", "target", "z", "predicted", "residual", "cov", "noise", "used")
    whole = Readings(
        first.name, first.space, *(np.concatenate([getattr(piece, name) for piece in pieces]) for name in names)
    )
    return whole.pick(np.argsort(whole.step, kind="stable"))


def parameter(run: Run, *names: str) -> tuple[str, Any] | None:
    """The first of these parameters that the run's scenario has, and its value."""
    params = run.properties.get("params", {})
    return next(((name, params[name]) for name in names if name in params), None)


class Sequence:
    """All stages of a run by place: `mean` (P, n) and `cov` (P, d, d) after each, NaN where a place has no stage."""

    def __init__(self, run: Run) -> None:
        tables = [table for table in run.stages.values() if len(table.place)]
        end = max((int(table.place.max()) + 1 for table in tables), default=0)
        n, d = len(run.space.names), len(run.space.axes)
        self.mean, self.cov = np.full((end, n), np.nan), np.full((end, d, d), np.nan)
        self.stage: list[tuple[StageTable, int] | None] = [None] * end
        for table in tables:
            if "mean" in table.values:
                self.mean[table.place], self.cov[table.place] = table.mean, table.cov
            for row, place in enumerate(table.place.tolist()):
                self.stage[place] = table, row

    @cached_property
    def sound(self) -> np.ndarray:
        """Which covariances (P,) can be solved with (`rounding.sound`)."""
        return sound(self.cov)

    def sound_before(self, table: StageTable) -> np.ndarray:
        """The same of those before each of a stage's rows (M,)."""
        return self.sound[table.place - 1] & (table.place > 0)

    def before(self, table: StageTable) -> tuple[Array, Array]:
        """The mean (M, n) and covariance (M, d, d) before each of a stage's rows, NaN before the first."""
        at = table.place - 1
        mean, cov = self.mean[at], self.cov[at]
        mean[at < 0], cov[at < 0] = np.nan, np.nan
        return mean, cov

    def past(self, table: StageTable, row: int, what: str) -> Array | None:
        """A quantity of the stage before one of a stage's rows, such as `states` (N, n); None where it was not kept."""
        place = int(table.place[row])
        found = self.stage[place - 1] if place else None
        return None if found is None or what not in found[0].values else found[0].values[what][found[1]]


@dataclass(frozen=True)
class Case:
    """A run under examination: its sensors' readings without those of faulty times, and its stages in order."""

    run: Run
    sensors: dict[str, Readings]
    sequence: Sequence

    @property
    def space(self) -> Product:
        """The state's, of one part where it has no parts."""
        return as_product(self.run.space)

    @property
    def first(self) -> int:
        return int(self.run.properties.get("first", 0))

    @property
    def whole(self) -> tuple[int, int]:
        """The steps that count."""
        return max(self.first, int(self.run.step[0])), int(self.run.step[-1])


def case(run: Run, faulty: Iterable[tuple[int, int]] = ()) -> Case:
    """The run without the steps of its faulty intervals (first, last), inclusive."""
    without = [np.arange(first, last + 1) for first, last in faulty]
    return Case(run, sensors(run, np.concatenate(without) if without else np.empty(0, int)), Sequence(run))


def once(case: Case, name: str, make: Callable[[Case], T]) -> T:
    """What `make` finds of a case, kept under a name for whoever asks next."""
    if not hasattr(case, name):
        object.__setattr__(case, name, make(case))
    found: T = getattr(case, name)
    return found


def tells_gain(table: StageTable) -> bool:
    """Whether an update says how readings move the state: a recording of a person's own may leave it out."""
    cross = table.values.get("innovation.cross_cov")
    return cross is not None and "gain" in table.values and bool(np.nan_to_num(cross).any())


def sensor_of(table: StageTable) -> str | None:
    """The sensor whose readings an update takes in; None where it takes in several."""
    space = table.spaces["innovation"]
    names = {name.partition("/")[0] for name in space.parts} if isinstance(space, Product) else set[str]()
    return names.pop() if len(names) == 1 else None


def tells_reading(predicted: Array) -> bool:
    """Whether readings are there, and not their residuals in their stead."""
    return bool(np.nan_to_num(predicted).any())


def units(space: Space) -> set[str]:
    return set(space.axis_units)
