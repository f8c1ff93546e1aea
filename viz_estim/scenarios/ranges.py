"""Distances to places that are known, and how they change: what every system with ranges is made of."""

from __future__ import annotations

import numpy as np

from viz_estim.core.quaternions import Array

_AT_THE_PLACE = 1e-9  # m: nearer than that a distance has no direction


def distances(position: Array, places: Array) -> Array:
    """The distances (*, N) in m of positions (*, 2) from places (N, 2)."""
    away = position[..., None, :] - places
    return np.hypot(away[..., 0], away[..., 1])


def directions(position: Array, places: Array) -> Array:
    """The derivatives (*, N, 2) of `distances`: unit vectors from each place to the position; zero at the place."""
    away = position[..., None, :] - places
    return away / np.maximum(np.hypot(away[..., 0], away[..., 1]), _AT_THE_PLACE)[..., None]
