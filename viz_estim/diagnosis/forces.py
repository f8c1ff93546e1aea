"""Does the specific force by which a velocity is predicted pull it as the truth is pulled? Axes, signs and units.

The velocity of a body with an accelerometer goes on by R·f + g, so that a prediction tells which force it took:
f = Rᵀ·(Δv/dt − g), with R of its own attitude (Titterton and Weston 2004, section 3.5). The truth's attitude and
velocity tell which force there was. Both are in the body's axes, wherever the estimate has gone.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO3, Euclidean
from viz_estim.diagnosis.axes import inverses, maps
from viz_estim.diagnosis.directions import NOT_TURNED, TURNED_BACK
from viz_estim.diagnosis.durations import by_biases, whole
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import EXPLAINED, FEWEST, ODDS, TINY, WINDOW, Finding, by_ratio, judge
from viz_estim.scenarios.imu_health import GRAVITY

_UP = np.array([0.0, 0.0, GRAVITY])
_OTHERS = "; others of the list do too, for it is along one axis"
_EXCHANGED = "gyro and accelerometer"


class Pulled(NamedTuple):
    """By window (W,) the forces (W, 3) m/s² that the truth shows and that were predicted by; rates (W, 3) rad/s too.
    plain, back: the force that was predicted by, had it not been turned into the world, or the wrong way."""

    step: np.ndarray
    truly: Array
    told: Array
    turns: Array
    turned: Array
    plain: Array
    back: Array


def pulled(case: Case) -> Pulled | None:
    """Of a state that has one attitude and one velocity of the world, both with a truth; means over windows, for in one
    step noise of the truth would hide them."""
    run, space = case.run, case.space
    attitudes = [space.at[name] for name, part in space.parts.items() if isinstance(part, SO3)]
    moving = [
        space.at[name] for name, part in space.parts.items()
        if isinstance(part, Euclidean) and list(part.axis_units) == ["m/s"] * 3
    ]  # fmt: skip
    tables = [t for t in run.stages.values() if t.name.startswith("predict") and "mean" in t.values]
    if len(attitudes) != 1 or len(moving) != 1 or len(tables) != 1 or run.labels:
        return None
    by, (q,), (v,) = whole(case, tables[0]), attitudes, moving
    row = np.searchsorted(run.step, by.step)
    past = np.maximum(row - 1, 0)
    dt = run.dt[row] * by.times
    fine = (dt > 0) & (row > 0) & (by.step > case.first) & np.isfinite(by.before).all(1) & np.isfinite(by.after).all(1)
    fine &= np.isfinite(run.truth[row][:, [*range(q.start, q.stop), *range(v.start, v.stop)]]).all(1)
    fine &= np.isfinite(run.truth[past][:, q]).all(1) & np.isfinite(run.truth[past][:, v]).all(1)
    n = max(1, round(WINDOW / max(float(np.median(run.dt[row])), 1e-9))) if len(row) else 1
    kept = np.flatnonzero(fine)
    kept = kept[: len(kept) // n * n]
    if 3 * (len(kept) // n) < FEWEST:  # numbers
        return None
    name = next(name for name in space.parts if space.at[name] == v)
    change = by.after[kept][:, v] - by.before[kept][:, v] - by_biases(case, tables[0], by, name)[kept]
    told, turned, middle = _force(by.before[kept][:, q], by.after[kept][:, q], change, dt[kept])
    true = run.truth[row[kept]], run.truth[past[kept]]
    plain = quaternions.rotate(middle, told)
    back = quaternions.rotate(middle, plain)
    truly, turns, _ = _force(true[1][:, q], true[0][:, q], true[0][:, v] - true[1][:, v], run.dt[row[kept]])
    means = (values.reshape(-1, n, 3).mean(1) for values in (truly, told, turns, turned, plain, back))
    return Pulled(by.step[kept[::n]], *means)


def foreseen(values: Array, left: float) -> bool:
    """Whether values (M, 3) are told by a map that leaves these squares of them, and not only made small: likelier by
    ODDS than none at all."""
    return bool(0.5 * values.size * np.log(float(np.square(values).sum()) / max(left, TINY)) > np.log(ODDS))


def _force(before: Array, after: Array, change: Array, dt: Array) -> tuple[Array, Array, Array]:
    """The force (M, 3) in the body's axes at the middle of its turn, the rate (M, 3) of that turn, and that middle."""
    turn = quaternions.log(quaternions.multiply(quaternions.conjugate(before), after))
    middle = quaternions.multiply(before, quaternions.exp(0.5 * turn))
    force = quaternions.rotate(quaternions.conjugate(middle), change / dt[:, None] + _UP)
    return force, turn / dt[:, None], middle


def forces(case: Case) -> Iterator[Finding]:
    """The map by which the predicted force is the true one: of those tried that which leaves the least, if it explains
    surely more than none, and foresees what was predicted better than any steady one. By a likelihood ratio, as a map
    of the list has no number that is fitted (Ville 1939); the gyro in the accelerometer's place is one of them."""
    found = pulled(case)
    if found is None:
        return
    truly, told = found.truly, found.told
    own = float(np.square(truly - told).sum())
    tried = [
        (float(np.square(told - truly @ back).sum()), title, A)
        for (title, A), (_, back) in zip(maps(3, "m/s²"), inverses(3, "m/s²"), strict=True)
    ]
    tried.append((float(np.square(told - found.turns).sum()), _EXCHANGED, np.eye(3)))
    for what, values in ((NOT_TURNED, found.plain), (TURNED_BACK, found.back)):
        tried.append((float(np.square(truly - values).sum()), what, np.eye(3)))
    left = min(one[0] for one in tried)
    explained = 1 - left / max(own, TINY)
    gain = 0.5 * truly.size * float(np.log(own / max(left, TINY)))
    if explained < EXPLAINED or judge(by_ratio(gain), len(tried), large=True) != "error":
        return
    # Of those that explain it as well (a force along one axis tells nothing of the others) the least change.
    alike = [one for one in tried if 0.5 * truly.size * np.log(one[0] / max(left, TINY)) < np.log(ODDS)]
    what = max(alike, key=lambda one: float(np.trace(one[2])))[1]
    if what not in (_EXCHANGED, NOT_TURNED, TURNED_BACK) and not foreseen(told, left):
        return
    steps = int(found.step[0]), int(found.step[-1])
    evidence = {"component": "force", "map": what, "explained": explained, "gain": gain, "against": "truth"}
    if what == _EXCHANGED:
        yield Finding(
            "process_model", "error", None, steps, evidence,
            "the velocity is predicted by the body's turn rates in place of its specific force: gyro and accelerometer "
            f"are exchanged (this explains {explained:.0%} of the difference)",
            "check the order of the six numbers: which three are the gyro's (rad/s), and which the accelerometer's "
            "(m/s², about 9.81 long)",
        )  # fmt: skip
        return
    if what in (NOT_TURNED, TURNED_BACK):
        yield Finding(
            "process_model", "error", None, steps, evidence,
            f"the velocity is predicted by the body's specific force, {what}: this explains {explained:.0%} of the "
            "difference",
            "turn the force of the body into the world's axes before it is added: a = R·f + g, R being world from body",
        )  # fmt: skip
        return
    words = f"as {what}" if what.startswith("axes") else f"by a factor ({what})"
    yield Finding(
        "process_model", "error", None, steps, evidence,
        f"the velocity is predicted by another specific force than the body feels: the accelerometer {words} explains "
        f"{explained:.0%} of the difference" + _OTHERS * (len(alike) > 1),
        f"check the order, the signs and the unit of the accelerometer: the best map is `{what}`",
    )  # fmt: skip
