"""Is time what the filter takes it for? Gaps, duplicates, steps back, and a dt that is another."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.diagnosis.finding import Finding
from viz_estim.recording.reader import Run

_GAP = 5.0  # usual intervals: a dropped sample makes 2, a real set's jitter 1.5
_TOLERANCE = 1e-6  # s: stamps are kept to the nanosecond


def stamps(run: Run) -> Iterator[Finding]:
    """Deterministic: stamps that go back or repeat, intervals of more than five medians, dt unlike the stamps'."""
    interval = np.diff(run.time)
    if len(interval) < 3:
        return
    usual = float(np.median(interval))
    back = np.flatnonzero(interval < 0) + 1
    same = np.flatnonzero(interval == 0) + 1
    gaps = np.flatnonzero(interval > _GAP * max(usual, _TOLERANCE)) + 1
    other = np.flatnonzero((np.abs(run.dt[1:] - interval) > _TOLERANCE + 1e-6 * usual) & (run.dt[1:] > 0)) + 1
    if len(back):
        yield _finding(
            run, back, "error", "back", "stamps go back in time",
            "sort the samples by their stamps, or drop those that come late",
        )  # fmt: skip
    if len(other):
        shown = float(np.abs(run.dt[other] - interval[other - 1]).max())
        yield _finding(
            run, other, "error" if len(other) > len(interval) / 20 else "warning", "dt",
            f"the filter's dt is not the difference of the stamps (by up to {shown:.3g} s): it may take a fixed one",
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
            f"the stamps leave gaps of up to {longest:.3g} s, {longest / max(usual, _TOLERANCE):.0f} usual intervals",
            "look for lost samples in the log; over a gap the prediction must use the whole dt",
        )  # fmt: skip


def _finding(run: Run, rows: np.ndarray, severity: str, kind: str, cause: str, remedy: str) -> Finding:
    steps = int(run.step[rows[0]]), int(run.step[rows[-1]])
    evidence = {"kind": kind, "count": len(rows), "usual_interval_s": float(np.median(np.diff(run.time)))}
    return Finding("stamps", severity, None, steps, evidence, f"{cause}, {len(rows)} times", remedy)  # type: ignore[arg-type]
