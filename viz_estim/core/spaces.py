"""The geometry of a state: how to add a small change, subtract two states, and average several.

The perturbation is on the right, everywhere: `plus(x, δ) = x·Exp(δ)` and `minus(y, x) = Log(x⁻¹y)`, so that
`plus(x, minus(y, x)) = y`. Covariances live in the tangent space at the mean (Sola et al., 2018, eqs. 25–26).
States are flat arrays (*, n), changes (*, d); all leading axes are batch axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.names import check_name
from viz_estim.core.quaternions import Array


class Space(Protocol):
    """A state's geometry. `names`, `units`: of the n numbers stored; `axes`, `axis_units`: of the d directions."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    axes: tuple[str, ...]
    axis_units: tuple[str, ...]
    flat: bool  # `transport` is the identity everywhere

    def plus(self, x: Array, delta: Array) -> Array:
        """x (*, n) moved by delta (*, d)."""
        ...

    def minus(self, y: Array, x: Array) -> Array:
        """The change (*, d) that takes x (*, n) to y (*, n)."""
        ...

    def mean(self, points: Array, weights: Array) -> Array:
        """The weighted mean (*, n) of points (*, N, n) under weights (N,) or (*, N) that sum to one."""
        ...

    def transport(self, x: Array, delta: Array) -> Array:
        """The matrix (*, d, d) that carries changes at x to changes at plus(x, delta), fixed in the world's frame.

        A covariance goes along as A·P·Aᵀ. On a group it is Ad(Exp(−δ)). Without it a direction that no sensor sees
        (heading, for gravity) would turn with every correction, and look seen (Barrau and Bonnabel 2017).
        """
        ...


_NO_MEAN = "the mean of the points does not settle: they are spread too widely to have one"
_X, _Y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def _weighted(values: Array, weights: Array) -> Array:
    """Σ_i w_i v_i over the last axis but one."""
    return (weights[..., None, :] @ values)[..., 0, :]


def _iterated_mean(
    minus: Callable[[Array, Array], Array],
    plus: Callable[[Array, Array], Array],
    points: Array,
    weights: Array,
    guess: Array,
) -> Array:
    """The point whose error vectors average to zero, by fixed-point iteration (Kraft 2003; Pennec 1998).

    ArithmeticError where it does not settle: the points are spread over more than a half turn and have no mean.
    """
    mean = guess
    # No closer than rounding allows, for large coordinates or the scaled rule's large weights.
    rounding = 64 * np.finfo(float).eps * max(1.0, float(np.abs(points).max())) * float(np.abs(weights).sum(-1).max())
    for _ in range(100):
        error = _weighted(minus(points, mean[..., None, :]), weights)
        mean = plus(mean, error)
        if np.abs(error).max(initial=0.0) < max(1e-10, rounding):
            return mean
    raise ArithmeticError(_NO_MEAN)


def _identity(delta: Array) -> Array:
    return np.broadcast_to(np.eye(delta.shape[-1]), (*delta.shape, delta.shape[-1]))


class Euclidean:
    """R^n with named components in one unit (or one unit each)."""

    flat = True

    def __init__(self, names: Sequence[str], units: Sequence[str] | str = "") -> None:
        if isinstance(names, str):
            raise ValueError(f"expected a sequence of names such as ('x', 'y'), got the text {names!r}")
        self.names = tuple(names)
        self.units = (units,) * len(self.names) if isinstance(units, str) else tuple(units)
        self.axes, self.axis_units = self.names, self.units

    def plus(self, x: Array, delta: Array) -> Array:
        return x + delta

    def minus(self, y: Array, x: Array) -> Array:
        return y - x

    def mean(self, points: Array, weights: Array) -> Array:
        return _weighted(points, weights)

    def transport(self, x: Array, delta: Array) -> Array:
        return _identity(delta)


class SO2:
    """An angle in radians, kept in [−π, π)."""

    flat = True
    names: tuple[str, ...] = ("angle",)
    axes: tuple[str, ...] = names
    units: tuple[str, ...] = ("rad",)
    axis_units: tuple[str, ...] = units

    def plus(self, x: Array, delta: Array) -> Array:
        return wrap(x + delta)

    def minus(self, y: Array, x: Array) -> Array:
        return wrap(y - x)

    def mean(self, points: Array, weights: Array) -> Array:
        return _iterated_mean(self.minus, self.plus, points, weights, points[..., 0, :])

    def transport(self, x: Array, delta: Array) -> Array:
        return _identity(delta)


class SO3:
    """An attitude as a unit quaternion (w, x, y, z), body → world; changes are rotation vectors in the body frame."""

    flat = False
    names: tuple[str, ...] = ("qw", "qx", "qy", "qz")
    units: tuple[str, ...] = ("", "", "", "")
    axes: tuple[str, ...] = ("x", "y", "z")
    axis_units: tuple[str, ...] = ("rad", "rad", "rad")

    def plus(self, x: Array, delta: Array) -> Array:
        return quaternions.normalise(quaternions.multiply(x, quaternions.exp(delta)))

    def minus(self, y: Array, x: Array) -> Array:
        return quaternions.log(quaternions.multiply(quaternions.conjugate(x), y))

    def mean(self, points: Array, weights: Array) -> Array:
        # All in one hemisphere, their chord mean is near: one or two iterations are left.
        aligned = points * np.copysign(1.0, points @ points[..., 0, :, None])
        return _iterated_mean(
            self.minus, self.plus, points, weights, quaternions.normalise(_weighted(aligned, weights))
        )

    def transport(self, x: Array, delta: Array) -> Array:
        return quaternions.to_matrix(quaternions.exp(-delta))


class SE2:
    """A pose (x, y, θ) in the plane, body → world; changes (dx, dy, dθ) are twists in the body frame."""

    flat = False
    names: tuple[str, ...] = ("x", "y", "theta")
    units: tuple[str, ...] = ("m", "m", "rad")
    axes: tuple[str, ...] = ("forward", "left", "turn")
    axis_units: tuple[str, ...] = units

    def plus(self, x: Array, delta: Array) -> Array:
        turn = delta[..., 2]
        a, b = np.sinc(turn / np.pi), 0.5 * turn * np.sinc(turn / (2 * np.pi)) ** 2  # sin θ/θ and (1 − cos θ)/θ
        forward, left = a * delta[..., 0] - b * delta[..., 1], b * delta[..., 0] + a * delta[..., 1]
        c, s = np.cos(x[..., 2]), np.sin(x[..., 2])
        return np.stack(
            [x[..., 0] + c * forward - s * left, x[..., 1] + s * forward + c * left, wrap(x[..., 2] + turn)], axis=-1
        )

    def minus(self, y: Array, x: Array) -> Array:
        turn = wrap(y[..., 2] - x[..., 2])
        c, s = np.cos(x[..., 2]), np.sin(x[..., 2])
        dx, dy = y[..., 0] - x[..., 0], y[..., 1] - x[..., 1]
        forward, left = c * dx + s * dy, c * dy - s * dx
        half = 0.5 * turn
        a = np.cos(half) / np.sinc(half / np.pi)  # (θ/2)·cot(θ/2)
        return np.stack([a * forward + half * left, a * left - half * forward, turn], axis=-1)

    def mean(self, points: Array, weights: Array) -> Array:
        return _iterated_mean(self.minus, self.plus, points, weights, points[..., 0, :])

    def transport(self, x: Array, delta: Array) -> Array:
        # Ad of a planar pose (p, θ) is [[R, (p_y, −p_x)], [0, 1]]; here of the step's inverse.
        step = self.plus(np.zeros_like(delta), -delta)
        A = np.zeros((*delta.shape, 3))
        c, s = np.cos(step[..., 2]), np.sin(step[..., 2])
        A[..., 0, 0], A[..., 0, 1], A[..., 0, 2] = c, -s, step[..., 1]
        A[..., 1, 0], A[..., 1, 1], A[..., 1, 2] = s, c, -step[..., 0]
        A[..., 2, 2] = 1.0
        return A


class S2:
    """A direction: a unit vector (x, y, z); changes are the two angles along a basis of its tangent plane.

    Hertzberg et al. (2013): the sphere as a ⊞-manifold.
    """

    flat = False
    names: tuple[str, ...] = ("x", "y", "z")
    units: tuple[str, ...] = ("", "", "")
    axes: tuple[str, ...] = ("tangent_1", "tangent_2")
    axis_units: tuple[str, ...] = ("rad", "rad")

    def basis(self, x: Array) -> Array:
        """Two orthonormal tangents at x, as rows (*, 2, 3); the first leans to the x axis, or to y where x is near."""
        reference = np.where(np.abs(x[..., :1]) < 0.9, _X, _Y)
        first = quaternions.normalise(reference - np.vecdot(reference, x)[..., None] * x)
        return np.concatenate([first[..., None, :], quaternions.cross(x, first)[..., None, :]], axis=-2)

    def plus(self, x: Array, delta: Array) -> Array:
        return self._exp(x, (delta[..., None, :] @ self.basis(x))[..., 0, :])

    def minus(self, y: Array, x: Array) -> Array:
        return (self._log(y, x)[..., None, :] @ np.swapaxes(self.basis(x), -1, -2))[..., 0, :]

    def mean(self, points: Array, weights: Array) -> Array:
        guess = _weighted(points, weights)
        if (quaternions.length(guess) < 1e-6).any():
            raise ArithmeticError(_NO_MEAN)
        return _iterated_mean(self._log, self._exp, points, weights, quaternions.normalise(guess))

    def transport(self, x: Array, delta: Array) -> Array:
        # Along the great circle; the basis at its end sees the carried tangents.
        step = (delta[..., None, :] @ self.basis(x))[..., 0, :]
        axis = quaternions.cross(x, step)
        turn = quaternions.to_matrix(quaternions.exp(axis))
        return self.basis(self.plus(x, delta)) @ turn @ np.swapaxes(self.basis(x), -1, -2)

    def _exp(self, x: Array, step: Array) -> Array:
        """The point at the end of the great-circle step (*, 3), a tangent vector at x."""
        angle = quaternions.length(step)
        return quaternions.normalise(np.cos(angle) * x + np.sinc(angle / np.pi) * step)

    def _log(self, y: Array, x: Array) -> Array:
        """The tangent vector (*, 3) at x that leads to y."""
        cosine = np.vecdot(x, y)[..., None]
        across = y - cosine * x
        sine = quaternions.length(across)
        size, opposite = sine + 1e-200, (sine < 1e-12) & (cosine < 0)
        if opposite.any():  # every way there is as long: the first tangent's is taken
            across, size = np.where(opposite, self.basis(x)[..., 0, :], across), np.where(opposite, 1.0, size)
        return np.arctan2(sine, cosine) / size * across


class Product:
    """Named parts side by side in one flat array: `Product(attitude=SO3(), rate=Euclidean(["x", "y", "z"], "rad/s"))`.

    `at[name]` and `axes_at[name]` are the part's slices of a state and of a change.
    """

    def __init__(self, **parts: Space) -> None:
        self.parts = {check_name(name, "part"): part for name, part in parts.items()}
        self.at, self.axes_at = dict[str, slice](), dict[str, slice]()
        n = d = 0
        for name, part in parts.items():
            self.at[name] = slice(n, n := n + len(part.names))
            self.axes_at[name] = slice(d, d := d + len(part.axes))
        self.names = tuple(f"{name}.{c}" for name, part in parts.items() for c in part.names)
        self.axes = tuple(f"{name}.{c}" for name, part in parts.items() for c in part.axes)
        self.units = tuple(u for part in parts.values() for u in part.units)
        self.axis_units = tuple(u for part in parts.values() for u in part.axis_units)
        self.flat = all(part.flat for part in parts.values())
        self._slices = [(part, self.at[name]) for name, part in self.parts.items()]

    def plus(self, x: Array, delta: Array) -> Array:
        moved = [part.plus(x[..., self.at[k]], delta[..., self.axes_at[k]]) for k, part in self.parts.items()]
        return np.concatenate(moved, axis=-1)

    def minus(self, y: Array, x: Array) -> Array:
        return np.concatenate([part.minus(y[..., s], x[..., s]) for part, s in self._slices], axis=-1)

    def mean(self, points: Array, weights: Array) -> Array:
        return np.concatenate([part.mean(points[..., s], weights) for part, s in self._slices], axis=-1)

    def transport(self, x: Array, delta: Array) -> Array:
        A = _identity(delta).copy()
        for name, part in self.parts.items():
            if not part.flat:
                at = self.axes_at[name]
                A[..., at, at] = part.transport(x[..., self.at[name]], delta[..., at])
        return A


def wrap(angle: Array) -> Array:
    """The same angles in [−π, π). Of many, those that are already are seen in a tenth of the time of a division."""
    turned = angle + np.pi
    if np.size(turned) <= 100:
        return turned % (2 * np.pi) - np.pi
    if not (turned.min() >= 0 and turned.max() < 2 * np.pi):  # nor where one is NaN
        turned[(turned < 0) | (turned >= 2 * np.pi)] %= 2 * np.pi
    turned -= np.pi
    return turned
