"""Are innovations what they should be: zero in the mean, each its own draw, normal in the tails?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from viz_estim.core.consistency import nees
from viz_estim.core.distributions import chi2, f, norm, t
from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.evidence import Case, Readings, parameter
from viz_estim.diagnosis.finding import FEWEST, GROSS, REPEATED, TINY, Finding, judge, level
from viz_estim.diagnosis.fits import STRETCHES, in_stretches
from viz_estim.diagnosis.icp import is_registration
from viz_estim.diagnosis.outlying import TAIL, outlying

_LAGS = 10
# The correlation ρ of neighbours in a first-order process whose mean has a variance larger by GROSS, (1 + ρ)/(1 − ρ).
_CORRELATED = (GROSS - 1) / (GROSS + 1)


def biased(case: Case) -> Iterator[Finding]:
    """The mean of each component of the innovation against its standard error: a t-test.

    The standard error takes autocorrelation in: s·√(τ/N), τ = 1 + 2·Σρₖ over the first lags, at least 1; and the means
    of 20 stretches of the run must say the same (batch means; Schmeiser 1982): the larger p counts.

    Large is a bias b that doubles the squared error with which the filter foresees the reading: b² = (H·P·Hᵀ)ᵢᵢ. The
    noise of the reading itself is no measure: a filter averages it away, and not the bias.
    """
    tests = sum(readings.dof for readings in case.sensors.values())
    for name, readings in case.sensors.items():
        N = len(readings)
        if N < FEWEST:
            continue
        for i, axis in enumerate(readings.space.axes):
            values = readings.scaled[:, i]
            tau = max(1.0, 1 + 2 * float(_autocorrelations(values[:, None] - values.mean())[0].sum()))
            mean, error = float(values.mean()), float(values.std(ddof=1) * np.sqrt(tau / N))
            if error <= 0:
                continue
            score = mean / error
            stretches = in_stretches(values) / in_stretches(np.ones(N))
            apart = mean / max(float(stretches.std(ddof=1)) / np.sqrt(len(stretches)), TINY)
            below = max(0.0, 1 - _own_share(readings, i) ** 0.5 / abs(mean))  # what of it is beyond a large one
            p, p_large = (
                float(max(2 * t.sf(k * abs(score), max(1, N / tau - 1)), 2 * t.sf(k * abs(apart), len(stretches) - 1)))
                for k in (1.0, below)
            )
            severity = judge(p, tests, large=p_large)
            if severity:
                value, unit = float(readings.residual[:, i].mean()), readings.space.axis_units[i]
                evidence = {"component": axis, "mean": value, "mean_sigma": mean, "z": score, "p": p}
                label = name if axis in ("", name) else f"{name} {axis}"
                yield Finding(
                    "biased_innovation", severity, name, readings.steps, evidence,
                    f"readings of {label} lie {value:+.3g} {unit} off what is expected, on the average over the run "
                    f"({score:+.1f} standard errors): the sensor has a bias that the state lacks, or the model has one",
                    f"subtract the bias by a calibration, or add it to the state and let the filter estimate it; check "
                    f"the sign and the mounting of {name}",
                )  # fmt: skip
                break  # one finding a sensor: its worst-known component leads on


def _own_share(readings: Readings, i: int) -> float:
    """The state's share of a component's variance, (H·P·Hᵀ/S)ᵢᵢ in the mean; 1 where R is not recorded."""
    return max(float(np.mean(1 - readings.noise[:, i, i] / readings.cov[:, i, i])), 0.0)  # S may leave out R


def coloured(case: Case) -> Iterator[Finding]:
    """Ljung and Box (1978): Q = N(N+2)·Σₖ ρₖ²/(N−k) over the lags and the whitened components is χ²(lags·m).

    Large is a correlation of 1/3: the mean of N such readings is as uncertain as that of N/2 that are white. atanh ρ is
    normal about that of the true one with 1/√(N − 3) (Fisher 1921); the strongest of all is taken.
    """
    for name, readings in case.sensors.items():
        N = len(readings)
        if N < FEWEST:
            continue
        Q, p, rho = ljung_box(readings)
        component, lag = np.unravel_index(np.argmax(np.abs(rho)), rho.shape)
        strongest = float(rho[component, lag])
        beyond = np.arctanh(min(abs(strongest), 1 - np.finfo(float).eps)) - np.arctanh(_CORRELATED)
        severity = judge(p, len(case.sensors), large=float(rho.size * norm.sf(beyond * np.sqrt(N - 3))))
        if severity:
            seconds = float(np.median(readings.time[lag + 1 :] - readings.time[: -(lag + 1)]))
            evidence = {"ljung_box": Q, "p": p, "lag": int(lag) + 1, "lag_s": seconds, "autocorrelation": strongest}
            yield Finding(
                "coloured_innovation",
                severity,
                name,
                readings.steps,
                evidence,
                *_colour(name, strongest, seconds, float(np.median(readings.nis)) < chi2.median(readings.dof)),
            )


def ljung_box(readings: Readings) -> tuple[float, float, Array]:
    """Q of the whitened innovations, the chance of it, and their autocorrelations (m, lags). The number of lags changes
    the power and no rate: Q is χ²(lags·m) for any."""
    N, white = len(readings), readings.white - readings.white.mean(0)
    lags = min(_LAGS, N // 5)
    rho = _autocorrelations(white, lags)
    Q = N * (N + 2) * float((rho**2 / (N - np.arange(1, lags + 1))).sum())
    return Q, float(chi2.sf(Q, rho.size)), rho


def _colour(name: str, strongest: float, seconds: float, small: bool) -> tuple[str, str]:
    if strongest > 0 and small:
        return (
            f"an innovation of {name} is like the one {seconds:.3g} s before it (correlation {strongest:.2f}), and "
            "they are smaller than S says: the gain is too small, as with an R that is too large",
            f"lower the noise of {name} and see whether the correlation falls; else the sensor's own noise is slow",
        )
    if strongest > 0:
        return (
            f"an innovation of {name} is like the one {seconds:.3g} s before it (correlation {strongest:.2f}): what is "
            "wrong stays wrong, as with a Q that is too small, a motion the model lacks, or noise that is coloured",
            "raise the process noise and see whether the correlation falls; else add what is missing to the state, "
            f"and check the stamps of {name} for a delay",
        )
    return (
        f"an innovation of {name} is undone by the one {seconds:.3g} s after it (correlation {strongest:.2f}): the "
        "filter over-corrects, as with a Q that is too large, an R too small, or a reading that is taken in twice",
        f"lower the process noise or raise the noise of {name}; check that each reading enters once",
    )


def _autocorrelations(values: Array, lags: int = _LAGS) -> Array:
    """(m, lags) of N centred values (N, m)."""
    total = np.maximum((values**2).sum(0), TINY)
    return np.stack([(values[k:] * values[:-k]).sum(0) / total for k in range(1, lags + 1)], axis=-1)


def outliers(case: Case) -> Iterator[Finding]:
    """Readings that are outliers by `outlying`. Large are those that no gate refuses and that alone double the mean of
    all, once these are brought to their median."""
    for name, readings in case.sensors.items():
        N, dof = len(readings), readings.dof
        if N < FEWEST:
            continue
        far, bound, p = outlying(readings.nis, dof, len(case.sensors))
        count, scale = int(far.sum()), bound / chi2.isf(TAIL, dof)
        moving = (readings.nis[far & readings.used] / scale - dof).sum()
        severity = judge(p, 2 * len(case.sensors), large=bool(moving > (GROSS - 1) * dof * N))
        if severity:
            rows = np.flatnonzero(far)
            gated = int((~readings.used[far]).sum())
            evidence: dict[str, Any] = {"outliers": count, "readings": N, "expected": N * TAIL, "p": p}
            evidence |= {"refused_by_gate": gated, "largest_nis": float(readings.nis.max())}
            cause = "detours, glitches or wrong associations, which a normal noise does not have"
            if gated:
                remedy = f"the gate refuses {gated} of them; look at the others by hand"
            elif rows[0] == 0 and rows[-1] < 2 * count:  # most of the first ones, and none after
                cause = "all among the first: the filter starts elsewhere than they say, and is too sure of it"
                remedy = (
                    "check the first belief and its covariance, and how the first update is made; set no gate on it"
                )
            else:
                remedy = (
                    f"set a gate ({gate_name(case, name)}=0.999) so that they move nothing; see where they come from"
                )
            yield Finding(
                "outliers", severity if gated < count else "note", name,
                (int(readings.step[rows[0]]), int(readings.step[rows[-1]])), evidence,
                f"{count} of {N} readings of {name} lie{'s' * (count == 1)} further off than one in a thousand should "
                f"({N * TAIL:.2g} expected; the furthest by {readings.nis.max() ** 0.5:.3g}σ): {cause}",
                remedy,
            )  # fmt: skip


def gate_name(case: Case, name: str) -> str:
    """The parameter by which a sensor's gate is set."""
    known = parameter(case.run, f"{name}_gate", "gate")
    return known[0] if known else "gate"


def diverged(case: Case) -> Iterator[Finding]:
    """NIS leaves for good: from some step on every block of readings lies above its χ² band, after some that did not.

    A block's sum is χ²(B·dof); a row of n such blocks at the level TAIL each has the probability TAILⁿ. By then
    innovations are twice as large, and NIS larger than before by a factor that is beyond GROSS for sure, by F.
    """
    for name, readings in case.sensors.items():
        block, blocks = _blocks(readings)
        if len(readings) < FEWEST:
            continue
        sums = readings.nis[-block * blocks :].reshape(blocks, block).sum(1)
        high = sums > chi2.isf(TAIL, block * readings.dof)
        low = np.flatnonzero(~high)
        start = int(low[-1]) + 1 if len(low) else 0
        row = blocks - start
        growth = float(sums[start:].mean() / max(sums[:start].mean(), TINY)) if 0 < start < blocks else 0.0
        if growth < GROSS**2:
            continue
        n = block * readings.dof
        at = len(readings) - block * (blocks - start)
        p_large = float(f.sf(growth / GROSS, n * row, n * start))
        severity = judge(blocks * TAIL**row, len(case.sensors), large=p_large)
        if severity:
            steps = int(readings.step[at]), int(readings.step[-1])
            evidence = {"onset_step": steps[0], "onset_s": float(readings.time[at]), "growth": growth}
            yield Finding(
                "diverged", severity, name, steps, evidence,
                f"from step {steps[0]} on innovations of {name} stay {growth**0.5:.2g}× as large as before: the "
                "estimate has left the readings and does not come back",
                f"go to step {steps[0]} and step through its stages: what moved the estimate, or why does the gain not "
                "pull it back (a covariance that is too small, a wrong linearisation, a gate that is locked out)?",
            )  # fmt: skip


def _blocks(readings: Readings) -> tuple[int, int]:
    """Length and number of blocks: one of each stretch, of at least five readings."""
    block = max(5, len(readings) // STRETCHES)
    return block, len(readings) // block


def lost(case: Case) -> Iterator[Finding]:
    """The error leaves for good: from some step to the end every NEES is beyond χ²'s quantile of an error's level.

    Whatever came before, that takes the last step to be beyond it, which chance does with that level. An error where
    it doubles the mean NEES of the whole run; no finding where it is shorter than one of STRETCHES, for a run may end
    anywhere.
    """
    run = case.run
    if run.labels or "mean" not in run.ends or run.properties.get("belief") == "Particles" or is_registration(case):
        return
    values, dof = nees(run.space, run.mean, run.cov, run.truth)
    rows = np.flatnonzero(np.isfinite(values) & (run.step >= case.first))
    if len(rows) < FEWEST:
        return
    inside = np.flatnonzero(values[rows] <= chi2.isf(level("error", 1), dof))
    start = int(inside[-1]) + 1 if len(inside) else 0
    lasting = len(rows) - start
    if lasting < max(REPEATED, len(rows) // STRETCHES):
        return
    large = float((values[rows[start:]] - dof).sum()) > (GROSS - 1) * dof * len(rows)
    steps = int(run.step[rows[start]]), int(run.step[rows[-1]])
    evidence = {"onset_step": steps[0], "mean_nees": float(values[rows[start:]].mean()), "dof": dof}
    since = "from the start" if start == 0 else f"from step {steps[0]} on"
    yield Finding(
        "diverged", "error" if large else "warning", None, steps, evidence,
        f"{since} the estimate is further from the truth than its covariance allows, to the end: it is sure of a wrong "
        "state" + (", such as a mirror image that explains the readings as well" if start == 0 else ""),
        f"go to step {steps[0]} and see which stage moves it away; a start elsewhere, or a larger initial covariance, "
        "tells whether it can find back",
    )  # fmt: skip
