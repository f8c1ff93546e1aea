"""A recording back into arrays, bit for bit. Also reads the partial file of a run that was killed."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from viz_estim.core.consistency import summary
from viz_estim.core.descriptions import rebuild
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product, Space
from viz_estim.errors import BadInput
from viz_estim.recording.layout import as_product
from viz_estim.recording.rescue import whole


class NotARun(BadInput):
    """A sound recording, but not of a run: a calibration's picture, or another program's."""


@dataclass(frozen=True)
class StageTable:
    """All rows of one stage: step (M,), place (M,) on the stage timeline, and its numbers by name, (M, …).

    `mean` (M, n) and `cov` (M, d, d) are there always; the others are named `field` or `field.part`, such as
    `gain`, `innovation.residual`, `sigma.points`. A quantity that only some rows have holds NaN in the others.
    """

    name: str
    step: np.ndarray
    place: np.ndarray
    values: dict[str, Array]
    spaces: dict[str, Space]

    @property
    def mean(self) -> Array:
        return self.values["mean"]

    @property
    def cov(self) -> Array:
        return self.values["cov"]


@dataclass(frozen=True)
class Run:
    """A recorded run. step, time (N,) of every step; dt (N,) s; truth (N, n), NaN where there is none.

    inputs: `control`, `z.<sensor>` and `raw.<sensor>` by name (N, …); mean (N, n) and cov (N, d, d) are the belief at
    the end of each step. properties: scenario, params, seed, data, versions, …; complete: the run ended well.
    """

    path: Path
    properties: dict[str, Any]
    space: Space
    step: np.ndarray
    time: Array
    dt: Array
    truth: Array
    inputs: dict[str, Array]
    stages: dict[str, StageTable]
    mean: Array
    cov: Array
    error: str | None
    complete: bool

    def at(self, step: int) -> list[tuple[StageTable, int]]:
        """The stages of a step in order, each as its table and row."""
        found = [
            (int(table.place[row]), table, int(row))
            for table in self.stages.values()
            for row in np.flatnonzero(table.step == step)
        ]
        return [(table, row) for _, table, row in sorted(found, key=lambda entry: entry[0])]

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
            raise BadInput(f"{self.path}: no step at {time:g} s; it holds {self.time[0]:g} to {self.time[-1]:g} s")
        return row

    def place(self, place: int) -> int:
        """The same place on the stage timeline, if there is one; else BadInput."""
        last = max((int(table.place[-1]) for table in self.stages.values()), default=0)
        if not 0 <= place <= last:
            raise BadInput(f"{self.path}: no stage {place}; the stage timeline goes from 0 to {last}")
        return place

    def summary(self) -> dict[str, Any]:
        """`metrics`, `nis` and `nees`, computed from the recorded numbers."""
        counts = (self.step >= self.properties.get("first", 0)) & np.isfinite(self.mean).all(1)
        if self.error is not None:
            counts[-1] = False
        last = self.step[counts][-1] if counts.any() else -1
        innovations = []
        for table in self.stages.values():
            if "innovation.residual" in table.values:
                rows = (table.step >= self.properties.get("first", 0)) & (table.step <= last)
                space = table.spaces["innovation"]
                assert isinstance(space, Product)
                residual, cov, offered = (table.values[f"innovation.{k}"][rows] for k in ("residual", "cov", "offered"))
                innovations.append((space, residual, cov, offered.astype(bool)))
        return summary(self.space, self.mean[counts], self.cov[counts], self.truth[counts], innovations)


def load(path: str | Path, *, points: bool = True) -> Run:
    """Reads a recording into arrays. points: also the sigma points, which are most of its bytes.

    BadInput where the file is missing, damaged, or not a recording of this project.
    """
    path = Path(path)
    properties: dict[str, Any] = {}
    steps = _Gathered()
    stages: dict[str, _Gathered] = {}
    error = None
    for chunk in _chunks(path):
        entity = str(chunk.entity_path)
        if entity == "/__properties/viz_estim":
            properties |= _texts(chunk.to_record_batch())
        elif entity == "/steps":
            steps.add(chunk.to_record_batch())
        elif entity == "/events":
            error = _texts(chunk.to_record_batch()).get("TextLog:text")
        elif entity.startswith("/stages/"):
            stages.setdefault(entity.removeprefix("/stages/"), _Gathered(points)).add(chunk.to_record_batch())
    if "space" not in properties or not steps.times:
        raise NotARun(f"{path}: holds no run of viz_estim (make one with `viz-estim run`)")
    facts = {name: json.loads(text) for name, text in properties.items()}
    space = rebuild(facts["space"])
    index = steps.index()
    inputs = {name: steps.column(name, (-1,)) for name in steps.names() if not name.startswith(("dt", "truth"))}
    truth = np.full((len(index["step"]), len(space.names)), np.nan)
    for name, at in as_product(space).at.items():
        truth[:, at] = steps.column(f"truth.{name}", (at.stop - at.start,))
    fields = facts.get("stages", {})
    known = [*(name for name in fields if name in stages), *(name for name in stages if name not in fields)]
    tables = {name: _table(name, stages[name], space, fields.get(name, {})) for name in known}
    mean, cov = _ends(index["step"], tables, space)
    return Run(
        path, facts, space, index["step"], index["time"], steps.column("dt", ()), truth, inputs, tables, mean, cov,
        error, "result" in facts,
    )  # fmt: skip


def _chunks(path: Path) -> Iterator[Any]:
    if not path.is_file():
        raise BadInput(f"{path}: no such recording")
    try:
        content = ["/__properties/**", "/steps", "/events", "/stages/**"]
        with whole(path) as sound:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RerunWarning)  # a killed run has no footer: we say so ourselves
                reader = RrdReader(sound)
            yield from reader.stream().filter(content=content)
    except (ValueError, OSError, RuntimeError) as error:
        text = " ".join(str(error).split())
        raise BadInput(f"{path}: not a readable recording, or damaged ({text[:120]})") from error


class _Gathered:
    """The rows of one entity, chunk by chunk."""

    def __init__(self, points: bool = True) -> None:
        self.times: list[dict[str, np.ndarray]] = []
        self.columns: dict[str, list[tuple[int, np.ndarray, np.ndarray]]] = {}  # chunk number, lengths, flat values
        self._points = points

    def add(self, batch: pa.RecordBatch) -> None:
        if not {"step", "time", "stage"} <= set(batch.schema.names):  # not ours
            return
        nanoseconds = batch.column("time").cast(pa.int64()).to_numpy()
        times = {name: batch.column(name).to_numpy() for name in ("step", "stage")}
        self.times.append(times | {"time": nanoseconds / 1e9})
        for name in batch.schema.names:
            component = name.partition(":")[2]
            if component and (self._points or not component.endswith(".points")):
                column = batch.column(name)
                lengths = column.value_lengths().fill_null(0).to_numpy()
                entry = (len(self.times) - 1, lengths, column.flatten().to_numpy())
                self.columns.setdefault(component, []).append(entry)

    def names(self) -> list[str]:
        return list(self.columns)

    def index(self) -> dict[str, np.ndarray]:
        return {key: np.concatenate([times[key] for times in self.times]) for key in ("step", "stage", "time")}

    def column(self, name: str, shape: tuple[int, ...]) -> Array:
        """The values (rows, *shape), NaN where a row has none; a −1 in the shape is found from the longest row."""
        counts = [len(times["step"]) for times in self.times]
        starts = np.concatenate([[0], np.cumsum(counts)])
        pieces = self.columns.get(name, [])
        if -1 in shape:
            longest = max((int(lengths.max(initial=0)) for _, lengths, _ in pieces), default=0)
            known = int(np.prod([v for v in shape if v != -1]))
            shape = tuple(longest // known if v == -1 else v for v in shape)
        size = int(np.prod(shape))
        out = np.full((int(starts[-1]), size), np.nan)
        for chunk, lengths, flat in pieces:
            out[starts[chunk] + np.flatnonzero(lengths == size)] = flat.reshape(-1, size) if size else 0
        return out.reshape(-1, *shape)


def _table(name: str, rows: _Gathered, space: Space, fields: dict[str, Any]) -> StageTable:
    n, d = len(space.names), len(space.axes)
    shapes: dict[str, tuple[int, ...]] = {"mean": (n,), "cov": (d, d)}
    spaces: dict[str, Space] = {}
    for field, what in fields.items():
        if "points" in what:
            spaces[field] = rebuild(what["points"])
            shapes[f"{field}.points"] = (what["count"], len(spaces[field].names))
        elif "innovation" in what:
            measured = rebuild(what["innovation"])
            assert isinstance(measured, Product)
            spaces[field] = measured
            n_z, m, s = len(measured.names), len(measured.axes), len(measured.parts)
            shapes |= {f"{field}.{part}": (n_z,) for part in ("z", "predicted")}
            shapes |= {f"{field}.residual": (m,), f"{field}.cov": (m, m), f"{field}.noise": (m, m)}
            shapes |= {f"{field}.cross_cov": (d, m), f"{field}.blind": (d, s)}
            shapes |= {f"{field}.{part}": (s,) for part in ("used", "offered")}
        else:
            shapes[field] = tuple(what["shape"])
    values = {column: rows.column(column, shapes.get(column, (-1,))) for column in rows.names()}
    index = rows.index()
    return StageTable(name, index["step"], index["stage"], values, spaces)


def _ends(steps: np.ndarray, tables: dict[str, StageTable], space: Space) -> tuple[Array, Array]:
    """The belief at the end of each step: that of the row with the highest place."""
    n, d = len(space.names), len(space.axes)
    mean, cov = np.full((len(steps), n), np.nan), np.full((len(steps), d, d), np.nan)
    highest = np.full(len(steps), -1)
    for table in tables.values():
        at = np.searchsorted(steps, table.step)
        inside = at < len(steps)  # a killed run may have a stage whose step did not reach the file
        later = np.zeros(len(at), bool)
        later[inside] = table.place[inside] > highest[at[inside]]
        highest[at[later]] = table.place[later]
        mean[at[later]], cov[at[later]] = table.mean[later], table.cov[later]
    return mean, cov


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
