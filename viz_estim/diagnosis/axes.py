"""The ways in which axes and units are mistaken: signed permutations and factors."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import permutations, product

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.finding import GROSS, ODDS, TINY, Finding
from viz_estim.scenarios.imu_health import GRAVITY

UNITS = {  # by what a sensor reads: the factor that brings a reading to what was expected
    "rad": {"degrees for radians": np.pi / 180, "radians for degrees": 180 / np.pi},
    "m/s²": {"g for m/s²": GRAVITY, "m/s² for g": 1 / GRAVITY},
    "m/s": {
        "km/h for m/s": 1 / 3.6,
        "m/s for km/h": 3.6,
        "feet for m": 0.3048,
        "m for feet": 1 / 0.3048,
        "mm for m": 1e-3,
        "m for mm": 1e3,
    },
    "m": {"mm for m": 1e-3, "m for mm": 1e3, "cm for m": 1e-2, "feet for m": 0.3048, "m for feet": 1 / 0.3048},
}


def explains(title: str, own: float, left: float, nothing: float, count: int) -> bool:
    """Whether a map is named: it leaves a GROSS-th at most of the squares `own`, and foresees what there is likelier by
    ODDS than nothing at all does, which leaves the squares `nothing` of `count` numbers: a unit that makes all small is
    none. These choose among causes; that there is one, the likelihood ratio says."""
    foreseen = 0.5 * count * np.log(nothing / max(left, TINY)) > np.log(ODDS)
    return bool(own > GROSS * left and (title.startswith("axes") or foreseen))


def units(unit: str) -> dict[str, float]:
    """The mistakes with a unit; all of them where it is not known."""
    of = {"rad/s": "rad", "m/s^2": "m/s²"}.get(unit, unit)
    return UNITS[of] if of in UNITS else {k: v for known in UNITS.values() for k, v in known.items()}


@cache
def maps(size: int, unit: str = "") -> tuple[tuple[str, Array], ...]:
    """All signed permutations of the axes (2, 8 or 48), and the units, by what they say; the identity is left out."""
    return tuple(_maps(size, unit))


def _maps(size: int, unit: str) -> Iterator[tuple[str, Array]]:
    for order in permutations(range(size)):
        for signs in product((1, -1), repeat=size):
            if order != tuple(range(size)) or -1 in signs:
                M = np.zeros((size, size))
                M[range(size), order] = signs
                names = ["+" if s > 0 else "−" for s in signs]
                yield "axes " + " ".join(f"{s}{'xyz'[o]}" for s, o in zip(names, order, strict=True)), M
    for name, factor in units(unit).items():
        yield name, factor * np.eye(size)


@cache
def inverses(size: int, unit: str = "") -> tuple[tuple[str, Array], ...]:
    """Of the same maps M⁻ᵀ, by which rows (N, size) of what was expected become what was read: x @ M⁻ᵀ."""
    return tuple((title, np.asarray(np.linalg.inv(M).T, float)) for title, M in maps(size, unit))


TRIED = len(maps(3)) + 1  # at most: of three numbers of an unknown unit, and whether they are squares


def finding_of(name: str, steps: tuple[int, int], what: str, explained: float, gain: float) -> Finding:
    words = f"the readings as {what}" if what.startswith("axes") else f"a factor ({what})"
    return Finding(
        "units_or_axes", "error", name, steps, {"map": what, "explained": explained, "log_likelihood_gain": gain},
        f"{words} would explain {explained:.0%} of what {name} and the rest disagree on",
        f"check the order, the signs and the unit of {name}: the best map is `{what}`",
    )  # fmt: skip
