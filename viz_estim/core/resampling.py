"""How often each particle is copied: four ways to draw N from N, all with N·wᵢ copies of particle i on the average.

Douc, Cappé and Moulines, *Comparison of resampling schemes for particle filtering* (2005). Each takes weights (*, N)
that sum to one and gives copies (*, N) that sum to N; copies stand in the particles' order, so that nothing is searched
for: as many points as lie below cⱼ = w₀ + … + wⱼ are copies of the particles up to j.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from viz_estim.core.quaternions import Array

Method = Literal["systematic", "stratified", "residual", "multinomial"]


def systematic(weights: Array, rng: np.random.Generator) -> np.ndarray:
    """One number u for all, points (i + u)/N: ⌊N·w⌋ or ⌈N·w⌉ copies (Kitagawa 1996)."""
    below = _scaled(weights)
    below -= rng.random((*weights.shape[:-1], 1))
    return _differences(np.ceil(below, out=below))


def stratified(weights: Array, rng: np.random.Generator) -> np.ndarray:
    """A number for each of N equal strata, points (i + uᵢ)/N (Kitagawa 1996)."""
    c = _scaled(weights)
    whole = np.floor(c)
    u = rng.random(weights.shape)
    stratum = np.minimum(whole.astype(int), weights.shape[-1] - 1)
    return _differences(whole + (np.take_along_axis(u, stratum, axis=-1) < c - whole))


def multinomial(weights: Array, rng: np.random.Generator) -> np.ndarray:
    """N independent draws (Gordon, Salmond and Smith 1993)."""
    return _draws(weights, np.full(weights.shape[:-1], weights.shape[-1]), rng)


def residual(weights: Array, rng: np.random.Generator) -> np.ndarray:
    """⌊N·w⌋ copies for sure, the rest drawn independently from what is left over (Liu and Chen 1998)."""
    expected = weights.shape[-1] * weights
    sure = np.floor(expected + 1e-9)  # rounding must not take its copy from a weight of 1/N
    rest = np.maximum(expected - sure, 0.0)
    return sure.astype(int) + _draws(rest, weights.shape[-1] - sure.sum(-1), rng)


METHODS: dict[Method, Callable[[Array, np.random.Generator], np.ndarray]] = {
    "systematic": systematic,
    "stratified": stratified,
    "residual": residual,
    "multinomial": multinomial,
}


def _scaled(weights: Array) -> Array:
    """N·cⱼ, whose last is N to the bit."""
    N = weights.shape[-1]
    c = np.add.accumulate(weights, axis=-1)
    c *= N / c[..., -1:]
    np.minimum(c, N, out=c)  # the product may be one bit above
    c[..., -1] = N
    return c


def _differences(below: Array) -> np.ndarray:
    """Copies (*, N) from how many points lie below each cⱼ."""
    copies = np.empty(below.shape, int)
    copies[..., 0] = below[..., 0]
    np.subtract(below[..., 1:], below[..., :-1], out=copies[..., 1:], casting="unsafe")  # whole numbers, all of them
    return copies


def _draws(weights: Array, count: Array, rng: np.random.Generator) -> np.ndarray:
    """Copies (*, N) of `count` (*,) independent draws with probabilities in proportion to the weights."""
    N = weights.shape[-1]
    c = np.cumsum(weights, axis=-1).reshape(-1, N)
    c /= np.where(c[:, -1:] > 0, c[:, -1:], 1.0)
    points = np.where(np.arange(N) < count[..., None], rng.random(weights.shape), 2.0).reshape(-1, N)
    # One search for all rows: row i has the numbers from 3·i to 3·i + 2.
    row = np.arange(len(c))[:, None]
    below = np.searchsorted((np.sort(points) + 3 * row).ravel(), (c + 3 * row).ravel()).reshape(-1, N) - N * row
    return _differences(below).reshape(weights.shape)
