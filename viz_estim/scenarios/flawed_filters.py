"""Filters that are broken inside, each by one mistake that people make."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from viz_estim.core import kalman, quaternions
from viz_estim.core.beliefs import Gaussian, Particles, normal
from viz_estim.core.kalman import KalmanFilter
from viz_estim.core.measurement import Measurement, Sensor, transposed
from viz_estim.core.particle import ParticleFilter
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick
from viz_estim.core.spaces import SO3, Product
from viz_estim.core.stages import LinearPredict, Stage, Update
from viz_estim.core.unscented import UnscentedFilter


@dataclass(frozen=True)
class Sampling:
    """Adds a sample of the process noise to the predicted mean: a particle filter's habit in a Kalman filter."""

    filter: KalmanFilter

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        if tick.dt > 0:
            x, Q = belief.mean, self.filter.process_noise(belief.mean, tick)
            moved = normal(belief.space, self.filter.process(x, tick), Q, rng)
            stage = kalman.predict(belief, moved, self.filter.jacobian(x, tick), Q)
            yield stage
            belief = stage.belief
        yield from self.filter.step(belief, replace(tick, dt=0.0), rng)


@dataclass(frozen=True)
class Untransposed:
    """Predicts P' = F·P + Q: the transpose forgotten."""

    filter: KalmanFilter

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        if tick.dt > 0:
            x = belief.mean
            F, Q = self.filter.jacobian(x, tick), self.filter.process_noise(x, tick)
            belief = Gaussian(belief.space, self.filter.process(x, tick), F @ belief.cov + Q)
            yield LinearPredict("predict", belief, F, Q)
        yield from self.filter.step(belief, replace(tick, dt=0.0), rng)


@dataclass(frozen=True)
class Greedy:
    """Subtracts three times what a reading tells from the covariance."""

    filter: KalmanFilter

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        for stage in self.filter.step(belief, tick, rng):
            cov = stage.belief.cov
            if isinstance(stage, Update):
                K, S = stage.gain, stage.innovation.cov
                cov = cov - 2 * K @ S @ transposed(K)
            yield replace(stage, belief=Gaussian(belief.space, stage.belief.mean, cov))


@dataclass(frozen=True)
class Repeating:
    """Takes every reading in twice."""

    filter: KalmanFilter

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        for stage in self.filter.step(belief, tick, rng):
            yield stage
            belief = stage.belief
        for stage in self.filter.step(belief, replace(tick, dt=0.0), rng):
            yield replace(stage, name=f"{stage.name}/again")


def with_sensors(filter: KalmanFilter, change: Callable[[Sensor], Sensor]) -> KalmanFilter:
    """The filter with each of its sensors changed."""
    return replace(filter, sensors={name: change(sensor) for name, sensor in filter.sensors.items()})


def with_process_noise(filter: KalmanFilter, factor: float) -> KalmanFilter:
    """The filter with its Q multiplied."""
    return replace(filter, process_noise=lambda x, tick: factor * filter.process_noise(x, tick))


def transposed_block(sensor: Sensor) -> Sensor:
    """The square block of the Jacobian transposed: rows taken for columns."""
    right = sensor.jacobian
    assert right

    def jacobian(x: Array) -> Array:
        H = right(x).copy()
        m = H.shape[-2]
        H[..., :m] = transposed(H[..., :m])
        return H

    return replace(sensor, jacobian=jacobian)


class PlainMean(SO3):
    """Attitudes averaged as four plain numbers."""

    def mean(self, points: Array, weights: Array) -> Array:
        return (weights[..., None, :] @ points)[..., 0, :]


class Uncarried(SO3):
    """A covariance that stays behind in the tangent space at the old mean."""

    flat = True

    def transport(self, x: Array, delta: Array) -> Array:
        return np.broadcast_to(np.eye(3), (*delta.shape, 3))


# A recording describes a space by its kind: both are attitudes.
PlainMean.__name__ = Uncarried.__name__ = "SO3"


def in_space(belief: Gaussian, attitude: SO3) -> Gaussian:
    """The belief with another geometry of its attitude."""
    parts = belief.space.parts | {"attitude": attitude}  # type: ignore[attr-defined]
    return replace(belief, space=Product(**parts))


def seeing_heading(filter: UnscentedFilter) -> UnscentedFilter:
    """The accelerometer's model mixed with a world axis that is level, as by a tilted gravity."""
    sensor = filter.measurement.sensors["accel"]
    lean = 0.1 * np.array([1.0, 0.0, 0.0])

    def measure(x: Array) -> Array:
        return sensor.measure(x) + 9.81 * quaternions.rotate(quaternions.conjugate(x[..., :4]), lean)

    sensors = filter.measurement.sensors | {"accel": replace(sensor, measure=measure)}
    return replace(filter, measurement=Measurement(sensors))


@dataclass(frozen=True)
class Clamping:
    """Holds particles inside an area of low to high (n,)."""

    filter: ParticleFilter
    low: Array
    high: Array

    def step(self, belief: Particles, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        inside: Any = lambda x, tick, rng: np.clip(self.filter.propagate(x, tick, rng), self.low, self.high)  # noqa: E731
        yield from replace(self.filter, propagate=inside).step(belief, tick, rng)
