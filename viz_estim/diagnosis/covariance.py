"""Is the covariance one, does it stay in bounds, and does no update know what its sensor cannot see?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.measurement import symmetrised
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product
from viz_estim.diagnosis.evidence import Case, sensor_of, tells_gain
from viz_estim.diagnosis.finding import FEWEST, GROSS, HALF_THE_DIGITS, LARGEST, TINY, Finding
from viz_estim.diagnosis.linear import tangents
from viz_estim.diagnosis.rounding import epsilon, sound


def broken(case: Case) -> Iterator[Finding]:
    """Not symmetric, not positive definite, or ill-conditioned; by the correlation matrix, so that units play no part.

    No sound covariance is any of these whatever the data, so that the bounds are of rounding. A product of d × d
    matrices is off by d·ε of its terms (Higham 2002, section 3.5), and the terms of an update are as large as the
    covariance before it: of the one after it that is d·ε·g, with g the largest ratio of a variance before to after. It
    piles up over the run's T updates as √T at most where rounding is fair. ε is that of the numbers that are held
    (float32 where all of them are). Ill-conditioned: a solve loses d·ε·κ (Higham, section 7.2), which must stay below
    what the tests here resolve, √(2/T).
    """
    if case.run.properties.get("belief") == "Particles":  # a cloud's covariance may be of any rank
        return
    tables = [(name, t) for name, t in case.run.stages.items() if "cov" in t.values and name != "start"]
    worst: dict[str, list[tuple[int, float, str]]] = {}
    for name, table in tables:
        before = case.sequence.before(table)[1]
        rows = np.flatnonzero(np.isfinite(table.cov).all((1, 2)) & (np.abs(table.cov).max((1, 2)) > 0))
        P = table.cov[rows]
        d, T = P.shape[-1], max(len(case.run.step), 2)
        variance = np.diagonal(P, axis1=1, axis2=2)
        past = np.nan_to_num(np.diagonal(before[rows], axis1=1, axis2=2))
        std = np.sqrt(np.where(variance > 0, variance, 1.0))
        growth = np.maximum(np.max(past / np.where(variance > 0, variance, np.inf), axis=1, initial=0.0), 1.0)
        known = (variance > 0)[:, :, None] & (variance > 0)[:, None, :]
        correlation = np.where(known, P / (std[:, :, None] * std[:, None, :]), np.eye(d))
        rounding = 8 * d * epsilon(P) * growth * np.sqrt(T)
        skew = np.abs(correlation - np.swapaxes(correlation, 1, 2)).max((1, 2))
        values = np.linalg.eigvalsh(0.5 * (correlation + np.swapaxes(correlation, 1, 2)))
        negative = np.minimum(values[:, 0], np.where(variance < 0, -1.0, 0.0).min(1))
        condition = np.where(values[:, 0] > 0, values[:, -1] / np.maximum(values[:, 0], TINY), np.inf)
        # A variance of zero is a state that is given; it tells of no combination that is.
        singular = d * np.finfo(float).eps * condition > np.sqrt(2 / T)
        for kind, figure, bad in (
            ("asymmetric", skew, skew > np.maximum(rounding, HALF_THE_DIGITS)),
            ("rounding", skew, (skew > rounding) & (skew <= HALF_THE_DIGITS)),
            ("negative", -negative, negative < -np.minimum(rounding, 0.5)),
            ("ill-conditioned", condition, singular & (negative >= -np.minimum(rounding, 0.5))),
        ):
            of = table.step[rows]
            worst.setdefault(kind, []).extend(
                zip(of[bad].tolist(), figure[bad].tolist(), [name] * int(bad.sum()), strict=True)
            )
    for kind, found in worst.items():
        if found:
            steps = min(step for step, _, _ in found), max(step for step, _, _ in found)
            _, most, stage = max(found, key=lambda entry: entry[1])
            evidence = {"kind": kind, "worst": most if np.isfinite(most) else None, "stage": stage, "count": len(found)}
            severity = {"ill-conditioned": "warning", "rounding": "note"}.get(kind, "error")
            yield Finding("covariance", severity, None, steps, evidence, *_WORDS[kind])  # type: ignore[arg-type]


def claims(case: Case) -> Iterator[Finding]:
    """An update that leaves less than a reading can: P⁺ ≥ P − C·S⁻¹·Cᵀ for any gain (Kalman's is the best).

    In whichever of the tangent spaces (`tangents`) P⁺ is kept. By the eigenvalues of P⁺ over that bound, which no sound
    update has below 1 by more than rounding: half of the digits, times the ratio of the variances before and after.
    Over the run they multiply, and are told from the factor on that as many readings can tell of a variance,
    1 + √(2/N); an error where in the middle one alone is GROSS.
    """
    for table in case.run.stages.values():
        if not {"innovation.cov", "cov"} <= table.values.keys() or not tells_gain(table):
            continue
        mean, before = case.sequence.before(table)
        C, S = table.values["innovation.cross_cov"], table.values["innovation.cov"]
        rows = np.isfinite(C).all((1, 2)) & case.sequence.sound_before(table) & case.sequence.sound[table.place]
        rows[rows] &= sound(S[rows])
        if not rows.any():
            continue
        least = before[rows] - C[rows] @ np.linalg.solve(S[rows], np.swapaxes(C[rows], 1, 2))
        fine = sound(symmetrised(least))
        if not fine.any():
            continue
        moved = case.space.minus(table.mean[rows], mean[rows])[fine]
        ratio = np.max([
            ratios(table.cov[rows][fine], A @ least[fine] @ np.swapaxes(A, 1, 2))[0]
            for A in tangents(case.space, mean[rows][fine], moved)
        ], axis=0)  # fmt: skip
        shrunk = np.diagonal(before[rows][fine], axis1=1, axis2=2) / np.diagonal(least[fine], axis1=1, axis2=2)
        bad = ratio < 1 - np.minimum(HALF_THE_DIGITS * shrunk.max(1), 1 - 1 / GROSS)
        claimed = -np.log(np.maximum(ratio[bad], TINY)).sum()
        if bad.sum() > 1 and claimed > np.log1p(np.sqrt(2 / (len(ratio) * S.shape[-1]))):
            of = table.step[rows][fine][bad]
            worst = float(ratio[bad].min())
            yield Finding(
                "covariance", "error" if GROSS * np.median(ratio[bad]) < 1 + HALF_THE_DIGITS else "warning",
                sensor_of(table), (int(of[0]), int(of[-1])),
                {"kind": "claims", "least_ratio": worst, "stage": table.name, "count": int(bad.sum())},
                f"at {int(bad.sum())} updates the covariance shrinks by more than the reading can tell (down to "
                f"{worst:.2g} of the least variance that any gain leaves)",
                "check P⁺ = (I − K·H)·P: its gain, its S, and that it is taken off once; write it in Joseph's form",
            )  # fmt: skip


def ratios(A: Array, B: Array) -> tuple[Array, Array]:
    """The smallest and the largest eigenvalue (M,) of B⁻¹·A, symmetric matrices, B positive definite: by its Cholesky
    factor, which no unit of a state makes less exact."""
    L = np.linalg.cholesky(symmetrised(B))
    inside = np.asarray(np.linalg.solve(L, np.swapaxes(np.linalg.solve(L, A), 1, 2)), float)
    values = np.asarray(np.linalg.eigvalsh(symmetrised(inside)), float)
    return values[:, 0], values[:, -1]


_WORDS = {
    "asymmetric": (
        "the covariance is not symmetric: a product in its update lacks a transpose, or is taken in another order",
        "write the update in Joseph's form, (I−KH)·P·(I−KH)ᵀ + K·R·Kᵀ, and symmetrise once, ½(P + Pᵀ)",
    ),
    "rounding": (
        "the covariance is no longer symmetric in its last digits: rounding piles up from step to step",
        "symmetrise once a step, ½(P + Pᵀ)",
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
    """A part that becomes known exactly, or that grows without bound.

    Collapsing: σ falls faster, over each eighth of the run's last half, than readings of a motion without noise let it:
    of d states that move as a polynomial, none falls faster than t^−(d − ½) (least squares of a polynomial's
    coefficients). Or it is below the rounding of the part's own numbers, ε·|x|, so that no reading moves the mean any
    more. Growing: over each of these eighths the variance gains at least as much as over the one before, as that of a
    random walk which no reading bounds, and doubles; it is a note, for it may be honest.
    """
    run = case.run
    if run.labels or "cov" not in run.ends or not case.sensors:
        return
    rows = np.flatnonzero((run.step >= case.first) & np.isfinite(run.cov).all((1, 2)))
    if len(rows) < FEWEST:
        return
    # Five ends of four eighths: more of them ask for more, and no chance is in it.
    ends = rows[np.linspace(len(rows) // 2, len(rows) - 1, 5).astype(int)]
    elapsed = run.time[ends] - run.time[rows[0]]
    if not (np.diff(elapsed) > 0).all():
        return  # stamps that stand still tell of no rate
    fastest = (elapsed[1:] / elapsed[:-1]) ** -(len(case.space.axes) - 0.5)
    for name in case.space.parts:
        axes, at = case.space.axes_at[name], case.space.at[name]
        sigma = np.sqrt(np.maximum(np.diagonal(run.cov, axis1=1, axis2=2)[:, axes], 0)).max(1)
        falls = sigma[ends[1:]] / np.maximum(sigma[ends[:-1]], TINY)
        deaf = sigma[rows] < np.finfo(float).eps * np.abs(run.mean[rows][:, at]).max()
        if sigma[rows[0]] > 0 and ((falls < (1 - HALF_THE_DIGITS) * fastest).all() or (deaf[-1] and not deaf[0])):
            step = int(run.step[rows[int(np.argmax(deaf))]] if deaf.any() else run.step[ends[0]])
            yield Finding(
                "covariance", "error", None, (step, int(run.step[rows[-1]])), {"kind": "collapsed", "part": name},
                f"the covariance of {name} collapses towards zero: the filter is sure, and deaf to what comes",
                f"give {name} process noise: without any, each reading only makes it surer",
            )  # fmt: skip
        gains = np.diff(sigma[ends] ** 2) / np.diff(elapsed)
        if (
            (gains[1:] > (1 - HALF_THE_DIGITS) * gains[:-1]).all()
            and gains[0] > 0
            and sigma[rows[-1]] ** 2 > GROSS * sigma[rows[0]] ** 2
            and not _told_of(case, axes, int(run.step[ends[0]]))
        ):
            evidence = {
                "kind": "growing", "part": name, "start": float(sigma[rows[0]]), "end": float(sigma[rows[-1]])
            }  # fmt: skip
            yield Finding(
                "covariance", "note", None, (int(run.step[ends[0]]), int(run.step[rows[-1]])), evidence,
                f"the covariance of {name} grows without bound: no sensor tells of it",
                f"if a sensor should see {name}, check its Jacobian; else this is dead reckoning, and honest",
            )  # fmt: skip


def _told_of(case: Case, axes: slice, since: int) -> bool:
    """Whether updates from a step on take off a part's variance: by GROSS in all, as where it is read from ever further
    away."""
    gained = 0.0
    for table in case.run.stages.values():
        if "innovation.cov" in table.values and "cov" in table.values:
            before = np.diagonal(case.sequence.before(table)[1], axis1=1, axis2=2)[table.step >= since, axes]
            after = np.diagonal(table.cov, axis1=1, axis2=2)[table.step >= since, axes]
            rows = (before > 0).all(1) & (after > 0).all(1)
            gained += float(np.log(before[rows] / after[rows]).max(1).sum())
    return gained > np.log(GROSS)


def unobservable(case: Case) -> Iterator[Finding]:
    """Information on a direction b that the sensor cannot see: bᵀP⁻¹b must stay as it is over the update.

    b is the blind direction before, and after it the same carried to the tangent space at the new mean. Their
    logarithms' differences are summed over the run: by what factor the information grew that no reading gave (Barrau
    and Bonnabel 2017: what a filter claims to learn of a direction that is not observable). No chance is in it: it is 0
    but for the transport, which is right to second order in a correction and leaves 1e-6 in sound filters. Told is a
    factor on the variance that as many errors as there are updates could tell, 1 + √(2/T); an error is GROSS.
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
            rows = (np.abs(b).max(1) > 0) & (table.step >= case.first)
            rows &= case.sequence.sound_before(table) & case.sequence.sound[table.place]
            if not rows.any():
                continue
            carried = case.space.transport(mean[rows], case.space.minus(table.mean[rows], mean[rows]))
            after = (carried @ b[rows][..., None])[..., 0]
            gained = np.log(_information(table.cov[rows], after) / _information(cov[rows], b[rows]))
            total = float(gained.sum())
            if total > np.log1p(np.sqrt(2 / rows.sum())):
                at = table.step[rows]
                first = int(at[np.argmax(np.cumsum(gained) > 0.1 * total)])  # about where it begins
                evidence = {"information_factor": float(np.exp(min(total, LARGEST))), "updates": int(rows.sum())}
                yield Finding(
                    "unobservable_update", "error" if total > np.log(GROSS) else "warning", name,
                    (first, int(at[-1])), evidence,
                    f"updates by {name} make a direction surer that {name} cannot see (as heading, by gravity): over "
                    f"the run they claim {np.exp(min(total, LARGEST)):.3g}× the information that there was",
                    "check that the Jacobian is zero along that direction, and that the covariance is carried to the "
                    "tangent space at the new mean after the update",
                )  # fmt: skip


def _information(P: Array, b: Array) -> Array:
    """bᵀP⁻¹b (M,)."""
    return (b * np.linalg.solve(P, b[..., None])[..., 0]).sum(-1)
