"""A quadrotor with an IMU and a camera that looks down: the flight, and two unscented filters over it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.consistency import rms
from viz_estim.core.measurement import Sensor
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.scenery import Box
from viz_estim.core.scenery import Path as Line
from viz_estim.core.spaces import Euclidean
from viz_estim.core.unscented import AugmentedFilter, Rule, scaled
from viz_estim.errors import BadInput
from viz_estim.scenarios import quadrotor_files, quadrotor_simulation
from viz_estim.scenarios.checks import at_most, positive, probability
from viz_estim.scenarios.quadrotor_data import QuadrotorData, flight_along, motion_capture, together
from viz_estim.scenarios.quadrotor_files import Camera, Flight
from viz_estim.scenarios.quadrotor_model import Chart, Imu, Model

_BODY = Box((0.3, 0.3, 0.08))


def quadrotor(
    source: list[Path] | None, rng: np.random.Generator, *, duration: float = 10.0, noise_scale: float = 1.0
) -> QuadrotorData:
    """A quadrotor's flight from files, or a simulated one of `duration` s.

    A camera's file without a flight's has no IMU: one is then simulated along a smooth path through its poses.
    """
    if source is None:
        positive(**{"data.duration": duration, "data.noise_scale": noise_scale})
        at_most(3600.0, **{"data.duration": duration})
        flight, camera = quadrotor_simulation.simulate(rng, duration=duration, noise_scale=noise_scale)
        return together(flight, camera, "a simulated flight; the truth is exact.")
    flight_file, camera_file = quadrotor_files.find(source)
    files = tuple(file for file in (flight_file, camera_file) if file)
    seen = quadrotor_files.load_camera(camera_file) if camera_file else None
    if flight_file:
        flight = quadrotor_files.load_flight(flight_file)
        if seen:
            known = "the truth is motion capture" if len(flight.states) else "nothing tells the truth"
            return together(flight, seen, f"measured by the camera; {known}.", files)
        seen = motion_capture(flight, flight_file)
        notes = (
            "no camera's measurements, so that motion capture serves as the measured pose, and is the truth too: the "
            "errors show how closely the filter follows it, no more."
        )
        return together(flight, seen, notes, files)
    assert seen is not None
    flight = flight_along(seen, rng, files[0])
    notes = (
        "the file has no IMU: one is simulated along a smooth path through the file's poses, and **that path is the "
        "truth here**: errors are against the path, not against the flight. Pose and velocity are the camera's, whose "
        "errors are slow (its velocity lags), not white: with velocity NIS lies below its band and NEES above it."
    )
    return together(flight, seen, notes, files)


def save(data: QuadrotorData, folder: Path) -> list[Path]:
    """Writes simulated data in the course's formats, as flight 1 of the folder."""
    seen = np.isfinite(data.pose).all(1)
    flight = Flight(data.time, data.gyro, data.accel, data.time, data.truth)
    return quadrotor_files.save(folder, 1, flight, Camera(data.time[seen], data.pose[seen], data.velocity[seen]))


def quadrotor_ukf_pose(
    data: QuadrotorData,
    *,
    attitude: Chart = "so3",
    gyro_noise: float = 0.01,
    accel_noise: float = 0.1,
    gyro_bias_walk: float = 0.001,
    accel_bias_walk: float = 0.01,
    position_noise: float = 0.005,
    attitude_noise: float = 0.01,
    gate: float | None = None,
    alpha: float = 0.5,
    beta: float = 2.0,
    kappa: float = 0.0,
    initial_velocity_std: float = 0.5,
    initial_gyro_bias_std: float = 0.01,
    initial_accel_bias_std: float = 0.1,
) -> Scenario:
    """A UKF on pose, velocity and the IMU's biases: the IMU drives it, the camera's pose corrects it.

    Noises are standard deviations of one reading (rad/s, m/s², m, rad), walks in rad/s/√s and m/s²/√s; alpha, beta,
    kappa place the scaled sigma points (the course's 0.001, 2, 1 give the same numbers, and a cloud too small to see).
    attitude=zxy keeps it as the course's Euler angles, R = Rz·Rx·Ry. It starts at the first pose.
    """
    positive(position_noise=position_noise, attitude_noise=attitude_noise)
    model = Model(attitude)
    noise = np.diag([position_noise**2] * 3 + [attitude_noise**2] * 3)
    sensor = Sensor(model.pose, lambda x: x[..., : len(model.pose.names)], noise, probability("gate", gate))
    imu = Imu(gyro_noise, accel_noise, gyro_bias_walk, accel_bias_walk)
    initial = (initial_velocity_std, initial_gyro_bias_std, initial_accel_bias_std)
    estimator = AugmentedFilter(model.move, imu.noise, {"pose": sensor}, _points(alpha, beta, kappa))
    notes = (
        "The IMU carries the state on, every pose pulls it back: between poses the ellipsoid of **position** grows. "
        "Only turning and accelerating part the **biases** from attitude and gravity, so watch their bands close."
    )
    return _scenario(data, model, estimator, imu, noise, initial, {"pose": model.of(data.pose)}, notes)


def quadrotor_ukf_velocity(
    data: QuadrotorData,
    *,
    attitude: Chart = "so3",
    gyro_noise: float = 0.01,
    accel_noise: float = 0.1,
    gyro_bias_walk: float = 0.001,
    accel_bias_walk: float = 0.01,
    velocity_noise: float = 0.1,
    gate: float | None = None,
    alpha: float = 0.5,
    beta: float = 2.0,
    kappa: float = 0.0,
    initial_position_std: float = 0.005,
    initial_attitude_std: float = 0.01,
    initial_velocity_std: float = 0.5,
    initial_gyro_bias_std: float = 0.01,
    initial_accel_bias_std: float = 0.1,
) -> Scenario:
    """The same UKF corrected by the camera's velocity alone: position and heading are dead reckoning.

    Parameters as those of quadrotor-ukf-pose; velocity_noise in m/s. It starts at the first pose.
    """
    positive(velocity_noise=velocity_noise)
    positive(initial_position_std=initial_position_std, initial_attitude_std=initial_attitude_std)
    if not np.isfinite(data.velocity).any():
        raise BadInput(
            f"{', '.join(map(str, data.files))}: no camera's velocity there; add the proj2_dataset file of the flight, "
            "or take quadrotor-ukf-pose"
        )
    model = Model(attitude)
    sensor = Sensor(
        Euclidean(("x", "y", "z"), "m/s"),
        lambda x: model.camera_velocity(x, Tick(0.0, 0.0, np.zeros(6))),
        velocity_noise**2 * np.eye(3),
        probability("gate", gate),
    )
    imu = Imu(gyro_noise, accel_noise, gyro_bias_walk, accel_bias_walk)
    initial = (initial_velocity_std, initial_gyro_bias_std, initial_accel_bias_std)
    pose_noise = np.diag([initial_position_std**2] * 3 + [initial_attitude_std**2] * 3)
    expected = {"velocity": model.camera_velocity}
    estimator = AugmentedFilter(model.move, imu.noise, {"velocity": sensor}, _points(alpha, beta, kappa), expected)
    notes = (
        "A velocity says nothing of **position** and **heading**: their bands grow. It does hold roll and pitch, "
        "since a wrong tilt turns gravity into an acceleration that the camera does not see. Compare "
        "`velocity_rmse_mps` with `camera_velocity_rmse_mps`, the camera's own."
    )
    scenario = _scenario(data, model, estimator, imu, pose_noise, initial, {"velocity": data.velocity}, notes)
    return replace(scenario, facts=_camera_error(data))


def _camera_error(data: QuadrotorData) -> dict[str, float]:
    """The RMSE of the camera's velocity against the truth's at the camera, where both are known."""
    truth = np.concatenate([data.truth[:, :10], np.nan_to_num(data.truth[:, 10:])], axis=1)
    tick = Tick(0.0, 0.0, np.concatenate([data.gyro, data.accel], axis=1))
    error = data.velocity - Model("so3").camera_velocity(truth, tick)
    known = np.isfinite(error).all(1)
    return {"camera_velocity_rmse_mps": rms(error[known])} if known.any() else {}


def _points(alpha: float, beta: float, kappa: float) -> Callable[[int], Rule]:
    """The scaled rule of any dimension."""
    positive(alpha=alpha)
    if not (kappa > -15 and np.isfinite(kappa) and np.isfinite(beta)):
        raise BadInput(f"kappa must be above -15, the number of states, and beta finite: got {kappa:g} and {beta:g}")
    return partial(scaled, alpha=alpha, beta=beta, kappa=kappa)


def _scenario(
    data: QuadrotorData,
    model: Model,
    estimator: AugmentedFilter,
    imu: Imu,
    pose_noise: Array,
    initial: tuple[float, float, float],
    readings: dict[str, Array],
    notes: str,
) -> Scenario:
    """The estimator over the flight, started at its first pose, which is then no reading any more.

    initial: standard deviations at the start, of velocity and of the two biases, which all start at 0.
    """
    velocity, gyro_bias, accel_bias = initial
    positive(initial_velocity_std=velocity, initial_gyro_bias_std=gyro_bias, initial_accel_bias_std=accel_bias)
    positive(gyro_noise=imu.gyro_noise, accel_noise=imu.accel_noise)
    positive(gyro_bias_walk=imu.gyro_bias_walk, accel_bias_walk=imu.accel_bias_walk)
    cov = np.diag(np.repeat([0.0, 0.0, velocity**2, gyro_bias**2, accel_bias**2], 3))
    cov[:6, :6] = pose_noise
    first = int(np.argmax(np.isfinite(data.pose).all(1)))
    start = Gaussian(model.space, model.of(np.concatenate([data.pose[first], np.zeros(9)])), cov)
    controls = np.concatenate([data.gyro, data.accel], axis=1)
    dts = np.diff(data.time, prepend=data.time[0])
    dts[first] = 0.0
    ticks = [
        Tick(
            float(data.time[k]),
            float(dts[k]),
            controls[k],
            {name: values[k] for name, values in readings.items() if k != first and np.isfinite(values[k]).all()},
            {"gyro": data.gyro[k], "accel": data.accel[k]},
        )
        for k in range(len(data.time))
    ]
    line = data.truth[np.isfinite(data.truth[:, :3]).all(1), :3]
    return Scenario(
        estimator,
        {0: start, first: start},
        ticks,
        model.of(data.truth),
        {"body": _BODY} | ({"path": Line(line)} if len(line) > 1 else {}),
        f"{notes}\n\n**This data:** {data.notes}",
    )
