"""The Bayes filter over labels, and what several binary sensors say of them.

Thrun, Burgard and Fox, *Probabilistic Robotics* (2005), table 4.1, with all probabilities as logarithms: products are
sums, and hundreds of readings do not underflow. All functions take leading batch axes.

Letters, for K labels and s sensors: p (*, K) the belief, T (K, K) the transition, Tᵢⱼ = P(j next | i now).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from viz_estim.core.beliefs import Categorical
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick
from viz_estim.core.stages import DiscretePredict, DiscreteUpdate, Stage, names_its_failures

# Stands for log 0: a number that plots and files can hold, whose exponential is exactly 0, and so low that no run of
# readings brings back a label that is impossible (a sensor would have to say so some 10⁸ times).
LOG_ZERO = -1e9
_IMPOSSIBLE = LOG_ZERO / 2


def logarithms(probabilities: Array) -> Array:
    """log p of probabilities of any shape, LOG_ZERO where p is 0; ValueError where one is outside [0, 1]."""
    p = np.asarray(probabilities, float)
    if not ((p >= 0) & (p <= 1)).all():
        raise ValueError(f"expected probabilities between 0 and 1, got {p.tolist()}")
    return np.log(p, out=np.full(p.shape, LOG_ZERO), where=p > 0)


def normalised(log_weights: Array) -> Array:
    """Log probabilities (*, K) in proportion to the weights; ArithmeticError where all of them are zero."""
    total = np.logaddexp.reduce(log_weights, axis=-1, keepdims=True)
    if (total < _IMPOSSIBLE).any():
        raise ArithmeticError("all labels have probability 0: no label can give what was read")
    found = log_weights - total
    return np.where(found < _IMPOSSIBLE, LOG_ZERO, found)


def categorical(labels: Sequence[str], probabilities: Array) -> Categorical:
    """The belief with these probabilities (*, K); ValueError where they are not K or don't sum to one."""
    p = np.asarray(probabilities, float)
    if p.shape[-1:] != (len(labels),):
        raise ValueError(f"expected {len(labels)} probabilities, one a label, got an array {p.shape}")
    _sum_to_one(p, "the probabilities of the labels")
    return Categorical(tuple(labels), normalised(logarithms(p)))


@names_its_failures
def predict(belief: Categorical, T: Array, *, name: str = "predict") -> DiscretePredict:
    """The belief moved on: p'ⱼ = Σᵢ pᵢ·Tᵢⱼ, T (K, K) or (*, K, K)."""
    moved = np.logaddexp.reduce(belief.log_probabilities[..., :, None] + logarithms(T), axis=-2)
    return DiscretePredict(name, Categorical(belief.labels, normalised(moved)), T)


@names_its_failures
def update(
    belief: Categorical, readings: Mapping[str, Array], sensors: Mapping[str, Array], *, name: str = "update"
) -> DiscreteUpdate:
    """The belief after the readings: p'ⱼ ∝ pⱼ·Πᵢ P(zᵢ | j), the sensors' errors independent given the label.

    sensors: by name the probability (K,) that it says yes, by label. readings: 0 or 1 (*, 1) of those that gave one.
    ValueError for any other reading; ArithmeticError where no label can give these.
    """
    batch = belief.log_probabilities.shape[:-1]
    offered = np.broadcast_to([sensor in readings for sensor in sensors], (*batch, len(sensors)))
    silent = np.zeros((*batch, 1))
    z = np.concatenate([readings.get(sensor, silent) for sensor in sensors], axis=-1)
    if not ((z == 0) | (z == 1)).all():
        raise ValueError(f"expected readings that are 0 or 1, got {z.tolist()} of {', '.join(sensors)}")
    yes = np.stack([*sensors.values()])
    says = np.where(z[..., None] == 1, logarithms(yes), logarithms(1 - yes))
    log_likelihoods = np.where(offered[..., None], says, 0.0)
    after = normalised(belief.log_probabilities + log_likelihoods.sum(-2))
    return DiscreteUpdate(name, Categorical(belief.labels, after), tuple(sensors), z, offered, log_likelihoods)


@dataclass(frozen=True)
class DiscreteFilter:
    """An estimator: one prediction a step, then one update by all sensors that the tick has a reading of.

    transition T (K, K) is from one tick to the next, however long that takes; sensors as in `update`.
    """

    pure = True
    transition: Array
    sensors: Mapping[str, Array]

    def __post_init__(self) -> None:
        _sum_to_one(self.transition, "each row of the transition")

    def step(self, belief: Categorical, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        if tick.dt > 0:
            stage: Stage = predict(belief, self.transition)
            yield stage
            belief = stage.belief
        readings = {sensor: z for sensor, z in tick.measurements.items() if sensor in self.sensors}
        if readings:
            yield update(belief, readings, self.sensors)


def redrawn(prior: Array, stay: float) -> Array:
    """The transition (K, K) that keeps the label with probability `stay` and else draws it anew from the prior (K,).

    The prior is then also the share of each label in the long run; stay = 1 is a label that never changes.
    """
    return stay * np.eye(len(prior)) + (1 - stay) * prior


def categorical_metrics(log_probabilities: Array, truth: Array) -> dict[str, float]:
    """How good beliefs over labels (T, K) are, over the steps whose truth (T, 1), the label's index, is not NaN.

    accuracy: the share of steps whose most probable label is the true one; log_loss_nats: the mean of −log p(true
    label), which also punishes being sure and wrong (Good 1952).
    """
    known = np.isfinite(truth[:, 0])
    if not known.any():
        return {}
    rows, label = log_probabilities[known], truth[known, 0].astype(int)
    right = rows.argmax(-1) == label
    return {"accuracy": float(right.mean()), "log_loss_nats": float(-rows[np.arange(len(rows)), label].mean())}


def _sum_to_one(p: Array, what: str) -> None:
    if not np.allclose(p.sum(-1), 1, rtol=0, atol=1e-9):
        raise ValueError(f"{what} must sum to 1, got {p.sum(-1).tolist()}")
