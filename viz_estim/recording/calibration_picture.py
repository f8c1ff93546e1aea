"""A recording of an IMU's calibration: what its sensors say about the attitude, before and after, against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from viz_estim.files import whole
from viz_estim.recording import schema

Array = NDArray[np.float64]
Series = Any  # time s (T,); accel_deg (T, 2), gyro_deg, truth_deg (T, 3); accel_error_deg, gyro_error_deg (T,)

# Drawn in this order: the truth is a broad line under the two that are compared with it.
_NAMES = ("motion capture", "documented constants", "fitted constants")
_COLOURS = (schema.TRUTH, (90, 150, 220), schema.ESTIMATE)
_WIDTHS = (3.5, 2.0, 1.0)
_PLOTS = (
    {f"gravity/{a}": f"{a.capitalize()} from gravity [deg]" for a in ("roll", "pitch", "error")},
    {f"gyro/{a}": f"{a.capitalize()} of the integrated gyro [deg]" for a in ("roll", "pitch", "yaw", "error")},
)
_WHAT_TO_LOOK_AT = """## What to look at
- **From gravity**: the accelerometer alone shakes with every push of the hand. A line that stays on one side of motion
  capture has a wrong bias; one that leaves it further the more it tilts, a wrong sensitivity.
- **From the gyro**: its rates, integrated from the first motion capture on, corrected by nothing. An error that climbs
  steadily is a wrong bias, one that jumps with each turn a wrong sensitivity. Where the gyro **freezes** while the body
  turns both lines leave for good: no constants mend that, and the fit leaves it out.
- **Errors** are angles in space. Near a pitch of ±90° roll and yaw jump, and the error doesn't.
"""


def write(path: Path, sets: Sequence[tuple[str, Series, Series]], fit: dict[str, Any]) -> None:
    """Writes the recording to `path`, whole or not at all.

    sets: each one's name, and its series under the documented and the fitted constants. fit: its JSON.
    """
    recording = rr.RecordingStream("viz_estim calibrate imu")
    with whole(path) as aside:
        recording.save(aside, default_blueprint=_blueprint([name for name, *_ in sets]))
        recording.log("notes", rr.TextDocument(_text(fit), media_type=rr.MediaType.MARKDOWN), static=True)
        for number, (_, before, after) in enumerate(sets, 1):
            steps = np.arange(len(after.time))
            time = [rr.TimeColumn("time", duration=after.time), rr.TimeColumn("step", sequence=steps)]
            for plot, values in _values(before, after).items():
                shown = slice(3 - values.shape[1], 3)  # an error has no truth to be drawn beside
                style = rr.SeriesLines(names=_NAMES[shown], colors=_COLOURS[shown], widths=_WIDTHS[shown])
                recording.log(f"set_{number}/{plot}", style, static=True)
                columns = rr.Scalars.columns(scalars=_broken(values).ravel()).partition([values.shape[1]] * len(steps))
                recording.send_columns(f"set_{number}/{plot}", time, columns)
        recording.disconnect()


def _values(before: Series, after: Series) -> dict[str, Array]:
    """What each plot shows: (T, 3) truth, before, after, or (T, 2) without the truth."""
    out = {}
    for sensor, was, now in (("gravity", before.accel_deg, after.accel_deg), ("gyro", before.gyro_deg, after.gyro_deg)):
        for i, angle in enumerate(("roll", "pitch", "yaw")[: now.shape[1]]):
            out[f"{sensor}/{angle}"] = np.stack([after.truth_deg[:, i], was[:, i], now[:, i]], axis=1)
    out["gravity/error"] = np.stack([before.accel_error_deg, after.accel_error_deg], axis=1)
    out["gyro/error"] = np.stack([before.gyro_error_deg, after.gyro_error_deg], axis=1)
    return out


def _broken(values: Array) -> Array:
    """The values with NaN, which breaks the line, where an angle wraps."""
    return np.where(np.abs(np.diff(values, axis=0, prepend=values[:1])) > 180.0, np.nan, values)


def _blueprint(names: list[str]) -> rrb.Blueprint:
    def plot(origin: str, title: str) -> rrb.TimeSeriesView:
        # A set begins with rest, so that the upper left is free; one legend is enough, for a colour means one thing.
        legend = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=origin.endswith("gravity/roll"))
        angle = origin.rpartition("/")[2]
        most = {"roll": 185.0, "pitch": 105.0, "yaw": 185.0}.get(angle)  # a hundred is named, even on a low plot
        axis = rrb.ScalarAxis(range=(-most, most)) if most else None
        return rrb.TimeSeriesView(origin=origin, name=title, plot_legend=legend, axis_y=axis)

    def tab(number: int, name: str) -> rrb.Horizontal:
        columns = [[plot(f"set_{number}/{key}", title) for key, title in plots.items()] for plots in _PLOTS]
        return rrb.Horizontal(*(rrb.Vertical(*column) for column in columns), name=name)

    text = rrb.TextDocumentView(origin="notes", name="The constants, and what to look at")
    tabs = rrb.Tabs(*(tab(number, name) for number, name in enumerate(names, 1)))
    layout = rrb.Horizontal(tabs, text, column_shares=[2.6, 1.0])
    return rrb.Blueprint(layout, rrb.TimePanel(timeline="time", state="collapsed"), collapse_panels=True)


def _text(fit: dict[str, Any]) -> str:
    rows = []
    for sensor, unit, key in (("accel", "m/s²", "mv_per_mps2"), ("gyro", "rad/s", "mv_per_radps")):
        for name, label in (("bias_counts", "bias [counts]"), (f"sensitivity_{key}", f"mV/({unit})")):
            columns = (fit["documented"][sensor][name], fit[sensor][name], fit[sensor][f"{name.split('_')[0]}_se"])
            for axis, old, new, error in zip("xyz", *columns, strict=True):
                rows.append([f"{sensor} {axis}, {label}", f"{old:.1f}", f"{new:.2f}", f"{error:.2f}"])
    text = [_WHAT_TO_LOOK_AT, "## The constants", "", _table(["channel", "documented", "fitted", "±"], rows)]
    text += [
        "±: one standard error. The plots, like a run, take the gyro's bias off each set's own rest where it has one.",
        "## What is left",
        "",
    ]
    rows = []
    for key, label in (("accel_mps2", "accel {} [m/s²]"), ("gyro_deg", "gyro {}, over 0.25 s [deg]")):
        before, after = (fit["residuals"][key][stage]["typical"] for stage in ("before", "after"))
        rows += [[label.format(a), f"{b:.3f}", f"{c:.3f}"] for a, b, c in zip("xyz", before, after, strict=True)]
    text += [_table(["typical size", "documented", "fitted"], rows), "## How late motion capture is stamped", ""]
    rows = []
    for number, one in enumerate(fit["sets"], 1):
        name = one["files"][0]["name"] if one["files"] else f"set {number}"
        offset, error = 1e3 * one["time_offset_s"], 1e3 * one["time_offset_se"]
        rows.append([name, f"{offset:.1f} ms", f"{error:.1f}", f"{one['frozen']} of {one['samples']}"])
    text.append(_table(["set", "late by", "±", "samples frozen"], rows))
    return "\n".join(text)


def _table(heading: list[str], rows: list[list[str]]) -> str:
    lines = [heading, ["---", *["---:"] * (len(heading) - 1)], *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines) + "\n"
