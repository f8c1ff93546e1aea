"""A quadrotor's model: 15 states, the IMU as input, and what its camera says of them.

World z is up; body x forward, y left, z up. Position p (m) and velocity v (m/s) are in the world's frame, attitude is
body → world, the biases (rad/s, m/s²) are the IMU's own. The camera sits below the body and looks down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.euler import EulerAngles
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick
from viz_estim.core.spaces import SO3, Euclidean, Product, Space
from viz_estim.scenarios.imu_health import GRAVITY

Chart = Literal["so3", "zxy"]

_XYZ = ("x", "y", "z")
BODY_CAMERA = np.array([-0.04, 0.0, -0.03])
"""Where the camera is in the body's frame, m."""
BODY_Q_CAMERA = quaternions.multiply(
    quaternions.exp(np.array([np.pi, 0.0, 0.0])), quaternions.exp(np.array([0.0, 0.0, np.pi / 4]))
)
"""How it is mounted, camera → body: turned over to look down, then by π/4 about its own axis."""
DOWN = np.array([0.0, 0.0, -GRAVITY])


class Attitude(NamedTuple):
    """How an attitude is kept: its space, to and from a quaternion body → world, turned by a body rate for dt."""

    space: Space
    to_quaternion: Callable[[Array], Array]
    from_quaternion: Callable[[Array], Array]
    turn: Callable[[Array, Array, Array, float], Array]


@dataclass(frozen=True)
class Imu:
    """Standard deviations of an IMU: of a reading (rad/s, m/s²), and of its biases' walks (rad/s/√s, m/s²/√s)."""

    gyro_noise: float = 0.01
    accel_noise: float = 0.1
    gyro_bias_walk: float = 0.001
    accel_bias_walk: float = 0.01

    def noise(self, tick: Tick) -> Array:
        """Q (12, 12) of gyro, accelerometer and the walks of their biases over tick.dt."""
        white = [self.gyro_noise**2, self.accel_noise**2, 0.0, 0.0]
        walks = [0.0, 0.0, self.gyro_bias_walk**2, self.accel_bias_walk**2]
        return np.eye(12) * (np.repeat(white, 3) + tick.dt * np.repeat(walks, 3))


class Model:
    """The 15 states and how they move; `space` names their parts."""

    def __init__(self, chart: Chart) -> None:
        self.attitude = _ATTITUDES[chart]
        self.space = Product(
            position=Euclidean(_XYZ, "m"),
            attitude=self.attitude.space,
            velocity=Euclidean(_XYZ, "m/s"),
            gyro_bias=Euclidean(_XYZ, "rad/s"),
            accel_bias=Euclidean(_XYZ, "m/s²"),
        )
        self.pose = Product(position=self.space.parts["position"], attitude=self.attitude.space)

    def of(self, x: Array) -> Array:
        """States or poses in this chart (*, n) of ones that keep a quaternion (*, 16 or 7)."""
        return np.concatenate([x[..., :3], self.attitude.from_quaternion(x[..., 3:7]), x[..., 7:]], axis=-1)

    def move(self, x: Array, w: Array, tick: Tick) -> Array:
        """States (*, n) after tick.dt under its control (gyro, accel) (6,) and noises (*, 12).

        The readings hold over the step; the specific force is turned to the world by the attitude at its middle:
        a = R(q·Exp(½ω·dt))·f + g, v' = v + a·dt, p' = p + v·dt + ½a·dt².
        """
        assert tick.control is not None
        at, dt, u = self.space.at, tick.dt, tick.control
        attitude, v = x[..., at["attitude"]], x[..., at["velocity"]]
        # Noise and bias stand side by side: gyro, then accelerometer.
        biases = x[..., at["gyro_bias"].start :]
        rates = u - biases - w[..., :6]
        rate, force = rates[..., :3], rates[..., 3:]
        half = quaternions.exp((0.5 * dt) * rate)
        middle = quaternions.multiply(self.attitude.to_quaternion(attitude), half)
        step = dt * (quaternions.rotate(middle, force) + DOWN)
        turned = self.attitude.turn(attitude, rate, quaternions.multiply(middle, half), dt)
        p = x[..., :3] + dt * (v + 0.5 * step)
        return np.concatenate([p, turned, v + step, biases + w[..., 6:]], axis=-1)

    def camera_velocity(self, x: Array, tick: Tick) -> Array:
        """The camera's velocity in its own frame (*, 3): R_bcᵀ·(Rᵀ·v + (ω − b)×r), ω the tick's gyro."""
        assert tick.control is not None
        at = self.space.at
        q = self.attitude.to_quaternion(x[..., at["attitude"]])
        rate = tick.control[..., :3] - x[..., at["gyro_bias"]]
        v = quaternions.rotate(quaternions.conjugate(q), x[..., at["velocity"]])
        return (v + quaternions.cross(rate, BODY_CAMERA)) @ _BODY_R_CAMERA


_BODY_R_CAMERA = quaternions.to_matrix(BODY_Q_CAMERA)


def _same(q: Array) -> Array:
    return q


def _zxy_of_quaternion(q: Array) -> Array:
    """Roll, pitch, yaw (*, 3) of R = Rz(yaw)·Rx(roll)·Ry(pitch)."""
    R = quaternions.to_matrix(q)
    roll = np.arcsin(np.clip(R[..., 2, 1], -1.0, 1.0))
    return np.stack([roll, np.arctan2(-R[..., 2, 0], R[..., 2, 2]), np.arctan2(-R[..., 0, 1], R[..., 1, 1])], axis=-1)


def _zxy_turned(angles: Array, rate: Array, turned: Array, dt: float) -> Array:
    """angles + dt·G⁻¹·ω, the course's step: ω = G·(roll', pitch', yaw')."""
    roll, pitch = angles[..., 0], angles[..., 1]
    c, s = np.cos(pitch), np.sin(pitch)
    yaw_rate = (c * rate[..., 2] - s * rate[..., 0]) / np.cos(roll)
    roll_rate, pitch_rate = c * rate[..., 0] + s * rate[..., 2], rate[..., 1] - np.sin(roll) * yaw_rate
    return angles + dt * np.stack([roll_rate, pitch_rate, yaw_rate], axis=-1)


_ZXY = EulerAngles("zxy")
_ATTITUDES = {
    "so3": Attitude(SO3(), _same, _same, lambda attitude, rate, turned, dt: turned),
    "zxy": Attitude(_ZXY, _ZXY.to_quaternion, _zxy_of_quaternion, _zxy_turned),
}
