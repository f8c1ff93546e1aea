"""What a weighted cloud says: its mean and covariance on the manifold, and its modes where it has several."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space

_EPS = float(np.finfo(float).eps)
_ROUNDS = 30
_REACH = 5.0  # σ either way: a mode of weight p lies at most 1/√p away
_SMOOTH = 2.0  # cells to a kernel's σ
_TRUSTED = 100.0  # after a resampling the ESS counts copies: no finer a kernel than for so many draws
_PAST = 2.0  # times as far from the rest of its mode as from another's mean: a piece that is no part of it
_VALLEY = 0.7  # of the lower peak: peaks that the density between them does not fall below are one mode


@dataclass(frozen=True, slots=True)
class Mode:
    """A part of a cloud that stands apart: its share of the weight, its mean (n,) and its covariance (d, d)."""

    weight: float
    mean: Array
    cov: Array


def moments(space: Space, states: Array, log_weights: Array) -> tuple[Array, Array]:
    """The mean (*, n) of states (*, N, n) on the manifold, and their covariance (*, d, d) in the tangent space there.

    The fixed point m = m ⊞ Σ wᵢ (xᵢ ⊟ m), started at the heaviest particle (Pennec 1998). Angles spread all around have
    none; theirs is where the iteration stands when it is given up, and their covariance says how little that means.
    """
    # Each component in one piece: numpy is fast along long axes.
    states = np.moveaxis(np.ascontiguousarray(np.moveaxis(states, -1, 0)), 0, -1)
    if log_weights.strides[-1]:
        weights = np.exp(log_weights)[..., None]
        mean = np.take_along_axis(states, log_weights.argmax(-1)[..., None, None], axis=-2)
    else:  # one number spread over all particles: its exponential is taken once, and the first is as heavy as any
        weights = np.ascontiguousarray(np.broadcast_to(np.exp(log_weights[..., :1]), log_weights.shape))[..., None]
        mean = states[..., :1, :]
    angles = [i for i, unit in enumerate(space.units) if unit == "rad"]
    for rounds in range(_ROUNDS):
        error = space.minus(states, mean)
        across = np.swapaxes(error, -1, -2)
        step = np.swapaxes(across @ weights, -1, -2)
        mean = space.plus(mean, step)
        if space.flat:  # the errors at the new mean are known, unless one of them passes the half turn
            error -= step
            if all(np.abs(error[..., i]).max() < np.pi for i in angles):
                break
            continue
        left = float(np.abs(step).max())
        if left < 1e-10 or (rounds > 1 and left < 64 * _EPS * float(np.abs(states).max())):
            break
    # One product a pair of components: BLAS takes thrice as long for matrices that are so long and thin.
    cov = np.vecdot((across * np.swapaxes(weights, -1, -2))[..., :, None, :], across[..., None, :, :])
    return mean[..., 0, :], 0.5 * (cov + np.swapaxes(cov, -1, -2))


def modes(space: Space, states: Array, log_weights: Array, least: float = 0.05) -> tuple[Mode, ...]:
    """The modes of one cloud, states (N, n), that hold at least a share `least` of its weight; the heaviest first.

    Of the density over the components in metres (over the changes from the mean, where there are none; the first three
    of either), a histogram smoothed with Silverman's width (1986, eq. 4.14): each cell climbs to its peak, and peaks
    without a valley between them are one mode. So are clouds that differ in heading alone.
    """
    label, share = _parted(space, states, log_weights, *_apart(space, states, log_weights), least)
    return _described(space, states, log_weights, label, share, least)


def several(space: Space, states: Array, log_weights: Array, least: float = 0.05) -> tuple[Mode, ...]:
    """The same where they are more than one, else none: half the work, where most clouds have one."""
    label, share = _apart(space, states, log_weights)
    if int((share >= least).sum()) < 2:
        return ()
    return _described(space, states, log_weights, *_parted(space, states, log_weights, label, share, least), least)


def _parted(
    space: Space, states: Array, log_weights: Array, label: np.ndarray, share: Array, least: float
) -> tuple[np.ndarray, Array]:
    """The modes anew, where one of several reaches past another: the kernel is as wide as they all are apart, and may
    join a few particles beside one mode to a second far off. Looked at alone, with a kernel of its own width, such a
    one falls into pieces of which one is far nearer to another mode's mean than to the rest of its own."""
    large = np.flatnonzero(share >= least)
    if len(large) < 2:
        return label, share
    found, weights, points = label.copy(), np.exp(log_weights), _points(space, states, log_weights)
    means = {i: weights[label == i] @ points[label == i] / share[i] for i in large}
    for i in large:
        members = np.flatnonzero(label == i)
        piece, size = _apart(space, states[members], log_weights[members] - np.log(share[i]))
        for j in np.flatnonzero(size * share[i] >= least) if len(size) > 1 else ():
            mine, rest = members[piece == j], members[piece != j]
            middle = weights[mine] @ points[mine] / weights[mine].sum()
            own = np.linalg.norm(middle - weights[rest] @ points[rest] / weights[rest].sum())
            if own > _PAST * min(float(np.linalg.norm(middle - means[other])) for other in large if other != i):
                found[mine] = found.max() + 1
                break
    return found, np.bincount(found, weights).astype(float)


def _described(
    space: Space, states: Array, log_weights: Array, label: np.ndarray, share: Array, least: float
) -> tuple[Mode, ...]:
    found = []
    for i in np.flatnonzero(share >= least):
        members = label == i
        mean, cov = moments(space, states[members], log_weights[members] - np.log(share[i]))
        found.append(Mode(float(share[i]), mean, cov))
    return tuple(sorted(found, key=lambda mode: -mode.weight))


def _apart(space: Space, states: Array, log_weights: Array) -> tuple[np.ndarray, Array]:
    """The number of each particle's mode (N,), and their shares of the weight."""
    weights = np.exp(log_weights)
    cell, density = _histogram(_points(space, states, log_weights), weights)
    label = _basins(density)[cell]
    return label, np.bincount(label, weights).astype(float)


def _points(space: Space, states: Array, log_weights: Array) -> Array:
    """Where the particles are (N, d), in three directions at most."""
    metres = [i for i, unit in enumerate(space.units) if unit == "m"]
    points = states[:, metres] if metres else space.minus(states, moments(space, states, log_weights)[0])
    return points[:, :3]


def _histogram(points: Array, weights: Array) -> tuple[np.ndarray, Array]:
    """The cell of each point (N,) in a smoothed histogram over as many axes as points (N, d) have, and that."""
    d = points.shape[1]
    centred = points - weights @ points
    std = np.sqrt(weights @ centred**2)
    width = min(1 / float(weights @ weights), _TRUSTED) ** (-1 / (d + 4))
    size = width / _SMOOTH * np.where(std > 0, std, 1.0)
    half = int(np.ceil(_REACH * _SMOOTH / width))
    at = np.clip(np.floor(centred / size), -half, half - 1).astype(int) + half
    cell = np.ravel_multi_index(tuple(at.T), (2 * half,) * d)
    histogram = np.bincount(cell, weights, (2 * half) ** d).reshape((2 * half,) * d)
    return cell, scipy.ndimage.gaussian_filter(histogram, _SMOOTH, mode="constant")


def _basins(density: Array) -> np.ndarray:
    """The mode's number of each cell, flat."""
    # Ranks instead of densities, so that no two cells are as high, and a rank names its cell.
    order = density.ravel().argsort(kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    peak = order[scipy.ndimage.maximum_filter(rank.reshape(density.shape), size=3)].ravel()
    while (peak != peak[peak]).any():
        peak = peak[peak]
    height = density.ravel()[peak].reshape(density.shape)
    peaks = np.flatnonzero(peak == np.arange(peak.size))
    number = np.empty_like(peak)
    number[peaks] = np.arange(len(peaks))
    label = number[peak]
    basin = label.reshape(density.shape)
    joined = []
    for axis in range(density.ndim):
        (low, high), (a, b), (one, other) = (_neighbours(x, axis) for x in (density, height, basin))
        no_valley = (one != other) & (np.minimum(low, high) > _VALLEY * np.minimum(a, b))
        joined.append(np.stack([one[no_valley], other[no_valley]]))
    one, other = np.concatenate(joined, axis=1)
    together = np.arange(len(peaks))  # of those that are joined, the lowest number; they are few
    while (lowest := np.minimum(together[one], together[other])).size:
        np.minimum.at(together, one, lowest)
        np.minimum.at(together, other, lowest)
        if (together[one] == together[other]).all():
            break
    return together[label]


def _neighbours(x: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of cells that are next to each other along an axis."""
    x = np.moveaxis(x, axis, 0)
    return x[:-1], x[1:]
