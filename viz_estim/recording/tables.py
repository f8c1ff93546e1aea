"""The rows of a recording's entities, gathered chunk by chunk into arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from viz_estim.core.descriptions import rebuild
from viz_estim.core.modes import moments
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product, Space


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


class Gathered:
    """The rows of one entity, chunk by chunk."""

    def __init__(self, points: bool = True) -> None:
        self.times: list[dict[str, np.ndarray]] = []
        # By component: chunk number, lengths, flat values, and which rows said nothing.
        self.columns: dict[str, list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]] = {}
        self._points = points

    def add(self, batch: pa.RecordBatch) -> None:
        if not {"step", "time", "stage"} <= set(batch.schema.names):  # not ours
            return
        nanoseconds = batch.column("time").cast(pa.int64()).to_numpy()
        times = {name: batch.column(name).to_numpy() for name in ("step", "stage")}
        self.times.append(times | {"time": nanoseconds / 1e9})
        for name in batch.schema.names:
            component = name.partition(":")[2]
            if component and (self._points or not is_geometry(component)):
                column = batch.column(name)
                lengths = column.value_lengths().fill_null(0).to_numpy()
                absent = column.is_null().to_numpy(zero_copy_only=False)
                entry = (len(self.times) - 1, lengths, column.flatten().to_numpy(), absent)
                self.columns.setdefault(component, []).append(entry)

    def names(self) -> list[str]:
        return list(self.columns)

    def ragged(self, name: str, width: int) -> np.ndarray:
        """Values of another length in each row, as an array of arrays: (K, width), or (K,) for a width of 1."""
        rows: list[Array] = [np.empty((0, width))] * sum(len(times["step"]) for times in self.times)
        starts = np.concatenate([[0], np.cumsum([len(times["step"]) for times in self.times])])
        for chunk, lengths, flat, _ in self.columns.get(name, []):
            for i, piece in enumerate(np.split(flat, np.cumsum(lengths)[:-1])):
                rows[starts[chunk] + i] = piece.reshape(-1, width)
        found = np.empty(len(rows), object)
        for i, row in enumerate(rows):
            found[i] = row[:, 0] if width == 1 else row
        return found

    def index(self) -> dict[str, np.ndarray]:
        return {key: np.concatenate([times[key] for times in self.times]) for key in ("step", "stage", "time")}

    def column(self, name: str, shape: tuple[int, ...], *, fill: bool = False) -> Array:
        """The values (rows, *shape), NaN where a row has none; a −1 in the shape is found from the longest row.

        fill: a row that is empty has that of the row before it; one that says nothing has none.
        """
        counts = [len(times["step"]) for times in self.times]
        starts = np.concatenate([[0], np.cumsum(counts)])
        pieces = self.columns.get(name, [])
        if -1 in shape:
            longest = max((int(lengths.max(initial=0)) for _, lengths, _, _ in pieces), default=0)
            known = int(np.prod([v for v in shape if v != -1]))
            shape = tuple(longest // known if v == -1 else v for v in shape)
        size = int(np.prod(shape))
        out = np.full((int(starts[-1]), size), np.nan)
        for chunk, lengths, flat, absent in pieces:
            rows = np.flatnonzero(lengths == size)
            if name == "log_weights" and size > 1 and (one := lengths == 1).any():  # one for all particles
                out[starts[chunk] + np.flatnonzero(one)] = flat[np.repeat(one, lengths)][:, None]
                flat = flat[np.repeat(~one, lengths)]
            out[starts[chunk] + rows] = flat.reshape(-1, size) if size else 0
            if fill and len(rows) and size:  # what all rows share is kept in the first alone
                lacking = np.flatnonzero((lengths == 0) & ~absent)
                source = rows[np.maximum(np.searchsorted(rows, lacking, side="right") - 1, 0)]
                out[starts[chunk] + lacking] = out[starts[chunk] + source]
        return out.reshape(len(out), *shape)


def is_geometry(name: str) -> bool:
    """Whether it is one of the large quantities that `--every` thins: sigma points, clouds, matches."""
    cloud = ("states", "log_weights", "log_likelihoods", "ancestors")
    return name.endswith(".points") or name in cloud or name.startswith("matches.")


def table_of(name: str, rows: Gathered, space: Space, fields: dict[str, Any], particles: int) -> StageTable:
    """particles: how many of a cloud are kept, 0 where the belief is none."""
    n, d = len(space.names), len(space.axes)
    shapes: dict[str, tuple[int, ...]] = {"mean": (n,), "cov": (d, d), "states": (particles, n)}
    shapes["log_weights"] = (particles,)
    ragged: dict[str, int] = {}
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
        elif "matches" in what:
            d = what["matches"]
            ragged |= {f"{field}.source": d, f"{field}.target": d, f"{field}.distance": 1}
            ragged |= {f"{field}.source_index": 1, f"{field}.target_index": 1}
        elif "shape" in what:
            shapes[field] = tuple(what["shape"])
    values: dict[str, Any] = {}
    for column in rows.names():
        if column in ragged:
            values[column] = rows.ragged(column, ragged[column])
        else:
            # The moments of a cloud are kept at the end of a step alone, and others must not be taken for them.
            alone = is_geometry(column) or (particles and column in ("mean", "cov"))
            values[column] = rows.column(column, shapes.get(column, (-1,)), fill=not alone)
    if particles:
        for column in ("mean", "cov"):
            values.setdefault(column, np.full((len(rows.index()["step"]), *shapes[column]), np.nan))
    index = rows.index()
    return StageTable(name, index["step"], index["stage"], values, spaces)


def fill_in(tables: dict[str, StageTable], fields: dict[str, Any]) -> None:
    """Points and clouds that are those of the stage before were kept once: they are put where they belong."""
    for table in tables.values():
        for field, what in fields.get(table.name, {}).items():
            stage, earlier = what.get("same_as", (None, None))
            name, theirs_name = _column_of(field), _column_of(str(earlier))
            if stage in tables and theirs_name in tables[stage].values:
                source = tables[stage]
                theirs = source.values[theirs_name]
                mine = table.values.setdefault(name, np.full((len(table.step), *theirs.shape[1:]), np.nan))
                row = np.minimum(np.searchsorted(source.step, table.step), len(source.step) - 1)
                lacking = np.isnan(mine).all((1, 2)) & (source.step[row] == table.step)
                values = theirs[row[lacking]]
                if "by" in what:
                    chosen = table.values[what["by"]][lacking]
                    known = np.isfinite(chosen).all(1)
                    values[known] = np.take_along_axis(values[known], chosen[known].astype(int)[..., None], axis=1)
                mine[lacking] = values


def _column_of(field: str) -> str:
    return "states" if field == "belief.states" else f"{field}.points"


def work_out(tables: dict[str, StageTable], space: Space) -> None:
    """The moments of the clouds that were recorded without them: all but those that end a step."""
    for table in tables.values():
        if "states" in table.values:
            states, weights = table.values["states"], table.values["log_weights"]
            lacking = np.flatnonzero(np.isnan(table.mean).all(1) & np.isfinite(weights).all(1))
            for some in np.array_split(lacking, max(1, len(lacking) * weights.shape[1] // 10_000)):
                if len(some):
                    table.mean[some], table.cov[some] = moments(space, states[some], weights[some])


def ends(steps: np.ndarray, tables: dict[str, StageTable], space: Space, labels: tuple[str, ...]) -> dict[str, Array]:
    """The belief at the end of each step: that of the row with the highest place."""
    n, d = len(space.names), len(space.axes)
    shapes: dict[str, tuple[int, ...]] = {"mean": (n,), "cov": (d, d)}
    if labels:
        shapes = {"log_probabilities": (len(labels),)}
    found = {name: np.full((len(steps), *shape), np.nan) for name, shape in shapes.items()}
    highest = np.full(len(steps), -1)
    for table in tables.values():
        at = np.searchsorted(steps, table.step)
        inside = at < len(steps)  # a killed run may have a stage whose step did not reach the file
        later = np.zeros(len(at), bool)
        later[inside] = table.place[inside] > highest[at[inside]]
        highest[at[later]] = table.place[later]
        for name, values in found.items():
            values[at[later]] = table.values[name][later]
    return found
