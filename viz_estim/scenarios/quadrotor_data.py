"""A quadrotor's flight by the IMU's samples: readings and truth from several clocks brought together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios.quadrotor_files import Camera, Flight
from viz_estim.scenarios.quadrotor_simulation import carry_imu, smooth_path

_LONGEST_GAP = 0.1  # s that are bridged: of motion capture, and from a camera's reading to the IMU's next sample
_FEWEST, _SLOWEST = 12, 0.2  # poses that a smooth path needs, and s from one to the next


@dataclass(frozen=True)
class QuadrotorData:
    """A flight by the IMU's samples: time (T,) s, gyro (T, 3) rad/s, accel (T, 3) m/s² in body axes.

    pose (T, 7), position and quaternion body → world, and velocity (T, 3), the camera's in its own frame: NaN in rows
    at which no reading came. truth (T, 16): position, quaternion, velocity, the biases of gyro and accelerometer.
    """

    time: Array
    gyro: Array
    accel: Array
    pose: Array
    velocity: Array
    truth: Array
    notes: str
    files: tuple[Path, ...] = ()


def together(flight: Flight, camera: Camera, notes: str, files: tuple[Path, ...] = ()) -> QuadrotorData:
    """The camera's readings and the truth at the IMU's samples; a reading comes with the first sample after it."""
    T, end = len(flight.stamps), flight.stamps[-1]
    pose, velocity = np.full((T, 7), np.nan), np.full((T, 3), np.nan)
    at = np.searchsorted(flight.stamps, camera.stamps - 1e-6)
    wait = np.append(flight.stamps, np.inf)[at] - camera.stamps
    good = (wait < _LONGEST_GAP) & (camera.stamps > flight.stamps[0] - 1e-6)
    if not good.any():
        raise BadInput(
            f"{', '.join(map(str, files))}: no measured pose lies among the IMU's stamps ({flight.stamps[0]:g} to "
            f"{end:g} s); are the clocks of one flight?"
        )
    pose[at[good]], velocity[at[good]] = camera.pose[good], camera.velocity[good]
    truth = _at(flight.stamps, flight.vicon_stamps, flight.states)
    return QuadrotorData(flight.stamps, flight.gyro, flight.accel, pose, velocity, truth, notes, files)


def motion_capture(flight: Flight, file: Path) -> Camera:
    """Motion capture in the camera's place: its pose at each sample of the IMU, and no velocity."""
    pose = _at(flight.stamps, flight.vicon_stamps, flight.states)[:, :7]
    known = np.isfinite(pose).all(1)
    spacing = np.diff(flight.vicon_stamps)
    if not known.any() and len(spacing) and (apart := float(np.median(spacing))) > _LONGEST_GAP:
        raise BadInput(f"{file}: motion capture's poses are {apart:g} s apart, {_LONGEST_GAP} s is the most")
    return Camera(flight.stamps[known], pose[known], np.full((int(known.sum()), 3), np.nan))


def flight_along(camera: Camera, rng: np.random.Generator, file: Path) -> Flight:
    """An IMU carried along the smooth path through a camera's poses, read at the camera's stamps."""
    stamps, rows = np.unique(camera.stamps, return_index=True)
    if len(stamps) < _FEWEST:
        raise BadInput(f"{file}: has {len(stamps)} poses, a path through them needs at least {_FEWEST}")
    if (apart := float(np.median(np.diff(stamps)))) > _SLOWEST:
        raise BadInput(
            f"{file}: its poses are {apart:g} s apart, a path through them needs {_SLOWEST} s or less; add the "
            "studentdata file of the flight, or give stamps in s"
        )
    try:
        path = smooth_path(stamps, camera.pose[rows])
    except ValueError as error:
        raise BadInput(f"{file}: no smooth path goes through its poses ({error}); are there long gaps?") from error
    return carry_imu(rng, stamps, path)


def _at(times: Array, stamps: Array, states: Array) -> Array:
    """States (M, 16) at `times`, between samples (N, 16) at `stamps`; NaN outside, and in gaps that are too long."""
    found = np.full((len(times), states.shape[1]), np.nan)
    good = np.isfinite(states[:, :7]).all(1)
    stamps, states = stamps[good], states[good]
    if len(stamps) < 2:
        return found
    after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    known = (times >= stamps[0]) & (times <= stamps[-1]) & (stamps[after] - stamps[after - 1] <= _LONGEST_GAP)
    plain = [i for i in range(states.shape[1]) if not 3 <= i < 7]
    for i in plain:
        found[known, i] = np.interp(times[known], stamps, states[:, i])
    found[known, 3:7] = quaternions.slerp(times[known], stamps, states[:, 3:7])
    return found
