"""Arrays into Rerun columns: whole batches at once, one row a stage or a step."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache

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

    def columns(self) -> list[rr.TimeColumn]:
        """All three, for a row that holds data."""
        nanoseconds = np.round(self.time * 1e9).astype("timedelta64[ns]")
        return [
            rr.TimeColumn("step", sequence=self.step),
            rr.TimeColumn("time", duration=nanoseconds),
            rr.TimeColumn("stage", sequence=self.stage),
        ]


class _Values:
    """A flat float64 array as Rerun wants to see a component's batch."""

    def __init__(self, values: Array) -> None:
        self.values = values

    def as_arrow_array(self) -> pa.Array:
        return pa.array(self.values)


@cache
def _descriptor(archetype: str, component: str) -> rr.ComponentDescriptor:
    return rr.ComponentDescriptor(component).with_builtin_archetype(archetype)


def numbers(archetype: str, component: str, rows: Sequence[Array | None]) -> rr.ComponentColumn:
    """Float64 arrays as one column, bit for bit, row-major; rows may be None or of several lengths."""
    descriptor = _descriptor(archetype, component)
    sizes = {-1 if row is None else row.size for row in rows}
    if len(sizes) == 1 and -1 not in sizes:
        flat = np.array(rows, dtype=float).ravel()
        offsets = np.arange(len(rows) + 1, dtype=np.int32) * np.int32(sizes.pop())
        return rr.ComponentColumn(descriptor, _Values(flat), offsets=offsets)
    lengths = [0 if row is None else row.size for row in rows]
    present = [np.asarray(row, float).ravel() for row in rows if row is not None]
    flat = np.concatenate(present) if present else np.empty(0)
    return rr.ComponentColumn(descriptor, _Values(flat), lengths=lengths)


def partition(columns: rr.ComponentColumnList, count: int, rows: int) -> Iterable[rr.ComponentColumn]:
    """Columns of `rows` batches, each of `count` instances."""
    return columns.partition(np.full(rows, count))
