"""Several recordings in one: their chunks streamed through, each run under its own name and in its own colour."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk, RrdReader
from rerun.error_utils import RerunWarning

from viz_estim.files import whole as whole_file
from viz_estim.recording import comparison_view, scene_views, schema
from viz_estim.recording.columns import send_static
from viz_estim.recording.compared import Clock, Compared
from viz_estim.recording.overlays import Overlays
from viz_estim.recording.rescue import whole

_LEFT_OUT = [f"{schema.PLOTS}/**", f"{schema.NOTES}/**", "/__properties/**"]  # drawn anew, over all runs


def write(path: Path, runs: list[Compared], result: dict[str, Any], notes: str) -> None:
    """Writes the comparison of the runs, the first of which all others are measured by, whole or not at all.

    Each run's entities come under `/runs/<name>`, on the first run's steps and stages where its own are others; a truth
    that is the first run's is kept there alone. What is over time is drawn over all of them at once, from the runs'
    numbers. result: kept as a property; notes: markdown.
    """
    # A view belongs to an application id: comparisons that are open in one viewer keep their own.
    application = "viz_estim compare " + re.sub(r"[^A-Za-z0-9_-]+", "-", " ".join(run.name for run in runs))
    with whole_file(path) as aside, rr.RecordingStream(application, send_properties=False) as stream:
        stream.save(aside)
        stream.send_recording_name(" · ".join(run.name for run in runs))
        stream.flush()  # what is logged so far comes before all chunks
        scenes = scene_views.Scenes()
        for run in runs:
            _stream_through(stream, run, Clock(runs[0], run), scenes)
        overlays = Overlays(stream, runs)
        overlays.draw()
        send_static(stream, schema.NOTES, rr.TextDocument(notes, media_type="text/markdown"))
        texts = rr.AnyValues(drop_untyped_nones=False, result=json.dumps(result))
        send_static(stream, "/__properties/viz_estim_comparison", texts)
        stream.send_blueprint(comparison_view.build(runs, scenes, overlays.plots, overlays.ranges, notes))
        stream.flush()
        stream.disconnect()


def _stream_through(stream: rr.RecordingStream, run: Compared, clock: Clock, scenes: scene_views.Scenes) -> None:
    """Sends a recording's chunks on, one after the other: none is kept."""

    def chunks(path: Path) -> Iterator[Chunk]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RerunWarning)  # of a run that was killed
            reader = RrdReader(path)
        for chunk in reader.stream().drop(content=_LEFT_OUT):
            entity = chunk.entity_path
            parts = entity.split("/")
            if run.place and run.of_first and "truth" in parts[2:3] and parts[1] in scenes.truths:
                continue
            scenes.learn(run, chunk)
            yield _moved(chunk, f"{run.path}{entity}", run, clock)

    with whole(run.run.path) as sound:
        rr.send_chunks(chunks(sound), recording=stream)


def _moved(chunk: Chunk, path: str, run: Compared, clock: Clock) -> Chunk:
    """The chunk under another path: what is amber gets the run's colour, its rows the first run's steps and stages."""
    shifted = not (chunk.is_static or clock.same)
    coloured = run.place and scene_views.scene_of(chunk.entity_path)
    if not (shifted or coloured):
        return chunk.with_entity_path(path)
    batch = chunk.to_record_batch()
    columns = list(batch.columns)
    names = batch.schema.names
    if shifted and "stage" in names:
        steps, places = clock.steps_and_places(batch.column("stage").to_numpy())
        columns[names.index("stage")] = pa.array(places)
        if "step" in names:
            columns[names.index("step")] = pa.array(steps)
    for i, name in enumerate(names):
        if name.endswith((":colors", ":color")):
            columns[i] = _recoloured(columns[i], run.colour)
    changed = pa.RecordBatch.from_arrays(columns, schema=batch.schema)
    (found,) = Chunk.from_record_batch(changed)
    return found.with_entity_path(path)


def _recoloured(column: pa.ListArray, colour: schema.Colour) -> pa.ListArray:
    """Packed colours with the estimate's own turned into another: bright, dimmed, or on a ramp of weights."""
    packed = column.values.to_numpy().astype(np.int64)
    rgb = _split(packed)
    values = packed
    for low in (np.zeros(3), _split(schema.by_weight(np.zeros(1)).astype(np.int64))[0]):
        share = (rgb[:, :1] - low[0]) / (schema.ESTIMATE[0] - low[0])
        mine = (np.abs(rgb - low - share * (schema.ESTIMATE - low)) <= 2).all(1) & (rgb.max(1) > 40)
        new = np.round(low + share * (colour - low)).astype(np.int64)
        values = np.where(mine, new[:, 0] << 24 | new[:, 1] << 16 | new[:, 2] << 8 | packed & 255, values)
    return pa.ListArray.from_arrays(column.offsets, pa.array(values.astype(np.uint32)), type=column.type)


def _split(packed: np.ndarray) -> np.ndarray:
    """Red, green and blue (M, 3) of colours 0xRRGGBBAA (M,)."""
    return packed[:, None] >> np.array([24, 16, 8]) & 255
