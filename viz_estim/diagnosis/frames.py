"""Readings that are those of another frame, of another convention, or of another sensor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO3, Euclidean
from viz_estim.diagnosis.causes import Cause, listed
from viz_estim.diagnosis.finding import EXPLAINED, GROSS, HALF_THE_DIGITS, TINY, by_ratio
from viz_estim.diagnosis.fits import Against, white

_ROUNDS = 10  # of a search whose steps are squared each time; what is found is held against all readings


def turned(one: Against) -> Iterator[Cause]:
    """Vectors z = R·true (+ c): the rotation that brings the truth's to the readings (Kabsch 1976), and the offset."""
    m = len(one.space.axes)
    if not isinstance(one.space, Euclidean) or one.space.axes not in (("x", "y"), ("x", "y", "z")):
        return
    for shifted in (False, True):
        z0, t0 = (one.z.mean(0), one.true.mean(0)) if shifted else (np.zeros(m), np.zeros(m))
        R = kabsch(one.true - t0, one.z - z0)
        left = float((white(one, one.z - z0 - (one.true - t0) @ R.T) ** 2).sum())
        angle, about = angle_of(R)
        where = f"{np.degrees(angle):.0f}°" + (f" about {about}" if about else "")
        again = f" and moved by ({', '.join(f'{v:.2g}' for v in z0 - R @ t0)}) {one.space.axis_units[0]}"
        yield from _turn(one, left, (1 if m == 2 else 3) + m * shifted, where + again * shifted, "")


def turned_attitudes(one: Against) -> Iterator[Cause]:
    """Attitudes z = D·true, another world, or true·D, another body's axes; D is their mean difference."""
    if not isinstance(one.space, SO3):
        return
    z, true = one.z, one.true
    sides = (
        (quaternions.multiply(z, quaternions.conjugate(true)), "the world's axes are others than the filter's"),
        (quaternions.multiply(quaternions.conjugate(true), z), "it is mounted so on the body"),
    )
    for side, (difference, words) in enumerate(sides):
        D = _mean(difference)
        should = quaternions.multiply(D, true) if side == 0 else quaternions.multiply(true, D)
        left = float((white(one, one.space.minus(z, should)) ** 2).sum())
        angle, about = angle_of(quaternions.to_matrix(D))
        yield from _turn(one, left, 3, f"{np.degrees(angle):.0f}°" + (f" about {about}" if about else ""), f": {words}")


def _turn(one: Against, left: float, k: int, turn: str, words: str) -> Iterator[Cause]:
    own, (M, m) = float((white(one, one.r) ** 2).sum()), one.r.shape
    gain, explained = 0.5 * M * m * float(np.log(own / max(left, TINY))), 1 - left / max(own, TINY)
    yield Cause(
        "units_or_axes", gain, k, _penalised(gain, k, M), own > GROSS * left,
        float(np.sqrt(max(own - left, 0.0) / (M * m))), explained,
        {"map": f"turned by {turn}", "log_likelihood_gain": gain},
        f"readings of {one.label} are turned by {turn} against the truth{words or ': they are in another frame'}",
        f"turn the readings of {one.label} back into the frame that h(x) is in, or put that rotation into h(x)", True,
    )  # fmt: skip


def _penalised(gain: float, k: int, M: int) -> float:
    """A bound of p: the likelihood ratio, less what k fitted numbers gain by themselves (Schwarz 1978)."""
    return by_ratio(gain - 0.5 * k * float(np.log(M)))


def conventions(one: Against) -> Iterator[Cause]:
    """Attitudes of the other direction, body from world, and quaternions whose numbers stand in another order."""
    if not isinstance(one.space, SO3):
        return
    read = {
        "the inverse": (quaternions.conjugate(one.z), "body → world is taken for world → body"),
        "x, y, z, w": (one.z[:, [3, 0, 1, 2]], "the real part w stands last, and is taken to stand first"),
        "w last": (one.z[:, [1, 2, 3, 0]], "the real part w stands first, and is taken to stand last"),
    }
    for what, (z, words) in read.items():
        left = float((white(one, one.space.minus(z, one.true)) ** 2).sum())
        own = float((white(one, one.r) ** 2).sum())
        found = listed(one, left, f"axes {what}", 1 - left / max(own, TINY))
        if found is not None:
            yield found._replace(
                evidence=found.evidence | {"map": what},
                cause=f"readings of {one.label}, read as {what}, would explain {found.explained:.0%} of what they and "
                f"the truth disagree on: {words}",
                remedy=f"bring {one.label} to quaternions w, x, y, z of world_T_body before the update",
            )  # fmt: skip


def exchanged(one: Against, others: list[Against]) -> Iterator[Cause]:
    """Readings that are another sensor's: by what each other one of the kind would read at the same moments."""
    own = float((white(one, one.r) ** 2).sum())
    best, whose = np.inf, None
    for other in others:
        if other is one or not _alike(one, other) or len(other.time) < 3:
            continue
        # Between its own readings what the other would read is a smooth curve: a line from one to the next.
        inside = (one.time >= other.time[0]) & (one.time <= other.time[-1])
        if inside.mean() < EXPLAINED:  # else it could not explain so much
            continue
        should = np.stack([np.interp(one.time, other.time, y) for y in other.true.T], axis=-1)
        left = float((white(one, one.z - should)[inside] ** 2).sum()) / inside.mean()
        if left < best:
            best, whose = left, other.name
    if whose is None:
        return
    found = listed(one, best, f"axes {whose}", 1 - best / max(own, TINY))
    if found is not None:
        yield found._replace(
            evidence=found.evidence | {"map": f"{whose} for {one.name}"},
            cause=f"the readings of {one.name} are those that {whose} would give: this explains "
            f"{found.explained:.0%} of what they and the truth disagree on",
            remedy=f"check which reading is whose: those of {one.name} and {whose} are exchanged, "
            "or the places of what they are read from",
        )  # fmt: skip


def misplaced(one: Against) -> Iterator[Cause]:
    """Distances from another place than the model has: where, by the truth and the readings."""
    if one.places is None or one.position is None:
        return
    d = one.position.shape[1]
    own, (M, m) = (white(one, one.r) ** 2).sum(0), one.r.shape
    for i in range(m):
        place = place_of(one.position, one.z[:, i], one.places[i])
        should = one.true.copy()
        should[:, i] = np.linalg.norm(one.position - place, axis=1)
        left = float((white(one, one.z - should) ** 2).sum())
        gain = 0.5 * M * m * float(np.log(own.sum() / max(left, TINY)))
        at, taken = (f"({', '.join(f'{v:.3g}' for v in p)}) m" for p in (place, one.places[i]))
        yield Cause(
            "units_or_axes", gain, d, _penalised(gain, d, M),
            bool(own.sum() > GROSS * left), float(np.sqrt(max(float(own.sum()) - left, 0.0) / M)),
            1 - left / max(float(own.sum()), TINY),
            {"map": f"place {at}", "log_likelihood_gain": gain},
            f"readings of {one.axis(i)} are distances from {at}, and the filter takes them from {taken}",
            f"check the place of what {one.axis(i)} is read from, and the order of the places", True,
        )  # fmt: skip


def place_of(position: Array, distance: Array, place: Array) -> Array:
    """Where distances (M,) to positions (M, d) come from, by Gauss and Newton from a first place (d,) on."""
    for _ in range(_ROUNDS):
        away = place - position
        length = np.maximum(np.linalg.norm(away, axis=1), TINY)
        to = away / length[:, None]
        step = np.linalg.lstsq(to, distance - length, rcond=HALF_THE_DIGITS)[0]
        place = place + step
        if np.abs(step).max() < HALF_THE_DIGITS * np.abs(away).max():
            break
    return place


def _alike(one: Against, other: Against) -> bool:
    return (
        one.name.partition("/")[0] == other.name.partition("/")[0]
        and isinstance(one.space, Euclidean)
        and one.space.axis_units == other.space.axis_units
        and one.part == other.part
    )


def kabsch(a: Array, b: Array) -> Array:
    """The rotation (m, m) that brings vectors a to b (M, m) best."""
    U, _, Vt = np.linalg.svd(b.T @ a)
    sign = np.ones(len(U))
    sign[-1] = np.sign(np.linalg.det(U @ Vt))
    return np.asarray((U * sign) @ Vt)


def _mean(q: Array) -> Array:
    """The mean attitude: the largest eigenvector of Σ q·qᵀ (Markley et al. 2007)."""
    return np.asarray(np.linalg.eigh(q.T @ q)[1][:, -1])


def angle_of(R: Array) -> tuple[float, str]:
    """How far a rotation turns (rad), and about which axis."""
    if len(R) == 2:
        return float(np.arctan2(R[1, 0], R[0, 0])), ""
    turn = quaternions.log(quaternions.from_matrix(R))
    angle = float(np.linalg.norm(turn))
    axis = turn / max(angle, TINY)
    near = int(np.argmax(np.abs(axis)))
    if abs(axis[near]) > np.cos(np.radians(10)):  # in words: about one axis, to ten degrees
        return angle * float(np.sign(axis[near])), "xyz"[near]
    return angle, f"({', '.join(f'{v:.2f}' for v in axis)})"
