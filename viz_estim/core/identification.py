"""Noise covariances identified from ground truth: what it says that inputs and sensors had wrong.

With the truth known, a noise can be looked at: a sensor's is z ⊟ h(x), an input's solves x' = f(x, u) ⊞ G·w.
Its covariance is that of the sample, with the standard errors of Gaussian samples (Anderson, *An Introduction to
Multivariate Statistical Analysis*, 2003, section 3.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viz_estim.core.measurement import symmetrised, transposed
from viz_estim.core.quaternions import Array


@dataclass(frozen=True)
class Noise:
    """A noise as identified from `count` samples: mean (*, m), cov (*, m, m), and the standard error of each entry.

    mean is what the noise is off by on average; cov is about the mean.
    """

    mean: Array
    cov: Array
    mean_se: Array
    cov_se: Array
    count: int


def identify(samples: Array, *, unbiased: bool = True) -> Noise:
    """The noise that samples (*, N, m) were drawn from.

    Divides by N − 1, or by N where not `unbiased` (the likelihood's maximum). ValueError for fewer than m + 1 samples,
    whose covariance is singular.
    """
    count, m = samples.shape[-2:]
    if count <= m:
        raise ValueError(f"expected more than {m} samples of {m} numbers, got {count}")
    mean = samples.mean(-2)
    off = samples - mean[..., None, :]
    cov = symmetrised(transposed(off) @ off / (count - 1 if unbiased else count))
    variances = np.diagonal(cov, axis1=-2, axis2=-1)
    # Var(S_ij) = (Σ_ij² + Σ_ii·Σ_jj)/(N − 1)
    cov_se = np.sqrt((cov**2 + variances[..., :, None] * variances[..., None, :]) / (count - 1))
    return Noise(mean, cov, np.sqrt(variances / count), cov_se, count)


def input_noise(change: Array, G: Array) -> Array:
    """The w (*, q) with which G·w comes closest to a change x' ⊟ f(x, u) (*, d), by least squares; G (*, d, q)."""
    solved = np.linalg.solve(transposed(G) @ G, transposed(G) @ change[..., None])[..., 0]
    return solved.astype(float, copy=False)
