"""Plaza files made ready for a filter: readings put on the odometry's rows, truth at its stamps, and where to begin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import wrap
from viz_estim.errors import BadInput
from viz_estim.scenarios.plaza_files import PlazaLog
from viz_estim.scenarios.ranges import distances

_BRIDGED = 3.0  # typical spacings: truth is not interpolated across longer gaps
_TRAVEL = 30.0  # m of the path that the ranges alone are fitted to, to find where it begins
_GUESSES = 12  # headings that the fit is begun from


@dataclass(frozen=True)
class PlazaData:
    """Row k of the odometry is step k.

    time (T,) s from the first stamp; odometry (T, 2): distance m and turn rad since the moment before; ranges (T, B) m
    to each beacon, NaN where none came; truth (T, 3): x, y, heading, NaN where it is not known. notes: what a person
    should know of the file.
    """

    time: Array
    odometry: Array
    ranges: Array
    truth: Array
    log: PlazaLog
    notes: str


def prepare(log: PlazaLog) -> PlazaData:
    """The log on its odometry's rows.

    A range belongs to the row that is nearest in time: on the real set at most 0.1 s away, which at the mower's 1 m/s
    is 0.06 m (rms) beside a noise of half a metre; the row that follows would be 0.1 m late on the average. Of several
    readings of a beacon on one row their mean is taken. A reading farther than a typical spacing from every row is
    left out.
    """
    spacing = np.diff(log.stamps)
    typical = float(np.median(spacing[spacing > 0]))
    middle = 0.5 * (log.stamps[1:] + log.stamps[:-1])
    row = np.searchsorted(middle, log.range_stamps)
    near = np.abs(log.stamps[row] - log.range_stamps) <= typical
    if not near.any():
        raise BadInput(
            f"{', '.join(map(str, log.files))}: no range came while there was odometry (`TD` is from "
            f"{log.range_stamps[0]:g} to {log.range_stamps[-1]:g} s, `DR` from {log.stamps[0]:g} to "
            f"{log.stamps[-1]:g} s); give stamps of one clock"
        )
    count, total = (np.zeros((len(log.stamps), len(log.beacons))) for _ in range(2))
    np.add.at(count, (row[near], log.range_beacons[near]), 1)
    np.add.at(total, (row[near], log.range_beacons[near]), log.ranges[near])
    ranges = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    notes = [f"{len(log.labels)} beacons, {int(near.sum())} ranges on {len(log.stamps)} rows of odometry"]
    for number, what in (
        (int((count > 1).sum()), "times several of one beacon fell on one row and their mean is taken"),
        (int((~near).sum()), "came while there was no odometry and are left out"),
        (log.unplaced, "are of beacons without a place and are left out"),
    ):
        if number:
            notes.append(f"{number} {what}")
    return PlazaData(
        log.stamps - log.stamps[0], _at_once(log), ranges, truth_at(log.stamps, log), log, "; ".join(notes)
    )


def truth_at(stamps: Array, log: PlazaLog) -> Array:
    """The truth (T, 3) at other stamps (T,), interpolated; NaN outside of it and in its gaps."""
    if len(log.truth_stamps) < 2:
        return np.full((len(stamps), 3), np.nan)
    found = np.stack([np.interp(stamps, log.truth_stamps, column) for column in log.truth.T], axis=1)
    spacing = np.diff(log.truth_stamps)
    after = np.clip(np.searchsorted(log.truth_stamps, stamps), 1, len(spacing))
    seen = (stamps >= log.truth_stamps[0]) & (stamps <= log.truth_stamps[-1])
    seen &= (spacing[after - 1] <= _BRIDGED * np.median(spacing)) | np.isin(stamps, log.truth_stamps)
    found[:, 2] = wrap(found[:, 2])
    return np.where(seen[:, None], found, np.nan)


def advance(pose: Array, odometry: Array) -> Array:
    """Poses (*, 3) after a distance and a turn (*, 2), driven along the heading half-way through the turn."""
    distance, turn = odometry[..., 0], odometry[..., 1]
    along = pose[..., 2] + 0.5 * turn
    x, y = pose[..., 0] + distance * np.cos(along), pose[..., 1] + distance * np.sin(along)
    return np.stack([x, y, wrap(pose[..., 2] + turn)], axis=-1)


def located(data: PlazaData) -> tuple[int, Array, float]:
    """A row, the pose (3,) there and the ranges' scale, from what came before that row; BadInput where no range did.

    The first 30 m of the path by odometry are laid over the beacons so that the ranges fit: least squares with large
    misfits damped, over the pose and the ranges' common scale, from several headings.
    """
    travelled = np.cumsum(np.abs(data.odometry[:, 0]))
    last = int(min(np.searchsorted(travelled, travelled[0] + _TRAVEL), len(travelled) - 1))
    path = _dead_reckoned(data.odometry[: last + 1])
    rows, beacons = np.nonzero(np.isfinite(data.ranges[:last]))
    if not len(rows):
        raise BadInput(f"no range came in the first {_TRAVEL:g} m of the way: nothing says where it begins")
    places, readings = data.log.beacons, data.ranges[rows, beacons]

    def misfit(guess: Array) -> Array:
        c, s = np.cos(guess[2]), np.sin(guess[2])
        at = guess[:2] + path[rows, :2] @ np.array([[c, s], [-s, c]])
        return guess[3] * distances(at, places)[np.arange(len(rows)), beacons] - readings

    centre = places.mean(0)
    guesses = [np.array([*centre, heading, 1.0]) for heading in np.arange(_GUESSES) * 2 * np.pi / _GUESSES]
    fits = [scipy.optimize.least_squares(misfit, guess, loss="soft_l1") for guess in guesses]
    x, y, turn, scale = min(fits, key=lambda fit: fit.cost).x
    c, s = np.cos(turn), np.sin(turn)
    position = np.array([x, y]) + path[last, :2] @ np.array([[c, s], [-s, c]])
    return last, np.array([*position, wrap(path[last, 2] + turn)]), float(scale)


def _at_once(log: PlazaLog) -> Array:
    """The odometry with the increments of rows that share a stamp summed on the first of them: one moment, one move."""
    first = np.flatnonzero(np.diff(log.stamps, prepend=-np.inf) > 0)
    merged = np.zeros_like(log.odometry)
    merged[first] = np.add.reduceat(log.odometry, first, axis=0)
    return merged


def _dead_reckoned(odometry: Array) -> Array:
    """Poses (T, 3) by odometry alone, from zero at row 0, whose own increments lie before it."""
    moves = np.concatenate([np.zeros((1, 2)), odometry[1:]])
    heading = np.cumsum(moves[:, 1])
    along = heading - 0.5 * moves[:, 1]
    return np.stack([np.cumsum(moves[:, 0] * np.cos(along)), np.cumsum(moves[:, 0] * np.sin(along)), heading], axis=1)
