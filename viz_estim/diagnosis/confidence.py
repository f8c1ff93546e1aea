"""Does the filter know how wrong it is? The size of innovations (NIS) and errors (NEES), by sensor and by part.

Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001), section 5.4.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2, norm

from viz_estim.core.consistency import squared_distance
from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.evidence import Case, Readings, parameter
from viz_estim.diagnosis.finding import Finding, judge

_GROSS = 2.0  # a covariance too small by this factor is an error, by less a warning; too large is never one
_FEWEST = 10
_TAIL, _MANY = 1e-3, 0.05


def by_sensor(case: Case) -> Iterator[Finding]:
    """Mean NIS of a sensor outside its χ² band: the sum of N of them is χ²(N·dof) (eq. 5.4.2-9)."""
    for name, readings in case.sensors.items():
        N, dof = len(readings), readings.dof
        if N < _FEWEST:
            continue
        ratio, p = size(readings.nis, dof)
        severity = judge(p, 2 * len(case.sensors), large=ratio > _GROSS)
        if severity is None:
            continue
        over = ratio > 1
        factor, rho = factor_on_noise(readings.pick(~_far(readings.nis, dof))), lag_one(readings.white)
        if factor is not None and (factor > 1) != over:
            factor = None
        evidence = {"mean_nis": float(readings.nis.mean()), "dof": dof, "readings": N, "p": p, "factor_on_R": factor}
        evidence["autocorrelation"] = rho
        code = "overconfident" if over else "underconfident"
        yield Finding(code, severity, name, readings.steps, evidence, *_words(case, readings, ratio, factor, rho))


def size(nis: Array, dof: int) -> tuple[float, float]:
    """How large NIS are, as a multiple of what they should be, and the chance of that.

    Without those beyond the χ² quantile of 1 − 10⁻³, which are a matter of outliers, as long as these are few: the mean
    of χ²(dof) below c is dof·F(c; dof + 2)/F(c; dof), its second moment dof·(dof + 2)·F(c; dof + 4)/F(c; dof).
    """
    c, far = chi2.isf(_TAIL, dof), _far(nis, dof)
    if not far.any():
        total, n = float(nis.sum()), len(nis) * dof
        return total / n, float(2 * min(chi2.sf(total, n), chi2.cdf(total, n)))
    held = chi2.cdf(c, dof)
    mean = dof * chi2.cdf(c, dof + 2) / held
    variance = dof * (dof + 2) * chi2.cdf(c, dof + 4) / held - mean**2
    found = float(nis[~far].mean())
    return found / mean, float(2 * norm.sf(abs(found - mean) / np.sqrt(variance / (~far).sum())))


def _far(nis: Array, dof: int) -> np.ndarray:
    """Which NIS (M,) are a matter of outliers; none where so many are far that it is the noise."""
    far = nis > chi2.isf(_TAIL, dof)
    return far if far.mean() <= _MANY else np.zeros(len(nis), bool)


def factor_on_noise(readings: Readings) -> float | None:
    """The factor f on R for which S − R + f·R brings the mean NIS to its dof; None where none does."""
    spread = readings.cov - readings.noise

    def excess(log_f: float) -> float:
        S = spread + np.exp(log_f) * readings.noise
        return float(np.nanmean(squared_distance(readings.residual, S))) / readings.dof - 1

    low, high = np.log(1e-4), np.log(1e6)
    try:
        return float(np.exp(brentq(excess, low, high, xtol=1e-3)))
    except ValueError:
        return None


def lag_one(white: Array) -> float:
    """The autocorrelation of whitened innovations (N, m) at lag 1, over all components."""
    total = float((white**2).sum())
    return float((white[1:] * white[:-1]).sum() / total) if total > 0 else 0.0


def _words(case: Case, readings: Readings, ratio: float, factor: float | None, rho: float) -> tuple[str, str]:
    """Cause and remedy. Innovations that follow one another tell a Q too small from an R too small (Mehra 1970)."""
    name = readings.name
    size = f"innovations of {name} are {ratio**0.5:.2g}× as large as S says (mean NIS {ratio:.2g} of what it should be)"
    noise = parameter(case.run, f"{name}_noise")
    std = float(np.sqrt(np.diagonal(readings.noise, axis1=1, axis2=2).mean()))
    now = noise[1] if noise and isinstance(noise[1], float) else std
    where = noise[0] if noise else f"the standard deviation of {name}"
    if factor is None:
        tuned = f"no R alone would explain it: look at the process noise of what {name} sees"
    else:
        tuned = f"set {where} to about {now * factor**0.5:.2g} (it is {now:.2g})"
    if ratio > 1 and rho > 0.2:
        return (
            f"{size}, and each is like the one before (autocorrelation {rho:.2f}): the state lags behind, as with a "
            "process noise Q that is too small or a motion that the model lacks",
            f"raise the process noise until the autocorrelation is gone; if that does not help, {tuned}",
        )
    if ratio > 1:
        by = "too small" if factor is None else f"{factor:.2g}× too small"
        return f"{size}: R of {name} is {by}, or the model misses what moves it", tuned
    by = "too large" if factor is None or factor == 0 else f"{1 / factor:.2g}× too large"
    return f"{size}: R of {name} is {by}, or Q is", tuned


def by_part(case: Case) -> Iterator[Finding]:
    """Mean NEES of each part of the state, where truth is known, against χ² of as many errors as are independent.

    Errors are not white: of T there are T/τ independent ones, with τ = 1 + 2·Σρₖ² of the whitened errors'
    autocorrelation about zero, up to its first ρₖ < 0.05 (Geyer 1992: an initial positive sequence). Twice that τ is
    taken, for it is an estimate itself.
    """
    run = case.run
    if run.labels or "mean" not in run.ends:
        return
    counts = run.step >= case.first
    found = []
    for name, part in case.space.parts.items():
        at, axes = case.space.at[name], case.space.axes_at[name]
        error = part.minus(run.mean[:, at], run.truth[:, at])
        P = run.cov[:, axes, axes]
        rows = counts & np.isfinite(error).all(1) & np.isfinite(P).all((1, 2))
        rows[rows] &= np.linalg.eigvalsh(P[rows])[:, 0] > 1e-12 * np.trace(P[rows], axis1=1, axis2=2)
        if rows.sum() >= _FEWEST:
            white = np.linalg.solve(np.linalg.cholesky(P[rows]), error[rows][..., None])[..., 0]
            found.append((name, run.step[rows], white))
    for name, steps, white in found:
        T, dof = white.shape
        mean = float((white**2).sum() / T)
        independent = max(1.0, T / (2 * _correlation_time(white)))
        total = mean * independent
        p = 2 * min(chi2.sf(total, dof * independent), chi2.cdf(total, dof * independent))
        ratio = mean / dof
        severity = judge(p, 2 * len(found), large=ratio > _GROSS**2)
        if severity is None:
            continue
        evidence = {"part": name, "mean_nees": mean, "dof": dof, "independent": independent, "p": p}
        code = "overconfident" if ratio > 1 else "underconfident"
        what = f"the error of {name} is {ratio**0.5:.2g}× as large as its covariance says"
        if ratio > 1:
            cause = (
                f"{what}: {name} carries the inconsistency; its process or initial noise is too small, or it is biased"
            )
            remedy = f"raise the noise that moves {name}; look for a bias in the sensors that tell of it"
        else:
            cause, remedy = f"{what}: it is better known than the filter believes", f"lower the noise that moves {name}"
        yield Finding(code, severity, None, (int(steps[0]), int(steps[-1])), evidence, cause, remedy)


def _correlation_time(white: Array) -> float:
    """τ of the squares: 1 + 2·Σρₖ², with ρₖ about zero, since a whitened error's mean is known to be that."""
    T = len(white)
    spectrum = np.fft.rfft(white, 2 * T, axis=0)
    rho = np.fft.irfft((np.abs(spectrum) ** 2).sum(1))[:T]
    rho = rho / max(rho[0], 1e-300)
    small = np.flatnonzero(rho < 0.05)
    end = int(small[0]) if len(small) else T
    return float(1 + 2 * (rho[1:end] ** 2).sum())
