"""Does the filter know how wrong its state is? The size of errors (NEES) by part, where truth is known.

Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001), section 5.4.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.distributions import chi2, norm
from viz_estim.core.quaternions import Array
from viz_estim.diagnosis import clouds, motion
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import FEWEST, GROSS, TINY, Finding, judge, level, times
from viz_estim.diagnosis.icp import is_registration
from viz_estim.diagnosis.rounding import sound


def has_covariance(case: Case) -> bool:
    """Whether a filter says how sure it is: by a covariance that is neither absent nor zero throughout."""
    if case.run.labels or "cov" not in case.run.ends:
        return True  # by probabilities
    return bool((np.nan_to_num(case.run.cov) != 0).any())


def untested(case: Case) -> Iterator[Finding]:
    """Neither innovations nor errors that could be held against a covariance: silence would look like health."""
    run = case.run
    if run.labels or case.sensors or run.error or run.properties.get("belief") == "Particles" or is_registration(case):
        return
    if "mean" not in run.ends or np.isfinite(run.mean).all(1).sum() < FEWEST:
        return
    truth, sure = np.isfinite(run.truth).any(), has_covariance(case)
    if truth and sure:
        return
    tell = "tell `rec.stage` the residual and residual_cov of each update, with z, noise and gain"
    yield Finding(
        "untested", "note", None, case.whole, {"truth": bool(truth), "covariance": sure},
        "no covariance is recorded, and no innovation: the errors against the truth are what they are, and what the "
        "filter believes of them is not known" if truth else
        "neither innovations nor a truth are recorded: nothing tells whether the estimate is right",
        f"{tell}, and the covariance" if truth else f"{tell}; or tell `rec.step` the truth, where there is one",
    )  # fmt: skip


def start(case: Case) -> Iterator[Finding]:
    """The error of the first belief against its covariance: eᵀ·P⁻¹·e is χ² of as many components as have a truth.

    It is one error and no estimate of how large errors are: large is one that is larger than GROSS allows.
    """
    run = case.run
    if run.labels or run.properties.get("belief") == "Particles" or not {"mean", "cov"} <= run.ends.keys():
        return
    if is_registration(case):
        return  # it starts where it is told to, and says so by no covariance
    table = run.stages.get("start")
    known_at = np.flatnonzero((run.step >= case.first) & np.isfinite(run.truth).any(1) & np.isfinite(run.mean).all(1))
    if not len(known_at) or not _of_the_start(case, int(known_at[0])):
        return
    k = int(known_at[0])
    mean, P = run.mean[k], run.cov[k]
    if table is not None and int(run.step[k]) in table.step.tolist():
        mean, P = table.mean[-1], table.cov[-1]
    error = case.space.minus(run.truth[k], mean)
    known = np.isfinite(error) & (np.diag(P) > 0)
    if not known.any() or not sound(P[np.ix_(known, known)][None])[0]:
        return
    value, dof = float(error[known] @ np.linalg.solve(P[known][:, known], error[known])), int(known.sum())
    severity = judge(float(chi2.sf(value, dof)), 1, large=bool(value > GROSS * dof))
    last = case.run.at(int(run.step[k]))[-1][0] if table is None else None  # the stage that the belief is of
    if severity and last is not None and "innovation.residual" in last.values:
        # It was moved already, and a first reading of something bent may leave less than it can tell.
        severity = "warning"
    if severity:
        sigma = np.where(known, np.abs(error) / np.sqrt(np.where(known, np.diag(P), 1.0)), 0.0)
        worst = int(np.argmax(sigma))
        name, unit, step = case.space.axes[worst], case.space.axis_units[worst], int(run.step[k])
        yield Finding(
            "start", severity, None, (step, step),
            {"component": name, "error": float(error[worst]), "sigma": float(sigma[worst]), "nees": value, "dof": dof},
            f"{'the filter starts' if last is None else f'after its first {last.name} the filter is'} "
            f"{sigma[worst]:.2g}σ off the truth, most of all in {name} ({error[worst]:+.3g} {unit})",
            f"start it nearer, or with a standard deviation of {name} of about {abs(error[worst]):.2g} {unit}"
            + (", and record the first belief as a stage `start`, to see which of them is off" if last else ""),
        )  # fmt: skip


def _of_the_start(case: Case, row: int) -> bool:
    """Whether the belief of a row is still the start's: the variance of no component that has a truth has been changed
    by GROSS since, by readings or by the process. It chooses a name and decides no rate."""
    first, now = (np.diag(case.run.cov[k]) for k in (case.run.row(step=case.whole[0]), row))
    known = np.isfinite(case.space.minus(case.run.truth[row], case.run.mean[row]))
    return bool(((now >= first / GROSS) & (now <= first * GROSS))[known].all())


def by_part(case: Case) -> Iterator[Finding]:
    """Mean NEES of each part of the state, where truth is known, against χ² of as many errors as are independent.

    Errors are not white: of T there are T/τ independent ones, with τ = 1 + 2·Σρₖ² of the whitened errors'
    autocorrelation about zero, up to its first ρₖ ≤ 0 (Geyer 1992: an initial positive sequence). τ is an estimate
    itself: of W lags its relative standard error is √(2·(2W + 1)/T) (Madras and Sokal 1988), and its upper limit at the
    share of a warning is taken.
    """
    run = case.run
    if run.labels or "mean" not in run.ends or is_registration(case):
        return
    counts = run.step >= case.first
    found = []
    for name, part in case.space.parts.items():
        at, axes = case.space.at[name], case.space.axes_at[name]
        error = part.minus(run.mean[:, at], run.truth[:, at])
        P = run.cov[:, axes, axes]
        rows = counts & np.isfinite(error).all(1) & np.isfinite(P).all((1, 2))
        rows[rows] &= sound(P[rows])
        if rows.sum() >= FEWEST:
            white = np.linalg.solve(np.linalg.cholesky(P[rows]), error[rows][..., None])[..., 0]
            found.append((name, run.step[rows], white))
    for name, steps, white in found:
        T, dof = white.shape
        mean = float((white**2).sum() / T)
        independent = max(1.0, T / _correlation_time(np.asarray(white, float)))
        total = mean * independent
        p = 2 * min(chi2.sf(total, dof * independent), chi2.cdf(total, dof * independent))
        ratio = mean / dof
        severity = judge(p, 2 * len(found), large=float(chi2.sf(total / GROSS, dof * independent)))
        if severity is None:
            continue
        evidence = {"part": name, "mean_nees": mean, "dof": dof, "independent": independent, "p": p}
        code = "overconfident" if ratio > 1 else "underconfident"
        what = f"the error of {name} is {times(ratio**0.5)} as large as its covariance says"
        if ratio * np.finfo(float).eps > 1:  # of a cloud of copies
            what = f"the covariance of {name} is as good as zero beside its error"
        if ratio > 1:
            why, remedy = _too_sure(case, name)
            cause = f"{what}: {why}"
        else:
            cause, remedy = f"{what}: it is better known than the filter believes", f"lower the noise that moves {name}"
        yield Finding(code, severity, None, (int(steps[0]), int(steps[-1])), evidence, cause, remedy)


def _too_sure(case: Case, name: str) -> tuple[str, str]:
    """Why a part's error may be larger than its covariance, and what to try, by the kind of estimator."""
    if case.run.properties.get("belief") == "Particles":
        if clouds.moves(case) is not None and not motion.predictions(case):
            return (
                "each step moves the particles as the truth moves, so that the readings pull the cloud away, or it is "
                "too narrow: too few particles, or noises that are too small",
                "check the readings' order, units, offsets and stamps, and the places of what they are read from; then "
                "take more particles and wider noises",
            )
        return (
            "the cloud is too narrow, or sits in a wrong place: too few particles, noises that are too small, or "
            "readings and motion that do not belong together",
            "take more particles and wider noises; then check units, signs and order of readings and control",
        )
    return (
        f"{name} carries the inconsistency; its process or initial noise is too small, or it is biased",
        f"raise the noise that moves {name}; look for a bias in the sensors that tell of it",
    )


def _correlation_time(white: Array) -> float:
    """The upper limit of τ of the squares: 1 + 2·Σρₖ², with ρₖ about zero, since a whitened error's mean is known to be
    that."""
    T = len(white)
    spectrum = np.fft.rfft(white, 2 * T, axis=0)
    rho = np.fft.irfft((np.abs(spectrum) ** 2).sum(1))[:T]
    rho = rho / max(rho[0], TINY)
    crossed = np.flatnonzero(rho <= 0)
    end = max(1, int(crossed[0])) if len(crossed) else T  # no error at all has no ρ₀ either
    tau = float(1 + 2 * (rho[1:end] ** 2).sum())
    return tau * (1 + float(norm.isf(level("warning", 1))) * (2 * (2 * end - 1) / T) ** 0.5)
