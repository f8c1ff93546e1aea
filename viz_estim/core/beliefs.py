"""What an estimator believes. Frozen: a step makes a new belief, so that going back is exact."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space


@dataclass(frozen=True, slots=True)
class Gaussian:
    """N(mean, cov) on a space: mean (*, n); cov (*, d, d) in the tangent space at the mean."""

    space: Space
    mean: Array
    cov: Array


@dataclass(frozen=True, slots=True)
class Categorical:
    """Probabilities of K labels, as logarithms (*, K) whose exponentials sum to one."""

    labels: tuple[str, ...]
    log_probabilities: Array

    @property
    def probabilities(self) -> Array:
        """(*, K)"""
        return np.exp(self.log_probabilities)


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
