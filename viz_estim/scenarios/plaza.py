"""A vehicle in the plane by its odometry and radio ranges to beacons, as in the Plaza sets of Djugash and Singh (2009).

What the ranges of `Plaza1` say against its truth: they are 7 % too long (+2.8 m on the average, from 0.8 m nearby to
4.9 m at 65 m). With that, a bias of at most 0.1 m a beacon is left, and a noise of 0.54 m that is white and Gaussian
(kurtosis 3.0, autocorrelation at most 0.08), without outliers and without delay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.kalman import KalmanFilter
from viz_estim.core.measurement import Sensor
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.scenery import Landmarks
from viz_estim.core.spaces import SO2, Euclidean, Product, Space
from viz_estim.errors import BadInput
from viz_estim.scenarios import plaza_files, plaza_simulation
from viz_estim.scenarios.checks import at_most, positive, probability
from viz_estim.scenarios.plaza_data import PlazaData, advance, located, prepare
from viz_estim.scenarios.ranges import directions, distances

RangeBias = Literal["none", "constant", "estimate"]

# Of a start that is found from odometry and ranges alone: m, rad, and of the scale. On Plaza1 it is off by 0.9 m,
# 0.02 rad and 0.002, on six simulated drives by up to 0.65 m, 0.06 rad and 0.01.
_LOCATED_STD = (1.0, 0.1, 0.02)
# m: a bias that stands in for a scale too is as large as 5 m; beside a scale little is left of it, and a first reading
# that came by a detour must not pass for a bias.
_BIAS_STD = {"none": 0.0, "constant": 3.0, "estimate": 1.0}


def plaza(
    source: list[Path] | None,
    rng: np.random.Generator,
    *,
    duration: float = 150.0,
    rate: float = 5.0,
    range_noise: float = 0.54,
    range_scale: float = 0.07,
    outliers: float = 0.02,
) -> PlazaData:
    """A drive from a file, or a simulated one of `duration` s with biased ranges, some of them by a detour."""
    if source is not None:
        return prepare(plaza_files.load(plaza_files.find(source)))
    positive(duration=duration, rate=rate, range_noise=range_noise)
    at_most(1e6, duration=duration, rows=duration * rate)
    if duration < 5 or duration * rate < 10 or not 0 <= outliers < 1 or range_scale <= -1:
        raise BadInput(
            "a simulation needs duration ≥ 5 s and ≥ 10 rows, 0 ≤ outliers < 1 and range_scale > -1: "
            f"got duration={duration:g}, rate={rate:g}, outliers={outliers:g}, range_scale={range_scale:g}"
        )
    log = plaza_simulation.simulate(
        rng, duration=duration, rate=rate, range_noise=range_noise, range_scale=range_scale, outliers=outliers
    )
    return prepare(log)


def save(data: PlazaData, folder: Path) -> list[Path]:
    """Writes simulated data in the Plaza sets' format."""
    return plaza_files.save(folder, data.log)


def range_ekf(
    data: PlazaData,
    *,
    initial: Literal["truth", "ranges"] | None = None,
    range_bias: RangeBias = "estimate",
    range_noise: float = 0.54,
    distance_noise: float = 0.05,
    turn_noise: float = 0.01,
    gate: float | None = 0.999,
    initial_position_std: float = 0.1,
    initial_heading_std: float = 0.03,
    initial_bias_std: float | None = None,
    initial_scale_std: float = 0.1,
) -> Scenario:
    """An EKF on a vehicle's pose from odometry and ranges to beacons, with the ranges' bias estimated or not.

    range_bias: none; constant: one a beacon; estimate: one a beacon, and a scale that all share. initial: the truth
    where there is one, else the pose to which odometry and ranges of the first 30 m fit. Noises are standard deviations
    in m (a range), m/√m (distance driven) and rad/√s (heading), a gate is the probability with which a good reading
    passes. Measured on Plaza1 over all 9657 steps, where the odometry is off by 0.11 m in 11 m and 0.22 m in 32 m:
    mean NIS 1.02, position RMSE 0.31 m, 5 of 3496 ranges refused; constant: 1.9 and 1.4 m; none: 51 and 9 m. The
    truth's heading there is the gyro's own, integrated, so that errors of heading count its drift as the filter's.
    """
    positive(range_noise=range_noise, distance_noise=distance_noise, turn_noise=turn_noise)
    positive(initial_position_std=initial_position_std, initial_heading_std=initial_heading_std)
    positive(initial_bias_std=initial_bias_std, initial_scale_std=initial_scale_std)
    model = RangeModel(data.log.beacons, data.log.labels, range_bias)
    estimator = model.estimator(distance_noise, turn_noise, range_noise, probability("gate", gate))
    bias_std = initial_bias_std or _BIAS_STD[range_bias]

    def belief(pose: Array, scale: float, position_std: float, heading_std: float, scale_std: float) -> Gaussian:
        mean = np.concatenate([pose, np.zeros(model.biases), [scale] * model.scales])
        std = np.array(
            [position_std, position_std, heading_std] + model.biases * [bias_std] + model.scales * [scale_std]
        )
        return Gaussian(model.space, mean, np.diag(std**2))

    beliefs = _starts(data, initial, belief, (initial_position_std, initial_heading_std, initial_scale_std))
    ticks = [_tick(data, k, k in beliefs) for k in range(len(data.time))]
    truth = np.full((len(data.time), len(model.space.names)), np.nan)
    truth[:, :3] = data.truth
    known = np.isfinite(data.truth).any()
    scenery = {"beacons": Landmarks(data.log.beacons, data.log.labels)}
    return Scenario(estimator, beliefs, ticks, truth if known else None, scenery, _notes(data))


@dataclass(frozen=True)
class RangeModel:
    """The state, pose and what is estimated of the ranges' bias, and how it moves and is read."""

    beacons: Array
    labels: tuple[str, ...]
    range_bias: RangeBias

    @property
    def biases(self) -> int:
        """How many biases are part of the state."""
        return 0 if self.range_bias == "none" else len(self.labels)

    @property
    def scales(self) -> int:
        """How many scales are part of the state."""
        return int(self.range_bias == "estimate")

    @property
    def space(self) -> Product:
        parts: dict[str, Space] = {"position": Euclidean(("x", "y"), "m"), "heading": SO2()}
        if self.biases:
            parts["bias"] = Euclidean(self.labels, "m")
        if self.scales:
            parts["scale"] = Euclidean(("scale",))
        return Product(**parts)

    def estimator(
        self, distance_noise: float, turn_noise: float, range_noise: float, gate: float | None
    ) -> KalmanFilter:
        """The filter with one sensor a beacon, `range/LABEL`."""

        def process_noise(x: Array, tick: Tick) -> Array:
            """Q: an error of the distance lies along the way, one of the turn swings it."""
            distance, along = _driven(x, tick)
            G = np.zeros((*x.shape, 2))
            G[..., 0, 0], G[..., 1, 0], G[..., 2, 1] = np.cos(along), np.sin(along), 1.0
            G[..., 0, 1], G[..., 1, 1] = -0.5 * distance * np.sin(along), 0.5 * distance * np.cos(along)
            variance = np.empty((*np.shape(distance), 1, 2))
            variance[..., 0, 0], variance[..., 0, 1] = distance_noise**2 * np.abs(distance), turn_noise**2 * tick.dt
            return (G * variance) @ np.swapaxes(G, -1, -2)

        sensors = {f"range/{label}": self._sensor(i, range_noise, gate) for i, label in enumerate(self.labels)}
        return KalmanFilter(_process, _process_jacobian, process_noise, sensors)

    def _sensor(self, i: int, range_noise: float, gate: float | None) -> Sensor:
        """z = s·|p − beacon| + b; s is 1 and b is 0 where they are not estimated."""
        place = self.beacons[i : i + 1]

        def scale(x: Array) -> Array:
            return x[..., -1:] if self.scales else np.ones((*x.shape[:-1], 1))

        def measure(x: Array) -> Array:
            expected = scale(x) * distances(x[..., :2], place)
            return expected + x[..., 3 + i : 4 + i] if self.biases else expected

        def jacobian(x: Array) -> Array:
            H = np.zeros((*x.shape[:-1], 1, x.shape[-1]))
            H[..., :2] = scale(x)[..., None] * directions(x[..., :2], place)
            if self.biases:
                H[..., 3 + i] = 1.0
            if self.scales:
                H[..., -1] = distances(x[..., :2], place)
            return H

        return Sensor(Euclidean(("range",), "m"), measure, np.array([[range_noise**2]]), gate, jacobian=jacobian)


def _process(x: Array, tick: Tick) -> Array:
    assert tick.control is not None
    return np.concatenate([advance(x[..., :3], tick.control), x[..., 3:]], axis=-1)


def _process_jacobian(x: Array, tick: Tick) -> Array:
    distance, along = _driven(x, tick)
    F = np.broadcast_to(np.eye(x.shape[-1]), (*x.shape, x.shape[-1])).copy()
    F[..., 0, 2], F[..., 1, 2] = -distance * np.sin(along), distance * np.cos(along)
    return F


def _driven(x: Array, tick: Tick) -> tuple[Array, Array]:
    """How far the tick's odometry went, and in which direction from states (*, n)."""
    assert tick.control is not None
    return tick.control[..., 0], x[..., 2] + 0.5 * tick.control[..., 1]


def _starts(
    data: PlazaData, initial: str | None, belief: Callable[..., Gaussian], std: tuple[float, float, float]
) -> dict[int, Gaussian]:
    """The beliefs that are set: where the truth begins, or where the ranges have told the pose.

    Before that nothing counts: the filter starts in the middle of the beacons, as unsure as they are far apart.
    """
    known = np.isfinite(data.truth).all(1)
    if initial == "truth" and not known.any():
        raise BadInput("initial=truth needs a truth (`GT`), and this data has none: use initial=ranges")
    spread = float(data.log.beacons.std(0).max()) + 1.0
    lost = belief(np.array([*data.log.beacons.mean(0), 0.0]), 1.0, spread, 1.0, std[2])
    if known.any() and initial != "ranges":
        row = int(np.argmax(known))
        return {0: lost} | {row: belief(data.truth[row], 1.0, *std)}
    row, pose, scale = located(data)
    return {0: lost} | {row: belief(pose, scale, *_LOCATED_STD)}


def _tick(data: PlazaData, k: int, start: bool) -> Tick:
    """Row k as a tick; no prediction where a belief is set."""
    heard = np.flatnonzero(np.isfinite(data.ranges[k]))
    readings = {f"range/{data.log.labels[i]}": data.ranges[k, i : i + 1] for i in heard}
    dt = 0.0 if start else float(data.time[k] - data.time[k - 1])
    return Tick(float(data.time[k]), dt, data.odometry[k], readings)


def _notes(data: PlazaData) -> str:
    text = (
        "Odometry moves the pose, ranges correct it. With `range_bias=none` every innovation of `range/…` lies **off "
        "zero on one side** and NIS far above its band: the ranges are longer than the filter believes. With "
        "`range_bias=constant` each beacon's bias follows the distance **up and down** (`bias` in the tab *State*): "
        "ranges a few percent too long have no constant bias. With `range_bias=estimate` the common `scale` settles, "
        "and all of them with it. The **gate** refuses ranges that came by a detour (NIS counts them all the same); "
        "over a wrong model it refuses good ones, and may lock itself out."
    )
    return f"{text}\n\n**This data:** {data.notes}."
