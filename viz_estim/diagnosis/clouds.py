"""Particles against the truth: how the cloud's own moves carry it.

A particle filter records no model, but it has asked its model at many states: how each particle moved. So a planar
robot's prediction from the truth is the mean of the particles' moves, each in its own body's frame, where it depends on
no place and no heading: also where the cloud has gone elsewhere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SE2, SO2
from viz_estim.diagnosis.evidence import Case

_FEWEST = 20


class Moves(NamedTuple):
    """By step (M,) what the truth does in its body's frame (M, 3): forward, left, turn; and what the cloud is told."""

    step: np.ndarray
    truly: Array
    told: Array


def moves(case: Case) -> Moves | None:
    """Of a planar robot's particles; None where there are none, or no truth."""
    run = case.run
    found = [t for t in run.stages.values() if "states" in t.values and t.name != "start"]
    found = [t for t in found if not {"ancestors", "log_likelihoods"} & t.values.keys()]
    if not _is_planar(case) or len(found) != 1 or not np.isfinite(run.truth).all(1).any():
        return None
    (table,), pose = found, SE2()
    kept: list[tuple[int, Array, Array]] = []
    for row, (step, place) in enumerate(zip(table.step.tolist(), table.place.tolist(), strict=True)):
        past, at = case.sequence.stage[place - 1] if place else None, int(np.searchsorted(run.step, step))
        before = past[0].values.get("states") if past else None
        if past is None or before is None or at == 0 or step <= case.first:
            continue
        x, y, weights = before[past[1]], table.values["states"][row], np.exp(table.values["log_weights"][row])
        told = weights @ pose.minus(y, x)
        truly = pose.minus(run.truth[at], run.truth[at - 1])
        if np.isfinite(told).all() and np.isfinite(truly).all():
            kept.append((step, truly, told))
    if len(kept) < _FEWEST:
        return None
    steps, truly_, told_ = zip(*kept, strict=True)
    return Moves(np.array(steps), np.array(truly_), np.array(told_))


def _is_planar(case: Case) -> bool:
    """Whether a state is x, y and a heading."""
    parts = list(case.space.parts.values())
    one = len(parts) == 1 and isinstance(parts[0], SE2)
    two = len(parts) == 2 and isinstance(parts[1], SO2) and list(parts[0].axis_units) == ["m", "m"]
    return case.run.properties.get("belief") == "Particles" and (one or two)
