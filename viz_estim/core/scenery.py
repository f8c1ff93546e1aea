"""What else stands in a scene, beside what the estimator believes: things whose place is known."""

from __future__ import annotations

from dataclasses import dataclass

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


Scenery = Box | Landmarks | Path
