"""A motion that is predicted in other directions than it goes: what moves it stands in the body's axes.

A force or a speed of the body that is not turned into the world, or the wrong way, looks along each single axis like a
factor, and like one that has a name where the heading happens to fit. So all axes of a vector are looked at together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.finding import EXPLAINED, ODDS, TINY, Finding, by_ratio, judge
from viz_estim.diagnosis.frames import angle_of, kabsch

NOT_TURNED, TURNED_BACK = "not turned into the world's axes", "turned the wrong way into the world's axes"
_TRIED = 3


def turned(part: str, truly: Array, told: Array, heading: Array | None, of: np.ndarray) -> Finding | None:
    """Of a vector's motion, as it is (M, n) and as it is predicted (M, n), n 2 or 3, at steps of (M,): by a heading
    (M,) that is known, or by one turn for all. Only where that explains it likelier, by ODDS, than a factor of
    each axis."""
    own = float(np.square(truly - told).sum())
    by_factor = float((np.square(truly).sum(0) - (truly * told).sum(0) ** 2 / np.maximum((told**2).sum(0), TINY)).sum())
    R = kabsch(told, truly)
    angle, about = angle_of(R)
    fixed = f"turned by {np.degrees(-angle):.0f}°" + (f" about {about}" if about else "")
    k = 0.5 * truly.shape[1] * (truly.shape[1] - 1)  # numbers that are fitted, each of which gains ½·log M by itself
    tried = [(float(np.square(truly - told @ R.T).sum()), fixed, k)]
    if heading is not None and truly.shape[1] == 2:
        for times, what in ((1, NOT_TURNED), (2, TURNED_BACK)):
            c, s = np.cos(times * heading), np.sin(times * heading)
            should = np.stack([c * told[:, 0] - s * told[:, 1], s * told[:, 0] + c * told[:, 1]], axis=-1)
            tried.append((float(np.square(truly - should).sum()), what, 0.0))

    def gain(left: float, fitted: float, over: float) -> float:
        return 0.5 * truly.size * float(np.log(over / max(left, TINY))) - 0.5 * fitted * float(np.log(len(truly)))

    left, what, fitted = max(tried, key=lambda one: gain(one[0], one[2], own))
    p = by_ratio(gain(left, fitted, own))
    explained = 1 - left / max(own, TINY)
    if explained < EXPLAINED or judge(p, _TRIED, large=True) != "error" or gain(left, fitted, by_factor) < np.log(ODDS):
        return None
    return Finding(
        "process_model", "error", None, (int(of[0]), int(of[-1])),
        {"component": part, "map": what, "explained": explained, "against": "truth"},
        f"{part} is predicted to move in other directions than it does: what moves it is {what}, which explains "
        f"{explained:.0%} of the difference",
        f"turn what moves {part}, a force or a speed of the body, into the world's axes before it is added: R·f, where "
        "R is world from body",
    )  # fmt: skip


def of_all(finding: Finding, part: str, truly: Array, told: Array) -> Finding:
    """The finding of one axis of a vector, where its factor is that of the others too (M, n); else no unit and no sign
    is named by it, for these are the same for all axes."""
    factor = finding.evidence.get("factor")
    if factor is None or truly.shape[1] == 1:
        return finding
    own = float(np.square(truly - told).sum())
    left = float(np.square(truly - told / factor).sum())
    if left < (1 - EXPLAINED) * own:
        return finding
    component = finding.evidence["component"]
    return replace(
        finding,
        cause=f"{component} is predicted to move by {factor:.3g}× what it does, and {part} as a whole by no such "
        "factor: its unit is not the cause, the direction is off",
        remedy=f"check in which axes what moves {part} is given: a force or a speed of the body is to be turned into "
        "the world's axes, R·f, before it is added",
    )  # fmt: skip
