"""Arrays into Rerun columns: whole batches at once, one row a stage or a step."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from operator import attrgetter
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from viz_estim.core.quaternions import Array

_FEW = 256 << 10  # bytes


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
    def columns(self) -> list[Column]:
        """All three, for a row that holds data."""
        nanoseconds = np.round(self.time * 1e9).astype("timedelta64[ns]")
        return [place(self.step, "step"), Column("time", _owned(nanoseconds)), place(self.stage)]


class Column:
    """An arrow array as `rr.send_columns` takes it, of a timeline or of a component: what `rr.TimeColumn` and
    `rr.ComponentColumn` are to it, without their checks of each value, which take longer than all else."""

    def __init__(self, name: Any, values: pa.Array) -> None:
        self._name, self._values = name, values

    def timeline_name(self) -> str:
        return str(self._name)

    def component_descriptor(self) -> rr.ComponentDescriptor:
        return self._name

    def as_arrow_array(self) -> pa.Array:
        return self._values


def place(values: np.ndarray, timeline: str = "stage") -> Column:
    """Places on a timeline that counts."""
    return Column(timeline, _owned(values.astype(np.int64, copy=False)))


def _owned(values: np.ndarray, kind: Any = None) -> pa.Array:
    """Numbers (*,) as an arrow array (N,), of another kind if asked for; few of them in arrow's own memory.

    What lies in numpy's is given back by the thread that wrote it, which has to wait for the interpreter's lock and
    takes it from the filter: that costs more than to copy what a processor has at hand.
    """
    kind = np.dtype(kind or values.dtype)
    if kind == values.dtype and values.nbytes > _FEW:
        return pa.array(values.ravel())
    memory = pa.allocate_buffer(values.size * kind.itemsize)
    np.frombuffer(memory, kind).reshape(values.shape)[...] = values
    return pa.Array.from_buffers(_arrow_type(kind), values.size, [None, memory])


_arrow_type = cache(pa.from_numpy_dtype)


@lru_cache(maxsize=256)
def _even(count: int, rows: int) -> pa.Array:
    return pa.array(np.arange(rows + 1, dtype=np.int32) * np.int32(count))


def _column(
    name: Any, values: pa.Array, counts: int | np.ndarray, rows: int, absent: np.ndarray | None = None
) -> Column:
    """`counts` values a row; absent: which rows say nothing, rather than that there is nothing."""
    if isinstance(counts, int):
        offsets = _even(counts, rows)
    else:
        offsets = _owned(np.concatenate([[0], np.cumsum(counts)]).astype(np.int32))
    mask = pa.array(absent) if absent is not None else None
    return Column(name, pa.ListArray.from_arrays(offsets, values, mask=mask))


_KIND, _SIZE = attrgetter("dtype"), attrgetter("nbytes")


def stacked(found: list[Any]) -> Array | list[Any]:
    """Arrays or numbers as one float64 array (M, …), or the list itself where shapes differ or one is None."""
    first = found[0] if found else None
    if isinstance(first, np.ndarray) and first.dtype == float and first.ndim:
        # The bytes one after the other: for small arrays several times as fast as what numpy does, which looks closer.
        try:
            if set(map(_KIND, found)) == {first.dtype} and set(map(_SIZE, found)) == {first.nbytes}:
                return np.frombuffer(bytearray().join(found)).reshape(len(found), *first.shape)
        except (AttributeError, TypeError):  # not arrays all of them, or not in one piece
            pass
    if any(one is None for one in found):
        return found
    try:
        return np.array(found, dtype=float)
    except ValueError:
        return found


@cache
def _named(archetype: str, component: str) -> rr.ComponentDescriptor:
    return rr.ComponentDescriptor(component).with_builtin_archetype(archetype)


def numbers(archetype: str, component: str, rows: Array | list[Any], known: np.ndarray | None = None) -> Column:
    """Float64 arrays as one column, bit for bit, row-major; rows may be None or of several lengths.

    known: which rows of an array have a value.
    """
    if not isinstance(rows, np.ndarray) and type(None) not in set(map(type, rows)):
        rows = stacked(rows)
    counts: int | np.ndarray
    absent = None
    if isinstance(rows, np.ndarray):
        size = rows.size // max(1, len(rows))
        if known is None or known.all():
            flat, counts = rows, size
        else:
            flat, counts = rows[known], np.where(known, size, 0)
    else:
        present = [np.asarray(row, float).ravel() for row in rows if row is not None]
        flat = np.concatenate(present) if present else np.empty(0)
        counts = np.array([0 if row is None else np.size(row) for row in rows])
        absent = np.array([row is None for row in rows])
    return _column(_named(archetype, component), _owned(flat, float), counts, len(rows), absent)


def indices(archetype: str, component: str, rows: list[Any]) -> Column:
    """Whole numbers that count rows of something, in half a float's space; rows may be None or of several lengths."""
    present = [np.asarray(row, np.int32).ravel() for row in rows if row is not None]
    flat = np.concatenate(present) if present else np.empty(0, np.int32)
    counts = np.array([0 if row is None else np.size(row) for row in rows])
    return _column(_named(archetype, component), _owned(flat), counts, len(rows))


def once(archetype: str, component: str, value: Array, rows: int) -> Column:
    """One value that all rows share, kept in the first of them alone: the reader fills the others in."""
    flat = np.asarray(value, float).ravel()
    counts = np.zeros(rows, int)
    counts[0] = len(flat)
    return _column(_named(archetype, component), _owned(flat), counts, rows)


def words(archetype: Any, component: str, kinds: Sequence[str], which: np.ndarray) -> Column:
    """One text a row: which (M,) says by its place which of the kinds."""
    (like,) = archetype.columns(**{component: ["-"]})
    return _column(like.component_descriptor(), pa.array(kinds, pa.string()).take(pa.array(which)), 1, len(which))


@cache
def _kind(archetype: Any, component: str) -> tuple[rr.ComponentDescriptor, pa.DataType]:
    """A component's descriptor and arrow type, learnt from a column that Rerun makes of one value."""
    one: list[Any] = [[1.0] * (4 if component.startswith("quaternion") else 3)]
    if component in ("values", "variances", "colors", "radii"):
        one = [0xFFFFFFFF] if component == "colors" else [1.0]
    (column,) = archetype.columns(**{component: one})
    return column.descriptor, column.component_batch.as_arrow_array().type


def drawn(archetype: Any, counts: int | np.ndarray, rows: int, **components: np.ndarray) -> list[Column]:
    """Components of an archetype, `counts` instances a row: what `archetype.columns(…).partition(…)` gives."""
    columns = []
    for name, values in components.items():
        descriptor, kind = _kind(archetype, name)
        if pa.types.is_fixed_size_list(kind):
            batch = pa.FixedSizeListArray.from_arrays(_owned(values, np.float32), type=kind)
        else:
            batch = _owned(np.asarray(values), kind.to_pandas_dtype())
        columns.append(_column(descriptor, batch, counts, rows))
    return columns


def send(stream: rr.RecordingStream, path: str, at: Times, columns: Iterable[Any]) -> None:
    """Rows of an entity, at their places on all three timelines."""
    rr.send_columns(path, at.columns, columns, recording=stream, strict=True)


def send_static(stream: rr.RecordingStream, path: str, archetype: Any) -> None:
    """What `stream.log(path, archetype, static=True)` does, at once: a log waits in the stream's own batches, and comes
    out among the columns in another order each time."""
    send_still(stream, path, still(archetype))


class Style:
    """What all rows of an entity look like. Made into an archetype when the first of them is drawn, no sooner: that
    takes longer than to draw a hundred."""

    def __init__(self, kind: Any, **fields: Any) -> None:
        self.kind, self._fields = kind, fields

    def made(self) -> Any:
        return self.kind.from_fields(**self._fields)


def still(archetype: Any) -> list[Column]:
    """An archetype's components as columns of one row, which may be sent many times."""
    batches = [(b.component_descriptor(), b.as_arrow_array()) for b in archetype.as_component_batches()]
    return [_column(name, values, len(values), 1) for name, values in batches if values is not None]


def send_still(stream: rr.RecordingStream, path: str, columns: Iterable[Any]) -> None:
    """Columns without a time."""
    rr.send_columns(path, [], columns, recording=stream, strict=True)
