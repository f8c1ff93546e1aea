"""Unit quaternions, w first, Hamilton's product; arrays of shape (*, 4) with any leading axes.

A quaternion `world_q_body` turns a vector's body coordinates into its world coordinates.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_PRODUCT = np.zeros((4, 4, 4))  # p*q = p_i q_j _PRODUCT[i, j]
for _i, _j, _k, _sign in [
    (0, 0, 0, 1), (0, 1, 1, 1), (0, 2, 2, 1), (0, 3, 3, 1),
    (1, 0, 1, 1), (1, 1, 0, -1), (1, 2, 3, 1), (1, 3, 2, -1),
    (2, 0, 2, 1), (2, 1, 3, -1), (2, 2, 0, -1), (2, 3, 1, 1),
    (3, 0, 3, 1), (3, 1, 2, 1), (3, 2, 1, -1), (3, 3, 0, -1),
]:  # fmt: skip
    _PRODUCT[_i, _j, _k] = _sign
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
_PRODUCT_MATRIX = _PRODUCT.reshape(4, 16)


def multiply(p: Array, q: Array) -> Array:
    """Hamilton product p·q; shapes (*, 4) broadcast."""
    left = (p @ _PRODUCT_MATRIX).reshape(*p.shape[:-1], 4, 4)
    return (q[..., None, :] @ left)[..., 0, :]


def accumulate(product: Array, steps: Array) -> None:
    """Fills product (N, 4), of which the first is given: each is the one before times its step (N, 4), in that order.

    To the bit what `multiply` gives in turn, without its shaping of each pair.
    """
    left = np.empty(16)
    matrix, before = left.reshape(4, 4), product[0]
    for after, step in zip(product[1:], steps, strict=False):
        np.dot(before, _PRODUCT_MATRIX, left)
        np.dot(step, matrix, after)
        before = after


def conjugate(q: Array) -> Array:
    """The inverse rotation."""
    return q * _CONJUGATE


_TINY = 1e-200  # keeps 0/0 away and changes no other quotient


def exp(rotation: Array) -> Array:
    """Quaternion (*, 4) of a rotation vector (*, 3) in radians."""
    angle = length(rotation) + _TINY
    half = 0.5 * angle
    return np.concatenate([np.cos(half), (np.sin(half) / angle) * rotation], axis=-1)


def log(q: Array) -> Array:
    """Rotation vector (*, 3) in radians, |log q| ≤ π, of unit quaternions (*, 4); q and −q give the same."""
    w, v = q[..., :1], q[..., 1:]
    sine = length(v) + _TINY
    return (2.0 * np.arctan2(sine, np.abs(w)) / np.copysign(sine, w)) * v


def length(v: Array) -> Array:
    """Euclidean length (*, 1) of vectors (*, n)."""
    return np.sqrt(np.vecdot(v, v))[..., None]


def normalise(q: Array) -> Array:
    """q scaled to length 1."""
    return q / length(q)


def rotate(q: Array, v: Array) -> Array:
    """World coordinates of body vectors v (*, 3), q being world_q_body (*, 4)."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * cross(u, v)
    return v + w * t + cross(u, t)


_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross(a: Array, b: Array) -> Array:
    """a × b for vectors (*, 3); numpy's own takes five times as long on small arrays."""
    return a.take(_NEXT, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_NEXT, -1)


def to_matrix(q: np.ndarray) -> Array:
    """Rotation matrices (*, 3, 3): world_R_body for world_q_body; in single precision of such quaternions."""
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    r = np.empty((*q.shape[:-1], 3, 3), np.result_type(q, np.float32))  # stacking rows takes three times as long
    r[..., 0, 0], r[..., 0, 1], r[..., 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    r[..., 1, 0], r[..., 1, 1], r[..., 1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    r[..., 2, 0], r[..., 2, 1], r[..., 2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return r


def from_matrix(r: Array) -> Array:
    """Quaternions (*, 4) with w ≥ 0 of rotation matrices (*, 3, 3); Bar-Itzhack (2000), by eigenvectors.

    The nearest rotation is taken where a matrix is a little off orthonormal.
    """
    q = np.linalg.eigh(_symmetric(r))[1][..., :, -1]
    return q * np.where(q[..., :1] < 0, -1.0, 1.0)


def from_rotation(r: Array) -> Array:
    """The same of matrices that are rotations to rounding, in a fifth of the time; of either sign.

    The symmetric matrix of a rotation is 4·q·qᵀ − 1: q is its longest column with 1 added, at length 1.
    """
    k = _symmetric(r) + np.eye(4)
    longest = np.argmax(np.diagonal(k, axis1=-2, axis2=-1), axis=-1)
    return normalise(np.take_along_axis(k, longest[..., None, None], axis=-1)[..., 0])


def _symmetric(r: Array) -> Array:
    """Bar-Itzhack's matrix (*, 4, 4) of (*, 3, 3): of a rotation's, q is the eigenvector to the eigenvalue 3."""
    r = np.asarray(r, float)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    k = np.empty((*r.shape[:-2], 4, 4))
    k[..., 0, 0], k[..., 1, 1], k[..., 2, 2], k[..., 3, 3] = xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy
    k[..., 0, 1] = k[..., 1, 0] = r[..., 2, 1] - r[..., 1, 2]
    k[..., 0, 2] = k[..., 2, 0] = r[..., 0, 2] - r[..., 2, 0]
    k[..., 0, 3] = k[..., 3, 0] = r[..., 1, 0] - r[..., 0, 1]
    k[..., 1, 2] = k[..., 2, 1] = r[..., 1, 0] + r[..., 0, 1]
    k[..., 1, 3] = k[..., 3, 1] = r[..., 2, 0] + r[..., 0, 2]
    k[..., 2, 3] = k[..., 3, 2] = r[..., 2, 1] + r[..., 1, 2]
    return k


def to_euler(q: Array) -> Array:
    """Roll, pitch, yaw (*, 3) in radians: R = Rz(yaw)·Ry(pitch)·Rx(roll)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], axis=-1)


def from_euler(angles: Array) -> Array:
    """Quaternions (*, 4) of roll, pitch, yaw (*, 3) in radians: R = Rz(yaw)·Ry(pitch)·Rx(roll)."""
    turns = np.eye(3) * angles[..., None, :]  # the three single turns, as rotation vectors
    x, y, z = (exp(turns[..., i]) for i in range(3))
    return multiply(multiply(z, y), x)


def continuous(q: Array) -> Array:
    """The same rotations (T, 4), signs chosen so that neighbours lie in one hemisphere; NaN rows are passed over."""
    good = np.isfinite(q).all(-1)
    out = q.copy()
    dots = (q[good][1:] * q[good][:-1]).sum(-1)
    out[good] *= np.concatenate([[1.0], np.cumprod(np.where(dots < 0, -1.0, 1.0))])[: good.sum(), None]
    return out


def slerp(times: Array, stamps: Array, q: Array) -> Array:
    """Quaternions (M, 4) at `times` (M,), interpolated on the sphere between samples q (N, 4) at `stamps` (N,).

    Times outside the stamps take the end's value; who must not extrapolate masks them. Shoemake (1985).
    """
    i = np.clip(np.searchsorted(stamps, times, side="right") - 1, 0, len(stamps) - 2)
    step = np.maximum(stamps[i + 1] - stamps[i], 1e-12)
    fraction = np.clip((times - stamps[i]) / step, 0.0, 1.0)[:, None]
    return multiply(q[i], exp(fraction * log(multiply(conjugate(q[i]), q[i + 1]))))
