"""An IMU's log made ready for a filter: SI units, the still prefix and the freezes found, the truth at its stamps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios import imu_calibration
from viz_estim.scenarios.imu_files import ImuLog
from viz_estim.scenarios.imu_health import frozen_gyro, still_prefix

_TRUTH_GAP = 0.1  # s: across a longer gap the truth is not interpolated


@dataclass(frozen=True)
class ImuData:
    """A log in SI units, (T, …) arrays: time s from the first stamp, gyro rad/s, accel m/s² (body x, y, z).

    truth (T, 4): quaternions body → world, NaN where there is none; frozen (T,): the gyro is stuck; still: the number
    of samples from the first on in which the sensor lies still. log: what was read, for the raw counts.
    """

    time: Array
    gyro: Array
    accel: Array
    truth: Array
    frozen: np.ndarray
    still: int
    log: ImuLog
    notes: str


def prepare(log: ImuLog, calibration: Path | None) -> ImuData:
    """The log in SI units, its still prefix and freezes found, the truth brought to its stamps."""
    if log.in_counts:
        constants = imu_calibration.DOCUMENTED if calibration is None else imu_calibration.load(calibration)
        accel = constants.accel(log.accel)
        typical = constants.with_gyro_bias(imu_calibration.TYPICAL_GYRO_BIAS)
        still = still_prefix(log.stamps, typical.gyro(log.gyro), accel)
        if constants.gyro_bias is None:
            # The mean, not the median: counts are whole numbers, and half a count is 10° after half a minute.
            constants = constants.with_gyro_bias(log.gyro[:still].mean(0)) if still else typical
        gyro = constants.gyro(log.gyro)
    else:
        if calibration is not None:
            raise BadInput(f"{log.files[0]}: is in SI units; a calibration is for counts (.mat), leave it out")
        still = still_prefix(log.stamps, log.gyro, log.accel)
        gyro = log.gyro - log.gyro[:still].mean(0) if still else log.gyro
        accel = log.accel
    frozen = frozen_gyro(log.stamps, gyro, accel, np.zeros(3))
    truth = truth_at(log.stamps, log)
    time = log.stamps - log.stamps[0]
    return ImuData(time, gyro, accel, truth, frozen, still, log, _describe(time, truth, frozen, still))


def truth_at(stamps: Array, log: ImuLog, offset: float = 0.0) -> Array:
    """The reference (T, 4) at IMU stamps + offset (s), by slerp; NaN outside it and across gaps over 0.1 s."""
    out = np.full((len(stamps), 4), np.nan)
    if len(log.truth_stamps) < 2:
        return out
    times = stamps + offset
    i = np.clip(np.searchsorted(log.truth_stamps, times, side="right") - 1, 0, len(log.truth_stamps) - 2)
    near = log.truth_stamps[i + 1] - log.truth_stamps[i] <= _TRUTH_GAP
    known = near & (times >= log.truth_stamps[0]) & (times <= log.truth_stamps[-1])
    out[known] = quaternions.slerp(times[known], log.truth_stamps, log.truth)
    return out


def intervals(flags: np.ndarray) -> list[tuple[int, int]]:
    """The runs of True in flags (T,), as first and last index, both inclusive."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]))).reshape(-1, 2)
    return [(int(first), int(end) - 1) for first, end in edges]


def _describe(time: Array, truth: Array, frozen: np.ndarray, still: int) -> str:
    """What was found in the data, as markdown."""
    lies = f"the sensor lies still until {time[still - 1]:.2f} s" if still else "the sensor moves from the start"
    stuck = ", ".join(f"{time[a]:.2f}–{time[b]:.2f} s" for a, b in intervals(frozen))
    seen = f"{np.isfinite(truth).all(1).mean():.0%} of the steps have a truth"
    return (
        f"{time[-1]:.1f} s of data; {lies}; {f'**the gyro is frozen at {stuck}**' if stuck else 'no freeze'}; {seen}."
    )
