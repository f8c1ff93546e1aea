"""The records of a step. A stage is frozen and carries the belief *after* it, with what led there.

What a stage holds is named by its fields and understood by their types: the recorder turns a `SigmaPoints` into points,
an `Innovation` into plots and NIS, an array into numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from viz_estim.core.beliefs import Belief
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product, Space


@dataclass(frozen=True, slots=True)
class SigmaPoints:
    """Weighted points (*, N, n) of a space; the weights (N,) are for the mean and for the covariance."""

    space: Space
    points: Array
    mean_weights: Array
    cov_weights: Array


@dataclass(frozen=True, slots=True)
class Innovation:
    """What a measurement said against what was expected. `space` is a product with one part a sensor.

    With n numbers and m directions of the measurement's space, d directions of the state and s sensors:
    z, predicted (*, n); residual = z ⊟ predicted (*, m); cov S, noise R (*, m, m); cross_cov (*, d, m);
    used (*, s): False where a gate refused the sensor's part; offered (*, s): False where the part is no reading of
    the sensor (a stand-in while it is frozen), so that NIS must not count it;
    blind (*, d, s): a unit direction of the state that the sensor cannot see, zero where there is none.
    """

    space: Product
    z: Array
    predicted: Array
    residual: Array
    cov: Array
    noise: Array
    cross_cov: Array
    used: NDArray[np.bool_]
    offered: NDArray[np.bool_]
    blind: Array


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage of a step: its name, and the belief after it."""

    name: str
    belief: Belief


@dataclass(frozen=True, slots=True)
class Start(Stage):
    """The belief is set rather than estimated: at step 0, and where a scenario says so."""


@dataclass(frozen=True, slots=True)
class Predict(Stage):
    """The belief moved on by the process model."""


@dataclass(frozen=True, slots=True)
class LinearPredict(Predict):
    """A prediction by a linear model, or a linearised one: P' = F·P·Fᵀ + Q; transition F, noise Q (*, d, d)."""

    transition: Array
    noise: Array


@dataclass(frozen=True, slots=True)
class UnscentedPredict(Predict):
    """A prediction through sigma points: as drawn, and as the process moved them."""

    drawn: SigmaPoints
    propagated: SigmaPoints


@dataclass(frozen=True, slots=True)
class DiscretePredict(Predict):
    """A prediction over labels: p'ⱼ = Σᵢ pᵢ·Tᵢⱼ; transition T (K, K), each row sums to one."""

    transition: Array


@dataclass(frozen=True, slots=True)
class Update(Stage):
    """A measurement taken in: Δ = gain·residual moved the mean; gain (*, d, m) is zero where a sensor was gated."""

    innovation: Innovation
    gain: Array


@dataclass(frozen=True, slots=True)
class UnscentedUpdate(Update):
    """An update through sigma points: in the state's space, and mapped into the measurement's."""

    sigma: SigmaPoints
    mapped: SigmaPoints


@dataclass(frozen=True, slots=True)
class DiscreteUpdate(Stage):
    """Readings of s binary sensors taken in over K labels: log p'ⱼ = log pⱼ + Σᵢ log_likelihoodsᵢⱼ + constant.

    reading (*, s): 1 where a sensor said yes; offered (*, s): False where it gave no reading at this tick, and its row
    of log_likelihoods (*, s, K) is zero. A row says how its sensor moved which label: only differences within it count.
    """

    sensors: tuple[str, ...]
    reading: Array
    offered: NDArray[np.bool_]
    log_likelihoods: Array


@dataclass(frozen=True, slots=True)
class Matches:
    """K pairs of points, one of a moved cloud and the nearest one of a fixed cloud; K differs from step to step.

    source (K, d) the moved points, target (K, d) their partners, distance (K,) between the two, all in m in the fixed
    cloud's frame; source_index, target_index (K,) their rows in the clouds.
    """

    source: Array
    target: Array
    distance: Array
    source_index: NDArray[np.intp]
    target_index: NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Match(Stage):
    """The points of a moved cloud paired with those of a fixed one; the belief stays as it was."""

    matches: Matches


@dataclass(frozen=True, slots=True)
class Align(Stage):
    """The pose that fits the matches of the stage before best.

    rmse (m) over these `count` matches after the fit; converged: at the new pose the matches are the same again, so
    that nothing would change any more.
    """

    rmse: float
    count: int
    converged: bool


@dataclass(frozen=True, slots=True)
class Weigh(Stage):
    """Particles weighed by what was read: log_likelihoods (*, N) of the readings z, as log p(z | x).

    evidence (*,): log Σ w·p(z | x), with the weights from before, how well the cloud foresaw the readings. ess (*,):
    the effective sample size that is left.
    """

    log_likelihoods: Array
    evidence: Array
    ess: Array


@dataclass(frozen=True, slots=True)
class Resample(Stage):
    """Particles drawn anew by their weights: particle i is a copy of ancestors[i] (*, N) of the stage before.

    distinct (*,): how many different ancestors there are; ess (*,): the effective sample size before.
    """

    ancestors: NDArray[np.int_]
    distinct: Array
    ess: Array


P = ParamSpec("P")
S = TypeVar("S", bound=Stage)


def names_its_failures(make: Callable[P, S]) -> Callable[P, S]:
    """Lets a function that makes a stage leave the stage's name on what it raises: `error.stage`.

    The name is the function's keyword argument `name`, or its default.
    """
    default = (make.__kwdefaults__ or {}).get("name", make.__name__)

    @functools.wraps(make)
    def named(*args: P.args, **kwargs: P.kwargs) -> S:
        try:
            return make(*args, **kwargs)
        except Exception as error:
            noted: Any = error
            noted.stage = kwargs.get("name", default)
            raise

    return named
