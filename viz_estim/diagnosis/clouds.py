"""Particles against the truth: how the cloud's own moves carry it; and means that have gone elsewhere.

A particle filter records no model, but it has asked its model at many states: how each particle moved. So a planar
robot's prediction from the truth is the mean of the particles' moves, each in its own body's frame, where it depends on
no place and no heading: also where the cloud has gone elsewhere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SE2, SO2, SO3, wrap
from viz_estim.diagnosis.durations import by_biases, whole
from viz_estim.diagnosis.evidence import Case, once
from viz_estim.diagnosis.finding import EXPLAINED, FEWEST, level


class Moves(NamedTuple):
    """By step (M,) what the truth does in its body's frame (M, 3): forward, left, turn; and what the cloud is told."""

    step: np.ndarray
    truly: Array
    told: Array


def moves(case: Case) -> Moves | None:
    """Of a planar robot's particles; None where there are none, or no truth."""
    return once(case, "_moves", _moves)


def _moves(case: Case) -> Moves | None:
    run = case.run
    found = [t for t in run.stages.values() if "states" in t.values and t.name != "start"]
    found = [t for t in found if not {"ancestors", "log_likelihoods"} & t.values.keys()]
    if not _is_planar(case) or len(found) != 1 or not np.isfinite(run.truth).all(1).any():
        return None
    (table,), pose = found, SE2()
    kept: list[tuple[int, Array, Array]] = []
    for row, step in enumerate(table.step.tolist()):
        x, at = case.sequence.past(table, row, "states"), int(np.searchsorted(run.step, step))
        if x is None or at == 0 or step <= case.first:
            continue
        y, weights = table.values["states"][row], np.exp(table.values["log_weights"][row])
        told = weights @ pose.minus(y, x)
        truly = pose.minus(run.truth[at], run.truth[at - 1])
        if np.isfinite(told).all() and np.isfinite(truly).all():
            kept.append((step, truly, told))
    if len(kept) < FEWEST:
        return None
    steps, truly_, told_ = zip(*kept, strict=True)
    return _unwrapped(case, Moves(np.array(steps), np.array(truly_), np.array(told_)))


def _unwrapped(case: Case, found: Moves) -> Moves:
    """With turns of more than a half one where the control tells of them: by the number of it that the turns follow
    best, all around the circle (Rayleigh's test; Mardia and Jupp 2000, section 6.3)."""
    run = case.run
    row = np.searchsorted(run.step, found.step)
    if "control" not in run.inputs or not np.isfinite(run.inputs["control"][row]).all():
        return found
    turns = run.inputs["control"][row] * run.dt[row][:, None]
    off = wrap(found.told[:, 2:] - turns)
    follows = np.exp(1j * off).mean(0).real
    best = int(np.argmax(follows))
    if not follows[best] > 0 or np.exp(-len(row) * follows[best] ** 2) > level("error", len(follows)):
        return found
    return found._replace(told=np.column_stack([found.told[:, :2], turns[:, best] + off[:, best]]))


def moves_of_means(case: Case) -> Moves | None:
    """The same of a filter whose one prediction moves the mean of a planar robot, wherever that has gone."""
    run, at = case.run, _planar_part(case)
    tables = [t for t in run.stages.values() if t.name.startswith("predict") and "mean" in t.values]
    if at is None or len(tables) != 1 or run.properties.get("belief") == "Particles":
        return None
    (table,), pose = tables, SE2()
    before, _ = case.sequence.before(table)
    row = np.searchsorted(run.step, table.step)
    told = pose.minus(table.mean[:, at], before[:, at])
    truly = pose.minus(run.truth[row][:, at], run.truth[np.maximum(row - 1, 0)][:, at])
    fine = np.isfinite(told).all(1) & np.isfinite(truly).all(1) & (row > 0) & (table.step > case.first)
    return _unwrapped(case, Moves(table.step[fine], truly[fine], told[fine])) if fine.sum() >= FEWEST else None


def turns_of_means(case: Case, window: float) -> tuple[str, Moves, Array] | None:
    """The part that is an attitude, by window (s) what the truth turns by and the mean by its prediction, each in
    its own body's axes (M, 3), and the mean's in the world's. In one step noise of the truth would hide it."""
    run = case.run
    tables = [t for t in run.stages.values() if t.name.startswith("predict") and "mean" in t.values]
    parts = [(name, case.space.at[name]) for name, part in case.space.parts.items() if isinstance(part, SO3)]
    if len(parts) != 1 or len(tables) != 1 or run.labels or "mean" not in run.ends:
        return None
    ((name, at), table), space = (parts[0], tables[0]), SO3()
    by = whole(case, table)
    before, row, usual = by.before, np.searchsorted(run.step, by.step), float(np.median(np.diff(run.time)))
    n = max(1, round(window / max(usual, 1e-9)))
    told = space.minus(by.after[:, at], before[:, at])
    fine = np.isfinite(told).all(1) & (row > 0) & (by.step > case.first)
    rates = [case.space.at[k] for k, part in case.space.parts.items() if list(part.axis_units) == ["rad/s"] * 3]
    for rate in rates:
        by_state = before[fine, rate] * run.dt[row[fine], None]
        if np.square(told[fine] - by_state).sum() < (1 - EXPLAINED) * np.square(told[fine]).sum():
            return None  # it turns as the state says, by a rate that readings have taught it
    told -= by_biases(case, table, by, name)
    rows = np.flatnonzero(fine)[: fine.sum() // n * n].reshape(-1, n)
    rows = rows[row[rows[:, -1]] - row[rows[:, 0]] == n - 1]
    turn = quaternions.exp(told)
    about = quaternions.exp(quaternions.rotate(before[:, at], told))
    turned, in_world = (_composed(q[rows]) for q in (turn, about))
    truly = space.minus(run.truth[row[rows[:, -1]]][:, at], run.truth[row[rows[:, 0]] - 1][:, at])
    known = np.isfinite(truly).all(1)
    if known.sum() < FEWEST:
        return None
    return name, Moves(by.step[rows[known, 0]], truly[known], turned[known]), in_world[known]


def _composed(q: Array) -> Array:
    """The rotation vectors (W, 3) of the products of n turns each (W, n, 4), one after the other."""
    whole = q[:, 0]
    for k in range(1, q.shape[1]):
        whole = quaternions.multiply(whole, q[:, k])
    return quaternions.log(whole)


def _planar_part(case: Case) -> slice | None:
    """Where x, y and a heading stand in the state, one after the other."""
    names, parts = list(case.space.parts), list(case.space.parts.values())
    for name, part, after in zip(names, parts, [*parts[1:], None], strict=True):
        start = case.space.at[name].start
        flat = not isinstance(part, SE2) and list(part.axis_units) == ["m", "m"] and isinstance(after, SO2)
        if isinstance(part, SE2) or flat:
            return slice(start, start + 3)
    return None


def _is_planar(case: Case) -> bool:
    """Whether a state is x, y and a heading."""
    parts = list(case.space.parts.values())
    one = len(parts) == 1 and isinstance(parts[0], SE2)
    two = len(parts) == 2 and isinstance(parts[1], SO2) and list(parts[0].axis_units) == ["m", "m"]
    return case.run.properties.get("belief") == "Particles" and (one or two)
