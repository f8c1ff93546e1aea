"""Files of two warning sensors: reading, checking, writing.

A CSV file with the columns `time` [s], `sonar` and `flow` [1 where the sensor warns, else 0] and, where the truth is
known, `state` (a label; an empty cell where it is not). Labels in any case, columns in any order; others are left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios.reading import expand
from viz_estim.scenarios.tables import Table, read_table

LABELS = ("hazard", "current", "clear")
_COLUMNS = ("time", "sonar", "flow")


@dataclass(frozen=True)
class UnderwaterData:
    """Readings over time: time (T,) s; sonar, flow (T,) 0 or 1; truth (T,) index into LABELS, NaN where unknown."""

    time: Array
    sonar: Array
    flow: Array
    truth: Array
    files: tuple[Path, ...] = ()


def find(paths: list[Path]) -> Path:
    """The one file of readings among files and folders, known by its columns; a file that was named must be one."""
    found = [file for path in paths for file in expand(path, (".csv",)) if file in paths or _is_readings(file)]
    if not found:
        raise BadInput(f"{', '.join(map(str, paths))}: no file of readings there (a .csv with {', '.join(_COLUMNS)})")
    if len(found) > 1:
        names = ", ".join(str(file) for file in found)
        raise BadInput(f"{len(found)} files of readings found, a run takes one: name one of {names}")
    return found[0]


def load(path: Path) -> UnderwaterData:
    """The file read and checked."""
    table = read_table(path)
    table.require(_COLUMNS)
    time, sonar, flow = (_numbers(table, name) for name in _COLUMNS)
    states = table.texts("state") if "state" in table else [""] * len(time)
    truth = [_label(table, row, cell.lower()) for row, cell in enumerate(states)]
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        raise BadInput(f"{path}: {table.where(back[0] + 1)}, time goes back; sort the readings by time")
    return UnderwaterData(np.array(time), np.array(sonar), np.array(flow), np.array(truth), (path,))


def save(path: Path, data: UnderwaterData) -> list[Path]:
    """Writes the readings as the CSV file that `load` reads."""
    if path.exists():
        raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
    states = [LABELS[int(label)] if np.isfinite(label) else "" for label in data.truth]
    rows = zip(data.time, data.sonar, data.flow, states, strict=True)
    lines = ["time,sonar,flow,state", *(f"{time:.17g},{s:g},{f:g},{state}" for time, s, f, state in rows)]
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return [path]


def _is_readings(path: Path) -> bool:
    try:
        return set(_COLUMNS) <= set(read_table(path).names)
    except BadInput:
        return False


def _numbers(table: Table, name: str) -> Array:
    """A column of stamps or readings."""
    values = table.numbers(name)
    bad = ~np.isfinite(values) if name == "time" else ~np.isin(values, (0.0, 1.0))
    if bad.any():
        row = int(np.argmax(bad))
        cell = table.texts(name)[row]
        where = f"{table.path}: {table.where(row)}, {name}: {cell!r}"
        if not math.isfinite(values[row]):
            raise BadInput(f"{where} is {'not finite' if cell else 'not a number'}; leave the line out")
        raise BadInput(f"{where} is neither 0 nor 1 (1 where the sensor warns)")
    return values


def _label(table: Table, row: int, cell: str) -> float:
    """The label's index; an empty cell or NaN is an unknown one."""
    if cell in ("", "nan"):
        return math.nan
    if cell not in LABELS:
        what = f"{cell[:40]!r} is none of {', '.join(LABELS)}, and not empty"
        raise BadInput(f"{table.path}: {table.where(row)}, state: {what}")
    return float(LABELS.index(cell))
