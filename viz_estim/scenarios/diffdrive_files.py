"""Files of a differential drive with GPS: finding, reading and writing them.

The CMU 16-642 course's format, a .mat file with `u` 2×N (speed in m/s and turn rate in rad/s, each acting for one
step), `y` 2×M (GPS x, y in m), `t_y` 1×M (its stamps in s) and optionally the truth `q_groundTruth` 3×(N+1) (x, y,
heading). The step is `T` (s), or the stamps `t` or `t_groundTruth` 1×(N+1), or else the course's 10 ms.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import wrap
from viz_estim.errors import BadInput
from viz_estim.scenarios.reading import expand, field, finite, mat_shapes, not_read, read_mat, shape_text, spelled

PERIOD = 0.01  # s: the course's step
_NEEDED = ("u", "y", "t_y")
_SUFFIXES = (".mat",)


@dataclass(frozen=True)
class DriveLog:
    """One file: stamps time (N+1,) s from 0; inputs (N, 2), of which row k acts from time[k] to time[k+1].

    gps (M, 2) in m, and the step (M,) that each reading belongs to; truth (N+1, 3), x, y (m) and heading (rad), NaN
    where it is absent; files are those it was read from.
    """

    time: Array
    inputs: Array
    gps: Array
    gps_step: np.ndarray
    truth: Array
    files: tuple[Path, ...] = ()


def find(paths: list[Path]) -> list[Path]:
    """The files of this kind among files and folders; a file that is named itself must be one."""
    found = []
    for path in paths:
        if not path.is_dir() and path.suffix.lower() not in _SUFFIXES:
            expand(path, _SUFFIXES)
            raise BadInput(f"{path}: expected a .mat file with {_listed(_NEEDED)}")
        found += [file for file in expand(path, _SUFFIXES) if file == path or _fits(file)]
    if not found:
        where = ", ".join(map(str, paths))
        what = f"a .mat with {_listed(_NEEDED)}"
        raise BadInput(f"{where}: no file of a differential drive there ({what}){not_read(paths)}")
    return list(dict.fromkeys(found))


def load(path: Path) -> DriveLog:
    """The file read and checked."""
    fields = read_mat(path)
    inputs = _rows(fields, "u", 2, path)
    gps = _rows(fields, "y", 2, path)
    if not spelled(fields, "t_y") and len(gps) == len(inputs):
        raise BadInput(
            f"{path}: no field `t_y`, and a `y` for every `u`: these look like ranges to two beacons, which diffdrive "
            f"does not read (it holds {_listed(_names(fields))}); a GPS needs its stamps `t_y`"
        )
    stamps = _stamps(fields, len(inputs), path)
    truth = np.full((len(stamps), 3), np.nan)
    if spelled(fields, "q_groundTruth"):
        truth = _rows(fields, "q_groundTruth", 3, path, len(stamps), absent=True)
        truth[:, 2] = wrap(truth[:, 2])
    return DriveLog(stamps - stamps[0], inputs, gps, _steps(fields, stamps, len(gps), path), truth, (path,))


def save(folder: Path, name: str, log: DriveLog) -> list[Path]:
    """Writes the log, whose steps are all as long, in the course's format."""
    path = folder / name
    if path.exists():
        raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
    fields = {"q_groundtruth": log.truth.T, "u": log.inputs.T, "y": log.gps.T, "t_y": log.time[None, log.gps_step]}
    scipy.io.savemat(path, fields | {"T": log.time[1]}, do_compression=True)
    return [path]


def _fits(path: Path) -> bool:
    try:
        held = {name.lower() for name in mat_shapes(path)}
    except BadInput:  # nobody named this one
        return False
    return held >= set(_NEEDED)


def _stamps(fields: dict[str, Any], count: int, path: Path) -> Array:
    """The stamp of each step (N+1,), by the first field there is that tells it."""
    for name in filter(None, (spelled(fields, name) for name in ("t_groundTruth", "t", "T"))):
        value = finite(field(fields, name, path).astype(float).ravel(), path, name)
        if value.size == 1:
            if value[0] <= 0:
                raise BadInput(f"{path}: `{name}` is the length of a step in s, expected a positive number")
            return float(value[0]) * np.arange(count + 1, dtype=float)
        if value.size != count + 1:
            raise BadInput(
                f"{path}: `{name}` has {value.size} stamps and `u` {count} columns; expected one stamp more than inputs"
            )
        return _increasing(value, path, name)
    return PERIOD * np.arange(count + 1, dtype=float)


def _steps(fields: dict[str, Any], stamps: Array, count: int, path: Path) -> np.ndarray:
    """The step (M,) whose stamp is nearest to each of `t_y`."""
    read = finite(field(fields, "t_y", path).astype(float).ravel(), path, "t_y")
    if len(read) != count:
        raise BadInput(f"{path}: `t_y` has {len(read)} stamps and `y` {count} columns; they must agree")
    _increasing(read, path, "t_y")
    half = 0.5 * np.diff(stamps)
    outside = (read < stamps[0] - half[0]) | (read > stamps[-1] + half[-1])
    if outside.any():
        k = int(np.argmax(outside))
        raise BadInput(
            f"{path}: `t_y` is {read[k]:g} s at sample {k}, but `u` lasts from {stamps[0]:g} to {stamps[-1]:g} s; "
            "give the right step as `T`"
        )
    steps = np.searchsorted(stamps[:-1] + half, read)
    twice = np.flatnonzero(np.diff(steps) == 0)
    if len(twice):
        raise BadInput(f"{path}: `t_y` has samples {twice[0]} and {twice[0] + 1} in one step; expected one a step")
    return steps


def _rows(
    fields: dict[str, Any], name: str, size: int, path: Path, count: int | None = None, *, absent: bool = False
) -> Array:
    """A field of shape size×count as (count, size); NaN in it only where it may be absent."""
    value = field(fields, name, path)
    if value.ndim != 2 or len(value) != size or value.shape[1] != (count or value.shape[1]) or not value.shape[1]:
        expected = f"{size}×{count}, one column more than `u`" if count else f"{size}×N"
        raise BadInput(f"{path}: expected `{name}` of shape {expected}, got {shape_text(value)}")
    value = value.astype(float)
    return (value if absent else finite(value, path, name)).T.copy()


def _increasing(stamps: Array, path: Path, name: str) -> Array:
    back = np.flatnonzero(np.diff(stamps) <= 0)
    if len(back):
        raise BadInput(f"{path}: `{name}` does not increase at sample {back[0] + 1}; sort the samples by time")
    return stamps


def _names(fields: dict[str, Any]) -> tuple[str, ...]:
    return tuple(name for name in fields if not name.startswith("__"))


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(f"`{name}`" for name in names)
