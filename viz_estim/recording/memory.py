"""A run as arrays straight from its steps, without a file between: what `load` would read back."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from viz_estim.core.descriptions import describe, rebuild
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Step, failed_where
from viz_estim.core.scenery import Cloud
from viz_estim.core.spaces import Space
from viz_estim.core.stages import Innovation, Matches, SigmaPoints, Stage
from viz_estim.recording.layout import as_product, flat3
from viz_estim.recording.reader import Run
from viz_estim.recording.tables import StageTable, ends, work_out


def collect(scenario: Scenario, steps: Iterable[Step], params: dict[str, Any] | None = None) -> Run:
    """The run (at least one step) with every number of its stages; properties: params, first, belief, facts."""
    rows = list(steps)
    labels = tuple(getattr(scenario.beliefs[0], "labels", ()))
    # As the reader has it, whatever a person's own space does.
    space = as_product(None) if scenario.space is None else rebuild(describe(scenario.space))
    stages: dict[str, list[tuple[int, int, Stage]]] = {}
    place = 0
    for step in rows:
        for stage in step.stages:
            stages.setdefault(stage.name, []).append((step.index, place, stage))
            place += 1
        place += not step.stages
    tables = {name: _table(name, found, space) for name, found in stages.items()}
    work_out(tables, space)
    index = np.array([step.index for step in rows])
    size = 1 if labels else len(space.names)
    properties = {
        "params": params or {},
        "first": max(scenario.beliefs),
        "belief": type(scenario.beliefs[0]).__name__,
        "facts": dict(scenario.facts),
    }
    failure = rows[-1].error
    return Run(
        Path("memory"),
        properties,
        space,
        labels,
        index,
        np.array([step.tick.time for step in rows]),
        np.array([step.tick.dt for step in rows]),
        np.stack([np.full(size, np.nan) if step.truth is None else step.truth for step in rows]),
        _inputs(rows),
        tables,
        ends(index, tables, space, labels),
        f"step {failure.step}, {failed_where(failure.stage)}: {failure.message}" if failure else None,
        True,
        {
            name: (flat3(thing.points), thing.moves)
            for name, thing in scenario.scenery.items()
            if isinstance(thing, Cloud)
        },
    )


def _inputs(rows: list[Step]) -> dict[str, Array]:
    found: dict[str, list[Any]] = {"control": [step.tick.control for step in rows]}
    for kind, of in (("z", "measurements"), ("raw", "raw")):
        names = dict.fromkeys(name for step in rows for name in getattr(step.tick, of))
        found |= {f"{kind}.{name}": [getattr(step.tick, of).get(name) for step in rows] for name in names}
    return {name: _stacked(values) for name, values in found.items() if any(v is not None for v in values)}


def _stacked(values: list[Any]) -> Array:
    """Values of one shape, NaN where one is absent."""
    absent = np.full(np.shape(next(v for v in values if v is not None)), np.nan)
    return np.array([absent if v is None else v for v in values], float)


def _table(name: str, found: list[tuple[int, int, Stage]], space: Space) -> StageTable:
    index, places, stages = zip(*found, strict=True)
    values: dict[str, Any] = {}
    spaces: dict[str, Space] = {}
    for kind in stages[0].belief.shapes:
        values[kind] = np.stack([getattr(stage.belief, kind) for stage in stages])
    if "states" in values:  # the moments of many clouds are worked out at once
        n, d = len(space.names), len(space.axes)
        values |= {"mean": np.full((len(found), n), np.nan), "cov": np.full((len(found), d, d), np.nan)}
    for field in [f.name for f in dataclasses.fields(stages[0])[2:]]:
        of = [getattr(stage, field) for stage in stages]
        if isinstance(of[0], SigmaPoints):
            spaces[field] = of[0].space
            values[f"{field}.points"] = np.stack([one.points for one in of])
        elif isinstance(of[0], Innovation):
            spaces[field] = of[0].space
            for part in Innovation.__slots__[1:]:
                values[f"{field}.{part}"] = np.array([getattr(one, part) for one in of], float)
        elif isinstance(of[0], Matches):
            for part in Matches.__slots__:
                values[f"{field}.{part}"] = _ragged([getattr(one, part) for one in of])
        elif isinstance(of[0], (np.ndarray, float, int)):
            values[field] = np.array(of, float)
    return StageTable(name, np.array(index), np.array(places), values, spaces)


def _ragged(arrays: list[Any]) -> np.ndarray:
    found = np.empty(len(arrays), object)
    found[:] = arrays
    return found
