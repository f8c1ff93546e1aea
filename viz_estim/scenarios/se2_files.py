"""Files of a differential drive in the plane: the course's problem, and logs of a real one; reading, checking, writing.

Tables as `tables` reads them, columns in any order; others are left.

- A problem: `time` s, `left` and `right` (wheel rates in rad/s that act up to that time), and where there is a reading
  of the position `x` and `y` m.
- A log (the Wifibot's): `t` or `time` s, `vx` m/s by the wheels' odometry and `gyro` rad/s, each of the time up to that
  stamp, and where it is known the true pose `px`, `py` m, `theta` rad.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import wrap
from viz_estim.errors import BadInput
from viz_estim.scenarios.reading import expand
from viz_estim.scenarios.tables import Table, read_table

RADIUS, TRACK = 0.25, 0.5  # m: of a wheel, and between the wheels
_SUFFIXES = (".csv", ".txt")
_PROBLEM, _LOG = ("time", "left", "right"), ("time", "vx", "gyro")
_POSITION, _TRUTH = ("x", "y"), ("px", "py", "theta")
_WHAT = f"a .csv or .txt with the columns {', '.join(_PROBLEM)}, or {', '.join(_LOG)}"


@dataclass(frozen=True)
class Drive:
    """A drive: stamps time (T,) s from 0; rates (T, 2) in rad/s of the left and right wheel up to each stamp.

    positions (T, 2) m, NaN where there is no reading; truth (T, 3): x, y (m), heading (rad), NaN where it is absent.
    wheel_noise is that of its rates (rad/s), held from stamp to stamp; files are those it was read from.
    """

    time: Array
    rates: Array
    positions: Array
    truth: Array
    wheel_noise: float
    files: tuple[Path, ...] = ()


def wheel_rates(speed: Array, turn: Array) -> Array:
    """The rates (*, 2) in rad/s of the left and right wheel at which the drive goes so fast (m/s) and turns (rad/s)."""
    half = 0.5 * TRACK * turn
    return np.stack([speed - half, speed + half], axis=-1) / RADIUS


def speed_and_turn(rates: Array) -> tuple[Array, Array]:
    """The speed (*,) m/s and turn rate (*,) rad/s that wheel rates (*, 2) make: the inverse of `wheel_rates`."""
    left, right = rates[..., 0], rates[..., 1]
    return 0.5 * RADIUS * (left + right), RADIUS / TRACK * (right - left)


def problem() -> Drive:
    """The course's: constant commands, and a reading of the position every 5 s."""
    time = np.arange(0.0, 25.0, 5.0)
    read = [[np.nan, np.nan], [1.6561, 1.2847], [1.0505, 3.1059], [-0.9875, 3.2118], [-1.6450, 1.1978]]
    return Drive(time, np.tile([1.5, 2.0], (5, 1)), np.array(read), np.full((5, 3), np.nan), 0.05)


def find(paths: list[Path]) -> Path:
    """The one file among files and folders, known by its columns; a file that was named must be one."""
    found = [file for path in paths for file in expand(path, _SUFFIXES) if file in paths or _fits(file)]
    if not found:
        raise BadInput(f"{', '.join(map(str, paths))}: no file of a drive there ({_WHAT})")
    if len(found) > 1:
        raise BadInput(
            f"{len(found)} files of a drive found, a run takes one: name one of {', '.join(map(str, found))}"
        )
    if found[0].suffix.lower() not in _SUFFIXES:
        raise BadInput(f"{found[0]}: expected {_WHAT}")
    return found[0]


def load(path: Path) -> Drive:
    """The file read and checked; NaN is allowed where a reading of the position or the truth is absent, alone."""
    table = _table(path)
    needed = _PROBLEM if "left" in table or "right" in table else _LOG
    missing = [name for name in needed if name not in table]
    if missing:
        raise BadInput(f"{path}: missing {', '.join(missing)} ({table.held()}); expected {_WHAT}")
    columns = table.columns((*needed, *(_POSITION if needed is _PROBLEM else _TRUTH)))
    for name in needed:
        bad = np.flatnonzero(~np.isfinite(columns[name]))
        if len(bad):
            where = table.where(bad[0])
            raise BadInput(f"{path}: {where}, {name} is not a finite number; measurements must be finite")
    time = columns[needed[0]]
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        raise BadInput(f"{path}: {table.where(back[0] + 1)}, {needed[0]} does not increase; sort the rows by time")
    empty = np.full(len(time), np.nan)
    if needed is _PROBLEM:
        rates = np.stack([columns["left"], columns["right"]], axis=-1)
        positions, truth = (
            np.stack([columns.get(name, empty) for name in _POSITION], axis=-1),
            np.tile(empty, (3, 1)).T,
        )
        _whole(table, positions, "x and y")
        noise = problem().wheel_noise
    else:
        rates, positions = wheel_rates(columns["vx"], columns["gyro"]), np.tile(empty, (2, 1)).T
        truth = np.stack([columns.get(name, empty) for name in _TRUTH], axis=-1)
        truth[:, 2] = wrap(truth[:, 2])
        noise = 0.4  # what the Wifibot's log shows beside its truth
    return Drive(time - time[0], rates, positions, truth, noise, (path,))


def save(path: Path, drive: Drive) -> list[Path]:
    """Writes a problem as the CSV file that `load` reads."""
    if path.exists():
        raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
    table = np.column_stack([drive.time, drive.rates, drive.positions])
    cells = [["" if np.isnan(value) else repr(float(value)) for value in row] for row in table]
    lines = ["time,left,right,x,y", *(",".join(row) for row in cells), ""]
    path.write_text("\n".join(lines), encoding="utf-8")
    return [path]


def _table(path: Path) -> Table:
    return read_table(path, {"t": "time"})


def _fits(path: Path) -> bool:
    try:
        names = _table(path).names
    except BadInput:
        return False
    return set(_PROBLEM) <= set(names) or set(_LOG) <= set(names)


def _whole(table: Table, values: Array, names: str) -> None:
    known = np.isfinite(values)
    half = np.flatnonzero((known.any(1) & ~known.all(1)) | np.isinf(values).any(1))
    if len(half):
        raise BadInput(f"{table.path}: {table.where(half[0])}, {names} must both be finite, or both be empty")
