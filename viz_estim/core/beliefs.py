"""What an estimator believes. Frozen: a step makes a new belief, so that going back is exact."""

from __future__ import annotations

from dataclasses import dataclass

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space


@dataclass(frozen=True, slots=True)
class Gaussian:
    """N(mean, cov) on a space: mean (*, n); cov (*, d, d) in the tangent space at the mean."""

    space: Space
    mean: Array
    cov: Array


# Particles and Categorical stand here when their filters come.
Belief = Gaussian
