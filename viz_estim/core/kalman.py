"""The Kalman filter, linear and extended, on any space.

Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001), sections 5.2 (linear)
and 10.3 (extended); the covariance of the update in Joseph's form (their eq. 5.2.3-18). All functions take leading
batch axes.

Letters, for d directions of the state and m of the measurement: F (*, d, d) how a small change of the state moves on,
Q process noise, H (*, m, d) how it shows in the reading, R measurement noise, P covariance, S (*, m, m) innovation
covariance, K (*, d, m) gain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from viz_estim.core.beliefs import Gaussian, read_only
from viz_estim.core.measurement import Measurement, Sensor, gain, symmetrised, transposed
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick
from viz_estim.core.spaces import Space
from viz_estim.core.stages import Innovation, LinearPredict, Stage, Update, names_its_failures


@names_its_failures
def predict(belief: Gaussian, mean: Array, F: Array, Q: Array, *, name: str = "predict") -> LinearPredict:
    """The belief moved on: `mean` is the process model at the old mean, P' = F·P·Fᵀ + Q.

    F (*, d, d) is the model's derivative there, in the spaces' own directions.
    """
    cov = symmetrised(F @ belief.cov @ transposed(F) + Q)
    return LinearPredict(name, Gaussian(belief.space, mean, cov), F, Q)


@names_its_failures
def update(
    belief: Gaussian,
    z: Array,
    measurement: Measurement,
    *,
    noise: Array | None = None,
    offered: np.ndarray | None = None,
    name: str = "update",
) -> Update:
    """The belief after a reading z (*, n): K = P·Hᵀ·S⁻¹, mean ⊞ K·ν, (I − K·H)·P·(I − K·H)ᵀ + K·R·Kᵀ (Joseph).

    Joseph's form stays symmetric and positive definite for any gain, so also where a gate set columns of K to zero.
    The covariance is then carried to the tangent space at the new mean. noise: R in place of the measurement's own.
    """
    H = measurement.jacobian(belief.mean)
    R = measurement.noise if noise is None else noise
    predicted = measurement.measure(belief.mean)
    residual = measurement.space.minus(z, predicted)
    C = belief.cov @ transposed(H)
    S = symmetrised(H @ C + R)
    used = measurement.passes(residual, S)
    K = gain(C, S, used[..., measurement.part])
    delta = (K @ residual[..., None])[..., 0]
    A = np.eye(C.shape[-2]) - K @ H
    cov = A @ belief.cov @ transposed(A) + K @ R @ transposed(K)
    if not belief.space.flat:
        T = belief.space.transport(belief.mean, delta)
        cov = T @ cov @ transposed(T)
    if offered is None:
        offered = np.ones_like(used)
    blind = measurement.blind(belief.mean, C.shape[-2])
    innovation = Innovation(measurement.space, z, predicted, residual, S, R, C, used, offered, blind)
    mean = belief.space.plus(belief.mean, delta)
    return Update(name, Gaussian(belief.space, mean, symmetrised(cov)), innovation, K)


@dataclass(frozen=True)
class KalmanFilter:
    """An estimator: one prediction a step, then an update by each sensor that the tick has a reading of, in turn.

    process(x, tick) moves a state (*, n), jacobian(x, tick) is its F (*, d, d), process_noise(x, tick) its Q over
    tick.dt. The stage of a filter's only sensor is `update`, those of several are `update/NAME`.
    """

    pure = True
    process: Callable[[Array, Tick], Array]
    jacobian: Callable[[Array, Tick], Array]
    process_noise: Callable[[Array, Tick], Array]
    sensors: Mapping[str, Sensor]
    _measurements: dict[str, Measurement] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        each = {name: Measurement({name: sensor}) for name, sensor in self.sensors.items()}
        object.__setattr__(self, "_measurements", each)

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        if tick.dt > 0:
            x = read_only(belief.mean)
            stage: Stage = predict(belief, self.process(x, tick), self.jacobian(x, tick), self.process_noise(x, tick))
            yield stage
            belief = stage.belief
        for name, measurement in self._measurements.items():
            if name in tick.measurements:
                title = "update" if len(self.sensors) == 1 else f"update/{name}"
                stage = update(belief, tick.measurements[name], measurement, name=title)
                yield stage
                belief = stage.belief


def linear(F: Array, Q: Array, sensors: Mapping[str, Sensor], B: Array | None = None) -> KalmanFilter:
    """The linear filter x' = F·x + B·u + w, w ~ N(0, Q), whatever tick.dt is; u is the tick's control."""

    def process(x: Array, tick: Tick) -> Array:
        moved = (F @ x[..., None])[..., 0]
        return moved if B is None or tick.control is None else moved + (B @ tick.control[..., None])[..., 0]

    return KalmanFilter(process, lambda x, tick: F, lambda x, tick: Q, sensors)


def linear_sensor(space: Space, H: Array, R: Array, gate: float | None = None) -> Sensor:
    """A sensor that reads z = H·x + v, v ~ N(0, R)."""
    return Sensor(space, lambda x: (H @ x[..., None])[..., 0], R, gate, jacobian=lambda x: H)


def finite_differences(
    function: Callable[[Array], Array], x: Array, space: Space, image: Space, step: float = 1e-6
) -> Array:
    """The derivative (m, d) of a function from one space to another at x (n,), by central differences along the axes.

    An oracle for a hand-written Jacobian: they should agree to about step².
    """
    offsets = step * np.eye(len(space.axes))
    ahead, behind = function(space.plus(x, offsets)), function(space.plus(x, -offsets))
    here = function(x)
    return transposed(image.minus(ahead, here) - image.minus(behind, here)) / (2 * step)
