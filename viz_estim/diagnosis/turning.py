"""Does the prediction turn the attitude as the truth turns? By which axes, in which unit, and about whose."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.diagnosis import clouds, forces
from viz_estim.diagnosis.axes import inverses, maps
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import EXPLAINED, TINY, WINDOW, Finding, by_ratio, judge

_WORLD = "the world's axes"


def turned(case: Case) -> Iterator[Finding]:
    """An attitude that is turned by other axes or units, or about the world's axes: step by step, or by window."""
    for window in (0.0, WINDOW):
        if (found := clouds.turns_of_means(case, window)) is not None:
            name, (of, truly, told), in_world = found
            if (finding := turns_as(name, truly, told, of, in_world)) is not None:
                yield finding
                return


def turns_as(name: str, truly: Array, told: Array, of: np.ndarray, in_world: Array | None = None) -> Finding | None:
    """The map of the rates' axes, or the unit, by which what is predicted (M, 3) is what happens (M, 3); or that it is
    predicted in the world's axes (M, 3)."""
    own = float(np.square(truly - told).sum())
    # In what was predicted, whose size stays as it is: a unit that makes it small explains nothing by that.
    tried = [
        (float(np.square(told - truly @ back).sum()), title, told @ A.T)
        for (title, A), (_, back) in zip(maps(3, "rad/s"), inverses(3, "rad/s"), strict=True)
    ]
    if in_world is not None:
        tried.append((float(np.square(truly - in_world).sum()), _WORLD, in_world))
    best, what, mapped = min(tried, key=lambda one: one[0])
    gain, explained = 0.5 * truly.size * np.log(own / max(best, TINY)), 1 - best / max(own, TINY)
    # Either way, so that noise of neither passes for a unit that makes it small.
    back = float(np.square(truly - mapped).sum())
    if what != _WORLD and not (forces.foreseen(told, best) and forces.foreseen(truly, back)):
        return None
    if explained < EXPLAINED or judge(by_ratio(gain), len(tried), large=True) != "error":
        return None
    if what == _WORLD:
        return Finding(
            "process_model", "error", None, (int(of[0]), int(of[-1])),
            {"component": name, "map": what, "explained": explained, "against": "truth"},
            f"{name} is predicted to turn about the world's axes by what the body turns by about its own: this "
            f"explains {explained:.0%} of the difference",
            "multiply by a turn of the body's rates from the right, q·Exp(ω·dt), where q is world from body",
        )  # fmt: skip
    words = f"its rates as {what}" if what.startswith("axes") else f"a factor ({what})"
    return Finding(
        "process_model", "error", None, (int(of[0]), int(of[-1])),
        {"component": name, "map": what, "explained": explained, "against": "truth"},
        f"{name} is predicted to turn otherwise than it does: {words} would explain {explained:.0%} of the difference",
        f"check the order, the signs and the unit of the rates that turn {name}: the best map is `{what}`",
    )  # fmt: skip
