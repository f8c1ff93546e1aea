"""Is the covariance one, does it stay in bounds, and does no update know what its sensor cannot see?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import Finding

_ASYMMETRY = 1e-9  # of the largest entry; rounding leaves 1e-15
_NEGATIVE = -1e-9  # an eigenvalue of the correlation matrix
_CONDITION = 1e12  # of the correlation matrix: beyond, a solve has four digits left
_COLLAPSED = 1e-6  # of the standard deviation at the start
_LEAK, _GREAT_LEAK = 0.02, 0.2  # the logarithm of what is claimed of a blind direction; a sound filter leaves 1e-6


def broken(case: Case) -> Iterator[Finding]:
    """Not symmetric, not positive definite, or ill-conditioned; by the correlation matrix, so that units play no part.

    Deterministic: no sound covariance is any of these, whatever the data.
    """
    if case.run.properties.get("belief") == "Particles":  # a cloud's covariance may be of any rank
        return
    tables = [(name, t) for name, t in case.run.stages.items() if "cov" in t.values and name != "start"]
    worst: dict[str, list[tuple[int, float, str]]] = {}
    for name, table in tables:
        P = table.cov
        rows = np.flatnonzero(np.isfinite(P).all((1, 2)) & (np.abs(P).max((1, 2)) > 0))
        P = P[rows]
        largest = np.abs(P).max((1, 2))
        skew = np.abs(P - np.swapaxes(P, 1, 2)).max((1, 2)) / largest
        variance = np.diagonal(P, axis1=1, axis2=2)
        std = np.sqrt(np.where(variance > 0, variance, 1.0))
        correlation = P / (std[:, :, None] * std[:, None, :])
        known = np.where((variance > 0)[:, :, None] & (variance > 0)[:, None, :], correlation, np.eye(P.shape[-1]))
        values = np.linalg.eigvalsh(0.5 * (known + np.swapaxes(known, 1, 2)))
        negative = np.minimum(values[:, 0], np.where(variance < 0, -1.0, 0.0).min(1))
        condition = np.where(values[:, 0] > 0, values[:, -1] / np.maximum(values[:, 0], 1e-300), 0.0)
        for kind, figure, bad in (
            ("asymmetric", skew, skew > _ASYMMETRY),
            ("negative", -negative, negative < _NEGATIVE),
            ("ill-conditioned", condition, condition > _CONDITION),
        ):
            of = table.step[rows]
            worst.setdefault(kind, []).extend(
                zip(of[bad].tolist(), figure[bad].tolist(), [name] * int(bad.sum()), strict=True)
            )
    for kind, found in worst.items():
        if found:
            steps = min(step for step, _, _ in found), max(step for step, _, _ in found)
            _, most, stage = max(found, key=lambda entry: entry[1])
            evidence = {"kind": kind, "worst": most, "stage": stage, "count": len(found)}
            severity = "warning" if kind == "ill-conditioned" else "error"
            yield Finding("covariance", severity, None, steps, evidence, *_WORDS[kind])  # type: ignore[arg-type]


_WORDS = {
    "asymmetric": (
        "the covariance is not symmetric: a product in its update lacks a transpose, or is taken in another order",
        "write the update in Joseph's form, (I−KH)·P·(I−KH)ᵀ + K·R·Kᵀ, and symmetrise once, ½(P + Pᵀ)",
    ),
    "negative": (
        "the covariance is not positive definite: more was subtracted than there was, as by (I−KH)·P with a gain that "
        "is not the best one, or by a wrong sign",
        "write the update in Joseph's form, which is positive definite for any gain; check the gain's S",
    ),
    "ill-conditioned": (
        "the covariance is nearly singular: some combination of the state is taken as known exactly",
        "give each part of the state some process noise, or scale states of very unlike size",
    ),
}


def bounds(case: Case) -> Iterator[Finding]:
    """A part that is taken as known exactly in the end (σ below 10⁻⁶ of its start), or that grows without bound.

    Growing: σ rises through the last half of the run, and ends at ten times its start, although readings come.
    """
    run = case.run
    if run.labels or "cov" not in run.ends or not case.sensors:
        return
    rows = np.flatnonzero((run.step >= case.first) & np.isfinite(run.cov).all((1, 2)))
    if len(rows) < 20:
        return
    for name in case.space.parts:
        axes = case.space.axes_at[name]
        sigma = np.sqrt(np.maximum(np.diagonal(run.cov[rows], axis1=1, axis2=2)[:, axes], 0)).max(1)
        if sigma[0] > 0 and sigma[-1] < _COLLAPSED * sigma[0]:
            at = int(run.step[rows[np.argmax(sigma < _COLLAPSED * sigma[0])]])
            yield Finding(
                "covariance", "error", None, (at, int(run.step[rows[-1]])), {"kind": "collapsed", "part": name},
                f"the covariance of {name} collapses towards zero: the filter is sure, and deaf to what comes",
                f"give {name} process noise: without any, each reading only makes it surer",
            )  # fmt: skip
        half = sigma[len(sigma) // 2 :]
        quarters = [float(piece.max()) for piece in np.array_split(half, 4)]
        if sigma[-1] > 10 * max(sigma[0], 1e-300) and quarters == sorted(quarters) and quarters[-1] > 1.2 * quarters[0]:
            at = int(run.step[rows[len(sigma) // 2]])
            evidence = {"kind": "growing", "part": name, "start": float(sigma[0]), "end": float(sigma[-1])}
            yield Finding(
                "covariance", "note", None, (at, int(run.step[rows[-1]])), evidence,
                f"the covariance of {name} grows without bound: no sensor tells of it",
                f"if a sensor should see {name}, check its Jacobian; else this is dead reckoning, and honest",
            )  # fmt: skip


def unobservable(case: Case) -> Iterator[Finding]:
    """Information on a direction b that the sensor cannot see: bᵀP⁻¹b must stay as it is over the update.

    b is the blind direction before, and after it the same carried to the tangent space at the new mean. Their
    logarithms' differences are summed over the run: by what factor the information grew that no reading gave (Barrau
    and Bonnabel 2017: what a filter claims to learn of a direction that is not observable).
    """
    run = case.run
    for table in run.stages.values():
        blind = table.values.get("innovation.blind")
        if blind is None or not np.any(blind):
            continue
        space = table.spaces["innovation"]
        assert isinstance(space, Product)
        mean, cov = case.sequence.before(table)
        for i, name in enumerate(space.parts):
            b = blind[:, :, i]
            rows = (np.abs(b).max(1) > 0) & np.isfinite(cov).all((1, 2)) & (table.step >= case.first)
            rows[rows] &= _sound(cov[rows]) & _sound(table.cov[rows])
            if not rows.any():
                continue
            carried = case.space.transport(mean[rows], case.space.minus(table.mean[rows], mean[rows]))
            after = (carried @ b[rows][..., None])[..., 0]
            gained = np.log(_information(table.cov[rows], after) / _information(cov[rows], b[rows]))
            total = float(gained.sum())
            if total > _LEAK:
                at = table.step[rows]
                first = int(at[np.argmax(np.cumsum(gained) > 0.1 * total)])
                evidence = {"information_factor": float(np.exp(min(total, 700.0))), "updates": int(rows.sum())}
                yield Finding(
                    "unobservable_update", "error" if total > _GREAT_LEAK else "warning", name,
                    (first, int(at[-1])), evidence,
                    f"updates by {name} make a direction surer that {name} cannot see (as heading, by gravity): over "
                    f"the run they claim {np.exp(min(total, 700.0)):.3g}× the information that there was",
                    "check that the Jacobian is zero along that direction, and that the covariance is carried to the "
                    "tangent space at the new mean after the update",
                )  # fmt: skip


def _sound(P: Array) -> np.ndarray:
    values = np.linalg.eigvalsh(P)
    return (values[:, 0] > 0) & (values[:, -1] < 1e14 * np.maximum(values[:, 0], 1e-300))


def _information(P: Array, b: Array) -> Array:
    """bᵀP⁻¹b (M,)."""
    return (b * np.linalg.solve(P, b[..., None])[..., 0]).sum(-1)
