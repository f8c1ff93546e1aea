"""Does the filter know how wrong it is? The size of innovations (NIS) and errors (NEES), by sensor and by part.

Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001), section 5.4.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import scipy

from viz_estim.core.distributions import chi2, norm
from viz_estim.core.measurement import symmetrised
from viz_estim.core.quaternions import Array
from viz_estim.diagnosis import tuning
from viz_estim.diagnosis.evidence import Case, Readings, parameter
from viz_estim.diagnosis.finding import FEWEST, GROSS, ODDS, SHEET, Finding, judge, times
from viz_estim.diagnosis.innovations import ljung_box
from viz_estim.diagnosis.outlying import outlying
from viz_estim.diagnosis.rounding import sound

# A covariance too small by GROSS is an error, by less a warning; too large is never one: it costs, and misleads nobody.
# S goes as the root of Q, as that of a random walk does in its steady state, P ≈ √(Q·R): Q may be wrong by its square.
_GROSS_Q = GROSS**2
_FURTHEST = 2 * np.log(1e3)  # log factors on a variance that are looked for: a unit may be wrong by a thousand


def by_sensor(case: Case, *, tune: bool) -> Iterator[Finding]:
    """The size of each sensor's innovations (`_by_sensor`); and where one sensor's are too large and another's too
    small, whether their noises are exchanged, which must be likelier than any other factor on either, by ODDS."""
    found = list(_by_sensor(case, tune))
    sizes = {f.sensor: f for f in found if f.sensor and f.evidence.get("gain_by_R") is not None}
    for large, over in sizes.items():
        for small, under in sizes.items():
            if over.code == "overconfident" and under.code == "underconfident" and _as_many(case, large, small):
                gains = [f.evidence[key] for f in (over, under) for key in ("gain_by_R", "gain_by_Q")]
                if tuning.exchanged(case, large, small) > max(gains) + np.log(ODDS):
                    told = (
                        f"the noises of {large} and {small} are exchanged: with each other's R they would be about "
                        f"as large as S says, where now those of {large} are too large and those of {small} too small",
                        f"give {large} the noise of {small}, and {small} that of {large}",
                    )
                    found = [replace(f, cause=told[0], remedy=told[1]) if f in (over, under) else f for f in found]
    yield from found


def _as_many(case: Case, one: str, other: str) -> bool:
    return case.sensors[one].dof == case.sensors[other].dof


def _by_sensor(case: Case, tune: bool) -> Iterator[Finding]:
    """Mean NIS of a sensor outside its χ² band: the sum of N of them is χ²(N·dof) (eq. 5.4.2-9)."""
    spoken = False
    for name, readings in case.sensors.items():
        N, dof = len(readings), readings.dof
        if N < FEWEST:
            continue
        ratio, p, p_gross = size(readings.nis, dof, len(case.sensors))
        if judge(p, 2 * len(case.sensors), large=False) is None:
            continue
        over, far = ratio > 1, outlying(readings.nis, dof, len(case.sensors)).far
        tuned, rho = tuning.factors(case) if tune else {}, lag_one(readings.white)
        factor = tuned[name].factor if name in tuned else factor_on_noise(readings.pick(~far))
        if factor is not None and (factor > 1) != over:
            factor = None
        evidence = {"mean_nis": float(readings.nis.mean()), "dof": dof, "readings": N, "p": p, "factor_on_R": factor}
        process = None
        if "Q" in tuned:
            evidence["factor_on_Q"] = tuned["Q"].factor
            evidence |= {f"gain_by_{'R' if k == name else k}": tuned[k].gain for k in (name, "Q") if k in tuned}
            if tuned["Q"].gain > tuned[name].gain and (tuned["Q"].factor > 1) == over and tuned["Q"].known:
                process = tuned["Q"].factor
        evidence["autocorrelation"] = rho
        if process is not None:
            p_gross = min(p_gross, tuned["Q"].p_beyond(_GROSS_Q))
        severity = judge(p, 2 * len(case.sensors), large=p_gross)
        assert severity
        spoken = spoken or process is not None or _astray(ratio, rho)
        code = "overconfident" if over else "underconfident"
        words = _words(case, readings, ratio, factor, process, rho)
        yield Finding(code, severity, name, readings.steps, evidence, *words)
    if tune and not spoken:
        yield from _by_process(case)


def _by_process(case: Case) -> Iterator[Finding]:
    """The likelihood ratio of another Q (`tuning`): twice its logarithm is χ²(1) if Q is right (Wilks 1938).

    It tells a wrong Q from innovations whose size is right and whose order is not. Only looked at where innovations
    look odd at the level of 0.05, by their size or by Ljung and Box, which saves the time of tuning and can but lower
    its false alarms.
    """
    looks = [
        min(size(r.nis, r.dof, len(case.sensors))[1], ljung_box(r)[1])
        for r in case.sensors.values()
        if len(r) >= FEWEST
    ]
    if not looks or min(looks) > 0.05:
        return
    tuned = tuning.factors(case)
    if "Q" not in tuned or any(tuned[name].gain > tuned["Q"].gain for name in tuned):
        return
    factor, gain = tuned["Q"].factor, tuned["Q"].gain
    if not tuned["Q"].known:
        return
    p, over = float(chi2.sf(2 * gain, 1)), factor > 1
    severity = judge(p, 1, large=tuned["Q"].p_beyond(_GROSS_Q))
    if severity:
        yield Finding(
            "overconfident" if over else "underconfident", severity, None, case.whole,
            {"factor_on_Q": factor, "log_likelihood_gain": gain, "p": p},
            f"the process noise Q is {factor if over else 1 / factor:.2g}× too {'small' if over else 'large'} by the "
            f"likelihood of the innovations{_lacks_dt(tuned['Q'], case)}" + (", or the model lacks a motion" * over),
            _more_noise(factor, tuned["Q"], case),
        )  # fmt: skip


def _lacks_dt(of: tuning.Tuned, case: Case) -> str:
    """Whether Q is as much too large as one that is not multiplied by dt, or by dt²: as likely as the best, by ODDS."""
    dt = case.run.dt[case.run.dt > 0]
    usual = float(np.median(dt)) if len(dt) else 1.0
    near = [k for k in (1, 2) if usual < 1 / GROSS and of.odds(usual**k) < ODDS]
    powers = " or ".join(("dt", "dt²")[k - 1] for k in near)
    return f", as one that is not multiplied by {powers} would be (dt is {usual:.3g} s)" if near else ""


def _more_noise(factor: float, of: tuning.Tuned, case: Case) -> str:
    more = f"multiply Q by about {factor:.2g}, its standard deviations by {factor**0.5:.2g}"
    if _lacks_dt(of, case):
        return f"{more}; or make it of the step's dt, by G·V·Gᵀ with dt in G where it is the noise of an input"
    return f"{more}; where the model lacks a motion, add that to the state instead"


def size(nis: Array, dof: int, sensors: int) -> tuple[float, float, float]:
    """How large NIS are, as a multiple of what they should be; the chance of that; and that of as much or more if S is
    too small by GROSS. Without outliers (`outlying`), of a run with so many sensors."""
    far, bound, _ = outlying(nis, dof, sensors)
    if not far.any():
        total, n = float(nis.sum()), len(nis) * dof
        p = 2 * min(chi2.sf(total, n), chi2.cdf(total, n))
        return total / n, float(p), float(chi2.sf(total / GROSS, n))
    mean, score = _below(nis[~far], dof, bound)
    _, beyond = _below(nis[~far] / GROSS, dof, bound / GROSS)
    return float(nis[~far].mean()) / mean, float(2 * norm.sf(abs(score))), float(norm.sf(beyond))


def _below(nis: Array, dof: int, bound: float) -> tuple[float, float]:
    """The mean of χ²(dof) below a bound c, and by how many standard errors that of NIS which are below it is larger:
    dof·F(c; dof + 2)/F(c; dof), with the second moment dof·(dof + 2)·F(c; dof + 4)/F(c; dof)."""
    held = chi2.cdf(bound, dof)
    mean = float(dof * chi2.cdf(bound, dof + 2) / held)
    variance = dof * (dof + 2) * chi2.cdf(bound, dof + 4) / held - mean**2
    return mean, float((nis.mean() - mean) / np.sqrt(variance / len(nis)))


def factor_on_noise(readings: Readings) -> float | None:
    """The factor f on R that brings the mean NIS to its dof, where `tuning` can't be asked; None where there is none.

    With the state's share of S going as √f, as that of a random walk does in its steady state, P ≈ √(Q·R).
    """
    readings = readings.pick(sound(readings.noise))
    if not len(readings):
        return None
    # In axes in which R is 1 and the state's share is diagonal, so that S is solved with once.
    L = np.linalg.cholesky(readings.noise)
    spread = np.linalg.solve(L, np.swapaxes(np.linalg.solve(L, readings.cov - readings.noise), 1, 2))
    share, axes = np.linalg.eigh(symmetrised(np.asarray(spread, float)))
    squares = (np.swapaxes(axes, 1, 2) @ np.linalg.solve(L, readings.residual[..., None]))[..., 0] ** 2

    def excess(log_f: float) -> float:
        return (
            float((squares / (np.exp(0.5 * log_f) * np.maximum(share, 0.0) + np.exp(log_f))).sum(1).mean())
            / readings.dof
            - 1
        )

    try:
        return float(np.exp(scipy.optimize.brentq(excess, -_FURTHEST, _FURTHEST, xtol=0.1 * SHEET)))
    except ValueError:
        return None


def lag_one(white: Array) -> float:
    """The autocorrelation of whitened innovations (N, m) at lag 1, over all components."""
    total = float((white**2).sum())
    return float((white[1:] * white[:-1]).sum() / total) if total > 0 else 0.0


def _astray(ratio: float, rho: float) -> bool:
    """Whether innovations are so alike and so large that no noise would make them: each explains more of the next than
    an error of Q would, by its square (`_GROSS_Q`), and they are larger than both a Q and an R that are errors make
    them. It chooses words among causes and decides no rate."""
    return rho > 0 and 1 - rho**2 < 1 / _GROSS_Q and ratio > GROSS * _GROSS_Q


def _no_process_noise(case: Case) -> bool:
    """Whether predictions say that they add none."""
    told = [t.values["noise"] for t in case.run.stages.values() if {"transition", "noise"} <= t.values.keys()]
    return bool(told) and not any(np.nan_to_num(Q).any() for Q in told)


def _words(
    case: Case, readings: Readings, ratio: float, factor: float | None, process: float | None, rho: float
) -> tuple[str, str]:
    """Cause and remedy. factor: on R; process: on Q, where that explains the innovations better."""
    name = readings.name
    size = f"innovations of {name} are {times(ratio**0.5)} as large as S says (mean NIS {times(ratio)} its due)"
    noise = parameter(case.run, f"{name}_noise")
    std = float(np.sqrt(np.diagonal(readings.noise, axis1=1, axis2=2).mean()))
    now = noise[1] if noise and isinstance(noise[1], float) else std
    where = noise[0] if noise else f"the standard deviation of {name}"
    if not readings.noise.any():
        tuned = (
            f"multiply the variance of {name} by about {ratio:.2g}; give `noise=R` to the recording, to be told more"
        )
    elif factor is None:
        tuned = f"no R alone would explain it: look at the process noise of what {name} sees"
    else:
        tuned = f"set {where} to about {now * factor**0.5:.2g} (it is {now:.2g})"
    if ratio > 1 and rho > 0 and _no_process_noise(case):
        return (
            f"{size}, and the process noise Q of the prediction is zero: the filter is ever surer of its model, and "
            f"takes less and less from {name}",
            "give the prediction the noise of what its model leaves out, Q > 0; tune the others after",
        )
    if _astray(ratio, rho):
        return (
            f"{size}, and each is like the one before (autocorrelation {rho:.2f}): the estimate goes another way than "
            f"{name}, which no noise does",
            f"check the order, the signs and the units of {name} and of the control, and the start; tune noises after",
        )
    if process is not None:
        wrong = f"{process:.2g}× too small" if process > 1 else f"{1 / process:.2g}× too large"
        return (
            f"{size}: the process noise Q is {wrong} (R alone would explain it less well)"
            f"{_lacks_dt(tuning.factors(case)['Q'], case)}"
            + (f", or the model misses what moves {name}" if process > 1 else ""),
            _more_noise(process, tuning.factors(case)["Q"], case),
        )
    if abs(ratio - 1) < SHEET:
        return f"{size}: by little, and for sure only because there are so many readings", f"leave it; or {tuned}"
    if ratio > 1:
        by = "too small" if factor is None else f"{factor:.2g}× too small"
        return f"{size}: R of {name} is {by}, or the model misses what moves it", tuned
    by = "too large" if factor is None or factor == 0 else f"{1 / factor:.2g}× too large"
    return f"{size}: R of {name} is {by}, or Q is", tuned
