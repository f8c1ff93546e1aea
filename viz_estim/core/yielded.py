"""What a filter yields, looked over as it comes: what could not be recorded or read back is told at its step."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from viz_estim.core.spaces import Product
from viz_estim.core.stages import Innovation, LinearPredict, Matches, SigmaPoints, Stage, Update

Shape = tuple[int, ...]


class Yielded:
    """Holds the stages of a run to its first belief, and those of a person's own filter to what their types say and to
    the first of their name.

    A recording keeps one table for all stages of a name: they have to be of one type, with arrays of one shape and
    innovations of the same sensors.
    """

    def __init__(self, belief: Any, *, trusted: bool) -> None:
        # A person's own kind of belief may lack shapes: then its first stage says so.
        self.shapes: dict[str, Shape] = dict(getattr(belief, "shapes", {}))
        self._trusted = trusted
        self._types: dict[str, type] = {}
        self._first: dict[tuple[str, str], Any] = {}  # by stage and field: the shape, or the sensors' components

    def check(self, stage: Any, before: Any) -> None:
        """TypeError or ValueError, with the stage's name on it, where it is no stage or does not fit.

        before: the belief before it, which did.
        """
        if not isinstance(stage, Stage):
            raise TypeError(f"step() must yield stages, got {type(stage).__name__}")
        try:
            for name, shape in self.shapes.items():
                value = getattr(stage.belief, name, None)
                if value is not getattr(before, name) and shape_of(value) != shape:
                    raise ValueError(f"expected a {name} of shape {shape}, got {shape_of(value)}")
            if not self._trusted:
                self._check_fields(stage)
        except (TypeError, ValueError) as error:
            noted: Any = error
            noted.stage = stage.name
            raise

    def _check_fields(self, stage: Stage) -> None:
        first = self._types.setdefault(stage.name, type(stage))
        if type(stage) is not first:
            raise TypeError(f"is {_a(type(stage))} here, and was {_a(first)} before; give it a name of its own")
        d = len(getattr(getattr(stage.belief, "space", None), "axes", ()))
        wanted: dict[str, Shape] = {}
        if isinstance(stage, LinearPredict):
            wanted = {"transition": (d, d), "noise": (d, d)}
        elif isinstance(stage, Update) and isinstance(stage.innovation, Innovation):
            wanted = {"gain": (d, len(stage.innovation.space.axes))}
        for field in dataclasses.fields(stage)[2:]:
            name, value = field.name, getattr(stage, field.name)
            self._check_kind(stage.name, name, value)
            if isinstance(value, Innovation):
                self._check_innovation(stage.name, name, value, d)
            elif isinstance(value, SigmaPoints):
                shape: Shape = np.shape(value.points)
                if len(shape) != 2 or shape[1] != (n := len(value.space.names)):
                    raise ValueError(f"{name}.points: expected (number of points, {n}), got {shape}")
                self._hold(stage.name, f"{name}.points", shape)
            elif isinstance(value, Matches):
                _check_matches(name, value)
            elif name in wanted:
                _expect(name, value, wanted[name])
            elif isinstance(value, np.ndarray):
                if value.dtype.kind not in "fiub":
                    raise TypeError(f"{name}: expected an array of real numbers, got one of {value.dtype}")
                self._hold(stage.name, name, value.shape)

    def _check_kind(self, stage: str, name: str, value: Any) -> None:
        kind = type(value) if isinstance(value, (Innovation, SigmaPoints, Matches)) else None
        before = self._first.setdefault((stage, f"kind of {name}"), kind)
        if kind is not before:
            got, wanted = _a(kind or type(value)), _a(before) if before else "none"
            raise TypeError(f"{name}: expected {wanted} as before, got {got}; name stages with and without one apart")

    def _check_innovation(self, stage: str, name: str, innovation: Innovation, d: int) -> None:
        space = innovation.space
        if not isinstance(space, Product):
            raise TypeError(f"{name}.space: expected a Product with a part for each sensor, got {type(space).__name__}")
        n, m, s = len(space.names), len(space.axes), len(space.parts)
        wanted: dict[str, Shape] = {"z": (n,), "predicted": (n,), "residual": (m,), "cov": (m, m), "noise": (m, m)}
        wanted |= {"cross_cov": (d, m), "used": (s,), "offered": (s,), "blind": (d, s)}
        for part, shape in wanted.items():
            _expect(f"{name}.{part}", getattr(innovation, part), shape)
        first = self._first.setdefault((stage, name), space.names)
        if space.names != first:
            raise ValueError(
                f"{name} is of {', '.join(space.names)} here, and was of {', '.join(first)} before; give the stage of "
                f'each sensor a name of its own, such as "{stage} {next(iter(space.parts))}"'
            )

    def _hold(self, stage: str, name: str, shape: Shape) -> None:
        first = self._first.setdefault((stage, name), shape)
        if shape != first:
            raise ValueError(f"{name}: expected {first} as before, got {shape}; fill up with NaN what is missing")


def shape_of(value: Any) -> Shape | str:
    """An array's shape; of anything else the name of its type."""
    return value.shape if isinstance(value, np.ndarray) else type(value).__name__


def _expect(name: str, value: Any, shape: Shape) -> None:
    if np.shape(value) != shape or value is None:
        got = type(value).__name__ if value is None else np.shape(value)
        raise ValueError(f"{name}: expected {shape}, got {got}")


def _check_matches(name: str, matches: Matches) -> None:
    source: Shape = np.shape(matches.source)
    if len(source) != 2:
        raise ValueError(f"{name}.source: expected (number of pairs, 2 or 3), got {source}")
    for part in Matches.__slots__:
        _expect(f"{name}.{part}", getattr(matches, part), source if part in ("source", "target") else source[:1])


def _a(kind: type) -> str:
    return f"{'an' if kind.__name__[0] in 'AEIOU' else 'a'} {kind.__name__}"
