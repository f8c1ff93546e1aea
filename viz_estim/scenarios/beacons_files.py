"""Files of a differential drive with ranges to two beacons: finding, reading and writing them.

The CMU 16-642 course's format, a .mat file with `u` 2×T (speed in m/s and turn rate in rad/s; column k acts from step k
to k + 1), `y` 2×T (ranges in m at step k to the beacons, whose places the files don't say) and optionally the truth
`q_groundTruth` 3×T (x, y, heading). Names in any case. The stamps are `t` 1×T, or follow from the step `T` (s), or else
are 100 ms apart.
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
from viz_estim.scenarios.reading import expand, field, finite, mat_shapes, not_read, read_mat, shape_text

PERIOD = 0.1  # s: the course's step
_SUFFIXES = (".mat",)
_WHAT = "a .mat with `u` and `y`, both 2×T"


@dataclass(frozen=True)
class BeaconLog:
    """One file: stamps time (T,) s from 0; inputs (T, 2), of which row k acts from time[k] to time[k+1].

    ranges (T, 2) in m; truth (T, 3), x, y (m) and heading (rad), NaN where it is absent; files are those read.
    """

    time: Array
    inputs: Array
    ranges: Array
    truth: Array
    files: tuple[Path, ...] = ()


def find(paths: list[Path]) -> Path:
    """The one file among files and folders, known by its fields; a file that was named must be one."""
    found = [file for path in paths for file in expand(path, _SUFFIXES) if file in paths or _fits(file)]
    where = ", ".join(map(str, paths))
    if not found:
        raise BadInput(f"{where}: no file of ranges to two beacons there ({_WHAT}){not_read(paths)}")
    if len(found) > 1:
        raise BadInput(f"{len(found)} files of ranges found, a run takes one: name one of {', '.join(map(str, found))}")
    if found[0].suffix.lower() not in _SUFFIXES:
        raise BadInput(f"{found[0]}: expected {_WHAT}")
    return found[0]


def load(path: Path) -> BeaconLog:
    """The file read and checked."""
    fields = read_mat(path)
    names = {name.lower() for name in fields}
    inputs = _rows(fields, "u", 2, None, path)
    if "t_y" in names:
        raise BadInput(f"{path}: `t_y` are the stamps of a GPS, so `y` holds no ranges; run diffdrive-ekf on it")
    ranges = _rows(fields, "y", 2, len(inputs), path)
    truth = np.full((len(inputs), 3), np.nan)
    if "q_groundtruth" in names:
        truth = _rows(fields, "q_groundTruth", 3, len(inputs), path)
        truth[:, 2] = wrap(truth[:, 2])
    finite(inputs.T, path, "u")
    finite(ranges.T, path, "y")
    return BeaconLog(_stamps(fields, len(inputs), path), inputs, ranges, truth, (path,))


def save(path: Path, log: BeaconLog) -> list[Path]:
    """Writes the log in the course's format."""
    if path.exists():
        raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
    fields = {"q_groundTruth": log.truth.T, "u": log.inputs.T, "y": log.ranges.T, "t": log.time[None]}
    scipy.io.savemat(path, fields, do_compression=True)
    return [path]


def _fits(path: Path) -> bool:
    try:
        shapes = {name.lower(): shape for name, shape in mat_shapes(path).items()}
    except BadInput:  # nobody named this one
        return False
    return "t_y" not in shapes and "u" in shapes and shapes["u"] == shapes.get("y") and shapes["u"][0] == 2


def _stamps(fields: dict[str, Any], count: int, path: Path) -> Array:
    """The stamps (T,) from 0. Names differ by their case alone here: `T` is a step where it is a single number."""
    held = [name for name in ("t", "T") if name in fields]
    if not held:
        return PERIOD * np.arange(count, dtype=float)
    value = finite(field(fields, held[0], path).astype(float).ravel(), path, held[0])
    if value.size == 1 and count > 1:
        if value[0] <= 0:
            raise BadInput(f"{path}: `{held[0]}` is the length of a step in s, expected a positive number")
        return float(value[0]) * np.arange(count, dtype=float)
    if value.size != count:
        raise BadInput(f"{path}: `{held[0]}` has {value.size} stamps and `u` {count} columns; they must agree")
    back = np.flatnonzero(np.diff(value) <= 0)
    if len(back):
        raise BadInput(f"{path}: `{held[0]}` does not increase at sample {back[0] + 1}; sort the samples by time")
    return value - value[0]


def _rows(fields: dict[str, Any], name: str, size: int, count: int | None, path: Path) -> Array:
    """A field of shape size×T as (T, size)."""
    value = field(fields, name, path)
    if value.ndim != 2 or len(value) != size or value.shape[1] != (count or value.shape[1]) or not value.shape[1]:
        expected = f"{size}×{count}, as many columns as `u`" if count else f"{size}×T"
        raise BadInput(f"{path}: expected `{name}` of shape {expected}, got {shape_text(value)}")
    return value.astype(float).T.copy()
