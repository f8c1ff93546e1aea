"""Data files of any system: finding them, a .mat file's fields, and one line for what is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput, one_line

_HDF5 = "is MATLAB v7.3 (HDF5), which is not read; in MATLAB save it anew with save(FILE, '-v7')"


def expand(path: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """The file itself, or the folder's files that end so, sorted; BadInput where there is nothing."""
    if path.is_dir():
        return [file for file in sorted(path.iterdir()) if file.suffix.lower() in suffixes]
    if not path.exists():
        raise BadInput(f"{path}: no such file or folder")
    return [path]


def read_mat(path: Path) -> dict[str, Any]:
    """The fields of a MATLAB file, by the names they have there; those of a struct stand beside it."""
    try:
        fields: dict[str, Any] = scipy.io.loadmat(path)
    except Exception as error:  # scipy raises whatever a damaged file makes it trip over
        raise unreadable(path, error) from error
    return _unpacked(fields)


def mat_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """The shapes of a MATLAB file's fields, by the names they have there, without reading the numbers."""
    try:
        found = scipy.io.whosmat(path)
        structs = [name for name, shape, kind in found if kind == "struct" and shape == (1, 1)]
        inner = _unpacked(scipy.io.loadmat(path, variable_names=structs)) if structs else {}
    except Exception as error:  # as above
        raise unreadable(path, error) from error
    shapes = {name: np.shape(value) for name, value in inner.items() if not name.startswith("__")}
    return shapes | {name: tuple(shape) for name, shape, _ in found}


def not_read(paths: list[Path]) -> str:
    """What to add where nothing was found: the MATLAB v7.3 files among files and folders, which are not read."""
    files = [file for path in paths for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    found = [file.name for file in files if file.is_file() and _is_hdf5(file)]
    return f"; {', '.join(found)[:100]}: {_HDF5}" if found else ""


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
    try:
        with path.open("rb"):
            pass
    except OSError as closed:
        return BadInput(f"{path}: cannot be opened ({closed.strerror})")
    if _is_hdf5(path):
        return BadInput(f"{path}: {_HDF5}")
    text = one_line(error) or type(error).__name__
    return BadInput(f"{path}: cannot be read, it may be truncated or of another format ({text[:120]})")


def shape_text(array: np.ndarray) -> str:
    """The shape as a person writes it: 6×T."""
    return "×".join(map(str, array.shape)) or "a single number"


def _is_hdf5(path: Path) -> bool:
    """Whether it is HDF5, as MATLAB saves with `-v7.3`; the file's own mark stands behind MATLAB's 512 bytes."""
    try:
        with path.open("rb") as file:
            return b"\x89HDF\r\n\x1a\n" in file.read(1024)
    except OSError:
        return False


def _unpacked(fields: dict[str, Any]) -> dict[str, Any]:
    """The fields, and beside them those of structs that hold one of each; a name outside goes before one inside."""
    for value in list(fields.values()):
        if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
            inner = value.ravel()[0]
            fields = _unpacked({name: inner[name] for name in value.dtype.names}) | fields
    return fields
