"""The unscented Kalman filter on any space: sigma points, prediction, update.

One filter for every geometry: states are added and subtracted by the space's ⊞ and ⊟ (Hertzberg et al., 2013), which
for (attitude, rate) is E. Kraft, "A quaternion-based unscented Kalman filter for orientation tracking" (2003).
All functions take leading batch axes.

Letters, for d directions of the state and m of the measurement:
P (*, d, d) covariance, Q process noise, R measurement noise, C (*, d, m) cross-covariance, S (*, m, m) innovation
covariance, K (*, d, m) gain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

from viz_estim.core.beliefs import Gaussian, read_only
from viz_estim.core.measurement import Measurement, Sensor, gain, symmetrised, transposed
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick
from viz_estim.core.spaces import Euclidean, Product, Space
from viz_estim.core.stages import (
    Innovation,
    SigmaPoints,
    Stage,
    UnscentedPredict,
    UnscentedUpdate,
    names_its_failures,
)


class Rule(NamedTuple):
    """Where sigma points lie and what they weigh: points at mean ⊞ chol(P)·unit[i], unit (N, d)."""

    unit: Array
    mean_weights: Array
    cov_weights: Array


@cache
def symmetric(d: int) -> Rule:
    """The 2d points at ±√d·columns, equally weighted, none at the mean (Julier et al. 1995; Kraft 2003)."""
    unit = np.sqrt(d) * np.concatenate([np.eye(d), -np.eye(d)])
    weights = np.full(2 * d, 0.5 / d)
    return Rule(unit, weights, weights)


@cache
def scaled(d: int, alpha: float = 1e-3, beta: float = 2.0, kappa: float = 0.0) -> Rule:
    """The scaled 2d+1 points (Wan and van der Merwe 2000, eq. 15); the first lies at the mean."""
    lam = alpha**2 * (d + kappa) - d
    unit = np.sqrt(d + lam) * np.concatenate([np.zeros((1, d)), np.eye(d), -np.eye(d)])
    mean_weights = np.full(2 * d + 1, 0.5 / (d + lam))
    mean_weights[0] = lam / (d + lam)
    cov_weights = mean_weights.copy()
    cov_weights[0] += 1 - alpha**2 + beta
    return Rule(unit, mean_weights, cov_weights)


def draw(space: Space, mean: Array, cov: Array, rule: Rule) -> SigmaPoints:
    """Sigma points of N(mean, cov). LinAlgError where cov is not positive definite: nothing is added to mend it."""
    offsets = rule.unit @ np.swapaxes(np.linalg.cholesky(cov), -1, -2)
    return SigmaPoints(space, space.plus(mean[..., None, :], offsets), rule.mean_weights, rule.cov_weights)


def moments(sigma: SigmaPoints) -> tuple[Array, Array, Array]:
    """Mean (*, n), covariance (*, d, d) and error vectors (*, N, d) of sigma points (Kraft 2003)."""
    mean = sigma.space.mean(sigma.points, sigma.mean_weights)
    errors = sigma.space.minus(sigma.points, mean[..., None, :])
    return mean, transposed(errors) @ (sigma.cov_weights[:, None] * errors), errors


@names_its_failures
def predict(
    belief: Gaussian, move: Callable[[Array], Array], noise: Array, rule: Rule, *, name: str = "predict"
) -> UnscentedPredict:
    """The belief moved on, process noise Q added before: x' = move(x ⊞ w), w ~ N(0, Q) (Kraft 2003).

    move maps states (*, N, n) to states; noise Q (d, d).
    """
    drawn = draw(belief.space, belief.mean, belief.cov + noise, rule)
    propagated = SigmaPoints(belief.space, move(read_only(drawn.points)), drawn.mean_weights, drawn.cov_weights)
    mean, cov, _ = moments(propagated)
    return UnscentedPredict(name, Gaussian(belief.space, mean, symmetrised(cov)), drawn, propagated)


@lru_cache(maxsize=16)
def _with_noise(space: Space, q: int) -> Product:
    """The space of a state and the q numbers of its noise."""
    return Product(state=space, noise=Euclidean([f"w{i}" for i in range(q)]))


@names_its_failures
def predict_augmented(
    belief: Gaussian, move: Callable[[Array, Array], Array], noise: Array, rule: Rule, *, name: str = "predict"
) -> UnscentedPredict:
    """The belief moved on by x' = move(x, w), w ~ N(0, Q), with w among the sigma points (Julier and Uhlmann 2004).

    The rule is for d + q dimensions, noise Q (q, q); move maps states (*, N, n) and noises (*, N, q) to states.
    """
    d, q, n = belief.cov.shape[-1], noise.shape[-1], belief.mean.shape[-1]
    joint = np.zeros((*belief.cov.shape[:-2], d + q, d + q))
    joint[..., :d, :d], joint[..., d:, d:] = belief.cov, noise
    mean = np.concatenate([belief.mean, np.zeros((*belief.mean.shape[:-1], q))], axis=-1)
    space: Any = belief.space  # a protocol does not say that it can be hashed
    drawn = draw(_with_noise(space, q), mean, joint, rule)
    points = read_only(drawn.points)
    moved = move(points[..., :n], points[..., n:])
    propagated = SigmaPoints(belief.space, moved, drawn.mean_weights, drawn.cov_weights)
    mean, cov, _ = moments(propagated)
    return UnscentedPredict(name, Gaussian(belief.space, mean, symmetrised(cov)), drawn, propagated)


@names_its_failures
def update(
    belief: Gaussian,
    z: Array,
    measurement: Measurement,
    rule: Rule,
    *,
    sigma: SigmaPoints | None = None,
    noise: Array | None = None,
    offered: np.ndarray | None = None,
    measure: Callable[[Array], Array] | None = None,
    name: str = "update",
) -> UnscentedUpdate:
    """The belief after a reading z (*, n): K = C·S⁻¹, mean ⊞ K·ν, P − K·S·Kᵀ (Kraft 2003).

    The covariance is then carried to the tangent space at the new mean, fixed in the world's frame: Kraft's error
    vectors q_i·q̄⁻¹ are in that frame, ours in the body's, and the transport makes both the same filter.

    sigma: the prediction's own propagated points, which Kraft's filter maps into the measurement; without them, points
    are drawn from the belief. noise: R in place of the measurement's own; measure: the expected reading in place of its
    own, where that depends on the moment. A gated sensor moves nothing: its columns of K are zero.
    """
    if sigma is None:
        sigma = draw(belief.space, belief.mean, belief.cov, rule)
    expected = (measure or measurement.measure)(read_only(sigma.points))
    mapped = SigmaPoints(measurement.space, expected, sigma.mean_weights, sigma.cov_weights)
    R = measurement.noise if noise is None else noise
    predicted, spread, errors = moments(mapped)
    S = symmetrised(spread + R)
    state_errors: Array = belief.space.minus(sigma.points, belief.mean[..., None, :])
    C = transposed(state_errors) @ (sigma.cov_weights[:, None] * errors)
    residual = measurement.space.minus(z, predicted)
    used = measurement.passes(residual, S)
    K = gain(C, S, used[..., measurement.part])
    delta = (K @ residual[..., None])[..., 0]
    mean = belief.space.plus(belief.mean, delta)
    A = belief.space.transport(belief.mean, delta)
    cov = symmetrised(A @ (belief.cov - K @ S @ transposed(K)) @ transposed(A))
    blind = measurement.blind(belief.mean, cov.shape[-1])
    if offered is None:
        offered = np.ones_like(used)
    innovation = Innovation(measurement.space, z, predicted, residual, S, R, C, used, offered, blind)
    return UnscentedUpdate(name, Gaussian(belief.space, mean, cov), innovation, K, sigma, mapped)


@dataclass(frozen=True)
class UnscentedFilter:
    """An estimator: one prediction and one joint update a step, Kraft's sigma points carried from one to the other.

    process(points, tick) moves states; process_noise(tick) is Q (d, d) over tick.dt. A sensor with a stand-in on the
    tick is read as that (z, R), and its part counts as not offered.
    """

    pure = True
    process: Callable[[Array, Tick], Array]
    process_noise: Callable[[Tick], Array]
    measurement: Measurement
    rule: Rule

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        sigma = None
        if tick.dt > 0:
            predicted = predict(belief, lambda x: self.process(x, tick), self.process_noise(tick), self.rule)
            yield predicted
            belief, sigma = predicted.belief, predicted.propagated
        names = self.measurement.sensors
        readings = [tick.stand_ins[s].z if s in tick.stand_ins else tick.measurements[s] for s in names]
        noise, offered = self.measurement.noise, None
        if tick.stand_ins:
            noise, offered = noise.copy(), np.array([s not in tick.stand_ins for s in names])
            for name in names & tick.stand_ins.keys():
                noise[self.measurement.block(name)] = tick.stand_ins[name].noise
        z = np.concatenate(readings, axis=-1)
        yield update(belief, z, self.measurement, self.rule, sigma=sigma, noise=noise, offered=offered)


@dataclass(frozen=True)
class AugmentedFilter:
    """An estimator: one prediction a step with its noise among the points, then an update by each sensor in turn.

    process(points, noises, tick) moves states, process_noise(tick) is the noises' Q (q, q) over tick.dt; rule gives the
    points of any dimension. Sensors are read at their own rates: those that the tick has a reading of. expected[name],
    a function of states and tick, stands in for the `measure` of a sensor into whose reading the tick's control enters.
    The first update takes the prediction's points, a further one draws anew. The stage of a filter's only sensor is
    `update`, those of several are `update/NAME`.
    """

    pure = True
    process: Callable[[Array, Array, Tick], Array]
    process_noise: Callable[[Tick], Array]
    sensors: Mapping[str, Sensor]
    rule: Callable[[int], Rule]
    expected: Mapping[str, Callable[[Array, Tick], Array]] = field(default_factory=dict)
    _measurements: dict[str, Measurement] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        each = {name: Measurement({name: sensor}) for name, sensor in self.sensors.items()}
        object.__setattr__(self, "_measurements", each)

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        sigma, d = None, belief.cov.shape[-1]
        if tick.dt > 0:
            Q = self.process_noise(tick)
            rule = self.rule(d + Q.shape[-1])
            predicted = predict_augmented(belief, lambda x, w: self.process(x, w, tick), Q, rule)
            yield predicted
            belief, sigma = predicted.belief, predicted.propagated
        for name, measurement in self._measurements.items():
            if name in tick.measurements:
                title = "update" if len(self.sensors) == 1 else f"update/{name}"
                z, measure = tick.measurements[name], self._measure(name, tick)
                updated = update(belief, z, measurement, self.rule(d), sigma=sigma, measure=measure, name=title)
                yield updated
                belief, sigma = updated.belief, None

    def _measure(self, name: str, tick: Tick) -> Callable[[Array], Array] | None:
        """The reading expected at this tick, where it depends on it."""
        expected = self.expected.get(name)
        return None if expected is None else lambda x: expected(x, tick)
