"""Are the Jacobians the models' derivatives, and is the prediction free of chance?

A linearised filter's record holds its model at the mean and its Jacobian there. Between two steps the trapezoid rule
must hold, f(b) − f(a) = ½(F_a + F_b)·(b ⊟ a), up to the third order in the step. No rerun is needed.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product
from viz_estim.diagnosis.evidence import Case, tells_gain
from viz_estim.diagnosis.finding import Finding

# The share of the model's change that a Jacobian leaves. Where it changes the expected by less than a tenth in a step,
# the trapezoid rule is off by a third of the square of that, 0.3 %, and a wrong row or sign by more than a half.
_UNEXPLAINED = 0.3
_FEWEST = 10


def measured(case: Case) -> Iterator[Finding]:
    """H against how the expected reading changes with the state; H = Cᵀ·P⁻¹, as the update used it."""
    for table in case.run.stages.values():
        if not tells_gain(table) or any(key.endswith(".points") for key in table.values):
            continue  # sigma points have no Jacobian that could be wrong
        space = table.spaces["innovation"]
        assert isinstance(space, Product)
        mean, cov = case.sequence.before(table)
        rows = np.flatnonzero(np.isfinite(cov).all((1, 2)) & (table.step >= case.first))
        rows = rows[np.linalg.cond(cov[rows]) < 1e13]
        if len(rows) < _FEWEST:
            continue
        H = np.swapaxes(np.linalg.solve(cov[rows], table.values["innovation.cross_cov"][rows]), 1, 2)
        moved = case.space.minus(mean[rows[1:]], mean[rows[:-1]])
        seen = space.minus(
            table.values["innovation.predicted"][rows[1:]], table.values["innovation.predicted"][rows[:-1]]
        )
        expected = (0.5 * (H[1:] + H[:-1]) @ moved[..., None])[..., 0]
        for name, axes in space.axes_at.items():
            bent = (H[1:, axes] - H[:-1, axes]) @ moved[..., None]
            left = _left(seen[:, axes], expected[:, axes], bent[..., 0])
            if left > _UNEXPLAINED:
                steps = int(table.step[rows[0]]), int(table.step[rows[-1]])
                yield _wrong(f"H of {name}", name.partition("/")[0], steps, left, "the measurement model h(x)")
                break


def _left(change: Array, expected: Array, bent: Array) -> float:
    """The share of the changes (M, m) that the expected ones leave: the median of |change − expected|/|change|.

    Of steps alone over which the Jacobian itself changes the expected by less than a tenth (bent, (M, m)): there the
    trapezoid rule is exact.
    """
    size = np.linalg.norm(change, axis=1)
    rows = (size > 1e-9) & (np.linalg.norm(bent, axis=1) < 0.1 * size)
    if rows.sum() < _FEWEST:
        return 0.0
    return float(np.median(np.linalg.norm(change - expected, axis=1)[rows] / size[rows]))


def predicted(case: Case) -> Iterator[Finding]:
    """F against how the prediction changes with the state, and whether what is left looks like a sample of Q.

    Only between steps with the same control and dt. What is left, r, is whitened by 2Q: r of a deterministic prediction
    is of the third order; with a sample of the noise it is N(0, 2Q), so that rᵀ(2Q)⁺r is the rank of Q in the mean.
    """
    run = case.run
    for table in run.stages.values():
        if not {"transition", "noise"} <= table.values.keys() or len(table.step) < _FEWEST:
            continue
        F, Q = table.values["transition"], table.values["noise"]
        before, _ = case.sequence.before(table)
        row = np.searchsorted(run.step, table.step)
        alike = _alike(case, row) & np.isfinite(before[1:]).all(1) & np.isfinite(before[:-1]).all(1)
        if alike.sum() < _FEWEST:
            continue
        moved = case.space.minus(before[1:], before[:-1])[alike]
        change = case.space.minus(table.mean[1:], table.mean[:-1])[alike]
        expected = (0.5 * (F[1:] + F[:-1])[alike] @ moved[..., None])[..., 0]
        steps = int(table.step[0]), int(table.step[-1])
        bent = ((F[1:] - F[:-1])[alike] @ moved[..., None])[..., 0]
        rest = change - expected
        values, vectors = np.linalg.eigh(2 * Q[1:][alike])
        held = values > 1e-12 * np.maximum(values[:, -1:], 1e-300)
        white = np.einsum("mij,mi->mj", vectors, rest) / np.sqrt(np.where(held, values, np.inf))
        ratio = float(np.median((white**2).sum(1) / np.maximum(held.sum(1), 1)))
        drift = _follows(rest, moved)
        if 0.05 < ratio < 20 and drift < 0.3:
            evidence = {"size_in_Q": ratio, "stage": table.name}
            yield Finding(
                "noisy_prediction", "error", None, steps, evidence,
                f"the prediction moves the mean at random, by {ratio**0.5:.2g}× the standard deviation of Q: a sample "
                "of the process noise is added to it",
                "predict the mean by the model alone; the noise enters the covariance, as + Q",
            )  # fmt: skip
        elif (left := _left(change - moved, expected - moved, bent)) > _UNEXPLAINED and drift > 0.5:
            yield _wrong("F", None, steps, left, "the process model f(x)")


def _alike(case: Case, row: np.ndarray) -> np.ndarray:
    """Which neighbouring predictions, by their steps' rows (M,), have the same control and dt."""
    run = case.run
    alike = np.abs(np.diff(run.dt[row])) <= 1e-9 + 1e-6 * run.dt[row][1:]
    control = run.inputs.get("control")
    if control is not None:
        alike &= (np.nan_to_num(control[row[1:]]) == np.nan_to_num(control[row[:-1]])).all(1)
    return alike


def _follows(rest: Array, moved: Array) -> float:
    """The share of what is left (M, d) that a constant matrix times the motion (M, d) explains: R² of least squares."""
    scale = np.maximum(np.abs(rest).max(0), 1e-300)
    rest = rest / scale
    fit, *_ = np.linalg.lstsq(moved / np.maximum(np.abs(moved).max(0), 1e-300), rest, rcond=None)
    left = rest - (moved / np.maximum(np.abs(moved).max(0), 1e-300)) @ fit
    return float(1 - (left**2).sum() / max((rest**2).sum(), 1e-300))


def _wrong(what: str, sensor: str | None, steps: tuple[int, int], left: float, of: str) -> Finding:
    return Finding(
        "jacobian", "error", sensor, steps, {"unexplained": left, "matrix": what},
        f"{what} is not the derivative of {of}: it leaves {left:.0%} of its change from step to step unexplained, as a "
        "transposed matrix, a wrong sign or a wrong row would",
        "compare it with `viz_estim.core.kalman.finite_differences`, entry by entry",
    )  # fmt: skip
