"""Files of a vehicle with odometry and radio ranges to beacons: reading, checking, writing.

The Plaza sets' format (Djugash and Singh 2009), a .mat file, names in any case: `DR` [t, distance, turn] odometry, the
increments since the row before; `TD` [t, sender, beacon, range]; `TL` [beacon, x, y]; and, where the truth is known,
`GT` [t, x, y, heading]. Seconds, metres, radians; a row a moment.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios.reading import expand, field, mat_shapes, not_read, read_mat, shape_text

_NAME = "Plaza.mat"
_SUFFIXES = (".mat",)


@dataclass(frozen=True)
class PlazaLog:
    """One file. Stamps are those of the file, in s; rows as they stand there, readings and truth sorted by stamp.

    stamps (T,), odometry (T, 2): distance m and turn rad since the row before; range_stamps (M,), range_beacons (M,)
    index into beacons, ranges (M,) m; beacons (B, 2) m with their labels; truth_stamps (N,) and truth (N, 3): x, y, and
    heading without jumps. unplaced: how many readings were left out because nobody says where their beacon stands.
    """

    stamps: Array
    odometry: Array
    range_stamps: Array
    range_beacons: np.ndarray
    ranges: Array
    beacons: Array
    labels: tuple[str, ...]
    truth_stamps: Array
    truth: Array
    unplaced: int = 0
    files: tuple[Path, ...] = ()


def find(paths: list[Path]) -> Path:
    """The one file among files and folders, known by its fields; a file that was named must be one."""
    found = []
    for path in paths:
        files = expand(path, _SUFFIXES)
        found += [file for file in files if not path.is_dir() or _is_ours(file)]
    where = ", ".join(map(str, paths))
    if not found:
        what = "a .mat with `DR`, `TD` and `TL`"
        raise BadInput(f"{where}: no file of odometry and ranges there ({what}){not_read(paths)}")
    if len(found) > 1:
        raise BadInput(f"{len(found)} files of ranges found, a run takes one: name one of {', '.join(map(str, found))}")
    if found[0].suffix.lower() not in _SUFFIXES:
        raise BadInput(f"{found[0]}: expected a data file that ends in .mat")
    return found[0]


def load(path: Path) -> PlazaLog:
    """The file read and checked; NaN is allowed in the truth alone, whose rows without numbers are left out."""
    fields = read_mat(path)
    odometry = _finite(_table(fields, "DR", ("t", "distance", "turn"), path), "DR", path)
    readings = _finite(_table(fields, "TD", ("t", "sender", "beacon", "range"), path), "TD", path)
    places = _finite(_table(fields, "TL", ("beacon", "x", "y"), path), "TL", path)
    moments = len(np.unique(odometry[:, 0]))
    if moments < 2:
        raise BadInput(f"{path}: `DR` has {moments} stamps; at least 2 are needed")
    back = np.flatnonzero(np.diff(odometry[:, 0]) < 0)
    if len(back):
        raise BadInput(f"{path}: `DR` goes back in time at row {back[0] + 1}; sort its rows by time")
    ids, count = np.unique(places[:, 0], return_counts=True)
    if (count > 1).any():
        raise BadInput(f"{path}: `TL` has beacon {ids[count > 1][0]:g} twice; one place a beacon")
    # Whoever logged these did so block by block: in the real set two blocks came a minute late. The stamps are right.
    readings = readings[np.argsort(readings[:, 0], kind="stable")]
    placed = np.isin(readings[:, 2], places[:, 0])
    if not placed.any():
        known, named = (", ".join(f"{b:g}" for b in np.unique(x)) or "none" for x in (places[:, 0], readings[:, 2]))
        raise BadInput(f"{path}: no reading is of a beacon in `TL` (there: {known}; in `TD`: {named})")
    kept, order = readings[placed], np.argsort(places[:, 0])
    truth = _truth(fields, path)
    return PlazaLog(
        stamps=odometry[:, 0],
        odometry=odometry[:, 1:],
        range_stamps=kept[:, 0],
        range_beacons=np.searchsorted(places[order, 0], kept[:, 2]),
        ranges=kept[:, 3],
        beacons=places[order, 1:],
        labels=tuple(f"{b:g}" for b in places[order, 0]),
        truth_stamps=truth[:, 0],
        truth=truth[:, 1:],
        unplaced=int((~placed).sum()),
        files=(path,),
    )


def save(folder: Path, log: PlazaLog) -> list[Path]:
    """Writes the log in the Plaza sets' format."""
    path = folder / _NAME
    if path.exists():
        raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
    ids = np.array([float(label) for label in log.labels])
    sender = np.full(len(log.ranges), 2.0)
    fields = {
        "GT": np.column_stack([log.truth_stamps, log.truth]),
        "DR": np.column_stack([log.stamps, log.odometry]),
        "TD": np.column_stack([log.range_stamps, sender, ids[log.range_beacons], log.ranges]),
        "TL": np.column_stack([ids, log.beacons]),
    }
    # A tenth of a millimetre, far below what any of it is measured to, packs to half the size.
    scipy.io.savemat(path, {name: table.round(6) for name, table in fields.items()}, do_compression=True)
    return [path]


def _is_ours(path: Path) -> bool:
    try:
        return {"DR", "TD", "TL"} <= {name.upper() for name in mat_shapes(path)}
    except BadInput:  # another file's damage is not ours
        return False


def _table(fields: dict[str, Any], name: str, columns: tuple[str, ...], path: Path) -> Array:
    table = field(fields, name, path)
    if table.ndim != 2 or table.shape[1] != len(columns):
        raise BadInput(
            f"{path}: expected `{name}` of shape N×{len(columns)} ({', '.join(columns)}), got {shape_text(table)}"
        )
    return table.astype(float)


def _finite(table: Array, name: str, path: Path) -> Array:
    bad = np.argwhere(~np.isfinite(table))
    if len(bad):
        row, column = bad[0]
        raise BadInput(f"{path}: `{name}` is not a number at row {row}, column {column}; measurements must be finite")
    return table


def _truth(fields: dict[str, Any], path: Path) -> Array:
    """Rows (N, 4) of t, x, y and heading, sorted, one a stamp; none where the file has no truth."""
    if not any(name.upper() == "GT" for name in fields):
        return np.empty((0, 4))
    table = _table(fields, "GT", ("t", "x", "y", "heading"), path)
    table = table[np.isfinite(table).all(1)]
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    table[:, 3] = np.unwrap(table[:, 3])
    return table
