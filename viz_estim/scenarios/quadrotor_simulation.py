"""A quadrotor's flight, made up; and an IMU carried along a path: a made-up one, or one fitted through real poses."""

from __future__ import annotations

import numpy as np
import scipy

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick
from viz_estim.scenarios.quadrotor_files import Camera, Flight
from viz_estim.scenarios.quadrotor_model import DOWN, Imu, Model

SENSOR = Imu()
GYRO_BIAS, ACCEL_BIAS = 0.01, 0.1  # rad/s, m/s²: how far off a copy of the sensor is, one standard deviation
POSITION, ATTITUDE, VELOCITY = 0.005, 0.01, 0.1  # m, rad, m/s: noise of the camera's measurements

_EVERY = 5  # the camera sees at every fifth sample of the IMU
_KNOTS = 0.4  # s between a path's knots: of 0.1 to 0.6 s, the path whose velocity is nearest to the course's camera's
_DEGREE = 5


def simulate(rng: np.random.Generator, *, duration: float, noise_scale: float) -> tuple[Flight, Camera]:
    """A flight of `duration` s, its IMU at about 100 Hz and its camera at 20 Hz; noise_scale multiplies all noise."""
    dts = rng.uniform(0.009, 0.011, max(2 * _EVERY, round(duration / 0.01)))
    return fly(rng, np.concatenate([[0.0], np.cumsum(dts)]).round(6), noise_scale)


def fly(rng: np.random.Generator, stamps: Array, noise_scale: float = 1.0) -> tuple[Flight, Camera]:
    """A flight whose IMU is read at stamps (T,).

    The path is a sum of sines; thrust is along the body's z axis, as without drag, and the heading sways.
    """
    frequency, phase = 2 * np.pi * rng.uniform(0.1, 0.4, (4, 3)), rng.uniform(0, 2 * np.pi, (4, 3))
    angle = frequency * stamps[:, None, None] + phase
    size = np.array([0.35, 0.35, 0.2, 0.35])[:, None]  # m/s and, of the heading, rad/s
    path = (size / frequency * np.sin(angle)).sum(-1)
    velocity, acceleration = (size * np.cos(angle)).sum(-1), -(size * frequency * np.sin(angle)).sum(-1)
    up = quaternions.normalise(acceleration[:, :3] - DOWN)
    heading = np.stack([np.cos(path[:, 3]), np.sin(path[:, 3]), 0 * path[:, 3]], axis=-1)
    left = quaternions.normalise(quaternions.cross(up, heading))
    matrix = np.stack([quaternions.cross(left, up), left, up], axis=-1)
    attitude = quaternions.continuous(quaternions.from_matrix(matrix))
    states = np.concatenate([path[:, :3] + [0.0, 0.0, 1.5], attitude, velocity[:, :3]], axis=1)
    flight = carry_imu(rng, stamps, states, noise_scale)
    return flight, look(rng, flight, noise_scale)


def carry_imu(rng: np.random.Generator, stamps: Array, states: Array, noise_scale: float = 1.0) -> Flight:
    """What an IMU reads along states (T, 10) of position, attitude and velocity at stamps (T,).

    A reading is the mean over the interval that it ends, of rate and of specific force as seen from the attitude at its
    middle; the first repeats the second. Biases are drawn, and walk.
    """
    dt = np.diff(stamps)[:, None]
    q, v = states[:, 3:7], states[:, 7:10]
    turn = quaternions.log(quaternions.multiply(quaternions.conjugate(q[:-1]), q[1:]))
    middle = quaternions.multiply(q[:-1], quaternions.exp(0.5 * turn))
    force = quaternions.rotate(quaternions.conjugate(middle), np.diff(v, axis=0) / dt - DOWN)
    exact = np.concatenate([turn / dt, force], axis=1)
    drawn, walk, noise = (rng.standard_normal((len(stamps), 6)) for _ in range(3))
    steps = np.sqrt(np.diff(stamps, prepend=stamps[0]))[:, None] * walk
    steps *= np.repeat([SENSOR.gyro_bias_walk, SENSOR.accel_bias_walk], 3)
    steps[0] = drawn[0] * np.repeat([GYRO_BIAS, ACCEL_BIAS], 3)
    bias = noise_scale * np.cumsum(steps, axis=0)
    read = np.concatenate([exact[:1], exact]) + bias
    read += noise_scale * noise * np.repeat([SENSOR.gyro_noise, SENSOR.accel_noise], 3)
    return Flight(stamps, read[:, :3], read[:, 3:], stamps, np.concatenate([states, bias], axis=1))


def look(rng: np.random.Generator, flight: Flight, noise_scale: float = 1.0) -> Camera:
    """What the camera measures of a flight at every fifth of its samples; no velocity at the first."""
    model, at = Model("so3"), np.s_[::_EVERY]
    x, imu = flight.states[at], np.concatenate([flight.gyro, flight.accel], axis=1)[at]
    velocity = model.camera_velocity(x, Tick(0.0, 0.0, imu))
    noise = noise_scale * rng.standard_normal((len(x), 9)) * np.repeat([POSITION, ATTITUDE, VELOCITY], 3)
    attitude = quaternions.multiply(x[:, 3:7], quaternions.exp(noise[:, 3:6]))
    velocity = velocity + noise[:, 6:]
    velocity[0] = np.nan
    return Camera(flight.stamps[at], np.concatenate([x[:, :3] + noise[:, :3], attitude], axis=1), velocity)


def smooth_path(stamps: Array, pose: Array) -> Array:
    """States (T, 10), position, attitude and velocity, of the smooth path nearest to poses (T, 7) at stamps (T,).

    A least-squares spline of degree 5 in position and quaternion, its knots at stamps 0.4 s apart or more.
    """
    ends = stamps[0] + _KNOTS, stamps[-1] - _KNOTS
    inner = np.unique(stamps[np.searchsorted(stamps, np.arange(*ends, _KNOTS))]) if ends[1] > ends[0] else stamps[:0]
    knots = np.concatenate([np.repeat(stamps[0], _DEGREE + 1), inner, np.repeat(stamps[-1], _DEGREE + 1)])
    pose = np.concatenate([pose[:, :3], quaternions.continuous(pose[:, 3:])], axis=1)
    path = scipy.interpolate.make_lsq_spline(stamps, pose, knots, _DEGREE)
    at = path(stamps)
    return np.concatenate([at[:, :3], quaternions.normalise(at[:, 3:]), path(stamps, 1)[:, :3]], axis=1)
