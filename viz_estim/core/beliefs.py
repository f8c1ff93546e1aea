"""What an estimator believes. Frozen: a step makes a new belief, so that going back is exact.

Each kind tells by `shapes` which arrays it is made of, and their shapes in one belief without batch axes: a run is held
to those of its start, and all their numbers must be finite.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from viz_estim.core.modes import Mode, modes, moments
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space


@dataclass(frozen=True, slots=True)
class Gaussian:
    """N(mean, cov) on a space: mean (*, n); cov (*, d, d) in the tangent space at the mean."""

    space: Space
    mean: Array
    cov: Array

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        n, d = len(self.space.names), len(self.space.axes)
        return {"mean": (n,), "cov": (d, d)}


@dataclass(frozen=True, slots=True)
class Categorical:
    """Probabilities of K labels, as logarithms (*, K) whose exponentials sum to one."""

    labels: tuple[str, ...]
    log_probabilities: Array

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        return {"log_probabilities": (len(self.labels),)}

    @property
    def probabilities(self) -> Array:
        """(*, K)"""
        return np.exp(self.log_probabilities)


@dataclass(frozen=True, slots=True)
class Particles:
    """N weighted points of a space: states (*, N, n); log_weights (*, N), whose exponentials sum to one."""

    space: Space
    states: Array
    log_weights: Array
    _moments: tuple[Array, Array] | None = field(default=None, init=False, repr=False, compare=False)
    _weights: Array | None = field(default=None, init=False, repr=False, compare=False)
    _ess: Array | None = field(default=None, init=False, repr=False, compare=False)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        count, n = self.states.shape[-2:]
        return {"states": (count, n), "log_weights": (count,)}

    @property
    def weights(self) -> Array:
        """(*, N), which sum to one; worked out when first asked for."""
        if self._weights is None:
            object.__setattr__(self, "_weights", np.exp(self.log_weights))
        assert self._weights is not None
        return self._weights

    @property
    def mean(self) -> Array:
        """(*, n), on the manifold."""
        return self._worked_out()[0]

    @property
    def cov(self) -> Array:
        """(*, d, d), in the tangent space at the mean."""
        return self._worked_out()[1]

    @property
    def ess(self) -> Array:
        """The effective sample size 1/Σw² (*,), from 1 to N (Kong, Liu and Wong 1994)."""
        if self._ess is None:
            # Not by BLAS for many particles: it wakes a thread on each core, which then waits there in a busy loop.
            weights = self.weights
            few = weights.shape[-1] <= 10_000
            squares = np.vecdot(weights, weights) if few else np.einsum("...i,...i->...", weights, weights)
            object.__setattr__(self, "_ess", np.asarray(1 / squares))
        assert self._ess is not None
        return self._ess

    def modes(self, least: float = 0.05) -> tuple[Mode, ...]:
        """The modes of one cloud (no batch) that hold at least a share `least` of its weight, the heaviest first."""
        return modes(self.space, self.states, self.log_weights, least)

    def _worked_out(self) -> tuple[Array, Array]:
        """Mean and covariance, worked out when first asked for: a filter needs neither."""
        if self._moments is None:
            object.__setattr__(self, "_moments", moments(self.space, self.states, self.log_weights))
        assert self._moments is not None
        return self._moments


# One of these: each estimator knows its own kind, and nothing that handles all kinds may assume one.
Belief = Any


def normal(space: Space, mean: Array, cov: Array, rng: np.random.Generator) -> Array:
    """A draw (*, n) from N(mean, cov) on the space; cov may be singular, such as that of an input's noise."""
    white = rng.standard_normal((*mean.shape[:-1], cov.shape[-1], 1))
    try:
        root = np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(cov)
        root = vectors * np.sqrt(np.maximum(values, 0))[..., None, :]
    return space.plus(mean, (root @ white)[..., 0])


def read_only(values: Array) -> Array:
    """The same numbers, to be shown to a person's model: one that writes into them would change what is recorded."""
    shown = values.view()
    shown.flags.writeable = False
    return shown
