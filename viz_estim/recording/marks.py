"""A copy of a recording with findings marked in it: lanes that say from when to when, a list to jump by, and the text.

A click on a row's time in the list moves the time cursor there; a link in the text selects the finding's lane.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk, RrdReader
from rerun.error_utils import RerunWarning

from viz_estim.core.spaces import Product
from viz_estim.files import whole as whole_file
from viz_estim.recording import schema
from viz_estim.recording.columns import Times, send_static
from viz_estim.recording.layout import as_product
from viz_estim.recording.reader import Run
from viz_estim.recording.rescue import whole

FINDINGS = "/findings"
_LIST = f"{FINDINGS}/list"
_COLOURS: dict[str, schema.Colour] = {"error": (220, 50, 50), "warning": (200, 150, 60), "note": (110, 120, 140)}
_LEVELS = {"error": "ERROR", "warning": "WARN", "note": "INFO"}
_PLOTS = 12  # more views at once are too small to read
_Item = rrb.Container | rrb.View


class Mark(NamedTuple):
    """A finding as it is drawn: its lane's name, severity (error, warning, note), steps (first, last) and one line."""

    name: str
    severity: str
    steps: tuple[int, int]
    text: str


def lane(mark: Mark) -> str:
    """The entity of a finding's lane."""
    return schema.lane(mark.name)


def write(source: Path, path: Path, run: Run, marks: list[Mark], markdown: str) -> None:
    """Copies the recording at `source`, which holds `run`, to `path`, whole or not at all, with the marks in it."""
    # A view belongs to an application id: diagnoses that are open in one viewer keep their own.
    application = "viz_estim diagnose " + re.sub(r"[^A-Za-z0-9_-]+", "-", source.stem)
    with whole_file(path) as aside, rr.RecordingStream(application, send_properties=False) as stream:
        stream.save(aside)
        stream.send_recording_name(f"{run.properties.get('title', source.stem)} · diagnosis")
        stream.flush()  # what is logged so far comes before all chunks
        scenes: set[str] = set()
        with whole(source) as sound:
            rr.send_chunks(_chunks(sound, scenes), recording=stream)
        send_static(stream, FINDINGS, rr.TextDocument(markdown, media_type="text/markdown"))
        for mark in marks:
            _draw_lane(stream, run, mark)
        _draw_list(stream, run, marks)
        stream.send_blueprint(_blueprint(run, scenes))
        stream.flush()
        stream.disconnect()


def _chunks(path: Path, scenes: set[str]) -> Iterator[Chunk]:
    """The recording's chunks one after the other; learns which scenes there are."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RerunWarning)  # of a run that was killed
        reader = RrdReader(path)
    for chunk in reader.stream():
        scenes.add("/" + chunk.entity_path.split("/")[1])
        yield chunk


def _at(run: Run, steps: list[int]) -> Times:
    """The stamps of steps, and the places of their first stages."""
    rows = np.searchsorted(run.step, steps)
    places: dict[int, int] = {}
    for table in run.stages.values():
        for step, place in zip(table.step.tolist(), table.place.tolist(), strict=True):
            places[step] = min(place, places.get(step, place))
    return Times(run.step[rows], run.time[rows], np.array([places.get(step, 0) for step in steps]))


def _draw_lane(stream: rr.RecordingStream, run: Run, mark: Mark) -> None:
    first, last = mark.steps
    after = run.step[run.step > last]
    steps, states = [first], [mark.severity]
    if len(after):
        steps, states = [first, int(after[0])], [mark.severity, ""]
    style = rr.StateConfiguration(values=list(_COLOURS), colors=list(_COLOURS.values()))
    send_static(stream, lane(mark), style)
    columns = rr.StateChange.columns(state=states)
    rr.send_columns(lane(mark), _at(run, steps).columns, columns, recording=stream, strict=True)


def _draw_list(stream: rr.RecordingStream, run: Run, marks: list[Mark]) -> None:
    marks = sorted(marks, key=lambda mark: mark.steps)
    if marks:
        columns = rr.TextLog.columns(text=[m.text for m in marks], level=[_LEVELS[m.severity] for m in marks])
        at = _at(run, [mark.steps[0] for mark in marks])
        rr.send_columns(_LIST, at.columns, columns, recording=stream, strict=True)


def _blueprint(run: Run, scenes: set[str]) -> rrb.Blueprint:
    """Findings at the left, with the list to jump by; the scene, the evidence over time and the lanes at the right."""
    left = rrb.Vertical(
        rrb.TextDocumentView(origin=FINDINGS, name="What is wrong"),
        rrb.TextLogView(origin=_LIST, name="Click a time to go there"),
        row_shares=[3, 1],
    )
    lanes = rrb.StateTimelineView(origin=schema.LANES, name="Lanes: findings, stages, readings")
    spatial = [rrb.Spatial3DView(origin=scene) for scene in (schema.WORLD, schema.ATTITUDE) if scene in scenes][:1]
    tabs = [tab for tab in (_consistency(run), _errors(run)) if tab is not None]
    right: list[_Item] = [*spatial, *([rrb.Tabs(*tabs, active_tab=0)] if tabs else []), lanes]
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*right), column_shares=[2, 3]),
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _consistency(run: Run) -> rrb.Container | None:
    views: list[rrb.View] = []
    for table in run.stages.values():
        space = table.spaces.get("innovation")
        if isinstance(space, Product):
            for name, part in space.parts.items():
                views.append(_plot("nis", name, f"NIS {name}"))
                views += [_plot("innovation", f"{name}.{axis}", f"innovation {name} {axis}") for axis in part.axes]
    return rrb.Grid(*views[:_PLOTS], name="Innovations") if views else None


def _errors(run: Run) -> rrb.Container | None:
    space = as_product(run.space)
    views = [
        _plot("error", f"{name}.{axis}", f"error {name} {axis}")
        for name, part in space.parts.items()
        if not run.labels and np.isfinite(run.truth[:, space.at[name]]).any()
        for axis in part.axes
    ]
    return rrb.Grid(*views[:_PLOTS], name="Errors") if views else None


def _plot(group: str, component: str, name: str) -> rrb.TimeSeriesView:
    hidden = rrb.PlotLegend("LeftTop", visible=False)
    return rrb.TimeSeriesView(
        origin=schema.plot(group, component), name=name, axis_x=rrb.TimeAxis(link="LinkToGlobal"), plot_legend=hidden
    )
