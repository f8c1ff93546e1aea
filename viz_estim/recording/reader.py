"""A recording back into arrays, bit for bit. Also reads the partial file of a run that was killed."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from viz_estim.core.consistency import FIT, summary
from viz_estim.core.descriptions import rebuild
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product, Space
from viz_estim.errors import BadInput, one_line
from viz_estim.recording import schema
from viz_estim.recording.layout import as_product
from viz_estim.recording.rescue import last_whole, whole
from viz_estim.recording.tables import Gathered, StageTable, ends, fill_in, table_of, work_out

_CLOUDS = (f"{schema.WORLD}/scenery/", f"{schema.WORLD}/moved/")  # of the scene: those that stand, and those that move


class NotARun(BadInput):
    """A sound recording, but not of a run: a calibration's picture, or another program's."""


@dataclass(frozen=True)
class Run:
    """A recorded run. step, time (N,) of every step; dt (N,) s; truth (N, n), NaN where there is none.

    inputs: `control`, `z.<sensor>` and `raw.<sensor>` by name (N, …). ends: the belief at the end of each step, by the
    name of its arrays: mean (N, n) and cov (N, d, d), or log_probabilities (N, K) of `labels`, whose truth (N, 1) is
    the label's index; the space then has no parts. properties: scenario, params, seed, data, versions, …; complete:
    the run ended well. clouds: points (N, 3) in m of the scene's clouds by name, z = 0 in a plane, and whether the
    estimate moves them.
    """

    path: Path
    properties: dict[str, Any]
    space: Space
    labels: tuple[str, ...]
    step: np.ndarray
    time: Array
    dt: Array
    truth: Array
    inputs: dict[str, Array]
    stages: dict[str, StageTable]
    ends: dict[str, Array]
    error: str | None
    complete: bool
    clouds: dict[str, tuple[Array, bool]] = field(default_factory=dict)

    @property
    def mean(self) -> Array:
        return self.ends["mean"]

    @property
    def cov(self) -> Array:
        return self.ends["cov"]

    def at(self, step: int) -> list[tuple[StageTable, int]]:
        """The stages of a step in order, each as its table and row."""
        found = [
            (int(table.place[row]), table, int(row))
            for table in self.stages.values()
            for row in np.flatnonzero(table.step == step)
        ]
        return [(table, row) for _, table, row in sorted(found, key=lambda entry: entry[0])]

    def before(self, table: StageTable, row: int) -> tuple[StageTable, int] | None:
        """The stage that came before a stage, as its table and row; None before the first."""
        place = int(table.place[row]) - 1
        for other in self.stages.values():
            found = int(np.searchsorted(other.place, place))
            if found < len(other.place) and other.place[found] == place:
                return other, found
        return None

    @property
    def span(self) -> str:
        """From when to when it goes, in words and in full: the stamps of a clock too."""
        first, last = (f"{stamp:.6f}".rstrip("0").rstrip(".") for stamp in self.time[[0, -1]])
        return f"{first} to {last} s"

    def row(self, *, step: int | None = None, time: float | None = None) -> int:
        """The row of a step by its number, or of the last one at or before a time (s). BadInput where there is none."""
        if step is not None:
            rows = np.flatnonzero(self.step == step)
            if not len(rows):
                raise BadInput(f"{self.path}: no step {step}; it holds steps {self.step[0]} to {self.step[-1]}")
            return int(rows[0])
        assert time is not None
        row = int(np.searchsorted(self.time, time + 5e-10, side="right")) - 1  # stamps are kept to the nanosecond
        if row < 0 or not time <= self.time[-1] + 1.0:
            raise BadInput(f"{self.path}: no step at {time:.16g} s; it holds {self.span}")
        return row

    def place(self, place: int) -> int:
        """The same place on the stage timeline, if there is one; else BadInput."""
        last = max((int(table.place[-1]) for table in self.stages.values()), default=0)
        if not 0 <= place <= last:
            raise BadInput(f"{self.path}: no stage {place}; the stage timeline goes from 0 to {last}")
        return place

    def summary(self) -> dict[str, Any]:
        """`metrics`, `nis` and `nees`, computed from the recorded numbers."""
        counts = (self.step >= self.properties.get("first", 0)) & np.isfinite(next(iter(self.ends.values()))).all(1)
        if self.error is not None:
            counts[-1] = False
        last = self.step[counts][-1] if counts.any() else -1
        if any(table.values.keys() >= FIT for table in self.stages.values()):
            counts &= self.step == last
        innovations = []
        for table in self.stages.values():
            if "innovation.residual" in table.values:
                rows = (table.step >= self.properties.get("first", 0)) & (table.step <= last)
                space = table.spaces["innovation"]
                assert isinstance(space, Product)
                residual, cov, offered = (table.values[f"innovation.{k}"][rows] for k in ("residual", "cov", "offered"))
                innovations.append((space, residual, cov, offered.astype(bool)))
        facts = self.properties.get("facts", {})
        ends = {name: values[counts] for name, values in self.ends.items()}
        return summary(self.space, ends, self.truth[counts], innovations, facts)


def load(path: str | Path, *, points: bool | None = True) -> Run:
    """Reads a recording into arrays. points: also the points and clouds, which are most of its bytes; None: the clouds
    alone, from which the mean and covariance within a step are worked out.

    BadInput where the file is missing, damaged, or not a recording of this project.
    """
    path = Path(path)
    properties: dict[str, Any] = {}
    steps = Gathered()
    stages: dict[str, Gathered] = {}
    error = None
    clouds: dict[str, tuple[Array, bool]] = {}
    for chunk in _chunks(path, _CLOUDS if points else ()):
        entity = str(chunk.entity_path)
        if entity == "/__properties/viz_estim":
            properties |= _texts(chunk.to_record_batch())
        elif entity == "/steps":
            steps.add(chunk.to_record_batch())
        elif entity == "/events":
            error = _texts(chunk.to_record_batch()).get("TextLog:text")
        elif entity.startswith("/stages/"):
            keep = "particles" in properties if points is None else points  # properties come first
            stages.setdefault(entity, Gathered(keep)).add(chunk.to_record_batch())
        elif (drawn := _points(chunk.to_record_batch())) is not None:
            clouds[entity.rpartition("/")[2]] = drawn, entity.startswith(_CLOUDS[1])
    if properties.keys() & {"space", "labels"} and not (steps.times and (stages or "result" in properties)):
        raise NotARun(f"{path}: the run was cut off before its first steps were written")
    if not properties.keys() & {"space", "labels"}:
        raise NotARun(f"{path}: holds no run of viz_estim (make one with `viz-estim run`)")
    facts = {name: json.loads(text) for name, text in properties.items()}
    space = rebuild(facts["space"]) if "space" in facts else as_product(None)
    labels = tuple(facts.get("labels", ()))
    index = steps.index()
    inputs = {name: steps.column(name, (-1,)) for name in steps.names() if not name.startswith(("dt", "truth"))}
    truth = np.full((len(index["step"]), len(space.names)), np.nan)
    for name, at in as_product(space).at.items():
        truth[:, at] = steps.column(f"truth.{name}", (at.stop - at.start,))
    if labels:
        truth = steps.column("truth.label", (1,))
    fields = facts.get("stages", {})
    names = {schema.stage(name): name for name in fields}
    stages = {names.get(entity, entity.removeprefix("/stages/")): rows for entity, rows in stages.items()}
    known = [*(name for name in fields if name in stages), *(name for name in stages if name not in fields)]
    kept = int(facts.get("particles", {}).get("kept", 0))
    tables = {name: table_of(name, stages[name], space, fields.get(name, {}), kept) for name in known}
    fill_in(tables, fields)
    if kept:
        work_out(tables, space)
    found = Run(
        path, facts, space, labels, index["step"], index["time"], steps.column("dt", ()), truth, inputs, tables,
        ends(index["step"], tables, space, labels), error, "result" in facts, clouds,
    )  # fmt: skip
    if found.complete or error:
        return found
    return _until(found, last_whole([times["step"] for times in steps.times], tables.values()))


def _until(run: Run, last: int) -> Run:
    """A run that was cut off, up to its step `last`."""
    rows = run.step <= last
    if not rows.any():
        raise NotARun(f"{run.path}: the run was cut off before its first steps were written")
    tables = {}
    for name, table in run.stages.items():
        kept = table.step <= last
        if kept.any():
            values = {quantity: numbers[kept] for quantity, numbers in table.values.items()}
            tables[name] = replace(table, step=table.step[kept], place=table.place[kept], values=values)
    return replace(
        run, step=run.step[rows], time=run.time[rows], dt=run.dt[rows], truth=run.truth[rows], stages=tables,
        inputs={name: values[rows] for name, values in run.inputs.items()},
        ends={name: values[rows] for name, values in run.ends.items()},
    )  # fmt: skip


def _chunks(path: Path, also: Iterable[str]) -> Iterator[Any]:
    if path.is_dir():
        raise BadInput(f"{path}: is a folder, expected a recording")
    if not path.is_file():
        raise BadInput(f"{path}: no such recording")
    try:
        content = ["/__properties/**", "/steps", "/events", "/stages/**", *(f"{above}*" for above in also)]
        with whole(path) as sound:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RerunWarning)  # a killed run has no footer: we say so ourselves
                reader = RrdReader(sound)
            yield from reader.stream().filter(content=content)
    except (ValueError, OSError, RuntimeError) as error:
        raise BadInput(f"{path}: not a readable recording, or damaged ({one_line(error)[:120]})") from error


def _points(batch: pa.RecordBatch) -> Array | None:
    """The points (N, 3) of a cloud that stands still in its frame."""
    name = "Points3D:positions"
    rows = batch.column(name).to_pylist() if name in batch.schema.names else []
    return np.array(rows[0], float).reshape(-1, 3) if len(rows) == 1 and rows[0] else None


def _texts(batch: pa.RecordBatch) -> dict[str, str]:
    """The texts of a batch by component, the last row's."""
    found = {}
    for name in batch.schema.names:
        values = batch.column(name)
        if pa.types.is_list(values.type) and pa.types.is_string(values.type.value_type):
            texts = [row[0] for row in values.to_pylist() if row]
            if texts:
                found[name] = texts[-1]
    return found
