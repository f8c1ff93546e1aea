"""Is time what the filter takes it for? Gaps, duplicates, steps back, jitter, and a dt that is another."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.distributions import norm
from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.finding import FEWEST, SHEET, Finding, level
from viz_estim.diagnosis.rounding import NANOSECOND, of_stamps
from viz_estim.recording.reader import Run

MISSING = 1.5  # usual intervals: what is longer is nearer to two than to one, so that a sample is missing


def stamps(run: Run) -> Iterator[Finding]:
    """What cannot be: stamps that go back or repeat, a dt that is not their difference by more than rounding.

    A dt that is off by a share moves the state too far by that share: an error from SHEET of the whole time on, as of
    any scale. What can be, by its chance: gaps and jitter.
    """
    interval = np.diff(run.time)
    if len(interval) < 3:
        return
    usual = float(np.median(interval))
    rounding = of_stamps(run)
    back = np.flatnonzero(interval < 0) + 1
    same = np.flatnonzero(interval == 0) + 1
    other = np.flatnonzero((np.abs(run.dt[1:] - interval) > rounding) & (run.dt[1:] > 0)) + 1
    gaps = _gaps(interval, usual, rounding)
    if len(back):
        yield _finding(
            run, back, "error", "back", "stamps go back in time",
            "sort the samples by their stamps, or drop those that come late",
        )  # fmt: skip
    if len(other):
        wrong = np.abs(run.dt[other] - interval[other - 1])
        yield _finding(
            run, other, "error" if wrong.sum() > SHEET * np.abs(interval).sum() else "warning", "dt",
            f"the filter's dt is not the difference of the stamps (by up to {wrong.max():.3g} s), as if it were fixed",
            "use each step's own dt = time[k] − time[k−1]",
        )  # fmt: skip
    if len(same):
        yield _finding(
            run, same, "note", "duplicates", "stamps come more than once",
            "check that no sample is there twice; at one moment a prediction has dt 0",
        )  # fmt: skip
    if len(gaps):
        longest = float(interval[gaps - 1].max())
        yield _finding(
            run, gaps, "warning", "gaps",
            f"the stamps leave gaps of up to {longest:.3g} s, {longest / max(usual, NANOSECOND):.0f} usual intervals",
            "look for lost samples in the log; over a gap the prediction must use the whole dt",
        )  # fmt: skip
    yield from _jitter(run, interval, usual, rounding)


def _gaps(interval: Array, usual: float, rounding: float) -> np.ndarray:
    """The rows after intervals in which a sample is missing, and which the run's own intervals don't explain.

    The tail beyond a high threshold is taken as exponential (Pickands 1975), whose mean excess is found from its
    median, so that the gaps don't widen what they are held against: N·¼·exp(−(x − u)/β) for an interval x beyond the
    upper quartile u.
    """
    u = float(np.quantile(interval, 0.75))
    beyond = np.sort(interval)[-max(len(interval) // 4, 1) :] - u
    beta = max(float(np.median(beyond)) / np.log(2), rounding)
    p = len(interval) * 0.25 * np.exp(-(interval - u) / beta)
    return np.flatnonzero((p < level("warning", 2)) & (interval > MISSING * usual)) + 1


def _jitter(run: Run, interval: Array, usual: float, rounding: float) -> Iterator[Finding]:
    """Stamps of a regular sensor that were taken on arrival: a late one makes its interval long and the next one short.

    Intervals of stamps kT + e, e white, have the autocorrelation −½ at lag 1; those of a sensor whose own times jitter
    have 0, with the standard error 1/√N (Box and Jenkins 1970): the likelier of the two is the nearer. A note where the
    spread is SHEET of an interval, as which it would scale a motion: the true times are known better than the stamps.
    """
    held = interval[(interval > 0) & (interval < MISSING * usual)]
    N, spread = len(held), float(held.std()) if len(held) else 0.0
    if N < FEWEST or spread < max(SHEET * usual, rounding):
        return
    about = held - held.mean()
    rho = float((about[1:] * about[:-1]).sum() / (about**2).sum())
    if norm.sf(-rho * np.sqrt(N)) < level("warning", 2) and rho < -0.25:
        yield Finding(
            "stamps", "note", None, (int(run.step[0]), int(run.step[-1])),
            {"kind": "jitter", "std_s": spread, "usual_interval_s": usual, "autocorrelation": rho},
            f"stamps jitter by {spread:.2g} s about {usual:.3g} s, a long interval before a short one: they were taken "
            "when samples arrived, not when they were measured",
            "use the sensor's own clock, or smooth the stamps by a line through them, if the readings are fast",
        )  # fmt: skip


def _finding(run: Run, rows: np.ndarray, severity: str, kind: str, cause: str, remedy: str) -> Finding:
    steps = int(run.step[rows[0]]), int(run.step[rows[-1]])
    evidence = {"kind": kind, "count": len(rows), "usual_interval_s": float(np.median(np.diff(run.time)))}
    return Finding("stamps", severity, None, steps, evidence, f"{cause}, {len(rows)} times", remedy)  # type: ignore[arg-type]
