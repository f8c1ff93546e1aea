"""Files of two warning sensors: reading, checking, writing.

A CSV file with the columns `time` [s], `sonar` and `flow` [1 where the sensor warns, else 0] and, where the truth is
known, `state` (a label; an empty cell where it is not). Names and labels in any case and order; other columns are left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios.reading import expand, unreadable

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
    names, *rows = _read_rows(path)
    held = f"columns: {', '.join(names)[:200]}"
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        raise BadInput(f"{path}: missing {', '.join(missing)} ({held})")
    if len(set(names)) < len(names):
        raise BadInput(f"{path}: two columns have one name ({held}); keep one of them")
    if not rows:
        raise BadInput(f"{path}: holds column names alone; at least one reading is needed")
    for number, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise BadInput(f"{path}: line {number} has {len(row)} cells, the first line {len(names)}")
    cells = {name: [row[i] for row in rows] for i, name in enumerate(names)}
    time, sonar, flow = ([_number(path, name, k, cell) for k, cell in enumerate(cells[name], 2)] for name in _COLUMNS)
    truth = [_label(path, k, cell) for k, cell in enumerate(cells.get("state", [""] * len(rows)), 2)]
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        raise BadInput(f"{path}: line {back[0] + 3}, time goes back; sort the readings by time")
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
        return set(_COLUMNS) <= set(_read_rows(path)[0])
    except BadInput:
        return False


def _read_rows(path: Path) -> list[list[str]]:
    """The cells of a CSV file by line, in lower case: people write `State` and `SONAR`."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise unreadable(path, error) from error
    if not text.strip():
        raise BadInput(f"{path}: is empty")
    return [[cell.strip().lower() for cell in line.split(",")] for line in text.rstrip().splitlines()]


def _number(path: Path, name: str, line: int, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise BadInput(f"{path}: line {line}, {name}: {cell[:40]!r} is not a number") from None
    if not math.isfinite(value):
        raise BadInput(f"{path}: line {line}, {name}: {cell!r} is not finite; leave the line out")
    if name != "time" and value not in (0.0, 1.0):
        raise BadInput(f"{path}: line {line}, {name}: {cell!r} is neither 0 nor 1 (1 where the sensor warns)")
    return value


def _label(path: Path, line: int, cell: str) -> float:
    """The label's index; an empty cell or NaN is an unknown one."""
    if cell in ("", "nan"):
        return math.nan
    if cell not in LABELS:
        raise BadInput(f"{path}: line {line}, state: {cell[:40]!r} is none of {', '.join(LABELS)}, and not empty")
    return float(LABELS.index(cell))
