"""The functions that an expression may call, each on the values of many moments at once: arrays (M, …)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.distributions import chi2
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import wrap


class BadExpression(ValueError):
    """An expression that means nothing here: one line that says why."""


def aligned(*values: Array) -> list[Array]:
    """The same with as many axes each, those that lack some filled after the first."""
    most = max((value.ndim for value in values), default=1)
    return [value.reshape(value.shape[:1] + (1,) * (most - value.ndim) + value.shape[1:]) for value in values]


def _items(function: Callable[..., Any]) -> Callable[[Array], Array]:
    """A function over all elements of each moment's value."""
    return lambda x: np.asarray(function(x.reshape(len(x), -1), axis=1))


def _least(function: Callable[..., Any], of_two: Callable[..., Any]) -> Callable[..., Array]:
    """min and max as Python has them: of one value's elements, or of several values."""

    def extreme(*values: Array) -> Array:
        if len(values) == 1:
            return _items(function)(values[0])
        found, *rest = aligned(*values)
        for value in rest:
            found = of_two(found, value)
        return found

    return extreme


def _matrices(function: Callable[[Array], Any]) -> Callable[[Array], Array]:
    """A function of square matrices (M, n, n); NaN where one isn't finite."""

    def of(matrix: Array) -> Array:
        if matrix.ndim != 3 or matrix.shape[1] != matrix.shape[2]:
            raise BadExpression(f"expected a square matrix, got {_shape(matrix)}")
        sound = np.asarray(np.isfinite(matrix).all((1, 2)))
        value = np.asarray(function(np.where(sound[:, None, None], matrix, 0.0)))
        return np.where(sound.reshape(-1, *[1] * (value.ndim - 1)), value, np.nan)

    return of


def _eigenvalues(matrix: Array) -> Array:
    scale = np.abs(matrix).max(initial=0.0)
    if np.abs(matrix - np.swapaxes(matrix, 1, 2)).max(initial=0.0) > 1e-8 * scale:
        raise BadExpression("eig() is for symmetric matrices, such as a covariance")
    return np.asarray(np.linalg.eigvalsh(matrix), float)


def _diagonal(matrix: Array) -> Array:
    if matrix.ndim != 3:
        raise BadExpression(f"diag() is for matrices, got {_shape(matrix)}")
    return np.diagonal(matrix, axis1=1, axis2=2)


def _euler(q: Array) -> Array:
    if q.shape[1:] != (4,):
        raise BadExpression(f"euler() is for a quaternion (w, x, y, z), got {_shape(q)}")
    return np.asarray(quaternions.to_euler(q))


# Each with the number of its arguments; None: any number from one on.
FUNCTIONS: dict[str, tuple[Callable[..., Any], int | None]] = {
    **{
        name: (getattr(np, name), 1)
        for name in ("sqrt", "exp", "log", "log10", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh",
                     "tanh", "abs", "sign", "floor", "ceil", "square", "degrees", "radians", "isnan", "isfinite")
    },
    **{name: (getattr(np, name), 2) for name in ("arctan2", "hypot", "minimum", "maximum")},
    "deg": (np.radians, 1),  # deg(10): ten degrees, in rad as all angles are
    "wrap": (wrap, 1),
    "min": (_least(np.min, np.minimum), None),
    "max": (_least(np.max, np.maximum), None),
    "sum": (_items(np.sum), 1),
    "any": (_items(np.any), 1),
    "all": (_items(np.all), 1),
    "norm": (_items(lambda x, axis: np.sqrt((x * x).sum(axis))), 1),
    "diag": (_diagonal, 1),
    "eig": (_matrices(_eigenvalues), 1),
    "det": (_matrices(np.linalg.det), 1),
    "trace": (lambda matrix: _diagonal(matrix).sum(1), 1),
    "cond": (_matrices(np.linalg.cond), 1),
    "euler": (_euler, 1),
    "chi2": (lambda dof, p: chi2.ppf(p, dof), 2),  # chi2(3, .999): what χ²(3) stays below with that probability
}  # fmt: skip


def _shape(value: Array) -> str:
    return "×".join(map(str, value.shape[1:])) or "one number"
