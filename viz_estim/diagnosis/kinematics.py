"""A gyro and an accelerometer against each other: gravity must turn as the gyro says, whatever the filter does."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO3
from viz_estim.diagnosis.axes import explains, finding_of, maps, units
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import FEWEST, GROSS, ODDS, SHEET, TINY, WINDOW, Finding, judge, level
from viz_estim.diagnosis.fits import STRETCHES, least_squares
from viz_estim.diagnosis.naming import likeliest, of_motion
from viz_estim.diagnosis.sensors import Imu, imu
from viz_estim.scenarios.imu_health import GRAVITY

_UP = np.array([0.0, 0.0, 1.0])


def imu_axes(case: Case) -> Iterator[Finding]:
    """ġ = −ω × g in the body's frame, over windows of 0.1 s, for each map of the one or the other sensor.

    The gain in log-likelihood is ½·(E(1) − E(M))/σ², where E is the sum of squares left and σ² that of the best map; if
    the readings are as they should be it exceeds log(1/α) with the probability α at most (Ville 1939). A map of gravity
    and its inverse of the rate say the same of the pair: motion capture tells them apart where there is any, else
    gravity's length and its direction at rest in the truth's stead: `sensor` is then `gyro` for a map of proper turns
    that keep up upright, else `accel`.
    """
    both = imu(case.run)
    if both is None:
        return
    pieces = _windows(case, both)
    if pieces is None:
        return
    turn, middle, change, steps = pieces
    own = float(_left(turn, middle, change).sum())
    candidates = maps(3, "rad/s")
    left_by_rate = [_left(turn @ M.T, middle, change) for _, M in candidates]
    left_by_force = [
        _left(turn, middle @ M.T, change @ M.T) if abs(np.linalg.det(M)) == 1 else np.full(len(turn), np.inf)
        for _, M in candidates
    ]
    of_rate, of_force = ([float(left.sum()) for left in those] for those in (left_by_rate, left_by_force))
    length = float(np.median(np.linalg.norm(both.force, axis=1)))
    least = min(*of_rate, *of_force)
    variance = max(least, TINY) / change.size
    pushes = _dependent(min((*left_by_rate, *left_by_force), key=lambda left: float(left.sum())))
    gain, explained = 0.5 * (own - least) / variance / pushes, 1 - least / max(own, TINY)
    nothing = float(np.square(change).sum())  # what no turn at all would leave: a map that is no better is none
    if gain > -np.log(level("error", 2 * len(candidates))):
        blamed = _blamed(case, both)
        # Another map of the other sensor, where that is as likely: their windows share pushes of the hand.
        alike = 0.5 * change.size / pushes * np.log(min(of_force) / max(least, TINY)) < np.log(ODDS)
        if blamed == "accel" and alike:
            name, what = "accel", candidates[int(np.argmin(of_force))][0]
        else:
            name, what = "gyro", candidates[int(np.argmin(of_rate))][0]
        if explains(what, own, least, nothing, int(change.size / pushes)) and nothing > GROSS * least:
            yield finding_of(name, steps, what, explained, gain)
    if not 1 / GROSS < length / GRAVITY < GROSS:  # a hand pulls by less than gravity, in the middle over a run
        for what in likeliest(length / GRAVITY, {name: 1 / value for name, value in units("m/s²").items()})[:1]:
            left = abs(np.log(length / GRAVITY * units("m/s²")[what]))
            yield finding_of("accel", steps, what, float(np.exp(-left)), float(len(both.rows)))


def scale(case: Case) -> Iterator[Finding]:
    """ġ = −(s∘ω) × g: the factor s of each axis of the gyro, or of all three, by least squares over the windows.

    Its errors by stretches of the run too, so that a push of the hand counts once.
    Told where s is further from 1 than 5 %, by a t-test against that: what a data sheet leaves to a calibration.
    """
    both = imu(case.run)
    pieces = None if both is None else _windows(case, both)
    if both is None or pieces is None:
        return
    turn, middle, change, steps = pieces
    axes = np.stack([-np.cross(turn[:, [i]] * np.eye(3)[i], middle) for i in range(3)], axis=-1)  # (W, 3, 3)
    fits = [least_squares(X, change - X.sum(-1)) for X in (axes.sum(-1, keepdims=True), axes)]  # on s − 1
    found = [(1 + float(s), fit.p(i, SHEET)) for fit in fits for i, s in enumerate(fit.coefficients)]
    k, (s, p) = min(enumerate(found), key=lambda one: max(one[1][1]))
    severity = judge(p, len(found), large=True)
    if severity and s > 0:
        which = "gyro" if k == 0 else f"gyro's {'xyz'[k - 1]}"
        names = likeliest(1 / s, of_motion("rad", 0.0))
        as_if = f": {', or '.join(names)}" if names else ": its sensitivity is another one"
        yield Finding(
            "units_or_axes", severity, "gyro", steps,
            {"map": f"a factor of {1 / s:.3g}", "p": max(p), "factors": [1 / one[0] for one in found]},
            f"the {which} reads {1 / s:.3g}× the turn that gravity shows{as_if}",
            f"divide the {which} by {1 / s:.3g}, or calibrate it (`viz-estim calibrate imu`)",
        )  # fmt: skip


def _windows(case: Case, both: Imu) -> tuple[Array, Array, Array, tuple[int, int]] | None:
    """By window: the gyro's turn (W, 3) rad, gravity's unit direction (W, 3) and its change (W, 3); frozen times are
    left out, as the readings of the filter's sensors are."""
    time = case.run.time[both.rows]
    n = max(2, round(WINDOW / max(float(np.median(np.diff(time))), 1e-6)))
    W = len(time) // n
    if W < FEWEST:
        return None
    force = both.force[: W * n].reshape(W, n, 3).mean(1)
    force = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-9)
    middle_time = time[: W * n].reshape(W, n).mean(1)
    rate = both.rate[: W * n].reshape(W, n, 3).mean(1)
    turn = 0.5 * (rate[1:] + rate[:-1]) * np.diff(middle_time)[:, None]
    read = {int(step) for readings in case.sensors.values() for step in readings.step}
    at = case.run.step[both.rows]
    fine = np.asarray(np.array([int(step) in read for step in at[: W * n]]).reshape(W, n).all(axis=1))
    fine = fine[1:] & fine[:-1]
    if fine.sum() < FEWEST:
        return None
    middle, change = 0.5 * (force[1:] + force[:-1]), force[1:] - force[:-1]
    return turn[fine], middle[fine], change[fine], (int(at[0]), int(at[-1]))


def _left(turn: Array, middle: Array, change: Array) -> Array:
    """|Δg + θ × g|² (W,)."""
    return np.asarray(np.square(change + quaternions.cross(turn, middle)).sum(1))


def _dependent(left: Array) -> float:
    """How many windows share one push of the hand: 1 + 2·Σρₖ of the squares (W,) that are left, up to the first
    ρₖ ≤ 0 (Geyer 1992)."""
    about = left - left.mean()
    rho = np.correlate(about, about, "full")[len(left) - 1 :] / max(float(about @ about), TINY)
    return float(1 + 2 * rho[1 : int(np.argmax(rho <= 0))].sum()) if (rho <= 0).any() else float(len(left))


def _blamed(case: Case, both: Imu) -> str:
    """Which of the two disagrees with the truth's attitude, if there is any; else the gyro."""
    run = case.run
    for name, part in case.space.parts.items():
        if isinstance(part, SO3):
            truth = run.truth[both.rows][:, case.space.at[name]]
            known = np.isfinite(truth).all(1)
            if known.any():
                up = quaternions.rotate(quaternions.conjugate(truth[known]), _UP)
                seen = both.force[known] / np.linalg.norm(both.force[known], axis=1, keepdims=True)
                return _upright(seen.T @ up / len(up))
    level_at_rest = both.force[: max(1, len(both.force) // STRETCHES)].mean(0)
    return _upright(np.outer(level_at_rest / np.linalg.norm(level_at_rest), _UP))


def _upright(seen_up: Array) -> str:
    """`accel` where with its axes as others it sees up GROSS nearer, by the mean of seen·upᵀ (3, 3); else the gyro.
    The mean square of their distance is 2·(1 − trace)."""
    others = [float((A * seen_up).sum()) for title, A in maps(3, "rad/s") if title.startswith("axes")]
    return "accel" if 1 - float(np.trace(seen_up)) > GROSS * (1 - max(others)) else "gyro"
