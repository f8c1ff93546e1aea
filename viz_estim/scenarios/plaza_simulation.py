"""A vehicle among four beacons, made up: what a Plaza file would hold for a drive that is known."""

from __future__ import annotations

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.scenarios.plaza_files import PlazaLog
from viz_estim.scenarios.ranges import distances

_BEACONS = np.array([[-30.0, -18.0], [28.0, -22.0], [32.0, 20.0], [-24.0, 24.0]])
_SPEED = 1.1  # m/s, about
_READING = 0.25  # s from one range to the next


def simulate(
    rng: np.random.Generator, *, duration: float, rate: float, range_noise: float, range_scale: float, outliers: float
) -> PlazaLog:
    """A log of `duration` s with odometry at `rate` Hz and one range every quarter second, the beacons in turn.

    As in the real set a range is `range_scale` of itself too long, and 0.3 m or so besides, other for each beacon. The
    share `outliers` of the ranges came by a detour of 3 to 12 m. The odometry's distance is 1 % off.
    """
    start = 1000.0 + rng.uniform(0, 1e3)
    ticks = np.cumsum(np.concatenate([[0.0], rng.uniform(0.95, 1.05, int(duration * rate)) / rate]))
    phase = rng.uniform(0, 2 * np.pi)
    poses = _drive(ticks, phase)
    steps = np.diff(poses, axis=0)
    distance = 1.01 * np.hypot(steps[:, 0], steps[:, 1])
    distance += 0.04 * np.sqrt(distance) * rng.standard_normal(len(distance))
    turn = steps[:, 2] + 0.01 * np.sqrt(np.diff(ticks)) * rng.standard_normal(len(steps))
    odometry = np.concatenate([np.zeros((1, 2)), np.stack([distance, turn], axis=1)])

    stamps = np.arange(1.0, ticks[-1], _READING)
    stamps += rng.uniform(-0.02, 0.02, len(stamps))
    beacon = np.arange(len(stamps)) % len(_BEACONS)
    exact = distances(_drive(stamps, phase)[:, :2], _BEACONS)[np.arange(len(stamps)), beacon]
    bias = rng.normal(0, 0.3, len(_BEACONS))
    ranges = (1 + range_scale) * exact + bias[beacon] + range_noise * rng.standard_normal(len(stamps))
    detour = rng.random(len(stamps)) < outliers
    ranges[detour] += rng.uniform(3.0, 12.0, int(detour.sum()))
    return PlazaLog(
        stamps=start + ticks,
        odometry=odometry,
        range_stamps=start + stamps,
        range_beacons=beacon,
        ranges=ranges,
        beacons=_BEACONS,
        labels=("0", "1", "5", "6"),
        truth_stamps=start + ticks,
        truth=poses,
    )


def _drive(time: Array, phase: float) -> Array:
    """Poses (T, 3) on a closed curve that crosses itself in the middle of the beacons, about 40 m by 24 m."""
    a, b = _SPEED / 22 * time + phase, 2 * _SPEED / 22 * time + 2 * phase
    x, y = 20 * np.sin(a), 12 * np.sin(b)
    heading = np.arctan2(2 * 12 * np.cos(b), 20 * np.cos(a))
    return np.stack([x, y, np.unwrap(heading)], axis=1)
