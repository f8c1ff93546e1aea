"""Attitude from an IMU: the data, and three filters over it.

The body's axes are x forward, y left, z up; the world's z is up. A resting, level accelerometer reads +9.81 on z.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.measurement import Measurement, Sensor
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, StandIn, Tick
from viz_estim.core.scenery import Box
from viz_estim.core.spaces import S2, SO3, Euclidean, Product
from viz_estim.core.stages import Predict, Stage
from viz_estim.core.unscented import UnscentedFilter, symmetric
from viz_estim.errors import BadInput
from viz_estim.scenarios import imu_files, imu_fit, imu_simulation
from viz_estim.scenarios.checks import at_most, positive, probability
from viz_estim.scenarios.imu_data import ImuData, prepare
from viz_estim.scenarios.imu_health import GRAVITY

Initial = Literal["accel", "truth"]
Frozen = Literal["ignore", "reject"]

# While the gyro is frozen a hand-held body still turns: its rate is taken as 0 ± 0.3 rad/s, which keeps the
# attitude within 1.5, 3.0 and 1.4° on the course's sets; leaving the rate to wander loses it by 12–77°.
# How that rate changes meanwhile nobody sees: the filter must not carry on the last one.
_UNSEEN_RATE_WALK = 3.0  # rad/s/√s
_STAND_IN = StandIn(np.zeros(3), 0.3**2 * np.eye(3))
_UP = np.array([0.0, 0.0, 1.0])
_LONGEST = 3600.0  # s that are simulated
_BODY = Box((0.9, 0.6, 0.2))
_RATE = Euclidean(("x", "y", "z"), "rad/s")


def imu(
    source: list[Path] | None,
    rng: np.random.Generator,
    *,
    calibration: Path | None = None,
    duration: float = 30.0,
    still: float = 3.0,
    freeze: float = 1.5,
    noise_scale: float = 1.0,
) -> ImuData:
    """An IMU's log from files, or a simulated one of `duration` s with a still prefix and a freeze of the gyro."""
    if source is not None:
        sets = imu_files.find_sets(source)
        if len(sets) > 1:
            names = ", ".join(str(file.name) for file, _ in sets)
            raise BadInput(f"{len(sets)} IMU files found, a run takes one: name one of {names}")
        return prepare(imu_files.load(*sets[0]), calibration)
    at_most(_LONGEST, duration=duration)
    if duration < still + max(2.0, freeze + 0.5) or min(still, freeze, noise_scale) < 0:
        raise BadInput(
            "a simulation needs duration ≥ still + 2 s and ≥ still + freeze + 0.5 s, none of them negative: "
            f"got duration={duration:g}, still={still:g}, freeze={freeze:g}, noise_scale={noise_scale:g}"
        )
    log, _ = imu_simulation.simulate(rng, duration=duration, still=still, freeze=freeze, noise_scale=noise_scale)
    return prepare(log, calibration)


def save(data: ImuData, folder: Path) -> list[Path]:
    """Writes simulated data in the course's format, as set 1 of the folder."""
    return imu_files.save_course(folder, 1, data.log)


def calibrate(paths: list[Path]) -> imu_fit.Fit:
    """The sensor's constants, fitted to motion capture over all sets among the paths."""
    return imu_fit.fit([imu_files.load(*one) for one in imu_files.find_sets(paths)])


def imu_gyro(
    data: ImuData, *, initial: Initial = "accel", gyro_noise: float = 0.015, initial_attitude_std: float = 0.05
) -> Scenario:
    """The gyro's rates integrated, nothing else: what drift and a freeze do to dead reckoning."""
    positive(gyro_noise=gyro_noise, initial_attitude_std=initial_attitude_std)
    space = Product(attitude=SO3())
    cov = initial_attitude_std**2 * np.eye(3)
    beliefs = _beliefs(data, initial, lambda q: Gaussian(space, q, cov))
    ticks = [_tick(data, k, k in beliefs, reads=("gyro",), control=data.gyro[k]) for k in range(len(data.time))]
    notes = (
        "The gyro's rates, integrated. Nothing corrects them: watch the **attitude error** leave its band, slowly by "
        "the bias that is left, at once where the gyro freezes."
    )
    return Scenario(GyroIntegrator(gyro_noise), beliefs, ticks, data.truth, {"body": _BODY}, _notes(notes, data))


def imu_ukf(
    data: ImuData,
    *,
    initial: Initial = "accel",
    frozen: Frozen = "ignore",
    gyro_noise: float = 0.015,
    accel_noise: float = 0.35,
    attitude_walk: float = 0.001,
    rate_walk: float = 0.25,
    gyro_gate: float | None = None,
    accel_gate: float | None = None,
    initial_attitude_std: float = 0.05,
    initial_rate_std: float = 0.1,
) -> Scenario:
    """Kraft's quaternion UKF: the state is attitude and rate, gyro and accelerometer are both measurements.

    Noises are standard deviations in rad/s and m/s², walks in rad/√s and rad/s/√s, initial ones in rad and rad/s; a
    gate is the probability with which a good reading passes. The defaults bring both sensors' NIS, pooled over the
    course's three sets, to the 3 that it should be.
    """
    positive(gyro_noise=gyro_noise, accel_noise=accel_noise, attitude_walk=attitude_walk, rate_walk=rate_walk)
    positive(initial_attitude_std=initial_attitude_std, initial_rate_std=initial_rate_std)
    space = Product(attitude=SO3(), rate=_RATE)
    Q_per_s = np.diag([attitude_walk**2] * 3 + [rate_walk**2] * 3)
    Q_unseen = np.diag([attitude_walk**2] * 3 + [max(rate_walk, _UNSEEN_RATE_WALK) ** 2] * 3)

    def constant_rate(x: Array, tick: Tick) -> Array:
        q = quaternions.multiply(x[..., :4], quaternions.exp(x[..., 4:] * tick.dt))
        return np.concatenate([q, x[..., 4:]], axis=-1)

    accelerometer = Sensor(
        Euclidean(("x", "y", "z"), "m/s²"),
        lambda x: GRAVITY * _up_in_body(x),
        accel_noise**2 * np.eye(3),
        probability("accel_gate", accel_gate),
        lambda mean: np.concatenate([_up_in_body(mean), np.zeros_like(mean[..., 4:])], axis=-1),
    )
    gyroscope = Sensor(_RATE, lambda x: x[..., 4:], gyro_noise**2 * np.eye(3), probability("gyro_gate", gyro_gate))
    estimator = UnscentedFilter(
        constant_rate,
        lambda tick: (Q_unseen if tick.stand_ins else Q_per_s) * tick.dt,
        Measurement({"accel": accelerometer, "gyro": gyroscope}),
        symmetric(6),
    )
    cov = np.diag([initial_attitude_std**2] * 3 + [initial_rate_std**2] * 3)
    beliefs = _beliefs(data, initial, lambda q: Gaussian(space, np.concatenate([q, np.zeros(3)]), cov))
    ticks = [
        _tick(data, k, k in beliefs, reject=frozen == "reject", accel=data.accel[k], gyro=data.gyro[k])
        for k in range(len(data.time))
    ]
    truth = np.concatenate([data.truth, np.full((len(data.time), 3), np.nan)], axis=1)
    notes = (
        "Attitude and rate by sigma points. **Propagated** points show how sure the filter is: a cloud that is long "
        "about the vertical is a heading that gravity cannot see. **NIS** above its band: a sensor says something "
        "that its noise does not allow."
    )
    return Scenario(estimator, beliefs, ticks, truth, {"body": _BODY}, _notes(notes, data))


def imu_ukf_gyro(
    data: ImuData,
    *,
    initial: Initial = "accel",
    frozen: Frozen = "ignore",
    gyro_noise: float = 0.015,
    accel_noise: float = 0.27,
    accel_gate: float | None = None,
    initial_attitude_std: float = 0.05,
) -> Scenario:
    """A UKF on attitude alone: the gyro drives the prediction, the accelerometer's direction corrects it."""
    positive(gyro_noise=gyro_noise, accel_noise=accel_noise, initial_attitude_std=initial_attitude_std)
    space = Product(attitude=SO3())

    def turned_by_gyro(x: Array, tick: Tick) -> Array:
        return quaternions.multiply(x, quaternions.exp(_rate(tick) * tick.dt))

    def rate_noise(tick: Tick) -> Array:
        std = np.sqrt(tick.stand_ins["gyro"].noise[0, 0]) if "gyro" in tick.stand_ins else gyro_noise
        return (std * tick.dt) ** 2 * np.eye(3)

    accelerometer = Sensor(
        S2(), _up_in_body, (accel_noise / GRAVITY) ** 2 * np.eye(2), probability("accel_gate", accel_gate), _up_in_body
    )
    estimator = UnscentedFilter(turned_by_gyro, rate_noise, Measurement({"accel": accelerometer}), symmetric(3))
    cov = initial_attitude_std**2 * np.eye(3)
    beliefs = _beliefs(data, initial, lambda q: Gaussian(space, q, cov))
    direction = data.accel / np.linalg.norm(data.accel, axis=1, keepdims=True)
    reject = frozen == "reject"
    rates = np.where(data.frozen[:, None] & reject, 0.0, data.gyro)
    ticks = [
        _tick(data, k, k in beliefs, reject=reject, control=rates[k], accel=direction[k]) for k in range(len(data.time))
    ]
    notes = (
        "The gyro turns the attitude, the direction of gravity corrects it. The accelerometer's view shows where each "
        "sigma point expects *up*, and where the reading says it is."
    )
    return Scenario(estimator, beliefs, ticks, data.truth, {"body": _BODY}, _notes(notes, data))


@dataclass(frozen=True)
class GyroIntegrator:
    """q' = q·Exp(ω·dt), the covariance carried by the same turn: P' = Fᵀ P F + (σ·dt)², F = R(Exp(ω·dt))."""

    pure = True
    gyro_noise: float

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        if tick.dt > 0:
            turn = quaternions.exp(_rate(tick) * tick.dt)
            F = quaternions.to_matrix(turn)
            mean = quaternions.normalise(quaternions.multiply(belief.mean, turn))
            cov = F.T @ belief.cov @ F + (self.gyro_noise * tick.dt) ** 2 * np.eye(3)
            yield Predict("predict", Gaussian(belief.space, mean, 0.5 * (cov + cov.T)))


def _up_in_body(x: Array) -> Array:
    """The world's up (*, 3) in body axes, for states (*, n) that begin with a quaternion; also gravity's blind axis."""
    w, i, j, k = x[..., 0], x[..., 1], x[..., 2], x[..., 3]
    up = np.empty((*x.shape[:-1], 3))
    up[..., 0], up[..., 1], up[..., 2] = 2 * (i * k - w * j), 2 * (j * k + w * i), w * w - i * i - j * j + k * k
    return up


def _beliefs(data: ImuData, initial: Initial, make: Callable[[Array], Gaussian]) -> dict[int, Gaussian]:
    """The start by step. A truth that comes while the sensor still lies still holds from step 0 on."""
    level = make(_level_start(data))
    if initial == "accel":
        return {0: level}
    known = np.isfinite(data.truth).all(1)
    if not known.any():
        raise BadInput("initial=truth needs motion capture, and this data has none: use initial=accel")
    first = int(np.argmax(known))
    start = make(data.truth[first])
    return {0: start} if first <= data.still else {0: level, first: start}


def _level_start(data: ImuData) -> Array:
    """Roll and pitch from gravity over the still prefix (or the first tenth of a second), heading 0."""
    x, y, z = data.accel[: data.still or max(1, int(np.searchsorted(data.time, 0.1)))].mean(0)
    return quaternions.from_euler(np.array([np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z)), 0.0]))


def _tick(
    data: ImuData,
    k: int,
    start: bool,
    *,
    reject: bool = False,
    reads: Sequence[str] = ("accel", "gyro"),
    control: Array | None = None,
    **readings: Array,
) -> Tick:
    """Sample k as a tick; no prediction where a belief is set. reject: a stand-in for the rate of a frozen gyro.

    reads: the sensors that the filter reads at all.
    """
    raw = {name: values[k] for name, values in (("accel", data.log.accel), ("gyro", data.log.gyro)) if name in reads}
    faults = {"gyro": "frozen"} if data.frozen[k] else {}
    stand_ins = {"gyro": _STAND_IN} if data.frozen[k] and reject else {}
    dt = 0.0 if start else float(data.time[k] - data.time[k - 1])
    return Tick(float(data.time[k]), dt, control, readings, raw, faults, stand_ins)


def _rate(tick: Tick) -> Array:
    assert tick.control is not None
    return tick.control


def _notes(text: str, data: ImuData) -> str:
    return f"{text}\n\n**This data:** {data.notes}"
