"""What can be asked of a moment, by name: the numbers of its stage, and what follows from them.

A `Frame` is one stage at one moment, or at M moments at once, so that a breakpoint is tried on a whole recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from viz_estim.core.consistency import nis, squared_distance
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product, Space
from viz_estim.debugger.expressions import Absent


class Axis(NamedTuple):
    """The names of an array's elements along one axis, and their units."""

    names: tuple[str, ...]
    units: tuple[str, ...]

    def find(self, wanted: str) -> list[int] | int | None:
        """Where the name stands, or all of a part's or a sensor's components; None where there is none."""
        if wanted in self.names:
            return self.names.index(wanted)
        return [i for i, name in enumerate(self.names) if name.startswith((f"{wanted}.", f"{wanted}/"))] or None


class Quantity(NamedTuple):
    """Values (M, …), and for each axis after the first its names, or None where they have none."""

    value: Array
    axes: tuple[Axis | None, ...] = ()

    def part(self, wanted: str) -> Quantity | None:
        """The part, sensor or component of that name, along every axis that has it."""
        value, axes, found = self.value, [], False
        for i, axis in reversed(list(enumerate(self.axes))):
            at = axis.find(wanted) if axis else None
            if at is None:
                axes.append(axis)
                continue
            value, found = np.take(value, at, axis=i + 1), True
            if axis and isinstance(at, list):
                names = tuple(axis.names[j].removeprefix(f"{wanted}.") for j in at)
                axes.append(Axis(names, tuple(axis.units[j] for j in at)))
        return Quantity(value, tuple(reversed(axes))) if found else None


def _nothing() -> Mapping[str, Array]:
    return {}


@dataclass(frozen=True)
class Frame:
    """A stage at M moments. step, place, time, dt (M,); index (M,): which of its step's stages it is.

    values: the stage's numbers by name (M, …), as recordings have them; spaces: of its fields; inputs: of the step;
    before(): the belief's arrays before the stage; findings (M,): where one begins; particles: of a cloud, how many;
    sensors: whose likelihoods a stage over labels tells.
    """

    stage: str
    space: Space | None
    labels: tuple[str, ...]
    step: np.ndarray
    place: np.ndarray
    index: np.ndarray
    time: np.ndarray
    dt: np.ndarray
    values: Mapping[str, Array]
    spaces: Mapping[str, Space]
    truth: Array | None
    inputs: Mapping[str, Array]
    before: Callable[[], Mapping[str, Array]] = _nothing
    findings: np.ndarray | None = None
    particles: int = 0
    sensors: tuple[str, ...] = ()
    _known: dict[str, Quantity] = field(default_factory=dict)

    def quantity(self, name: str) -> Quantity:
        """The quantity of that name; Absent where this stage has none."""
        if name not in self._known:
            head, dot, rest = name.partition(".")
            if head == "before" and dot:
                before = replace(
                    self, values=self.before(), spaces={}, inputs={}, findings=None, _known={}, before=_nothing
                )
                try:
                    self._known[name] = before.quantity(rest)
                except Absent as error:
                    known = [f"before.{one}" for one in before.values]
                    hint = f"there are {', '.join(known)}" if known else "nothing came before this stage"
                    raise Absent(f"no {name}; {hint}") from error
            else:
                self._known[name] = self._found(name)
        return self._known[name]

    def lookup(self, name: str) -> Array:
        """Its values alone, for an expression."""
        return self.quantity(name).value

    def names(self) -> Iterator[str]:
        """Every quantity there is here, whole."""
        yield from self._derived
        yield from (name for name in self.values if name not in self._derived)
        yield from self.inputs
        yield from (f"before.{name}" for name in self.before())

    def parts(self, name: str) -> list[str]:
        """What may stand behind the name's dot: parts, sensors, components."""
        try:
            axes = [axis for axis in self.quantity(name).axes if axis]
        except Absent:
            return []
        names = [full for axis in axes for full in axis.names]
        return [*dict.fromkeys(part for full in names for part in (full.partition(".")[0], full))]

    def _found(self, name: str) -> Quantity:
        words = name.split(".")
        for count in range(len(words), 0, -1):
            head, rest = ".".join(words[:count]), ".".join(words[count:])
            for known in (head, f"{head}.residual", f"{head}.points"):
                if (whole := self._whole(known)) is not None:
                    part = whole.part(rest) if rest else whole
                    if part is None:
                        break
                    # An error of several components is asked for as its length: for an attitude, the geodesic angle.
                    several = head == "error" and rest and part.value.ndim == 2
                    return Quantity(np.sqrt((part.value**2).sum(1))) if several else part
        close = get_close_matches(name, list(self.names()), n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else "`names` lists what there is"
        raise Absent(f"no {name} at {f'stage {self.stage}' if self.stage else 'a step without stages'}; {hint}")

    def _whole(self, name: str) -> Quantity | None:
        if name in self._derived:
            return self._derived[name]()
        for known in (self.values, self.inputs):
            if name in known:
                value = _plain(known[name])
                axes = (*self._axes(name), *[None] * value.ndim)[: value.ndim - 1]
                fitting = zip(axes, value.shape[1:], strict=True)
                return Quantity(value, tuple(axis if axis and len(axis.names) == n else None for axis, n in fitting))
        return None

    @cached_property
    def _derived(self) -> dict[str, Callable[[], Quantity]]:
        """What is not recorded, but follows."""
        one: dict[str, Callable[[], Quantity]] = {
            "step": lambda: Quantity(self.step),
            "time": lambda: Quantity(self.time),
            "dt": lambda: Quantity(self.dt),
            "stage": lambda: Quantity(np.array([self.stage])),
        }
        if self.findings is not None:
            findings = self.findings
            one["finding"] = lambda: Quantity(findings)
        if "cov" in self.values and self.space is not None:
            one["std"] = self._std
        if self._truth_known:
            one["truth"] = self._truth
            if "mean" in self.values and self.space is not None:
                one |= {"error": self._error, "nees": self._nees}
        if any(name.endswith(".residual") and name[:-9] in self.spaces for name in self.values):
            one["nis"] = self._nis
        if self.particles:
            one["N"] = lambda: Quantity(np.array([float(self.particles)]))
            if "log_weights" in self.values and "ess" not in self.values:
                one["ess"] = self._ess
        if self.labels and "log_probabilities" in self.values:
            one["probability"] = lambda: Quantity(np.exp(self.values["log_probabilities"]), (self._components,))
        return one

    @property
    def _truth_known(self) -> bool:
        return self.truth is not None and self.truth.shape[-1] > 0

    @property
    def _components(self) -> Axis:
        """Of the mean; of the probabilities, where the belief is over labels."""
        if self.space is None or self.labels:
            return Axis(self.labels, ("",) * len(self.labels))
        return Axis(self.space.names, self.space.units)

    @property
    def _directions(self) -> Axis:
        return Axis(self.space.axes, self.space.axis_units) if self.space is not None else Axis((), ())

    def _truth(self) -> Quantity:
        truth = np.asarray(self.truth)
        if not self.labels:
            return Quantity(truth, (self._components,))
        return Quantity(
            np.array(["", *self.labels])[np.where(np.isfinite(truth[:, 0]), truth[:, 0], -1).astype(int) + 1]
        )

    def _std(self) -> Quantity:
        variance = np.diagonal(self.values["cov"], axis1=1, axis2=2)
        return Quantity(np.sqrt(np.maximum(variance, 0.0)), (self._directions,))

    def _error(self) -> Quantity:
        assert self.space is not None
        assert self.truth is not None
        return Quantity(self.space.minus(self.values["mean"], self.truth), (self._directions,))

    def _ess(self) -> Quantity:
        weights = np.exp(self.values["log_weights"])
        if weights.shape[1] != self.particles:
            raise Absent("the cloud was thinned for the recording: ess is known where a stage tells it")
        return Quantity(1 / np.square(weights).sum(-1))

    def _nees(self) -> Quantity:
        """Over the parts of the state that have a truth; NaN where the covariance is singular."""
        error, P = self._error().value, self.values["cov"]
        known = np.isfinite(error)
        found = np.full(len(error), np.nan)
        for pattern in np.unique(known, axis=0):
            rows, at = np.flatnonzero((known == pattern).all(1)), np.flatnonzero(pattern)
            if len(at):
                sound = np.isfinite(P[rows]).all((1, 2))
                block = P[np.ix_(rows[sound], at, at)]
                found[rows[sound]] = squared_distance(error[rows[sound]][:, at], block)
        return Quantity(found)

    def _nis(self) -> Quantity:
        """Of each sensor, by its own block of S."""
        names: list[str] = []
        found: list[Array] = []
        for one, space in self.spaces.items():
            if f"{one}.residual" in self.values and isinstance(space, Product):
                residual, cov, offered = (self.values[f"{one}.{k}"] for k in ("residual", "cov", "offered"))
                for name, sensor in nis(space, residual, cov, offered.astype(bool)).items():
                    names.append(name)
                    found.append(sensor.values)
        return Quantity(np.stack(found, axis=1), (Axis(tuple(names), ("",) * len(names)),))

    def _axes(self, name: str) -> tuple[Axis | None, ...]:
        """The names along each axis of a stage's own number, as far as its name tells."""
        state = self._components
        along = state if self.labels else self._directions
        own: dict[str, tuple[Axis | None, ...]] = {
            "mean": (state,), "cov": (along, along), "states": (None, state), "log_probabilities": (state,),
            "transition": (along, along), "noise": (along, along),
            "log_likelihoods": (Axis(self.sensors, ("",) * len(self.sensors)), state),
            "reading": (Axis(self.sensors, ("",) * len(self.sensors)),),
        }  # fmt: skip
        if name in own:
            return own[name]
        if name == "gain" and "innovation" in self.spaces:
            measured = self.spaces["innovation"]
            return along, Axis(measured.axes, measured.axis_units)
        field_, _, part = name.rpartition(".")
        if field_ not in self.spaces:
            return ()
        space = self.spaces[field_]
        numbers, axes = Axis(space.names, space.units), Axis(space.axes, space.axis_units)
        sensors = Axis(tuple(space.parts), ("",) * len(space.parts)) if isinstance(space, Product) else None
        parts: dict[str, tuple[Axis | None, ...]] = {
            "points": (None, numbers), "z": (numbers,), "predicted": (numbers,), "residual": (axes,),
            "cov": (axes, axes), "noise": (axes, axes), "cross_cov": (along, axes), "blind": (along, sensors),
            "used": (sensors,), "offered": (sensors,),
        }  # fmt: skip
        return parts.get(part, ())


def _plain(values: Any) -> Array:
    """Of rows of different lengths, one alone; several have no common array."""
    if values.dtype == object:
        if len(values) != 1:
            raise Absent("its length differs from step to step: ask for it at one step")
        return np.asarray(values[0], float)[None]
    return np.asarray(values, float)
