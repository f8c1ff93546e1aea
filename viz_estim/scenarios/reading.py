"""Data files of any system: a .mat file's fields, a .csv's or .npz's columns, and one line for what is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput


def expand(path: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """The file itself, or the folder's files that end so, sorted; BadInput where there is nothing."""
    if path.is_dir():
        return [file for file in sorted(path.iterdir()) if file.suffix.lower() in suffixes]
    if not path.exists():
        raise BadInput(f"{path}: no such file or folder")
    return [path]


def read_mat(path: Path) -> dict[str, Any]:
    """The fields of a MATLAB file, by the names they have there."""
    try:
        fields: dict[str, Any] = scipy.io.loadmat(path)
    except Exception as error:  # scipy raises whatever a damaged file makes it trip over
        raise unreadable(path, error) from error
    return fields


def read_columns(path: Path, key: str) -> dict[str, Array]:
    """The columns of a .csv (names in its first line) or an .npz, all as long as `key` where that is one of them."""
    try:
        if path.suffix.lower() == ".npz":
            with np.load(path, allow_pickle=False) as file:
                columns = {name: np.asarray(file[name], float) for name in file.files}
        else:
            with path.open(encoding="utf-8-sig") as text:
                names = [name.strip() for name in text.readline().split(",")]
                rows = [line.split(",") for line in text if line.strip()]
            columns = {name: np.array(values) for name, values in zip(names, _cells(path, names, rows), strict=True)}
    except BadInput:
        raise
    except Exception as error:
        raise unreadable(path, error) from error
    if key in columns and any(c.ndim != 1 or c.shape != columns[key].shape for c in columns.values()):
        raise BadInput(f"{path}: all columns must be one-dimensional and as long as `{key}`")
    return columns


def spelled(fields: Mapping[str, Any], name: str) -> str | None:
    """The field's name as the file spells it, in whatever case; None where there is none."""
    return next((held for held in (name, *fields) if held in fields and held.lower() == name.lower()), None)


def field(fields: dict[str, Any], name: str, path: Path) -> np.ndarray:
    """The numbers of a field, in whatever case its name is spelled."""
    found = spelled(fields, name)
    if found is None:
        held = ", ".join(k for k in fields if not k.startswith("__")) or "nothing"
        raise BadInput(f"{path}: no field `{name}` (it holds {held})")
    value = np.asarray(fields[found])
    if value.dtype.kind not in "uifb":
        raise BadInput(f"{path}: `{name}` must hold numbers")
    return value


def finite(values: Array, path: Path, name: str) -> Array:
    """The values, where all are numbers; samples are along the last axis."""
    bad = ~np.isfinite(values)
    if bad.any():
        raise BadInput(
            f"{path}: {name} is not a number at sample {np.argwhere(bad)[0][-1]}; measurements must be finite"
        )
    return values


def unreadable(path: Path, error: Exception) -> BadInput:
    """What to say of a file that its reader tripped over."""
    text = " ".join(str(error).split()) or type(error).__name__
    return BadInput(f"{path}: cannot be read, it may be truncated or of another format ({text[:120]})")


def shape_text(array: np.ndarray) -> str:
    """The shape as a person writes it: 6×T."""
    return "×".join(map(str, array.shape)) or "a single number"


def _cells(path: Path, names: list[str], rows: list[list[str]]) -> list[list[float]]:
    """The columns of a table of texts; an empty cell is NaN."""
    if not rows:
        raise BadInput(f"{path}: is empty, or holds column names alone")
    columns: list[list[float]] = [[] for _ in names]
    for number, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise BadInput(f"{path}: line {number} has {len(row)} cells, the first line {len(names)}")
        for column, name, cell in zip(columns, names, row, strict=True):
            try:
                column.append(float(cell) if cell.strip() else np.nan)
            except ValueError:
                raise BadInput(f"{path}: line {number}, {name}: {cell.strip()!r} is not a number") from None
    return columns
