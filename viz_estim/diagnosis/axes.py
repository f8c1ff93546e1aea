"""The ways in which axes and units are mistaken: signed permutations and factors."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.finding import Finding
from viz_estim.scenarios.imu_health import GRAVITY

EXPLAINED = 0.5  # of the misfit, for a map to be named
_UNITS = {
    "degrees for radians": np.pi / 180,
    "radians for degrees": 180 / np.pi,
    "g for m/s²": GRAVITY,
    "m/s² for g": 1 / GRAVITY,
    "mm for m": 1e-3,
    "m for mm": 1e3,
}


def maps(size: int) -> Iterator[tuple[str, Array]]:
    """All signed permutations of the axes (2, 8 or 48), and all units, by what they say; the identity is left out."""
    for order in permutations(range(size)):
        for signs in product((1, -1), repeat=size):
            if order != tuple(range(size)) or -1 in signs:
                M = np.zeros((size, size))
                M[range(size), order] = signs
                names = ["+" if s > 0 else "−" for s in signs]
                yield "axes " + " ".join(f"{s}{'xyz'[o]}" for s, o in zip(names, order, strict=True)), M
    for name, factor in _UNITS.items():
        yield name, factor * np.eye(size)


def finding_of(name: str, steps: tuple[int, int], what: str, explained: float, gain: float) -> Finding:
    words = f"the readings as {what}" if what.startswith("axes") else f"a factor ({what})"
    return Finding(
        "units_or_axes", "error", name, steps, {"map": what, "explained": explained, "log_likelihood_gain": gain},
        f"{words} would explain {explained:.0%} of what {name} and the rest disagree on",
        f"check the order, the signs and the unit of {name}: the best map is `{what}`",
    )  # fmt: skip
