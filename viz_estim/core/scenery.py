"""What else stands in a scene, beside what the estimator believes: things whose place is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from viz_estim.core.quaternions import Array


@dataclass(frozen=True)
class Box:
    """The estimated body as a box: sizes (x, y, z) in metres along its body axes."""

    sizes: tuple[float, float, float]


@dataclass(frozen=True)
class Landmarks:
    """Points whose place in the world is known: positions (N, 2) or (N, 3) in m, and a label each."""

    positions: Array
    labels: tuple[str, ...]


@dataclass(frozen=True)
class Path:
    """A line through the world: positions (T, 2) or (T, 3) in m, such as where another method says the robot was."""

    positions: Array


@dataclass(frozen=True)
class Cloud:
    """A cloud of points (N, 2) or (N, 3) in m, in the world's frame; where it `moves`, in the estimated body's."""

    points: Array
    moves: bool = False


@dataclass(frozen=True)
class Camera:
    """A camera on the body that looks along its x axis, and what it saw: pictures (K, M, N, 3) of bytes, RGB.

    field_of_view: (horizontal, vertical) in rad. panorama (H, 2H, 3) of bytes: the world around as it truly is, by
    azimuth from π to −π and elevation from π/2 to −π/2; None where nobody knows.
    """

    pictures: NDArray[np.uint8]
    field_of_view: tuple[float, float]
    panorama: NDArray[np.uint8] | None = None


Scenery = Box | Landmarks | Path | Cloud | Camera
