"""Arrays into Rerun columns: whole batches at once, one row a stage or a step."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from viz_estim.core.quaternions import Array


@dataclass(frozen=True)
class Times:
    """The three timelines of some rows: step (N,), time (N,) in s, stage (N,)."""

    step: np.ndarray
    time: np.ndarray
    stage: np.ndarray

    def __len__(self) -> int:
        return len(self.stage)

    def pick(self, rows: np.ndarray) -> Times:
        return Times(self.step[rows], self.time[rows], self.stage[rows])

    @cached_property
    def columns(self) -> list[rr.TimeColumn]:
        """All three, for a row that holds data."""
        nanoseconds = np.round(self.time * 1e9).astype("timedelta64[ns]")
        return [
            rr.TimeColumn("step", sequence=self.step),
            rr.TimeColumn("time", duration=nanoseconds),
            rr.TimeColumn("stage", sequence=self.stage),
        ]


class _Batch:
    """An arrow array as Rerun wants to see a component's batch."""

    def __init__(self, values: pa.Array) -> None:
        self.values = values

    def as_arrow_array(self) -> pa.Array:
        return self.values


def _offsets(counts: int | np.ndarray, rows: int) -> np.ndarray:
    if isinstance(counts, int):
        return np.arange(rows + 1, dtype=np.int32) * np.int32(counts)
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


@cache
def _named(archetype: str, component: str) -> rr.ComponentDescriptor:
    return rr.ComponentDescriptor(component).with_builtin_archetype(archetype)


def numbers(archetype: str, component: str, rows: Array | Sequence[Array | None]) -> rr.ComponentColumn:
    """Float64 arrays as one column, bit for bit, row-major; rows may be None or of several lengths."""
    if not isinstance(rows, np.ndarray) and not any(row is None for row in rows):
        with suppress(ValueError):  # of several lengths
            rows = np.array(rows, dtype=float)
    if isinstance(rows, np.ndarray):
        flat, counts = np.asarray(rows, float).ravel(), _offsets(rows.size // max(1, len(rows)), len(rows))
    else:
        present = [np.asarray(row, float).ravel() for row in rows if row is not None]
        flat = np.concatenate(present) if present else np.empty(0)
        counts = _offsets(np.array([0 if row is None else np.size(row) for row in rows]), len(rows))
    return rr.ComponentColumn(_named(archetype, component), _Batch(pa.array(flat)), offsets=counts)


def once(archetype: str, component: str, value: Array, rows: int) -> rr.ComponentColumn:
    """One value that all rows share, kept in the first of them alone: the reader fills the others in."""
    flat = np.asarray(value, float).ravel()
    counts = np.zeros(rows, int)
    counts[0] = len(flat)
    return rr.ComponentColumn(_named(archetype, component), _Batch(pa.array(flat)), offsets=_offsets(counts, rows))


@cache
def _kind(archetype: Any, component: str) -> tuple[rr.ComponentDescriptor, pa.DataType]:
    """A component's descriptor and arrow type, learnt from a column that Rerun makes of one value."""
    one: list[Any] = [[1.0] * (4 if component.startswith("quaternion") else 3)]
    if component in ("values", "variances", "colors"):
        one = [0xFFFFFFFF] if component == "colors" else [1.0]
    (column,) = archetype.columns(**{component: one})
    return column.descriptor, column.component_batch.as_arrow_array().type


def drawn(archetype: Any, counts: int | np.ndarray, rows: int, **components: Array) -> list[rr.ComponentColumn]:
    """Components of an archetype, `counts` instances a row: what `archetype.columns(…).partition(…)` gives, without
    its checks of each value, which take longer than all else."""
    offsets = _offsets(counts, rows)
    columns = []
    for name, values in components.items():
        descriptor, kind = _kind(archetype, name)
        if pa.types.is_fixed_size_list(kind):
            flat = pa.array(np.asarray(values, np.float32).ravel())
            batch = pa.FixedSizeListArray.from_arrays(flat, type=kind)
        else:
            batch = pa.array(np.asarray(values, kind.to_pandas_dtype()).ravel())
        columns.append(rr.ComponentColumn(descriptor, _Batch(batch), offsets=offsets))
    return columns


def send_static(stream: rr.RecordingStream, path: str, archetype: Any) -> None:
    """What `stream.log(path, archetype, static=True)` does, at once: a log waits in the stream's own batches, and comes
    out among the columns in another order each time."""
    batches = archetype.as_component_batches()
    columns = [
        rr.ComponentColumn(b.component_descriptor(), b, lengths=[len(b.as_arrow_array())])
        for b in batches
        if b.as_arrow_array() is not None
    ]
    rr.send_columns(path, [], columns, recording=stream, strict=True)
