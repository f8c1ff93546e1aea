"""From where a scene is seen at first, whole and as large as its panel lets it be, and the ground beneath it.

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


def spacing(reach: float) -> float:
    """The round number of metres between a grid's lines, some eight of them across a scene of that half width (m)."""
    return _round(max(reach, 0.5) / 4)


def ground(reach: float) -> rrb.LineGrid3D:
    """A grid on the ground of a scene of that half width (m)."""
    return rrb.LineGrid3D(visible=True, spacing=spacing(reach), color=(45, 46, 50))


def _round(length: float) -> float:
    """A round number near a length."""
    power = 10.0 ** int(f"{length:e}".partition("e")[2])
    return power * min((1.0, 2.0, 5.0, 10.0), key=lambda nice: abs(nice - length / power))
