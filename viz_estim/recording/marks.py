"""A copy of a recording with findings marked in it: lanes that say from when to when, a list to jump by, and the text.

A link in the text (in the viewer that `viz-estim open` starts) and a click on a row's time in the list move the time
cursor there.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr
from rerun.chunk import Chunk, RrdReader
from rerun.error_utils import RerunWarning

from viz_estim.files import whole as whole_file
from viz_estim.recording import diagnosis_view, schema
from viz_estim.recording.columns import Times, send_static
from viz_estim.recording.compared import Alone
from viz_estim.recording.diagnosis_view import FINDINGS, LIST
from viz_estim.recording.ranges import Ranges
from viz_estim.recording.reader import Run
from viz_estim.recording.rescue import whole
from viz_estim.recording.scene_views import Scenes

_COLOURS: dict[str, schema.Colour] = {"error": (220, 50, 50), "warning": (200, 150, 60), "note": (110, 120, 140)}
_LEVELS = {"error": "ERROR", "warning": "WARN", "note": "INFO"}


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
        alone, scenes, ranges = Alone(run, 0, source.stem, True), Scenes(), Ranges()
        with whole(source) as sound:
            rr.send_chunks(_chunks(sound, alone, scenes, ranges), recording=stream)
        send_static(stream, FINDINGS, rr.TextDocument(markdown, media_type="text/markdown"))
        for mark in marks:
            _draw_lane(stream, run, mark)
        _draw_list(stream, run, marks)
        stream.send_blueprint(diagnosis_view.build(alone, scenes, ranges, len(marks), markdown))
        stream.flush()
        stream.disconnect()


def _chunks(path: Path, alone: Alone, scenes: Scenes, ranges: Ranges) -> Iterator[Chunk]:
    """The recording's chunks one after the other; learns which scenes there are, and the values of plots."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RerunWarning)  # of a run that was killed
        reader = RrdReader(path)
    for chunk in reader.stream():
        scenes.learn(alone, chunk)
        if chunk.entity_path.startswith(f"{schema.PLOTS}/") and not chunk.is_static:
            batch = chunk.to_record_batch()
            if "Measurements:values" in batch.schema.names:
                values = batch.column("Measurements:values").flatten().to_numpy(zero_copy_only=False)
                ranges.learn(chunk.entity_path.removesuffix("/value"), values.reshape(-1, 1))
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
        at = _at(run, [mark.steps[0] for mark in marks])
        texts = [f"{time:.2f} s · {mark.text}" for time, mark in zip(at.time, marks, strict=True)]
        columns = rr.TextLog.columns(text=texts, level=[_LEVELS[m.severity] for m in marks])
        rr.send_columns(LIST, at.columns, columns, recording=stream, strict=True)
