"""A hand-held IMU and its motion capture, made up: what the course's files would hold for a motion that is known."""

from __future__ import annotations

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.scenarios.imu_calibration import (
    ACCEL_SIGNS,
    DOCUMENTED,
    MV_PER_COUNT,
    Calibration,
)
from viz_estim.scenarios.imu_files import ImuLog
from viz_estim.scenarios.imu_health import GRAVITY

_FINE = 1e-3  # s: the grid on which the motion is integrated
_GENTLE = 0.3  # of the full motion, at first
_STUCK = np.array([382, 383, 384])  # counts at which the real sensor freezes


def simulate(
    rng: np.random.Generator, *, duration: float, still: float, freeze: float, noise_scale: float
) -> tuple[ImuLog, Calibration]:
    """A log in counts of `duration` s with a still prefix of `still` s and a freeze of `freeze` s; and its constants.

    noise_scale multiplies the noise of all readings and of the reference (1: about that of the real sets).
    """
    constants = _constants(rng)
    grid = np.arange(0.0, duration + 0.5, _FINE)
    rate = _rates(grid, rng, still, duration)
    attitude = _integrate(rate, _tilted_start(rng))
    push = _hand(grid, rng, still, duration)

    start = 1.3e9 + rng.uniform(0, 1e6)
    stamps = _stamps(rng, duration, 0.0096, 0.0012)
    at = np.minimum((stamps / _FINE).astype(int), len(grid) - 1)
    gravity = quaternions.rotate(quaternions.conjugate(attitude[at]), np.array([0.0, 0.0, GRAVITY]))
    gyro = constants.gyro_bias + rate[at] * constants.gyro_sensitivity / MV_PER_COUNT
    accel = constants.accel_bias + ACCEL_SIGNS * (gravity + push[at]) * constants.accel_sensitivity / MV_PER_COUNT
    gyro = _counts(gyro + noise_scale * 0.5 * rng.standard_normal(gyro.shape))
    accel = _counts(accel + noise_scale * 0.4 * rng.standard_normal(accel.shape))
    if freeze > 0:
        # As in the real sets: soon after it was picked up, while it is turned gently.
        begin = min(still + rng.uniform(0.8, 1.6), duration - freeze)
        stuck = (stamps >= begin) & (stamps < begin + freeze)
        gyro[stuck] = _STUCK + rng.integers(-1, 2, (int(stuck.sum()), 3))

    truth_stamps = _stamps(rng, duration, 0.0100, 0.0004)
    seen = (truth_stamps > 0.1) & (truth_stamps < duration - 0.2)  # motion capture starts later and ends earlier
    truth_stamps = truth_stamps[seen]
    at = np.minimum((truth_stamps / _FINE).astype(int), len(grid) - 1)
    # To the stamp itself, not to the grid's last point: half of a millisecond is two errors of a fitted clock offset.
    truth = quaternions.multiply(attitude[at], quaternions.exp(rate[at] * (truth_stamps - grid[at])[:, None]))
    wobble = quaternions.exp(noise_scale * 0.003 * rng.standard_normal((len(truth), 3)))
    truth = quaternions.continuous(quaternions.multiply(truth, wobble))
    return ImuLog(start + stamps, accel, gyro, True, start + truth_stamps, truth), constants


def _constants(rng: np.random.Generator) -> Calibration:
    """Constants as another copy of the sensor would have them: within a percent or two of the documented ones."""
    return Calibration(
        accel_bias=DOCUMENTED.accel_bias + rng.uniform(-0.5, 0.5, 3),
        accel_sensitivity=DOCUMENTED.accel_sensitivity * rng.uniform(0.99, 1.01, 3),
        gyro_sensitivity=DOCUMENTED.gyro_sensitivity * rng.uniform(0.98, 1.02, 3),
        gyro_bias=DOCUMENTED.gyro_bias + rng.uniform(-0.5, 0.5, 3),
    )


def _waves(grid: Array, rng: np.random.Generator, size: float, low_hz: float, high_hz: float) -> Array:
    """A smooth random signal (N, 3): three sines an axis, of standard deviation `size`."""
    frequency, phase = rng.uniform(low_hz, high_hz, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
    waves = np.sin(2 * np.pi * frequency * grid[:, None, None] + phase)
    return size * np.sqrt(2.0 / 3.0) * waves.sum(-1)


def _moving(grid: Array, still: float, duration: float) -> Array:
    """0 while the sensor lies still, gentle for 4 s, then 1, smooth between (N, 1); it is put down a second early."""
    envelope = (
        _GENTLE * _smooth((grid - still) / 0.5) + (1 - _GENTLE) * _smooth((grid - still - 4.0) / 1.0)
    ) * _smooth((duration - 1.0 - grid) / 0.5)
    return envelope[:, None]


def _smooth(x: Array) -> Array:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


def _rates(grid: Array, rng: np.random.Generator, still: float, duration: float) -> Array:
    return _moving(grid, still, duration) * _waves(grid, rng, 1.2, 0.08, 0.6)


def _hand(grid: Array, rng: np.random.Generator, still: float, duration: float) -> Array:
    """The hand's own accelerations (m/s²), which an accelerometer cannot tell from gravity."""
    return _moving(grid, still, duration) * _waves(grid, rng, 0.35, 0.5, 3.0)


def _tilted_start(rng: np.random.Generator) -> Array:
    return quaternions.from_euler(np.array([*rng.normal(0, 0.03, 2), rng.normal(0, 0.05)]))


def _integrate(rate: Array, start: Array) -> Array:
    """Attitudes (N, 4) after body rates (N, 3), each held for one grid step."""
    steps = quaternions.exp(rate * _FINE)
    attitude = np.empty((len(rate), 4))
    attitude[0] = start
    quaternions.accumulate(attitude, steps)
    return quaternions.normalise(attitude)


def _stamps(rng: np.random.Generator, duration: float, dt: float, jitter: float) -> Array:
    """Jittered stamps from 0 to duration (s)."""
    return np.cumsum(np.concatenate([[0.0], rng.uniform(dt - jitter, dt + jitter, int(duration / dt))]))


def _counts(values: Array) -> Array:
    return np.clip(np.round(values), 0, 1023)
