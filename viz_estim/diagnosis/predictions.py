"""Does a prediction's covariance do what its own numbers say?

P⁺ = F·P·Fᵀ + Q (Kalman 1960), of which all four are recorded: no chance is in it, and no truth is needed. Where it does
not hold, it is tried whether it is one of the ways in which it is often written wrong; that one is named if it explains
all but SHEET of the deviation, and if over the run the deviations multiply to what as many predictions can tell of a
variance, 1 + √(2/N). What has no name is told only where a single prediction, in the middle of them, is that far off: a
filter may scale its covariance, or turn it into other axes, in between.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.measurement import symmetrised
from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.covariance import ratios
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import GROSS, REPEATED, SHEET, TINY, Finding, Severity
from viz_estim.diagnosis.rounding import rounding_of, sound
from viz_estim.recording.tables import StageTable

_WAYS = {
    "transposed": (
        "the covariance is predicted as Fᵀ·P·F + Q: F is transposed, so that uncertainty goes from one part of the "
        "state to another the wrong way", "write P⁺ = F·P·Fᵀ + Q",
    ),
    "no Q": (
        "the predicted covariance is F·P·Fᵀ alone: the process noise Q is told of, but not added to it, so that the "
        "filter becomes too sure", "write P⁺ = F·P·Fᵀ + Q",
    ),
    "no F": (
        "the predicted covariance is P + Q: F does not move it, so that an unsure rate makes no place unsure",
        "write P⁺ = F·P·Fᵀ + Q",
    ),
    "stale": (
        "the prediction starts from a covariance that is not the last one, but the one before the update: what the "
        "reading told is forgotten, or the update's covariance went into another variable",
        "carry the covariance after the update on to the next prediction",
    ),
}  # fmt: skip


def predictions(case: Case) -> Iterator[Finding]:
    """One finding for each prediction whose F (d, d) and Q (d, d) are recorded."""
    if case.run.labels:
        return
    for table in case.run.stages.values():
        if {"transition", "noise", "cov"} <= table.values.keys():
            yield from _of(case, table)


def _of(case: Case, table: StageTable) -> Iterator[Finding]:
    F, Q, after = (table.values[name] for name in ("transition", "noise", "cov"))
    if not F.shape == Q.shape == after.shape:
        return
    P = case.sequence.before(table)[1]
    rows = np.all([np.isfinite(A).all((1, 2)) for A in (F, Q, after, P)], axis=0) & (table.step >= case.first)
    right = F @ P @ np.swapaxes(F, 1, 2) + Q
    rows[rows] &= sound(symmetrised(right[rows])) & sound(symmetrised(after[rows]))
    if rows.sum() < REPEATED:
        return
    earlier = np.concatenate([P[:1], after[:-1]]), case.sequence.cov[np.maximum(table.place - 2, 0)]
    F, Q, after, P, right, last, past = (A[rows] for A in (F, Q, after, P, right, *earlier))
    beyond = after - right
    off = np.abs(beyond).max((1, 2)) > rounding_of(P, after)
    if not np.median(off) or _faded(after - Q, right - Q, rounding_of(P, after)):
        return
    low, high = ratios(after, right)
    ratio = np.maximum(high, 1 / np.maximum(low, TINY))
    told = float(np.sqrt(2 / (len(P) * P.shape[-1])))
    middle = float(np.median(ratio))
    severity: Severity = "error" if middle > GROSS else "warning"
    steps = int(table.step[rows][0]), int(table.step[rows][-1])
    evidence: dict[str, object] = {"stage": table.name, "predictions": len(P), "ratio": middle}
    if np.log(ratio[off]).sum() > np.log1p(told):
        ways = {"transposed": np.swapaxes(F, 1, 2) @ P @ F + Q, "no F": P + Q, "no Q": right - Q}
        left = {name: _left(after, made, beyond) for name, made in ways.items()}
        # Before all updates of the step, or before its last one.
        left["stale"] = min(_left(after, F @ A @ np.swapaxes(F, 1, 2) + Q, beyond) for A in (last, past))
        name = min(left, key=lambda name: left[name])
        times = _times(beyond, Q)
        if left[name] < SHEET:
            cause, remedy = _WAYS[name]
            yield Finding("prediction", "error", None, steps, evidence | {"way": name}, cause, remedy)
            return
        if times is not None:
            yield Finding(
                "prediction", "error" if not 1 / GROSS < times < GROSS else severity, None, steps,
                evidence | {"way": "Q", "times": times},
                f"the predicted covariance is F·P·Fᵀ + {times:.3g}× Q: the process noise is not added as it is told",
                "add Q once a prediction; where it is a density, multiply it by dt once",
            )  # fmt: skip
            return
    if middle > 1 + told:
        yield Finding(
            "prediction", severity, None, steps, evidence,
            f"the predicted covariance is not F·P·Fᵀ + Q: in some direction it is {middle:.3g}× what that gives, or "
            "as much smaller",
            "write P⁺ = F·P·Fᵀ + Q with the F and Q of this prediction and the P after the last update",
        )  # fmt: skip


def _left(after: Array, made: Array, beyond: Array) -> float:
    """The share of the deviations (M, d, d) that is left where the covariance is taken to be made in this way."""
    size = np.linalg.norm(beyond, axis=(1, 2))
    return float(np.median(np.linalg.norm(after - np.nan_to_num(made), axis=(1, 2)) / np.maximum(size, TINY)))


def _faded(A: Array, B: Array, rounding: Array) -> bool:
    """Whether A is c·B with one c above 1 throughout, to rounding (M,): a fading memory (Sorenson and Sacks 1971)."""
    c = (A * B).sum((1, 2)) / np.maximum((B * B).sum((1, 2)), TINY)
    left = np.abs(A - c[:, None, None] * B).max((1, 2))
    once = np.ptp(c) < SHEET * abs(float(np.median(c)) - 1)
    return bool(np.median(c) > 1 and once and np.median(left / rounding) < 1)


def _times(beyond: Array, Q: Array) -> float | None:
    """The factor c by which c·Q stands for Q; None where what is beyond is no multiple of Q."""
    size = (Q * Q).sum((1, 2))
    if not size.any():
        return None
    c = (beyond * Q).sum((1, 2)) / np.maximum(size, TINY)
    left = np.linalg.norm(beyond - c[:, None, None] * Q, axis=(1, 2))
    if np.median(left / np.maximum(np.linalg.norm(beyond, axis=(1, 2)), TINY)) > SHEET:
        return None
    return 1 + float(np.median(c))
