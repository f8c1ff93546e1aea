"""A differential drive's motion: the state is (x, y, heading), the inputs are speed and turn rate."""

from __future__ import annotations

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO2, Euclidean, Product, wrap

SPACE = Product(position=Euclidean(("x", "y"), "m"), heading=SO2())


def moved(x: Array, u: Array, dt: Array | float) -> Array:
    """States (*, 3) after dt (*) s under inputs u (*, 2): x + dt·(v·cos θ, v·sin θ, ω), Euler's step."""
    v, w, heading = u[..., 0], u[..., 1], x[..., 2]
    return np.stack(
        [x[..., 0] + dt * v * np.cos(heading), x[..., 1] + dt * v * np.sin(heading), wrap(heading + dt * w)], axis=-1
    )


def transition(x: Array, u: Array, dt: Array | float) -> Array:
    """F (*, 3, 3): how a small change of the state moves on."""
    F = np.zeros((*x.shape[:-1], 3, 3))
    F[...] = np.eye(3)
    F[..., 0, 2] = -dt * u[..., 0] * np.sin(x[..., 2])
    F[..., 1, 2] = dt * u[..., 0] * np.cos(x[..., 2])
    return F


def effect(x: Array, dt: Array | float) -> Array:
    """G (*, 3, 2): how a small change of the inputs shows after dt."""
    G = np.zeros((*x.shape[:-1], 3, 2))
    G[..., 0, 0], G[..., 1, 0] = dt * np.cos(x[..., 2]), dt * np.sin(x[..., 2])
    G[..., 2, 1] = dt
    return G


def path(start: Array, u: Array, dt: Array) -> Array:
    """All states (N+1, 3) from a start (3,) under inputs u (N, 2), each for dt (N,) s: what `moved` does N times."""
    heading = start[2] + np.concatenate([[0.0], np.cumsum(u[:, 1] * dt)])
    steps = (u[:, 0] * dt)[:, None] * np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=-1)
    position = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.concatenate([position, wrap(heading)[:, None]], axis=-1)
