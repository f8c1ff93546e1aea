"""Does an update do what its own numbers say?

Kalman (1960): of the reading z, its prediction ẑ, P, C = P·Hᵀ and R before it an update makes ν = z ⊟ ẑ,
S = CᵀP⁻¹C + R, K = C·S⁻¹, x⁺ = x ⊞ K·ν and P⁺ = P − K·Cᵀ − C·Kᵀ + K·S·Kᵀ (of any gain; Gelb 1974, eq. 4.2-12). All of
these are recorded, so that each line is held against what follows from the others: no chance is in it, and no truth is
needed. A matrix is compared by the eigenvalues of the one over the other, which are 1 where they agree. A deviation is
told from the size on that as many readings can tell of a variance, 1 ± √(2/N), and is an error where it is GROSS. A
line is taken for one that is known to be mistaken where it is off that by less than this too, and than SHEET.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from viz_estim.core.measurement import symmetrised
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product
from viz_estim.diagnosis.doubled import LINE, doubled
from viz_estim.diagnosis.evidence import Case, sensor_of, tells_gain, tells_reading
from viz_estim.diagnosis.finding import GROSS, REPEATED, SHEET, TINY, Finding, Severity
from viz_estim.diagnosis.linear import tangents
from viz_estim.diagnosis.rounding import rounding_of, sound
from viz_estim.recording.tables import StageTable


class Told(NamedTuple):
    """Updates (M,) in which every sensor was used: P, C, S, R before, gain K, ν, and the step and covariance after."""

    step: np.ndarray
    P: Array
    C: Array
    S: Array
    R: Array
    K: Array
    residual: Array
    difference: Array
    moved: Array
    after: Array

    @property
    def told(self) -> float:
        """The share of a variance that as many readings tell."""
        return float(np.sqrt(2 / (len(self.step) * self.S.shape[-1])))

    @property
    def near(self) -> float:
        """The share by which a line may miss one that is known to be mistaken, and be that one."""
        return min(self.told, SHEET)


def updates(case: Case) -> Iterator[Finding]:
    """The first of an update's lines that does not hold: those after it are made of it."""
    if case.run.labels:
        return
    for table in case.run.stages.values():
        if tells_gain(table) and (told := _told(case, table)) is not None:
            points = any(key.endswith(".points") for key in table.values)
            reading = tells_reading(table.values["innovation.predicted"])
            twice = LINE if doubled(told.P, told.C, told.S, told.R, told.after, _left(told)) else None
            lines = [
                _spread(told, points), _gain(told), twice, _mean(told),
                _added(told, _noise(case, told.step), list(case.space.axes_at.values())) or _cov(told),
            ]  # fmt: skip
            found = [_residual(told) if reading else None, *lines]
            for severity, what, cause, remedy in [one for one in found if one][:1]:
                steps = int(told.step[0]), int(told.step[-1])
                evidence = {"line": what, "stage": table.name, "updates": len(told.step)}
                yield Finding("update", severity, sensor_of(table), steps, evidence, cause, remedy)


def _space(table: StageTable) -> Product:
    space = table.spaces["innovation"]
    assert isinstance(space, Product)
    return space


_Line = tuple[Severity, str, str, str]


def _told(case: Case, table: StageTable) -> Told | None:
    get, space = table.values, _space(table)
    mean, P = case.sequence.before(table)
    rows = (get["innovation.used"] > 0).all(1) & (table.step >= case.first)
    for name in ("cov", "innovation.cov", "innovation.noise", "innovation.cross_cov", "gain"):
        rows &= np.isfinite(get[name]).all((1, 2))
    rows &= case.sequence.sound_before(table) & np.isfinite(get["innovation.residual"]).all(1)
    rows[rows] &= sound(symmetrised(get["innovation.cov"][rows]))
    if rows.sum() < REPEATED:
        return None
    moved = case.space.minus(table.mean[rows], mean[rows])
    difference = space.minus(get["innovation.z"][rows], get["innovation.predicted"][rows])
    told = Told(
        table.step[rows], P[rows], get["innovation.cross_cov"][rows], get["innovation.cov"][rows],
        get["innovation.noise"][rows], get["gain"][rows], get["innovation.residual"][rows], difference, moved,
        table.cov[rows],
    )  # fmt: skip
    if case.space.flat:
        return told
    left, back = _left(told), [np.linalg.inv(A) for A in tangents(case.space, mean[rows], moved)]
    kept = [told._replace(after=T @ told.after @ np.swapaxes(T, 1, 2)) for T in back]  # at the mean before
    return min(kept, key=lambda one: float(np.median(np.linalg.norm(one.after - left, axis=(1, 2)))))


def _residual(told: Told) -> _Line | None:
    """ν = z ⊟ ẑ, and not the other way round. Angles that are not wrapped are `geometry.wraps`' matter."""
    size = np.linalg.norm(told.residual, axis=1)
    sign = np.linalg.norm(told.residual + told.difference, axis=1) < told.near * size
    if not sign[size > 0].all() or not (size > 0).any():
        return None
    return (
        "error", "residual", "the residual is ẑ − z, what is expected less what is read: every update moves the mean "
        "away from its reading", "take the residual the other way round, ν = z − h(x)",
    )  # fmt: skip


def _spread(told: Told, points: bool) -> _Line | None:
    """S ⪰ CᵀP⁻¹C + R, and equal to it where no sigma points add what a straight line leaves of h's spread."""
    H = np.swapaxes(np.linalg.solve(told.P, told.C), 1, 2)
    spread = H @ told.C
    low, high = _ratios(told.S, spread + told.R)
    if (severity := _severity(1 / low, told)) is not None:
        if _alike(told.S, spread, told) and told.R.any():
            return (
                severity, "S", "S is H·P·Hᵀ alone: the noise R of the reading is missing from it, so that the gain "
                "follows every reading", "write S = H·P·Hᵀ + R",
            )  # fmt: skip
        return (
            severity, "S", f"S is smaller than H·P·Hᵀ + R, down to {float(np.median(low)):.2g} of it: it is made of "
            "another R or P than the ones that are recorded, or with another H", "write S = H·P·Hᵀ + R, with the R "
            "that this sensor has and the P after the prediction",
        )  # fmt: skip
    if not points and told.R.any() and (severity := _severity(high, told)) is not None:
        return (
            "warning", "S", f"S is larger than H·P·Hᵀ + R, up to {float(np.median(high)):.2g}× of it: it is made of "
            "another R or P than the ones that are recorded", "write S = H·P·Hᵀ + R, with the R that this sensor has",
        )  # fmt: skip
    return None


def _gain(told: Told) -> _Line | None:
    """K·S = C. Large is a gain that leaves GROSS times the least variance in some direction."""
    size = np.linalg.norm(told.C, axis=(1, 2))
    if np.median(np.linalg.norm(told.K @ told.S + told.C, axis=(1, 2)) / np.maximum(size, TINY)) < told.near:
        return (
            "error", "gain", "the gain has the wrong sign, −P·Hᵀ·S⁻¹: every update moves the mean away from its "
            "reading", "write K = P·Hᵀ·S⁻¹, and add K·ν to the mean",
        )  # fmt: skip
    best = told.P - told.C @ np.linalg.solve(told.S, np.swapaxes(told.C, 1, 2))
    if not sound(symmetrised(best)).all():
        return None
    _, high = _ratios(_left(told), best)
    if (severity := _severity(high, told)) is None:
        return None
    return (
        severity, "gain", f"the gain is not P·Hᵀ·S⁻¹: it leaves up to {float(np.median(high)):.2g}× the variance that "
        "the best one would", "write K = P·Hᵀ·S⁻¹ with the S of this update, R in it, and not its transpose or root; "
        "a fixed gain must be meant to be one",
    )  # fmt: skip


def _mean(told: Told) -> _Line | None:
    """x⁺ = x ⊞ K·ν. By the sign and the length alone: in which frame a change of an attitude is, each may choose."""
    should = (told.K @ told.residual[..., None])[..., 0]
    size = np.linalg.norm(should, axis=1)
    if not (size > 0).any():
        return None
    share = float(np.median(np.linalg.norm(told.moved, axis=1)[size > 0] / size[size > 0]))
    if np.median(np.linalg.norm(told.moved + should, axis=1)[size > 0] / size[size > 0]) < told.near:
        return (
            "error", "mean", "the mean is moved by −K·ν: every update moves it away from its reading",
            "add K·ν to the mean, with ν = z − h(x)",
        )  # fmt: skip
    if share < told.near:
        return (
            "error", "mean", "the mean stays as it was before the update: K·ν is not added to it, or to a copy only",
            "add K·ν to the mean, and carry that mean on",
        )  # fmt: skip
    if not 1 / GROSS < share**2 < GROSS:  # of the variance that it takes in, as of any
        return (
            "warning", "mean", f"the mean moves {share:.2g}× as far as K·ν: another gain or residual moves it than "
            "those that are recorded", "move it by K·ν once, with the K and ν of this update",
        )  # fmt: skip
    return None


def _cov(told: Told) -> _Line | None:
    """P⁺ = P − K·Cᵀ − C·Kᵀ + K·S·Kᵀ."""
    left = _left(told)
    if not sound(left).all():
        return None
    low, high = _ratios(told.after, left)
    severity = _severity(np.maximum(high, 1 / np.maximum(low, TINY)), told)
    if severity is None:
        return None
    if _alike(told.after, told.P, told):
        return (
            "error", "covariance", "the covariance after an update is the one before it: what a reading tells is not "
            "taken off, so that the gain stays too large and the filter never becomes surer",
            "write P⁺ = (I − K·H)·P, and carry that P on to the next prediction",
        )  # fmt: skip
    if _alike(told.after, told.P + told.K @ np.swapaxes(told.C, 1, 2), told):
        return (
            "error", "covariance", "the covariance grows with every reading: P⁺ is (I + K·H)·P, with a wrong sign",
            "write P⁺ = (I − K·H)·P, better in Joseph's form",
        )  # fmt: skip
    how = f"up to {float(np.median(high)):.2g}×" if np.median(high) > 1 / max(float(np.median(low)), TINY) else (
        f"down to {float(np.median(low)):.2g} of"
    )  # fmt: skip
    return (
        severity, "covariance", f"the covariance after an update is {how} what its gain and S leave",
        "write P⁺ = (I − K·H)·P·(I − K·H)ᵀ + K·R·Kᵀ (Joseph), with the K, H and R of this update; the process noise Q "
        "belongs to the prediction alone",
    )  # fmt: skip


def _noise(case: Case, step: np.ndarray) -> Array | None:
    """Q (M, d, d) of the prediction of each of these steps, NaN where there is none; None where it is not recorded."""
    d = len(case.space.axes)
    tables = [t for t in case.run.stages.values() if {"transition", "noise"} <= t.values.keys()]
    if len(tables) != 1 or tables[0].values["noise"].shape[1:] != (d, d) or not len(tables[0].step):
        return None
    at = np.minimum(np.searchsorted(tables[0].step, step), len(tables[0].step) - 1)
    same = tables[0].step[at] == step
    return np.where(same[:, None, None], tables[0].values["noise"][at], np.nan)


def _added(told: Told, Q: Array | None, parts: list[slice]) -> _Line | None:
    """What is beyond P⁺ is the prediction's Q, to rounding; or the prediction has none, and something is added here."""
    left = _left(told)
    if Q is None or not sound(left).all():
        return None
    rows = np.isfinite(Q).all((1, 2))
    beyond, rounding = told.after - left, rounding_of(told.P, told.after)
    if rows.sum() < REPEATED or np.median(np.abs(beyond[rows]).max((1, 2)) / rounding[rows]) < 1:
        return None
    _, high = _ratios(told.after, left)
    severity = _severity(high, told) or "warning"
    if Q[rows].any() and (times := _multiple(beyond[rows], Q[rows], parts, rounding[rows], told)) is not None:
        of = "Q" if abs(times - 1) < told.near else f"{times:.3g}× Q"
        return (
            severity, "covariance", f"the covariance after an update is what its gain and S leave, and {of} besides: "
            "the process noise is added in the update as well as in the prediction", "add Q in the prediction alone",
        )  # fmt: skip
    if not Q[rows].any() and np.median(np.linalg.eigvalsh(beyond[rows])[:, 0] / rounding[rows]) > -1:
        return (
            severity, "covariance", "the prediction adds no process noise, and the covariance after an update is "
            f"larger than its gain and S leave, up to {float(np.median(high)):.3g}×: Q is added in the update, so that "
            "it counts once a reading and not by time", "add Q in the prediction, and not in the update",
        )  # fmt: skip
    return None


def _left(told: Told) -> Array:
    KC = told.K @ np.swapaxes(told.C, 1, 2)
    left = told.P - KC - np.swapaxes(KC, 1, 2) + told.K @ told.S @ np.swapaxes(told.K, 1, 2)
    return symmetrised(left)


def _ratios(A: Array, B: Array) -> tuple[Array, Array]:
    """The smallest and the largest eigenvalue (M,) of B⁻¹·A, symmetric matrices."""
    values, vectors = np.linalg.eigh(symmetrised(B))
    root = vectors / np.sqrt(np.maximum(values, TINY))[:, None, :]
    found = np.asarray(np.linalg.eigvalsh(np.swapaxes(root, 1, 2) @ symmetrised(A) @ root), float)
    return found[:, 0], found[:, -1]


def _severity(ratio: Array, told: Told) -> Severity | None:
    """ratio (M,), at least 1 where the lines agree. In the middle, for a few odd updates are another matter."""
    middle = float(np.median(np.where(ratio > 0, ratio, np.inf)))
    if not middle > 1 + told.told:
        return None
    return "error" if middle > GROSS else "warning"


def _multiple(A: Array, B: Array, parts: list[slice], rounding: Array, told: Told) -> float | None:
    """The factor c by which A is c·B but for a turn of each part of the state, such as that of the body's axes, by the
    eigenvalues of its block; None where it is not. Of one eigenvalue any c would do: then it must be 1."""
    a, b = (np.concatenate([np.linalg.eigvalsh(symmetrised(M[:, k, k])) for k in parts], axis=1) for M in (A, B))
    there = np.median(np.maximum(a, b) / rounding[:, None], axis=0) > 1
    ratio = np.median(a[:, there] / np.maximum(b[:, there], TINY), axis=0)
    c = float(np.median(ratio)) if len(ratio) else 0.0
    if c <= 0 or np.abs(ratio / c - 1).max() > told.near:
        return None
    return c if len(ratio) > 1 or abs(c - 1) < told.near else None


def _alike(A: Array, B: Array, told: Told) -> bool:
    off = np.abs(A - B).max((1, 2)) / np.maximum(np.abs(B).max((1, 2)), TINY)
    return bool(np.median(off) < told.near)
