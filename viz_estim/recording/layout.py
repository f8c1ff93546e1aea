"""What a recording holds, learnt from the steps themselves: stages, their fields' spaces, sensors, what was drawn.

The view is a function of this, and the reader gives arrays their shapes by it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from viz_estim.core.run import Step
from viz_estim.core.spaces import Product, Space, describe, rebuild
from viz_estim.core.stages import Innovation, SigmaPoints


class Layout:
    """stages: per stage the shape (as JSON: a list) or the space of each field; inputs: the sensors seen on ticks.

    sensors: the spaces of those that innovations came from, reach: about how long their readings are; true_parts: the
    parts of the state that have a truth.
    """

    def __init__(self, space: Space) -> None:
        self.space = as_product(space)
        self.stages: dict[str, dict[str, Any]] = {}
        self.inputs: list[str] = []
        self.sensors: dict[str, Space] = {}
        self.true_parts: list[str] = []
        self.reach: dict[str, float] = {}
        self._seen: set[tuple[str, ...]] = set()

    def learn(self, steps: list[Step]) -> bool:
        """Takes in what is new; True where anything is."""
        before = (len(self.stages), len(self.inputs), len(self.true_parts))
        for step in steps:
            key = (*(stage.name for stage in step.stages), "|", *step.tick.measurements, *step.tick.raw)
            if key not in self._seen:
                self._seen.add(key)
                self._learn(step)
        truths = [step.truth for step in steps if step.truth is not None]
        for name in self.space.parts:
            if name not in self.true_parts and any(np.isfinite(x[self.space.at[name]]).all() for x in truths):
                self.true_parts.append(name)
        return before != (len(self.stages), len(self.inputs), len(self.true_parts))

    @property
    def has_truth(self) -> bool:
        return bool(self.true_parts)

    def _learn(self, step: Step) -> None:
        self.inputs += [s for s in {**step.tick.measurements, **step.tick.raw} if s not in self.inputs]
        for stage in step.stages:
            if stage.name in self.stages:
                continue
            fields: dict[str, Any] = {}
            for field in dataclasses.fields(stage)[2:]:
                value = getattr(stage, field.name)
                if isinstance(value, SigmaPoints):
                    fields[field.name] = {"points": describe(value.space), "count": int(value.points.shape[-2])}
                elif isinstance(value, Innovation):
                    fields[field.name] = {"innovation": describe(value.space)}
                    self.sensors |= value.space.parts
                    for name, at in value.space.at.items():
                        self.reach[name] = float(np.linalg.norm(value.z[at])) or 1.0
                elif isinstance(value, np.ndarray):
                    fields[field.name] = {"shape": list(value.shape)}
            self.stages[stage.name] = fields

    def place(self, sensor: str) -> int:
        """Where the sensor stands among all: its colour."""
        return [*self.inputs, *(name for name in self.sensors if name not in self.inputs)].index(sensor)

    def points(self) -> list[tuple[str, str, Space]]:
        """Stage, field and space of all sigma points."""
        return [
            (stage, field, rebuild(what["points"]))
            for stage, fields in self.stages.items()
            for field, what in fields.items()
            if "points" in what
        ]

    def as_json(self) -> dict[str, Any]:
        return {"stages": self.stages, "inputs": self.inputs}


def as_product(space: Space) -> Product:
    """The space itself, or a product of it alone under the name `state`."""
    return space if isinstance(space, Product) else Product(state=space)
