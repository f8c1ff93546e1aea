"""Steps into a recording file: buffered, sent as columns, safe against a kill, complete to the last bit."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from viz_estim.core.descriptions import describe
from viz_estim.core.run import Scenario, Step, failed_where
from viz_estim.core.stages import Stage
from viz_estim.recording import blueprints, schema
from viz_estim.recording.batch import Batch
from viz_estim.recording.bodies import Bodies
from viz_estim.recording.clouds import Clouds
from viz_estim.recording.columns import Times, numbers, send, send_static
from viz_estim.recording.layout import Layout
from viz_estim.recording.pictures import Pictures
from viz_estim.recording.plots import Plots
from viz_estim.recording.registration import Registration
from viz_estim.recording.scenes import Scenes
from viz_estim.recording.stage_columns import stage_columns
from viz_estim.recording.standing import Standing

# A batch is cut by rows and bytes, which the same seed repeats; by time only where steps are so slow that a kill would
# lose a second of them, or while a viewer watches.
_ROWS = (700, 2500)  # at least, for each batch has its cost; and at most
_BYTES = (2 << 20, 20 << 20)  # about, above the least rows; and in no case more
# Steps as large as these take their time in calls that free the interpreter's lock (a tree is asked for ten thousand
# neighbours, a hundred thousand particles move): the other thread writes meanwhile, in batches that are soon full. By
# small steps it would be hindered, and hinder them.
_LARGE, _BYTES_BESIDE = 256 << 10, 5 << 20
_BEHIND = 3  # full batches that may wait for it
_SECONDS = 0.8
_SECONDS_WATCHED = 0.05


class Recorder:
    """Writes a run's steps to `path`, as `NAME.partial.rrd` until it is closed well, and to a live viewer beside it.

    properties: JSON-ready facts of the run, kept with the recording. every: geometry (sigma points) is drawn and kept
    at every N-th step only. live: the gRPC address of a viewer. Use it as a context manager: leaving it by an
    exception keeps the partial file.
    """

    def __init__(
        self,
        path: Path,
        scenario: Scenario,
        properties: dict[str, Any],
        *,
        every: int = 1,
        live: str | None = None,
    ) -> None:
        self.path, self.partial = path, partial_of(path)
        self._every = every
        self._layout = Layout(scenario)
        self._last: Stage | None = None  # of the steps sent so far
        self._rows: list[Step] = []
        self._full: deque[list[Step]] = deque()  # batches that wait to be written
        self._beside = False  # whether the other thread writes them
        self._limit = _ROWS[1]  # steps to a batch; the first few tell the size of the others
        self._sized = 0
        self._viewed: list[str] | None = None  # what the view shows, and about how much of the world
        self._framed = 0.0
        self._places = 0  # taken on the stage timeline
        self._lock, self._writing = threading.Lock(), threading.Lock()  # of the batches, and of the file
        self._failed: Exception | None = None
        self._closed = threading.Event()
        self._sent = threading.Event()  # a batch waits to be written by the other thread
        name = str(properties.get("scenario", path.stem))
        # A view belongs to an application id: runs of one scenario share what a person arranges in the viewer.
        plain = re.sub(r"[^A-Za-z0-9_-]+", "-", name)  # Rerun renames others, and says so
        self._stream = rr.RecordingStream(f"viz_estim {plain}", send_properties=False)
        self._stream.set_sinks(rr.FileSink(self.partial), *([rr.GrpcSink(live)] if live else []))
        self._stream.send_recording_name(str(properties.get("title", name)))
        self._stream.flush()  # what is logged so far comes before all columns
        self._bodies = Bodies(self._stream, self._layout, scenario)
        self._standing = Standing(self._stream, every)
        self._scenes = Scenes(self._stream, self._layout, self._bodies, self._standing, every)
        self._registration = Registration(self._stream, self._layout, self._standing, every)
        count = len(scenario.ticks)
        self._clouds = (
            Clouds(self._stream, self._layout, self._standing, every, count) if self._layout.particles else None
        )
        self._plots = Plots(self._stream, self._layout)
        self._pictures = Pictures(self._stream, self._layout, every)
        belief = scenario.beliefs[0]
        kind: dict[str, Any] = {"belief": type(belief).__name__, "facts": dict(scenario.facts)}
        kind |= {"labels": list(belief.labels)} if self._layout.labels else {"space": describe(scenario.space)}
        self._properties = dict(properties) | kind
        self._send_properties()
        notes = f"{scenario.notes}\n\n{blueprints.legend(self._layout)}".strip()
        send_static(self._stream, schema.NOTES, rr.TextDocument(notes, media_type="text/markdown"))
        self._patience = _SECONDS_WATCHED if live else _SECONDS
        self._oldest = 0.0  # when the first of the buffered rows came
        self._timer = threading.Thread(target=self._tick, daemon=True)
        self._timer.start()

    def add(self, step: Step) -> None:
        """Takes in one step; it reaches the file within a second."""
        if self._failed:
            raise self._failed
        with self._lock:
            if self._clouds:
                step = self._clouds.take(step)
            now = time.monotonic()
            if not self._rows:
                self._oldest = now
            self._rows.append(step)
            if self._sized < 3:
                self._size_batches(max(1, _size(step)))
            # By time here rather than by the timer, where steps are quick enough: two threads would hinder each other.
            full = len(self._rows) >= self._limit or now - self._oldest >= 0.9 * self._patience
            if full:
                self._take()
        if full and self._beside and len(self._full) <= _BEHIND:
            self._sent.set()
        elif full:
            self._write()
            self._stream.flush(timeout_sec=0)  # begun and not waited for; to wake the other thread for it costs more

    def _size_batches(self, size: int) -> None:
        """Settles, from a step of so many bytes, how many make a batch, and who writes it."""
        self._sized += 1
        self._beside |= size >= _LARGE
        few, most = (limit // size for limit in _BYTES)
        rows = _BYTES_BESIDE // size if self._beside else min(max(few, _ROWS[0]), most)
        self._limit = max(1, min(self._limit, rows))

    def close(self, result: dict[str, Any] | None = None, *, facts: Mapping[str, float] | None = None) -> None:
        """Ends the recording well: the result is kept with it, and the file takes its own name.

        facts: the scenario's, with the figures of its last step.
        """
        self._stop()
        if self._failed:
            raise self._failed
        self._properties["result"] = result
        self._properties["facts"] |= facts or {}
        self._layout.ranges.fixed = True
        self._stream.send_blueprint(blueprints.build(self._layout))
        self._send_properties()
        self._disconnect()
        os.replace(self.partial, self.path)

    def abort(self) -> None:
        """Ends the recording where it is; the partial file stays."""
        self._stop()
        self._show()
        self._disconnect()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if not self._closed.is_set():
            self.abort() if kind else self.close()

    def _stop(self) -> None:
        self._closed.set()
        self._sent.set()
        self._timer.join()
        self._take()
        self._write()

    def _disconnect(self) -> None:
        self._stream.flush()
        self._stream.disconnect()

    def _tick(self) -> None:
        written, due = 0, self._patience
        while not self._closed.is_set():
            # As seldom as can be: each time that this thread wakes costs the filter's some five milliseconds.
            self._sent.wait(due)
            self._sent.clear()
            try:
                with self._lock:
                    age = time.monotonic() - self._oldest if self._rows else 0.0
                    if age >= self._patience:
                        self._take()
                        age = 0.0
                self._write()
                places = self._places
                if places != written:  # to the file, for a kill may come; steps go on meanwhile
                    self._stream.flush()
                    written = places
                due = self._patience - age
            except Exception as error:  # told at the next step, in the thread that can act on it
                self._failed = error
                return

    def _send_properties(self) -> None:
        texts = {name: json.dumps(value) for name, value in (self._properties | self._layout.as_json()).items()}
        send_static(self._stream, "/__properties/viz_estim", rr.AnyValues(drop_untyped_nones=False, **texts))

    def _take(self) -> None:
        """Makes a batch of the steps that came."""
        if self._rows:
            self._full.append(self._rows)
            self._rows = []

    def _write(self) -> None:
        """Sends the batches that wait, in order."""
        with self._writing:
            while self._full:
                self._flush(self._full.popleft())

    def _flush(self, steps: list[Step]) -> None:
        """Sends a batch: the steps, their stages by name, and what is drawn of them."""
        batch = Batch(steps, self._places, self._last)
        self._places, self._last = batch.end, batch.last
        if self._layout.learn(batch):  # before the columns that it describes: the file may be cut between them
            self._send_properties()
        self._send_steps(batch)
        for rows in batch.stages:
            send(self._stream, schema.stage(rows.name), rows.at, stage_columns(self._layout, batch, rows, self._every))
        self._bodies.add(batch)
        self._scenes.add(batch)
        self._registration.add(batch)
        if self._clouds:
            self._clouds.add(batch)
        self._standing.clear(batch)
        self._plots.add(batch)
        self._pictures.add(batch)
        if not self._closed.is_set():  # at the end the view is built anew from all that came
            self._show()
        if error := steps[-1].error:  # a failure is a run's last step
            text = f"step {error.step}, {failed_where(error.stage)}: {error.message}"
            last = batch.times.pick(np.array([-1]))
            at = Times(last.step, last.time, np.array([batch.end - 1]))
            send(self._stream, schema.EVENTS, at, rr.TextLog.columns(text=[text], level=["ERROR"]))

    def _show(self) -> None:
        """Sends the view, where it is built from other things than the last one, or its frame has been outgrown."""
        known = [*self._layout.sensors, *self._layout.stages]
        reach = self._layout.extent[1] if self._layout.extent else 0.0
        if known != self._viewed or reach > 1.5 * self._framed:
            self._viewed, self._framed = known, reach
            self._stream.send_blueprint(blueprints.build(self._layout))

    def _send_steps(self, batch: Batch) -> None:
        steps = batch.steps
        columns = [numbers("viz_estim.Step", "dt", np.array([step.tick.dt for step in steps]))]
        # By part, and absent where it is not known: NaN is never written, for it compares unequal to itself.
        optional: dict[str, list[Any]] = {"control": [step.tick.control for step in steps]}
        truths = {name: self._layout.space.at[name] for name in self._layout.true_parts}
        if self._layout.labels and any(step.truth is not None for step in steps):
            truths = {"label": slice(0, 1)}
        for part, where in truths.items():
            values = batch.truth[:, where]
            known = np.asarray(np.isfinite(values).all(axis=1))
            if known.any():
                columns.append(numbers("viz_estim.Step", f"truth.{part}", values, known))
        for sensor in self._layout.inputs:
            optional[f"z.{sensor}"] = [s.tick.measurements.get(sensor) for s in steps]
            optional[f"raw.{sensor}"] = [s.tick.raw.get(sensor) for s in steps]
        columns += [
            numbers("viz_estim.Step", name, rows)
            for name, rows in optional.items()
            if any(row is not None for row in rows)
        ]
        send(self._stream, schema.STEPS, batch.times, columns)


def partial_of(path: Path) -> Path:
    """Where a recording lies while its run goes on."""
    return path.with_name(f"{path.stem}.partial.rrd")


def _size(step: Step) -> int:
    """About the bytes of a step: what its arrays hold, each counted once."""
    held: dict[int, int] = {}
    pending: list[Any] = list(step.stages)
    while pending:
        value = pending.pop()
        if isinstance(value, np.ndarray):
            held[id(value)] = value.nbytes
        elif dataclasses.is_dataclass(value):
            pending += [getattr(value, field.name) for field in dataclasses.fields(value) if field.init]
    return sum(held.values())
