"""Does a prediction go over its step's own time, and over it once?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import GROSS, REPEATED, Finding
from viz_estim.diagnosis.linear import transitions
from viz_estim.recording.tables import StageTable

_RATE = {"m": "m/s", "rad": "rad/s", "m/s": "m/s²"}


class Whole(NamedTuple):
    """A prediction by step, however often it is done in one: step (M,), the means before and after it (M, n), the row
    of its first part (M,), and how many parts it has at most steps."""

    step: np.ndarray
    before: Array
    after: Array
    first: np.ndarray
    times: int


def whole(case: Case, table: StageTable) -> Whole:
    """The prediction of each step from the mean before its first part to that after its last."""
    step, first, times = np.unique(table.step, return_index=True, return_counts=True)
    before, _ = case.sequence.before(table)
    return Whole(step, before[first], table.mean[first + times - 1], first, int(np.median(times)))


def composed(F: Array, by: Whole) -> Array:
    """F (M, d, d) of whole steps, the product of their parts' (K, d, d)."""
    if len(F) == len(by.first):
        return F
    made = F[by.first].copy()
    ends = np.append(by.first[1:], len(F))
    for later in range(1, int((ends - by.first).max())):
        rows = by.first + later < ends
        made[rows] = F[by.first[rows] + later] @ made[rows]
    return made


def by_biases(case: Case, table: StageTable, by: Whole, name: str) -> Array:
    """What biases that are part of the state do to a part (M, d) in whole steps: F's block times their mean, for parts
    of the unit of its rate. Wrong readings may have taught them; what is left is by the control as it came."""
    F, space = transitions(case, table), case.space
    own = space.axes_at[name]
    done = np.zeros((len(by.step), own.stop - own.start))
    rate = [_RATE.get(unit) for unit in space.parts[name].axis_units]
    for other, part in space.parts.items():
        if F is not None and list(part.axis_units) == rate:
            block = composed(F, by)[:, own, space.axes_at[other]]
            done += np.einsum("tij,tj->ti", np.nan_to_num(block), by.before[:, space.at[other]])
    return done


def carried(case: Case) -> Iterator[Finding]:
    """How much of a rate F adds to what it is the rate of: of a constant rate dt, of one that is damped less.

    Exact, whatever the data: of ẋ = v, v̇ = −A·v the block F_xv is ∫e^(−At)dt over the step, whose norm is dt at most
    (Van Loan 1978), in whatever axes of equal scale v stands. Told from the size on that makes what is added to the
    variance wrong by GROSS.
    """
    parts, axes = case.space.parts, case.space.axes_at
    pairs = [
        (name, rate)
        for name, part in parts.items()
        for rate, other in parts.items()
        if len(part.axes) == len(other.axes)
        and [_RATE.get(unit) for unit in part.axis_units] == list(other.axis_units)
        and len(set(part.axis_units)) == 1
    ]
    for table in case.run.stages.values():
        F = transitions(case, table) if pairs else None
        if F is None:
            continue
        by = whole(case, table)
        F, dt = composed(F, by), case.run.dt[np.searchsorted(case.run.step, by.step)]
        for name, rate in pairs:
            block = F[:, axes[name], axes[rate]]
            rows = np.isfinite(block).all((1, 2)) & (dt > 0) & (by.step > case.first)
            if rows.sum() < REPEATED:
                continue
            ratio = float(np.median(np.linalg.norm(block[rows], 2, axis=(1, 2)) / dt[rows]))
            if ratio**2 > GROSS:
                yield _long(case, table.name, by, name, rate, ratio, float(np.median(dt[rows])))
                return


def _long(case: Case, stage: str, by: Whole, name: str, rate: str, ratio: float, dt: float) -> Finding:
    why, remedy = (
        (f"{stage} is done {by.times} times a step, each over the whole of it", "predict once a step")
        if by.times > 1
        else ("it predicts more than once a step, or its model has another dt", "look for a second call, and at F's dt")
    )
    return Finding(
        "process_model", "error", None, (int(by.step[0]), int(by.step[-1])),
        {"component": name, "factor": ratio, "times": by.times, "dt_s": dt},
        f"a step of {dt:.3g} s moves {name} by {ratio * dt:.3g} s of {rate}, {ratio:.3g}× too far: {why}",
        f"{remedy}, over the time since the step before",
    )  # fmt: skip
