"""Moments on a viewer's timelines: where one lies, where the cursor stands, and waiting for the two to meet."""

from __future__ import annotations

import time
from collections.abc import Iterator

from rerun.experimental import ViewerState

Moment = tuple[str | None, int | None]  # a timeline, and a count or nanoseconds


def goal_of(state: ViewerState, timeline: str, value: float | None) -> tuple[Moment | None, Moment | None, str]:
    """Where on a timeline of the front recording a moment lies, where the cursor stands, and what to say of a failure.

    The moment is None where it is not there, or not yet.
    """
    fronts = [recording for recording in state.recordings if recording.store_id == state.active_recording]
    if not fronts:
        return None, None, "no recording is open; open one first"
    front, known = fronts[0], ", ".join(line.name for line in fronts[0].timelines)
    at = (front.current_timeline, front.current_time)
    lines = [line for line in front.timelines if line.name == timeline]
    if not lines:
        return None, at, f"no timeline {timeline!r}; choose from: {known}"
    scale, slack = (1, 0) if lines[0].time_type == "sequence" else (1e9, 1e6)  # ns; times are typed rounded
    first, last = lines[0].start or 0, lines[0].end or 0
    target = last if value is None else round(value * scale)
    if not first - slack <= target <= last + slack:
        return None, at, f"{timeline} {value} is not recorded; choose from {first / scale:g} to {last / scale:g}"
    return (timeline, min(max(target, first), last)), at, "the cursor did not stay where it was put; try again"


def polls(seconds: float) -> Iterator[float]:
    """The time (s) that has passed, again and again until so many have."""
    began = time.monotonic()
    yield 0.0
    while (passed := time.monotonic() - began) < seconds:
        time.sleep(0.02)
        yield passed
