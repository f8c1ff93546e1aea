"""A recording as a debugger moves through it: its rows by place on the `stage` timeline."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.run import Failure
from viz_estim.core.spaces import Space
from viz_estim.debugger.expressions import Absent
from viz_estim.debugger.quantities import Frame
from viz_estim.debugger.sources import NoSuchPlace, step_at
from viz_estim.differences import sound_steps
from viz_estim.errors import BadInput
from viz_estim.recording.reader import Run, load
from viz_estim.recording.tables import StageTable, is_geometry

_BLOCK = 20_000  # places that a breakpoint is tried on at once


class Recorded:
    """A `Source` over a recording, read without its sigma points and clouds until somebody asks for one.

    findings: what a diagnosis found, by the step at which it begins; None where nobody looked.
    """

    def __init__(self, path: Path) -> None:
        self.run: Run = _whole_steps(load(path, points=False))
        self.findings: dict[int, list[str]] | None = None
        tables = list(self.run.stages.values())
        inside = [np.isin(table.step, self.run.step) for table in tables]  # a kill may have left stages of no step
        counts = np.zeros(len(self.run.step), int)
        for table, rows in zip(tables, inside, strict=True):
            np.add.at(counts, np.searchsorted(self.run.step, table.step[rows]), 1)
        self._starts = np.concatenate([[0], np.cumsum(np.maximum(counts, 1))])
        self._table = np.full(self._starts[-1], -1)
        self._row = np.zeros(self._starts[-1], int)
        for i, (table, rows) in enumerate(zip(tables, inside, strict=True)):
            self._table[table.place[rows]], self._row[table.place[rows]] = i, np.flatnonzero(rows)

    @property
    def times(self) -> Array:
        return self.run.time

    @property
    def reached(self) -> int:
        return int(self.run.step[-1])

    @cached_property
    def failure(self) -> Failure | None:
        error = (self.run.properties.get("result") or {}).get("error")
        if error:
            return Failure(error["step"], error["stage"], error["message"])
        return Failure(self.reached, "unknown", self.run.error) if self.run.error else None

    def span(self, step: int) -> range:
        row = int(np.searchsorted(self.run.step, step))
        if row == len(self.run.step) or self.run.step[row] != step:
            raise NoSuchPlace(f"no step {step}: the run has steps {self.run.step[0]} to {self.run.step[-1]}")
        return range(int(self._starts[row]), int(self._starts[row + 1]))

    def step_at(self, time: float) -> int:
        return int(self.run.step[step_at(self.times, time)])

    def frame(self, place: int) -> Frame:
        if not 0 <= place < len(self._table):
            raise NoSuchPlace(f"no stage {place}: the run has stages 0 to {len(self._table) - 1}")
        table = self._tables[self._table[place]] if self._table[place] >= 0 else None
        rows = self._row[place : place + 1]
        places = np.array([place])
        if table is None:
            return self._frame("", places, {}, {})
        known = {name: values[rows] for name, values in table.values.items()}
        found = {name: values for name, values in known.items() if values.dtype == object or not _empty(values)}
        values = _Row(found, self._geometry_of(table.name), lambda: self._fetched(table.name, rows))
        return self._frame(table.name, places, values, table.spaces)

    def ahead(self, place: int) -> Iterator[list[Frame]]:
        return (self._block(low, low + _BLOCK) for low in range(place + 1, len(self._table), _BLOCK))

    def behind(self, place: int) -> Iterator[list[Frame]]:
        return (self._block(max(0, high - _BLOCK), high) for high in range(place, 0, -_BLOCK))

    def one_of_each(self) -> Iterator[Frame]:
        """A frame of each kind of stage, the last of its kind."""
        return (
            self.frame(int(places[-1]))
            for i in range(len(self._tables))
            if len(places := np.flatnonzero(self._table == i))
        )

    def _block(self, low: int, high: int) -> list[Frame]:
        """The frames of the places from low up to high, one for each kind of stage."""
        kinds = self._table[low:high]
        frames = []
        for i, table in enumerate(self._tables):
            places = low + np.flatnonzero(kinds == i)
            if len(places):
                values = _Rows(table, self._row[places], self._geometry_of(table.name), lambda: self.whole)
                frames.append(self._frame(table.name, places, values, table.spaces))
        return frames

    def _frame(self, name: str, places: np.ndarray, values: Mapping[str, Array], spaces: dict[str, Space]) -> Frame:
        at = np.searchsorted(self._starts, places, side="right") - 1
        run = self.run
        inputs = {k: v[at] for k, v in run.inputs.items()} if len(places) > 1 else {
            k: v[at] for k, v in run.inputs.items() if not _empty(v[at])
        }  # fmt: skip
        findings = None if self.findings is None else self._begins(at, places)
        return Frame(
            name, None if run.labels else run.space, run.labels,
            run.step[at], places, places - self._starts[at], run.time[at], run.dt[at],
            values, spaces, run.truth[at] if np.isfinite(run.truth[at]).any() else None, inputs,
            lambda: self._before(places), findings, int((run.properties.get("particles") or {}).get("count", 0)),
            tuple(run.properties.get("stages", {}).get(name, {}).get("sensors", {}).get("names", ())),
        )  # fmt: skip

    def _begins(self, at: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Where a finding begins: at the end of its first step."""
        assert self.findings is not None
        return np.isin(self.run.step[at], list(self.findings)) & (places + 1 == self._starts[at + 1])

    def _before(self, places: np.ndarray) -> dict[str, Array]:
        """The belief's arrays after the stage before each place; nothing before the first."""
        earlier = places - 1
        if (earlier < 0).all():
            return {}
        names = ("log_probabilities",) if self.run.labels else ("mean", "cov")
        # Of a cloud the moments are kept at the end of each step alone: the others follow from it.
        tables = list((self.whole if self.run.properties.get("particles") else self.run).stages.values())
        found = {name: np.full((len(places), *self.run.ends[name].shape[1:]), np.nan) for name in names}
        kinds = np.where(earlier >= 0, self._table[earlier], -1)
        for i, table in enumerate(tables):
            rows = np.flatnonzero(kinds == i)
            for name, values in found.items():
                values[rows] = table.values[name][self._row[earlier[rows]]]
        return found

    @cached_property
    def _tables(self) -> list[StageTable]:
        return list(self.run.stages.values())

    @cached_property
    def whole(self) -> Run:
        """The recording with its sigma points and clouds."""
        return _whole_steps(load(self.run.path))

    def _geometry_of(self, stage: str) -> set[str]:
        """The names of a stage's sigma points, matches and clouds; a cloud's moments are those that follow from it."""
        found = {"states", "log_weights", "mean", "cov"} if self.run.properties.get("particles") else set()
        for name, what in self.run.properties.get("stages", {}).get(stage, {}).items():
            if "points" in what:
                found.add(f"{name}.points")
            elif "matches" in what:
                found |= {f"{name}.{part}" for part in ("source", "target", "distance", "source_index", "target_index")}
            elif what.get("cloud") or is_geometry(name):
                found.add(name)
        return found

    def _fetched(self, stage: str, rows: np.ndarray) -> dict[str, Array]:
        values = self.whole.stages[stage].values
        return {k: v[rows] for k, v in values.items() if v.dtype == object or not _empty(v[rows])}


def _whole_steps(run: Run) -> Run:
    """The run without the steps of which a kill has left but some stages. BadInput where no step is whole."""
    count = sound_steps(run) if run.stages or run.complete else 0
    if not count:
        raise BadInput(f"{run.path}: it was cut off before its first step was whole")
    return run if count == len(run.step) else between(run, int(run.step[0]), int(run.step[count - 1]))


def between(run: Run, first: int, last: int) -> Run:
    """The run's steps from one up to another."""
    rows = (run.step >= first) & (run.step <= last)

    def cut(table: StageTable) -> StageTable:
        inside = (table.step >= first) & (table.step <= last)
        values = {name: value[inside] for name, value in table.values.items()}
        return replace(table, step=table.step[inside], place=table.place[inside], values=values)

    tables = {name: cut(table) for name, table in run.stages.items()}
    return replace(
        run, step=run.step[rows], time=run.time[rows], dt=run.dt[rows], truth=run.truth[rows],
        inputs={name: value[rows] for name, value in run.inputs.items()},
        stages={name: table for name, table in tables.items() if len(table.step)},
        ends={name: value[rows] for name, value in run.ends.items()},
        error=run.error if last >= run.step[-1] else None,
    )  # fmt: skip


class _Rows(Mapping[str, Array]):
    """Some rows of a table's numbers, taken when they are asked for; sigma points and clouds from the whole run."""

    def __init__(self, table: StageTable, rows: np.ndarray, geometry: set[str], whole: Callable[[], Run]) -> None:
        self._table, self._rows, self._geometry, self._whole = table, rows, geometry, whole

    def __getitem__(self, name: str) -> Array:
        table = self._whole().stages[self._table.name] if name in self._geometry else self._table
        return table.values[name][self._rows]

    def __contains__(self, name: object) -> bool:
        return name in self._table.values or name in self._geometry

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys([*self._table.values, *sorted(self._geometry)]))

    def __len__(self) -> int:
        return len(self._table.values.keys() | self._geometry)


class _Row(Mapping[str, Array]):
    """One row's numbers; sigma points and clouds are fetched when they are asked for."""

    def __init__(self, known: dict[str, Any], geometry: set[str], fetch: Callable[[], dict[str, Array]]) -> None:
        self._known, self._geometry, self._fetch = known, geometry - known.keys(), fetch

    def __getitem__(self, name: str) -> Array:
        if name in self._geometry:
            self._known, self._geometry = self._fetch() | self._known, set()
        if name not in self._known:
            raise Absent(f"{name} was not kept at this step")
        value: Array = self._known[name]
        return value

    def __contains__(self, name: object) -> bool:
        return name in self._known or name in self._geometry

    def __iter__(self) -> Iterator[str]:
        return iter([*self._known, *sorted(self._geometry)])

    def __len__(self) -> int:
        return len(self._known) + len(self._geometry)


def _empty(values: Array) -> bool:
    """Whether a row has none: the reader puts NaN where there is nothing."""
    return bool(values.size == 0 or np.isnan(values).all())
