"""From where a scene is seen at first: whole, and as large as its panel lets it be.

The viewer's field of view is some 55° upwards: what is seen at a distance d reaches half of d up and down.
"""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb

from viz_estim.core.quaternions import Array
from viz_estim.recording import schema

_ASIDE = np.array([1.5, -1.85, 1.25]) / np.linalg.norm([1.5, -1.85, 1.25])
_AWAY = 1.8  # by the radius of what is seen: its sphere is seen under 67°, but few scenes fill it


def above(centre: Array, height: float) -> rrb.EyeControls3D:
    """A plan from above, its y axis upwards."""
    x, y, z = centre
    return rrb.EyeControls3D(position=[x, y, z + height], look_target=[x, y, z], eye_up=[0, 1, 0], kind="Orbital")


def aside(centre: Array, half_sizes: Array) -> rrb.EyeControls3D:
    """A box (half sizes (3,)) in space from the side and above, its z axis upwards."""
    place = centre + _AWAY * max(0.5, float(np.linalg.norm(half_sizes))) * _ASIDE
    return rrb.EyeControls3D(position=place, look_target=centre, eye_up=[0, 0, 1], kind="Orbital")


def around(radius: float) -> rrb.EyeControls3D:
    """A sphere round the origin, with room for what stands out of it."""
    place = radius * np.array([1.6, -1.9, 1.1])
    return rrb.EyeControls3D(position=place, look_target=[0, 0, 0], eye_up=[0, 0, 1], kind="Orbital")


def bars(count: int) -> rrb.EyeControls3D:
    """So many bars beside each other, from the front."""
    middle = 0.5 * schema.BAR * (count - 1)
    place = [middle, 0.45, 0.85 + 0.385 * count]
    return rrb.EyeControls3D(position=place, look_target=[middle, 0.45, 0], eye_up=[0, 1, 0], kind="Orbital")
