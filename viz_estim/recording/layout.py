"""What a recording holds, learnt from the steps themselves: stages, their fields' spaces, sensors, what was drawn.

The view is a function of this, and the reader gives arrays their shapes by it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from viz_estim.core.descriptions import describe
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product, Space
from viz_estim.core.stages import Innovation, SigmaPoints, Stage
from viz_estim.recording.batch import Batch


class Layout:
    """stages: per stage the shape (as JSON: a list) or the space of each field; inputs: the sensors seen on ticks.

    sensors: the spaces of those that innovations came from, reach: about how long their readings are; true_parts: the
    parts of the state that have a truth.
    """

    def __init__(self, space: Space, truth: Array | None) -> None:
        self.space = as_product(space)
        known = np.isfinite(np.empty((0, len(self.space.names))) if truth is None else truth)
        self.true_parts = [name for name, at in self.space.at.items() if known[:, at].all(1).any()]
        self.stages: dict[str, dict[str, Any]] = {}
        self.inputs: list[str] = []
        self.sensors: dict[str, Space] = {}
        self.reach: dict[str, float] = {}

    def learn(self, batch: Batch) -> bool:
        """Takes in what is new; True where anything is."""
        before = (len(self.stages), len(self.inputs))
        for rows in batch.stages:
            if rows.name not in self.stages:
                self._learn(rows.stages[0])
        for step in batch.steps:
            tick = step.tick
            for sensor in tick.measurements:
                if sensor not in self.inputs:
                    self.inputs.append(sensor)
            for sensor in tick.raw:
                if sensor not in self.inputs:
                    self.inputs.append(sensor)
        return before != (len(self.stages), len(self.inputs))

    def _learn(self, stage: Stage) -> None:
        fields: dict[str, Any] = {}
        for field in dataclasses.fields(stage)[2:]:
            value = getattr(stage, field.name)
            if isinstance(value, SigmaPoints):
                fields[field.name] = {"points": describe(value.space), "count": int(value.points.shape[-2])}
            elif isinstance(value, Innovation):
                fields[field.name] = {"innovation": describe(value.space)}
                self.sensors |= value.space.parts
                for name, at in value.space.at.items():
                    size = float(np.linalg.norm(value.z[at]))
                    self.reach[name] = size if size > 0.1 else 1.0
            elif isinstance(value, np.ndarray):
                fields[field.name] = {"shape": list(value.shape)}
        self.stages[stage.name] = fields

    def place(self, sensor: str) -> int:
        """Where the sensor stands among all: its colour."""
        return [*self.inputs, *(name for name in self.sensors if name not in self.inputs)].index(sensor)

    def as_json(self) -> dict[str, Any]:
        return {"stages": self.stages, "inputs": self.inputs}


def as_product(space: Space) -> Product:
    """The space itself, or a product of it alone under the name `state`."""
    return space if isinstance(space, Product) else Product(state=space)
