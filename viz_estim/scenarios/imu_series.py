"""What an IMU's sensors say of the attitude each on its own, against motion capture: what a calibration is seen by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array, conjugate, multiply
from viz_estim.errors import BadInput
from viz_estim.scenarios.imu_calibration import Calibration
from viz_estim.scenarios.imu_data import truth_at
from viz_estim.scenarios.imu_files import ImuLog

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Series:
    """A set under some constants: (T, …) arrays, angles in degrees, NaN where there is none.

    time s from the first stamp. accel_deg (T, 2): roll, pitch of the accelerometer alone. gyro_deg, truth_deg (T, 3):
    roll, pitch, yaw. accel_error_deg (T,): the angle between gravity as read and as the truth has it; gyro_error_deg
    (T,): the geodesic angle from the truth to the integrated gyro.
    """

    time: Array
    accel_deg: Array
    gyro_deg: Array
    truth_deg: Array
    accel_error_deg: Array
    gyro_error_deg: Array


def series(log: ImuLog, calibration: Calibration, offset: float = 0.0) -> Series:
    """The set under these constants, the gyro integrated from the first truth on, through freezes and all.

    offset: how late (s) the truth's stamps are.
    """
    truth = truth_at(log.stamps, log, offset)
    if not np.isfinite(truth).any():
        name = log.files[0] if log.files else "the set"
        raise BadInput(f"{name}: no motion capture at the IMU's stamps, nothing to compare with")
    first = int(np.argmax(np.isfinite(truth).all(1)))
    rate, force = calibration.gyro(log.gyro), calibration.accel(log.accel)
    attitude = quaternions.exp(rate * np.diff(log.stamps, prepend=log.stamps[0])[:, None])
    attitude[:first], attitude[first] = np.nan, truth[first]
    stride = 1
    while stride < len(truth) - first:  # products of 2, 4, 8, … turns up to each sample (Hillis & Steele 1986)
        attitude[first + stride :] = multiply(attitude[first:-stride], attitude[first + stride :])
        stride *= 2
    x, y, z = force.T
    up = quaternions.rotate(conjugate(truth), _UP)
    cosine = (up * force).sum(1) / np.maximum(np.linalg.norm(force, axis=1), 1e-9)
    return Series(
        log.stamps - log.stamps[0],
        np.degrees(np.stack([np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))], axis=1)),
        np.degrees(quaternions.to_euler(attitude)),
        np.degrees(quaternions.to_euler(truth)),
        np.degrees(np.arccos(np.clip(cosine, -1, 1))),
        np.degrees(quaternions.length(quaternions.log(multiply(conjugate(truth), attitude)))[:, 0]),
    )
