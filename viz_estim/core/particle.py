"""The particle filter: propagate, weigh, resample.

Gordon, Salmond and Smith (1993); Doucet and Johansen, *A tutorial on particle filtering and smoothing* (2011),
algorithm of section 4.1. Weights are logarithms throughout. All functions take leading batch axes: states (*, N, n),
log weights (*, N).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from viz_estim.core.beliefs import Particles, read_only
from viz_estim.core.discrete import LOG_ZERO
from viz_estim.core.quaternions import Array
from viz_estim.core.resampling import METHODS, Method
from viz_estim.core.run import Tick
from viz_estim.core.spaces import Space
from viz_estim.core.stages import Predict, Resample, Stage, Weigh, names_its_failures

Propagate = Callable[[Array, Tick, np.random.Generator], Array]
LogLikelihood = Callable[[Array, Tick], Array]


def equal(space: Space, states: Array) -> Particles:
    """The belief with these states (*, N, n), all of the same weight."""
    N = states.shape[-2]
    return Particles(space, states, np.full(states.shape[:-1], -np.log(N)))


@names_its_failures
def predict(
    belief: Particles, propagate: Propagate, tick: Tick, rng: np.random.Generator, *, name: str = "predict"
) -> Predict:
    """The belief after each particle is drawn anew from the process model, p(x' | x): the weights stay."""
    shown = read_only(belief.states)
    moved = propagate(shown, tick, rng)
    return Predict(name, Particles(belief.space, belief.states if moved is shown else moved, belief.log_weights))


@names_its_failures
def weigh(belief: Particles, log_likelihood: LogLikelihood, tick: Tick, *, name: str = "weigh") -> Weigh:
    """The belief after the tick's readings z: log w' = log w + log p(z | x) − log Σ w·p(z | x).

    ArithmeticError where no particle can give the readings.
    """
    log_likelihoods = np.maximum(log_likelihood(read_only(belief.states), tick), LOG_ZERO)  # log 0 is a number here
    log_weights = belief.log_weights + log_likelihoods
    best = np.maximum.reduce(log_weights, axis=-1, keepdims=True)
    if not all(one > LOG_ZERO / 2 for one in best.ravel().tolist()):  # nor NaN
        raise ArithmeticError("no particle has a likelihood above 0: none can give what was read")
    weights = log_weights - best
    np.exp(weights, out=weights)
    total = np.add.reduce(weights, axis=-1, keepdims=True)
    evidence = best + np.log(total)
    log_weights -= evidence
    after = Particles(belief.space, belief.states, log_weights)
    weights /= total
    object.__setattr__(after, "_weights", weights)  # so that a resampling need not take exponentials again
    return Weigh(name, after, log_likelihoods, evidence[..., 0], after.ess)


@lru_cache(maxsize=8)
def _equal_log_weights(N: int) -> Array:
    log_weights = np.full(N, -np.log(N))
    log_weights.flags.writeable = False  # many beliefs share it
    return log_weights


@lru_cache(maxsize=8)
def _numbers(count: int) -> np.ndarray:
    return np.arange(count)


@names_its_failures
def resample(
    belief: Particles,
    rng: np.random.Generator,
    method: Method = "systematic",
    where: np.ndarray | None = None,
    *,
    name: str = "resample",
) -> Resample:
    """The belief with N equal weights, each particle copied in proportion to the weight that it had.

    where (*,): the members of a batch that are resampled; the others stay as they are, each its own ancestor.
    """
    weights = belief.weights
    copies = METHODS[method](weights, rng)
    N, n = belief.states.shape[-2:]
    log_weights = _equal_log_weights(N) if copies.ndim == 1 else np.full(weights.shape, -np.log(N))
    if where is not None:
        copies = np.where(where[..., None], copies, 1)
        log_weights = np.where(where[..., None], log_weights, belief.log_weights)
    chosen = np.repeat(_numbers(copies.size), copies.ravel())
    states = belief.states.reshape(-1, n).take(chosen, axis=0).reshape(belief.states.shape)
    ancestors = (chosen if copies.ndim == 1 else chosen % N).reshape(copies.shape)
    distinct = np.asarray(np.count_nonzero(copies, axis=-1 if copies.ndim > 1 else None), float)
    return Resample(name, Particles(belief.space, states, log_weights), ancestors, distinct, belief.ess)


@dataclass(frozen=True)
class ParticleFilter:
    """An estimator: particles are propagated, weighed where the tick has readings, and then resampled.

    propagate(states, tick, rng) draws states (*, N, n) over tick.dt; log_likelihood(states, tick) is log p(z | x)
    (*, N) of all readings of the tick. threshold: resampled where the effective sample size is below this fraction
    of N; at 1 always.
    """

    pure = True
    propagate: Propagate
    log_likelihood: LogLikelihood
    resampling: Method = "systematic"
    threshold: float = 1.0

    def step(self, belief: Particles, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        if tick.dt > 0:
            moved = predict(belief, self.propagate, tick, rng)
            yield moved
            belief = moved.belief
        if not tick.measurements:
            return
        weighed = weigh(belief, self.log_likelihood, tick)
        yield weighed
        low = weighed.ess < self.threshold * belief.states.shape[-2]
        if self.threshold >= 1 or low.all():
            yield resample(weighed.belief, rng, self.resampling)
        elif low.any():
            yield resample(weighed.belief, rng, self.resampling, low)
