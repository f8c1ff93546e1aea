"""Are the Jacobians the models' derivatives, and is the prediction free of chance?

A linearised filter's record holds its model at the mean and its Jacobian there. Between two steps the trapezoid rule
must hold, f(b) − f(a) = ½(F_a + F_b)·(b ⊟ a). By how much it may fail is bounded: f(b) − f(a) is the mean of F along
the way times b ⊟ a, and where F's entries go from one end to the other without turning back, that mean is no further
from ½(F_a + F_b) than half of their difference, entry by entry. So no chance and no size of step makes a right Jacobian
look wrong; what a wrong one leaves is counted beyond that bound and beyond rounding. No rerun is needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product
from viz_estim.diagnosis.evidence import Case, tells_gain
from viz_estim.diagnosis.finding import FEWEST, GROSS, HALF_THE_DIGITS, TINY, Finding, Severity
from viz_estim.diagnosis.linear import jacobians
from viz_estim.diagnosis.rounding import of_stamps, rounding_of

# The share of its model's change by which a Jacobian is wrong that makes H·P·Hᵀ wrong by GROSS: (1 + s)² = 2.
_LARGE = GROSS**0.5 - 1
# Of the squares of what a sampled prediction leaves, n' − n of two draws, the motion in between holds n and not n': it
# explains at most a half, while it explains all that a wrong Jacobian leaves.
_HALF = 0.5


def measured(case: Case) -> Iterator[Finding]:
    """H against how the expected reading changes with the state; H = Cᵀ·P⁻¹, as the update used it."""
    for table in case.run.stages.values():
        if not tells_gain(table) or any(key.endswith(".points") for key in table.values):
            continue  # sigma points have no Jacobian that could be wrong
        space = table.spaces["innovation"]
        assert isinstance(space, Product)
        mean, _ = case.sequence.before(table)
        rows = np.flatnonzero(case.sequence.sound_before(table) & (table.step >= case.first))
        if len(rows) < FEWEST:
            continue
        H = jacobians(case, table)[rows]
        moved = case.space.minus(mean[rows[1:]], mean[rows[:-1]])
        seen = space.minus(
            table.values["innovation.predicted"][rows[1:]], table.values["innovation.predicted"][rows[:-1]]
        )
        expected, may = _trapezoid(H[1:], H[:-1], moved)
        predicted = np.abs(table.values["innovation.predicted"][rows])
        for name, axes in space.axes_at.items():
            largest = predicted[:, space.at[name]].max(initial=0.0)
            left, count = _left(seen[:, axes], expected[:, axes], may[:, axes], float(largest))
            if severity := _severity(left, count * (axes.stop - axes.start)):
                steps = int(table.step[rows[0]]), int(table.step[rows[-1]])
                sensor = name.partition("/")[0]
                yield _wrong(f"H of {name}", severity, sensor, steps, left, "the measurement model h(x)")
                break


def _trapezoid(after: Array, before: Array, moved: Array) -> tuple[Array, Array]:
    """½(F_a + F_b)·δ (M, m) of Jacobians (M, m, d) and steps δ (M, d), and the bound on its error: ½|F_b − F_a|·|δ|."""
    expected = 0.5 * (after + before) @ moved[..., None]
    return expected[..., 0], (0.5 * np.abs(after - before) @ np.abs(moved)[..., None])[..., 0]


def _left(change: Array, expected: Array, may: Array, largest: float) -> tuple[float, int]:
    """The median share of the changes (M, m) by which the expected ones miss them beyond what they may; of how many.

    largest: of the numbers whose differences the changes are, for their rounding. Steps that tell little are left out:
    of which the bound is more than a half.
    """
    size = np.linalg.norm(change, axis=1)
    missed = np.linalg.norm(np.maximum(np.abs(change - expected) - may, 0.0), axis=1)
    rows = (size > HALF_THE_DIGITS * max(largest, 1.0)) & (np.linalg.norm(may, axis=1) < _HALF * size)
    if rows.sum() < FEWEST:
        return 0.0, 0
    return float(np.median(missed[rows] / size[rows])), int(rows.sum())


def _severity(left: float, count: int) -> Severity | None:
    """An error where the variance is wrong by GROSS, a warning where as many numbers could tell it, 1 ± √(2/count)."""
    if count == 0 or (1 + left) ** 2 < 1 + np.sqrt(2 / count):
        return None
    return "error" if left > _LARGE else "warning"


def predicted(case: Case) -> Iterator[Finding]:
    """F against how the prediction changes with the state, and whether what is left looks like a sample of Q.

    Only between steps with the same control and dt. What is left, r, is whitened by 2Q: r of a deterministic prediction
    is 0 beyond its bound; with a sample of the noise it is N(0, 2Q), so that rᵀ(2Q)⁺r is the rank of Q in the mean.
    Told is a sample of a share of Q's variance that as many draws can tell, √(2/N) of N numbers.
    """
    run = case.run
    for table in run.stages.values():
        if not {"transition", "noise"} <= table.values.keys() or len(table.step) < FEWEST:
            continue
        F, Q = table.values["transition"], table.values["noise"]
        before, _ = case.sequence.before(table)
        row = np.searchsorted(run.step, table.step)
        alike = _alike(case, row) & np.isfinite(before[1:]).all(1) & np.isfinite(before[:-1]).all(1)
        if alike.sum() < FEWEST:
            continue
        moved = case.space.minus(before[1:], before[:-1])[alike]
        change = case.space.minus(table.mean[1:], table.mean[:-1])[alike]
        expected, may = _trapezoid(F[1:][alike], F[:-1][alike], moved)
        steps = int(table.step[0]), int(table.step[-1])
        rest = change - expected
        rest = np.sign(rest) * np.maximum(np.abs(rest) - may, 0.0)
        values, vectors = np.linalg.eigh(2 * Q[1:][alike])
        held = values > rounding_of(Q[1:][alike], Q)[:, None]
        white = np.einsum("mij,mi->mj", vectors, rest) / np.sqrt(np.where(held, values, np.inf))
        ratio = float(np.median((white**2).sum(1) / np.maximum(held.sum(1), 1)))
        unfelt = np.sqrt(2 / max(int(held.sum()), 1))
        drift = _follows(rest, moved)
        told = "control" in run.inputs  # else the prediction may follow what the recording does not hold
        whole = told or run.properties.get("recorded_by") != "viz_estim.record"  # a loop need not tell what drives it
        largest = float(np.abs(table.mean).max())
        left, count = _left(change - moved, expected - moved, may, largest)
        size = np.median(np.linalg.norm(rest, axis=1))
        if size > HALF_THE_DIGITS * max(largest, 1.0) and ratio > unfelt and drift < _HALF:
            evidence = {"size_in_Q": ratio, "stage": table.name}
            cause = f"the prediction moves the mean at random, by {ratio**0.5:.2g}× the standard deviation of Q: "
            remedy = "predict the mean by the model alone; the noise enters the covariance, as + Q"
            if whole:
                cause += "a sample of the process noise is added to it"
                yield Finding("noisy_prediction", "error", None, steps, evidence, cause, remedy)
            else:
                cause += "a noisy control (an IMU, odometry) that the recording does not hold, or a sample of the noise"
                remedy = f"tell of what moves it, `rec.step(control=…)`; if nothing does: {remedy}"
                yield Finding("noisy_prediction", "note", None, steps, evidence, cause, remedy)
        elif (drift > _HALF or (told and ratio <= unfelt)) and (severity := _severity(left, count * change.shape[1])):
            finding = _wrong("F", severity, None, steps, left, "the process model f(x)")
            if whole:
                yield finding
            else:
                yield replace(
                    finding, severity="warning",
                    cause=f"{finding.cause}; or a control that follows the state moves it, which is not recorded",
                    remedy=f"tell of what moves it, `rec.step(control=…)`; if nothing does: {finding.remedy}",
                )  # fmt: skip


def _alike(case: Case, row: np.ndarray) -> np.ndarray:
    """Which neighbouring predictions, by their steps' rows (M,), have the same control and dt.

    What is read and no update takes in may be a control too.
    """
    run = case.run
    alike = np.abs(np.diff(run.dt[row])) <= of_stamps(run)
    for name, values in run.inputs.items():
        sensor = name.removeprefix("z.").partition("/")[0]
        if name == "control" or (name.startswith("z.") and sensor not in case.sensors):
            alike &= (np.nan_to_num(values[row[1:]]) == np.nan_to_num(values[row[:-1]])).reshape(len(alike), -1).all(1)
    return alike


def _follows(rest: Array, moved: Array) -> float:
    """The share of what is left (M, d) that a constant matrix times the motion (M, d) explains: R² of least squares."""
    scale = np.maximum(np.abs(rest).max(0), TINY)
    rest = rest / scale
    fit, *_ = np.linalg.lstsq(moved / np.maximum(np.abs(moved).max(0), TINY), rest, rcond=None)
    left = rest - (moved / np.maximum(np.abs(moved).max(0), TINY)) @ fit
    return float(1 - (left**2).sum() / max((rest**2).sum(), TINY))


def _wrong(what: str, severity: Severity, sensor: str | None, steps: tuple[int, int], left: float, of: str) -> Finding:
    return Finding(
        "jacobian", severity, sensor, steps, {"unexplained": left, "matrix": what},
        f"{what} is not the derivative of {of}: it leaves {left:.0%} of its change from step to step unexplained, as a "
        "transposed matrix, a wrong sign or a wrong row would",
        "compare it with `viz_estim.core.kalman.finite_differences`, entry by entry",
    )  # fmt: skip
