"""What a sensor would read of the truth by the filter's own model, which the recording does not hold.

It does hold what the filter expected at each of its estimates: pairs of x and ẑ = h(x). Most sensors are of a few
kinds, of which each is a straight line once x and ẑ are written in the right numbers: a part of the state as it is, a
distance from a fixed place (whose square is linear in the place; Smith and Abel 1987), a vector of the world seen from
the body, a velocity in the body's axes. A kind that explains all the pairs is the model, and is good wherever the truth
is: it needs no line along a Jacobian, which is as wrong as the estimate is far off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import S2, SE2, SO2, SO3, Euclidean, Product, Space
from viz_estim.diagnosis.finding import HALF_THE_DIGITS, TINY
from viz_estim.recording.layout import leaves

_ROWS = 3  # pairs for each number of a fit, at least: two of each are left to belie it, and none does by `exact`


class Recovered(NamedTuple):
    """What is expected at the truth (M, n), and by how much that may be wrong (M,), in standard deviations of R."""

    true: Array
    slip: Array
    places: Array | None = None  # (m, d): of distances, from where
    position: Array | None = None  # (M, d): the truth's, to which the distances are
    by_control: bool = False  # whether it takes the control, as of a place off the origin that turns with the body


def recovered(
    state: Product, mean: Array, truth: Array, control: Array | None, part: Space, predicted: Array, std: Array
) -> Recovered | None:
    """By the kind of sensor that explains what was expected; None where none does.

    mean, truth (M, n) of the state, control (M, c) or None, predicted (M, k) of the sensor's part, std (m,) of its R.
    """
    own = list(leaves(state))
    for _, leaf, at in own:
        if type(leaf) is type(part) and leaf.axis_units == part.axis_units and len(leaf.names) == len(part.names):
            off = np.sqrt(np.mean((part.minus(predicted, mean[:, at]) / std) ** 2))
            if off < exact(len(mean)):
                return Recovered(truth[:, at], np.where(np.isfinite(truth[:, at]).all(1), off, np.inf))
    if isinstance(part, Euclidean | S2):
        std = std if len(std) == predicted.shape[1] else np.full(predicted.shape[1], std.mean())
        if set(part.axis_units) == {"m"} and (found := _distances(own, mean, truth, predicted, std)) is not None:
            return found
        fits = [
            one._replace(by_control=steered)
            for kind, steered in _kinds(own, control)
            if (one := _by(kind, mean, truth, predicted, std)) is not None
        ]
        best = min(fits, key=lambda one: float(np.median(one.slip)), default=None)  # many numbers fit any few pairs
        if best is not None and isinstance(part, S2):
            return best._replace(true=best.true / np.linalg.norm(best.true, axis=1, keepdims=True))
        return best
    return None


def exact(count: int) -> float:
    """Of R's standard deviation, as a root mean square: less than what so many readings would tell of a mean."""
    return float(1 / np.sqrt(count))


def _by(kind: Callable[[Array], Array], mean: Array, truth: Array, y: Array, std: Array) -> Recovered | None:
    line = _line(kind(mean), y, kind(truth))
    if line is None:
        return None
    true, fitted, leverage, _ = line
    off = np.sqrt(np.mean(((fitted - y) / std) ** 2))
    return Recovered(true, off * (1 + leverage)) if off < exact(len(y)) else None


def _distances(
    own: list[tuple[str, Space, slice]], mean: Array, truth: Array, d: Array, std: Array
) -> Recovered | None:
    """d² = |p|² − 2·Lᵀp + |L|² of each component, L its place, for a position p among the state's parts."""
    for _, leaf, at in own:
        if isinstance(leaf, SE2):
            at = slice(at.start, at.start + 2)
        elif not (isinstance(leaf, Euclidean) and len(leaf.names) in (2, 3) and set(leaf.axis_units) == {"m"}):
            continue
        p, q = mean[:, at], truth[:, at]
        line = _line(_affine(p), d**2 - (p**2).sum(1, keepdims=True), _affine(q))
        if line is None or (d <= 0).any():
            continue
        rest, fitted, leverage, coefficients = line
        squared = np.maximum(fitted + (p**2).sum(1, keepdims=True), 0.0)
        off = np.sqrt(np.mean(((np.sqrt(squared) - d) / std) ** 2))
        if off < exact(len(d)):
            true = np.sqrt(np.maximum(rest + (q**2).sum(1, keepdims=True), 0.0))
            place = -0.5 * coefficients[:-1].T
            return Recovered(true, off * (1 + leverage), place, q)
    return None


def distance_place(position: Array, beside: Array, d: Array, std: float) -> Array | None:
    """The place (k,) from which d (M,) are s·|p − L| + b of positions p (M, k), the scale s and the bias b each one of
    other numbers of the state (M, q), or none; None where no place gives them as `exact` as a noise of std lets."""
    one, none = np.ones(len(d)), np.zeros(len(d))
    for b in [none, *beside.T]:
        for s in [one, *beside.T]:
            if (s == 0).any() or s is b:
                continue
            own = (d - b) / s
            line = _line(_affine(position), own**2 - (position**2).sum(1), _affine(position))
            if line is None:
                return None
            _, fitted, _, coefficients = line
            off = np.sqrt(np.maximum(fitted + (position**2).sum(1), 0.0)) - own
            if np.sqrt(np.mean((s * off / std) ** 2)) < exact(len(d)) and (own > 0).all():
                return np.asarray(-0.5 * coefficients[:-1])
    return None


def _kinds(
    own: list[tuple[str, Space, slice]], control: Array | None
) -> Iterator[tuple[Callable[[Array], Array], bool]]:
    """Straight lines in the state's plain numbers, in a rotation's entries, and in vectors seen from the body; and
    whether the control is among their numbers."""
    steered = control is not None
    plain = [at for _, leaf, at in own if isinstance(leaf, Euclidean)]
    turns = [at for _, leaf, at in own if isinstance(leaf, SO3)]
    headings = [at for _, leaf, at in own if isinstance(leaf, SO2)]

    def numbers(x: Array) -> Array:
        return _affine(np.concatenate([x[:, at] for at in plain], axis=1)) if plain else np.ones((len(x), 1))

    yield numbers, False
    for turn in turns:
        yield lambda x, turn=turn: quaternions.to_matrix(x[:, turn]).reshape(len(x), 9), False  # type: ignore[misc]
        for at in plain:
            if at.stop - at.start == 3:
                # The body's rate, by which a place off its origin moves, is the control's or a part of the state.
                yield lambda x, turn=turn, at=at: _seen(x, turn, at, control), steered  # type: ignore[misc]
                yield (
                    lambda x, turn=turn, at=at: np.concatenate(  # type: ignore[misc]
                        [_seen(x, turn, at, control), numbers(x)[:, :-1]], axis=1
                    ),
                    steered,
                )
    for heading in headings:
        yield (
            lambda x, heading=heading: np.concatenate(  # type: ignore[misc]
                [numbers(x), np.cos(x[:, heading]), np.sin(x[:, heading])], axis=1
            ),
            False,
        )


def _seen(x: Array, turn: slice, at: slice, control: Array | None) -> Array:
    """A vector of the world in the body's axes, and the control."""
    seen = quaternions.rotate(quaternions.conjugate(x[:, turn]), x[:, at])
    return _affine(seen if control is None else np.concatenate([seen, np.nan_to_num(control)], axis=1))


def _affine(p: Array) -> Array:
    return np.concatenate([p, np.ones((len(p), 1))], axis=1)


def _line(x: Array, y: Array, at: Array) -> tuple[Array, Array, Array, Array] | None:
    """Least squares of y (M, k) on x (M, f): the line at other rows (M, f), at its own, and how far the others lie from
    these, √(aᵀ(XᵀX/M)⁻¹a) (M,), and its coefficients; infinitely far where they lie in a direction that no row of x
    tells of, or are not known."""
    rows = np.asarray(np.isfinite(x).all(1) & np.isfinite(y.reshape(len(y), -1)).all(1))
    if rows.sum() < _ROWS * x.shape[1]:
        return None
    size = np.maximum(np.abs(x[rows]).max(0), TINY)
    U, s, Vt = np.linalg.svd(x[rows] / size, full_matrices=False)
    told = s > HALF_THE_DIGITS * s[0]  # in other directions the estimates never moved
    coefficients = (Vt[told].T / s[told]) @ (U[:, told].T @ y[rows])
    known = np.asarray(np.isfinite(at).all(1))
    a = np.where(known[:, None], at, 0.0) / size
    leverage = np.linalg.norm(a @ (Vt[told].T / s[told]), axis=1) * np.sqrt(rows.sum())
    beside = np.linalg.norm(a @ Vt[~told].T, axis=1) > HALF_THE_DIGITS * np.linalg.norm(a, axis=1)
    own = np.where(rows[:, None], x, 0.0) / size @ coefficients
    far = np.where(known & ~beside, leverage, np.inf)
    scaled = coefficients / (size[:, None] if coefficients.ndim > 1 else size)
    return a @ coefficients, np.where(rows[:, None] if y.ndim > 1 else rows, own, y), far, scaled
