"""A live stage as the debugger asks it: its numbers by the names that recordings give them, made when asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import numpy as np

from viz_estim.core.beliefs import Belief
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Step
from viz_estim.core.spaces import Space
from viz_estim.core.stages import Stage
from viz_estim.debugger.quantities import Frame


def frame_of(step: Step, index: int, before: Belief | None, place: int, scenario: Scenario) -> Frame:
    """One of a step's stages, after a belief, at a place; its name is empty where the step has none."""
    tick, stage = step.tick, step.stages[index] if step.stages else None
    inputs = {f"z.{name}": z for name, z in tick.measurements.items()} | {f"raw.{k}": z for k, z in tick.raw.items()}
    if tick.control is not None:
        inputs["control"] = tick.control
    values, spaces = _numbers(stage) if stage else ({}, {})
    first = scenario.beliefs[0]
    return Frame(
        stage.name if stage else "", scenario.space, getattr(first, "labels", ()),
        np.array([step.index]), np.array([place]), np.array([index]), np.array([tick.time]), np.array([tick.dt]),
        values, spaces,
        None if step.truth is None else step.truth[None], {name: np.atleast_1d(z)[None] for name, z in inputs.items()},
        lambda: {} if before is None else _belief(before), None, len(getattr(first, "log_weights", ())),
        tuple(getattr(stage, "sensors", ())),
    )  # fmt: skip


class _Lazy(Mapping[str, Array]):
    """Numbers that are made when they are asked for."""

    def __init__(self, makers: dict[str, Callable[[], Any]]) -> None:
        self._makers = makers

    def __getitem__(self, name: str) -> Array:
        return np.asarray(self._makers[name]())[None]

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


def _belief(belief: Belief) -> _Lazy:
    """Its arrays, and the moments of a cloud."""
    names = dict.fromkeys(getattr(belief, "shapes", {}))
    names |= dict.fromkeys(name for name in ("mean", "cov") if hasattr(type(belief), name))
    return _Lazy({name: partial(getattr, belief, name) for name in names})


def _numbers(stage: Stage) -> tuple[Mapping[str, Array], dict[str, Space]]:
    """A stage's numbers as recordings name them, and the spaces of its fields."""
    makers, spaces = dict(_belief(stage.belief)._makers), {}
    for one in fields(stage)[2:]:
        value = getattr(stage, one.name)
        if is_dataclass(value):
            if (space := getattr(value, "space", None)) is not None:
                spaces[one.name] = space
            names = [part.name for part in fields(value) if isinstance(getattr(value, part.name), np.ndarray)]
            makers |= {
                f"{one.name}.{name}": partial(getattr, value, name) for name in names if not name.endswith("_weights")
            }
        elif isinstance(value, (np.ndarray, float, int)):
            makers[one.name] = partial(getattr, stage, one.name)
    return _Lazy(makers), spaces
