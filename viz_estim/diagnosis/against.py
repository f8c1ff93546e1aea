"""The readings of each sensor against the truth, piece by piece: what the truth would give, and what was read.

By the filter's own model where that can be recovered (`recovered`), else along its Jacobian: with e the error before an
update, r = ν − H·e, right to first order in e. How much that order may leave is told from how H changes along the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SE2, SO2, SO3, Product, Space
from viz_estim.diagnosis.evidence import Case, once, tells_gain, tells_reading
from viz_estim.diagnosis.finding import FEWEST, HALF_THE_DIGITS, MOST, SHEET
from viz_estim.diagnosis.fits import Against
from viz_estim.diagnosis.likelihoods import by_particles
from viz_estim.diagnosis.linear import jacobians
from viz_estim.diagnosis.recovered import recovered
from viz_estim.recording.layout import leaves

_TURNED = SHEET**0.5  # rad: an error θ of an angle leaves θ² of what turns with it, here a share that counts
_HALF = float(np.finfo(float).eps) ** -0.5  # of the digits, as a ratio


def against(case: Case) -> list[Against]:
    """One for each sensor, and for each part of one that has several."""
    return once(case, "_against", lambda case: list(_against(case)))


def _against(case: Case) -> Iterator[Against]:
    run = case.run
    if run.labels or not np.isfinite(run.truth).any():
        return
    yield from by_particles(case, _attitude(case, run.truth))
    row = {int(step): k for k, step in enumerate(run.step)}
    for table in run.stages.values():
        if not tells_gain(table) or not tells_reading(table.values["innovation.predicted"]):
            continue
        space, get = table.spaces["innovation"], table.values
        assert isinstance(space, Product)
        mean, cov = case.sequence.before(table)
        at = np.array([row[int(step)] for step in table.step])
        truth, H = run.truth[at], jacobians(case, table)
        control = run.inputs["control"][at] if "control" in run.inputs else None
        used = {int(step) for r in case.sensors.values() for step in r.step}
        counts = np.array([int(step) in used for step in table.step]) & np.isfinite(mean).all(1)
        residual, attitude = get["innovation.residual"], _attitude(case, truth)
        line = _along(case, truth, mean, H)
        for i, (name, label, part, numbers, axes) in enumerate(_pieces(space)):
            sensor = list(space.parts).index(name)
            R = get["innovation.noise"][:, axes, axes]
            rows = counts & (get["innovation.offered"][:, sensor] > 0) & np.isfinite(H[:, axes]).all((1, 2))
            rows &= np.isfinite(residual[:, axes]).all(1)
            rows[rows] &= np.linalg.eigvalsh(R[rows])[:, 0] > 0
            if rows.sum() < FEWEST or i > MOST:
                continue
            z, expected = get["innovation.z"][rows, numbers], get["innovation.predicted"][rows, numbers]
            std = np.sqrt(np.median(np.diagonal(R[rows], axis1=1, axis2=2), axis=0))
            told = None if control is None else control[rows]
            model = recovered(case.space, mean[rows], truth[rows], told, part, expected, std)
            if model is not None:
                true, off = model.true, model.slip
                known: np.ndarray = np.asarray(np.isfinite(off))
                r = np.where(known[:, None], part.minus(z, np.where(known[:, None], true, expected)), np.nan)
            else:
                change, told_of, bound = line
                moved = np.where(told_of[rows, None], np.einsum("tij,tj->ti", H[rows][:, axes], change[rows]), 0.0)
                scale = np.linalg.inv(np.linalg.cholesky(R[rows]))
                # H is known to half of its digits: of an error beyond that r would be rounding.
                held = told_of[rows] & (np.linalg.norm(np.einsum("tij,tj->ti", scale, moved), axis=1) < _HALF)
                off = np.where(held, bound(scale @ H[rows][:, axes], rows), np.inf)
                r, true = residual[rows][:, axes] - moved, part.plus(expected, moved)
            near = np.asarray(np.isfinite(off))
            if near.sum() >= FEWEST:
                yield Against(
                    name, part, table.step[rows][near], run.time[at[rows]][near], z[near], true[near], r[near],
                    R[rows][near], _spread(H[rows][:, axes], cov[rows])[near], off[near], label, model is not None,
                    None if attitude is None else attitude[rows][near],
                    None if model is None else model.places,
                    None if model is None or model.position is None else model.position[near],
                    model is not None and model.by_control,
                )  # fmt: skip


def _pieces(space: Product) -> Iterator[tuple[str, str, Space, slice, slice]]:
    """Of each sensor, by its name, the parts that are no products: label, space, numbers and directions."""
    for name, part in space.parts.items():
        start, axis = space.at[name].start, space.axes_at[name].start
        if not isinstance(part, Product):
            yield name, "", part, space.at[name], space.axes_at[name]
            continue
        for label, leaf, at in leaves(part):
            end = axis + len(leaf.axes)
            yield name, label, leaf, slice(start + at.start, start + at.stop), slice(axis, end)
            axis = end


def _attitude(case: Case, truth: Array) -> Array | None:
    """World-from-body matrices (M, m, m) of the truth, NaN where it is not known; None where no part says them."""
    for _, part, at in leaves(case.space):
        if isinstance(part, SO3):
            known: np.ndarray = np.asarray(np.isfinite(truth[:, at]).all(1, keepdims=True))
            R = quaternions.to_matrix(np.where(known, truth[:, at], [1.0, 0.0, 0.0, 0.0]))
            return np.where(known[..., None], R, np.nan)
        if isinstance(part, SO2 | SE2):
            c, s = np.cos(truth[:, at.stop - 1]), np.sin(truth[:, at.stop - 1])
            return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=-2)
    return None


def _along(
    case: Case, truth: Array, mean: Array, H: Array
) -> tuple[Array, np.ndarray, Callable[[Array, np.ndarray], Array]]:
    """The errors (M, d) of the directions that readings see, where these are known, and what bounds J·e."""
    error = case.space.minus(truth, mean)
    seen = (np.abs(np.nan_to_num(H)) > HALF_THE_DIGITS * np.nan_to_num(np.abs(H)).max()).any((0, 1))
    error[:, ~seen] = 0.0  # what no reading sees need not be known
    return error, np.asarray(np.isfinite(error).all(1)), lambda J, rows: slip(J, error[rows], mean[rows], case.space)


def _spread(H: Array, P: Array) -> Array:
    """(H·P·Hᵀ)ᵢᵢ (M, m) of H (M, m, d) and P (M, d, d)."""
    return np.asarray(np.maximum(np.einsum("tmi,tij,tmj->tm", H, P, H), 0.0))


def slip(J: Array, error: Array, mean: Array, space: Space) -> Array:
    """By how much J·e may be wrong (M,), for a Jacobian J (M, m, d) at the estimate; 0 where it is constant.

    Where it turns with an angle, an error of that angle (rad) changes it by as large a share (|R − I| ≤ θ); infinite
    beyond `_TURNED`. Else ½·L·|e|² (Taylor), with L the largest of its changes between neighbouring rows, over the
    directions that it sees and beyond rounding.
    """
    seen = (np.abs(J).max((0, 1)) > HALF_THE_DIGITS * np.abs(J).max()) & (error**2).any(0)
    bends = seen & (np.abs(J - J[:1]).max((0, 1)) > HALF_THE_DIGITS * np.abs(J).max())
    if not bends.any():
        return np.zeros(len(J))
    angles = np.array([unit == "rad" for unit in space.axis_units]) & seen
    if angles.any():
        wide = np.abs(error[:, angles]).max(1)
        told = np.linalg.norm(J[..., bends] @ error[:, bends, None], axis=(1, 2))
        return np.asarray(np.where(wide > _TURNED, np.inf, wide * told))
    J, e, step = J[..., seen], error[:, seen], space.minus(mean[1:], mean[:-1])[:, seen]
    size = np.sqrt(np.mean(e**2, axis=0))
    moved = np.linalg.norm(step / size, axis=1)
    change = np.linalg.norm((J[1:] - J[:-1]) * size, axis=(1, 2))
    far = moved > HALF_THE_DIGITS * moved.max(initial=0.0)
    L = float((change[far] / moved[far]).max(initial=0.0))
    return np.asarray(0.5 * L * (e**2 / size**2).sum(1))
