"""An IMU's log made ready for a filter: SI units, the still prefix and the freezes found, the truth at its stamps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios import imu_calibration
from viz_estim.scenarios.imu_files import ImuLog
from viz_estim.scenarios.imu_health import frozen_gyro, still_prefix, stuck_at_first

_TRUTH_GAP = 0.1  # s: across a longer gap the truth is not interpolated

_FRAMES = 21  # over so many the reference's stamps are evened
_HANDS_ON = 2.0  # s before the motion is seen; of a short prefix, its second half


@dataclass(frozen=True)
class ImuData:
    """A log in SI units, (T, …) arrays: time s from the first stamp, gyro rad/s, accel m/s² (body x, y, z).

    truth (T, 4): quaternions body → world, NaN where there is none; frozen (T,): the gyro is stuck; still: the number
    of samples from the first on in which the sensor lies still; stuck: in so many of these, from the first on, the gyro
    is stuck. log: what was read, for the raw counts.
    """

    time: Array
    gyro: Array
    accel: Array
    truth: Array
    frozen: np.ndarray
    still: int
    stuck: int
    log: ImuLog
    notes: str


def prepare(log: ImuLog, calibration: Path | None) -> ImuData:
    """The log in SI units, its still prefix and freezes found, the truth brought to its stamps.

    The gyro's bias is read off the data's own rest, also beside a calibration: it wanders by a tenth of a count from
    set to set, which is 3° after half a minute. Only where there is no rest are the constants' own biases taken.
    """
    offset = 0.0
    if log.in_counts:
        constants = imu_calibration.DOCUMENTED if calibration is None else imu_calibration.load(calibration)
        offset = constants.truth_offset(log.files)
        accel = constants.accel(log.accel)
        rates = constants.gyro(log.gyro)
        still, stuck = (find(log.stamps, rates, accel) for find in (still_prefix, stuck_at_first))
        if still:
            constants = constants.with_gyro_bias(resting_gyro(log, still, stuck))
        gyro = constants.gyro(log.gyro)
    else:
        if calibration is not None:
            raise BadInput(f"{log.files[0]}: is in SI units; a calibration is for counts (.mat), leave it out")
        still, stuck = (find(log.stamps, log.gyro, log.accel) for find in (still_prefix, stuck_at_first))
        gyro = log.gyro - resting_gyro(log, still, stuck) if still else log.gyro
        accel = log.accel
    frozen = frozen_gyro(log.stamps, gyro, accel, np.zeros(3))
    truth = truth_at(log.stamps, log, offset)
    time = log.stamps - log.stamps[0]
    notes = _describe(time, truth, frozen, still)
    if offset:
        notes += f" The truth's stamps are {1e3 * offset:.0f} ms late, by the calibration, and corrected."
    return ImuData(time, gyro, accel, truth, frozen, still, stuck, log, notes)


def resting_gyro(log: ImuLog, still: int, stuck: int = 0) -> Array:
    """What the gyro (3,) reads at rest: its mean over the still prefix, but for the end, when a hand takes hold, and
    for the samples at the beginning in which it was stuck.

    The mean, not the median: counts are whole numbers, and the median's error of up to half a count is 10° after half
    a minute.
    """
    begin, end = log.stamps[stuck], log.stamps[still - 1]
    untouched = (log.stamps >= begin) & (log.stamps <= max(end - _HANDS_ON, 0.5 * (begin + end)))
    mean: Array = log.gyro[untouched].mean(0)
    return mean


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


def evened(stamps: Array) -> Array:
    """Motion capture takes its frames evenly and stamps them when they arrive, up to 10 ms early or late: a frame's
    stamp is the mean of those around it, unless frames are missing among them."""
    half = _FRAMES // 2
    out = stamps.copy()
    if len(stamps) > _FRAMES:
        inner, frame = slice(half, -half), float(np.median(np.diff(stamps)))
        whole = np.abs(stamps[2 * half :] - stamps[: -2 * half] - 2 * half * frame) < 3 * frame
        out[inner] = np.where(whole, scipy.ndimage.uniform_filter1d(stamps, _FRAMES)[inner], stamps[inner])
    return np.maximum.accumulate(out)


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
