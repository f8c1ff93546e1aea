"""Least squares of what a sensor's readings miss the truth by, with standard errors that hold where it is coloured."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from viz_estim.core.distributions import chi2, t
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space
from viz_estim.diagnosis.finding import TINY, Chance, level

# Of the run: so long that what is coloured within one is hardly so between two (Liang and Zeger 1986). Their number is
# a matter of power alone, for with B of them a mean is t of B − 1 degrees of freedom.
STRETCHES = 20


@dataclass(frozen=True, eq=False)
class Against:
    """A sensor's M readings against the truth: z (M, n), what the truth would give (M, n), r (M, m), R (M, m, m).

    foreseen (M, m) is the variance of the truth's reading by the filter's prediction, (H·P·Hᵀ)ᵢᵢ; slip (M,) bounds the
    error of r by the model of the sensor, in standard deviations of R. part: which of the sensor's parts it is, if it
    has several; exact: the model is the filter's own and no line along its Jacobian; attitude (M, d, d): the truth's,
    world from body, if a part of the state says it; places (m, d), position (M, d): of distances, from where the model
    takes them to be, and to where. by_control: the model takes the control.
    """

    name: str
    space: Space
    step: np.ndarray
    time: Array
    z: Array
    true: Array
    r: Array
    noise: Array
    foreseen: Array
    slip: Array
    part: str
    exact: bool
    attitude: Array | None
    places: Array | None = None
    position: Array | None = None
    by_control: bool = False

    def pick(self, rows: slice | np.ndarray) -> Against:
        """Some of the readings."""
        arrays = {f.name: v for f in fields(self) if isinstance(v := getattr(self, f.name), np.ndarray)}
        return replace(self, **{name: v[rows] for name, v in arrays.items()})

    @cached_property
    def whitening(self) -> Array:
        """L⁻¹ (M, m, m), R = L·Lᵀ: some sixty causes are held against the same noise."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.noise)), float)

    @property
    def label(self) -> str:
        return f"{self.name} {self.part}" if self.part else self.name

    def axis(self, i: int) -> str:
        """A component as people call it: `gps x`, `pose attitude z`, `range 2`, `range/1`."""
        axis = self.space.axes[i]
        own = axis in ("", "angle", self.name.partition("/")[0])
        return self.label if own else f"{self.label} {axis}"


def white(one: Against, values: Array) -> Array:
    """L⁻¹·v of values (M, m) or (M, m, k), R = L·Lᵀ."""
    return (one.whitening @ values[..., None])[..., 0] if values.ndim == 2 else one.whitening @ values


class Fitted(NamedTuple):
    """A fit's coefficients (k,), their standard errors (2, k), by noise that is white and by stretches of the run, with
    the degrees of freedom (2,) of their tests, its gain in log-likelihood, and the share that it explains."""

    coefficients: Array
    error: Array
    dof: tuple[float, float]
    gain: float
    explained: float

    def p(self, i: int, size: float = 0.0) -> Chance:
        """The chance of such a coefficient where it is of this size."""
        return _chance(abs(float(self.coefficients[i])) - size, self.error[:, i], self.dof)


def in_stretches(values: Array) -> Array:
    """Sums (B, …) of values (M, …) over STRETCHES parts of the run, or as many as have five each."""
    B = max(1, min(STRETCHES, len(values) // 5))
    return np.asarray(np.add.reduceat(values, np.arange(B) * len(values) // B, axis=0))


def _chance(off: float, error: Array, dof: tuple[float, float]) -> Chance:
    """By t-tests of what is `off`, with each of two standard errors (2,)."""
    scores = max(off, 0.0) / np.maximum(error, TINY)
    return Chance(*(float(2 * t.sf(score, of)) for score, of in zip(scores, dof, strict=True)))


def fitted(one: Against, design: Array) -> Fitted:
    """r (M, m) on a design (M, m, k) by least squares in R."""
    return least_squares(white(one, design), white(one, one.r), 1.0)


def least_squares(X: Array, y: Array, variance: float = 0.0) -> Fitted:
    """y (M, m) on X (M, m, k), whose noise has this variance at least; explained: the share of Σ|y|² beyond what such
    noise may be, its χ² quantile at a warning's level. Zeros where X does not tell all coefficients."""
    M, m, k = X.shape
    A = np.einsum("tmi,tmj->ij", X, X)
    if not np.isfinite(A).all() or np.linalg.matrix_rank(A) < k:
        return Fitted(np.zeros(k), np.ones((2, k)), (1.0, 1.0), 0.0, 0.0)
    inverse = np.linalg.inv(A)
    beta = np.linalg.solve(A, np.einsum("tmi,tm->i", X, y))
    left = y - X @ beta
    pieces = in_stretches(np.einsum("tmi,tm->ti", X, left)) @ inverse
    spread = max(len(pieces) - 1, 1)
    model = np.diag(inverse) * max(variance, float((left**2).mean()))
    error = np.sqrt([model, np.square(pieces).sum(0) * len(pieces) / spread])
    own, rest = float((y**2).sum()), float((left**2).sum())
    noise = variance * float(chi2.isf(level("warning", 1), M * m))
    # In the least variance that explains the rest, so that an R that is too small does not count for a cause.
    gain = 0.5 * M * m * np.log(own / max(rest, TINY))
    return Fitted(beta, error, (M - k, spread), gain, (own - rest) / max(own - min(noise, rest), TINY))


class Slope(NamedTuple):
    """A slope through zero, its standard errors (2,) and their degrees of freedom as of `Fitted`, and Σ of the squares
    that are left."""

    value: float
    errors: Array
    dof: tuple[float, float]
    left: float

    @property
    def error(self) -> float:
        """The larger one."""
        return float(self.errors.max())

    def p(self, size: float = 0.0) -> Chance:
        """The chance of such a slope where it is of this size."""
        return _chance(abs(self.value) - size, self.errors, self.dof)


def slope(y: Array, x: Array) -> Slope:
    """Of y on x (M,)."""
    A = float(x @ x)
    if A <= 0:
        return Slope(0.0, np.ones(2), (1.0, 1.0), float(y @ y))
    slope = float(x @ y) / A
    left = y - slope * x
    pieces, squares = in_stretches(x * left) / A, float(left @ left)
    spread = max(len(pieces) - 1, 1)
    errors = np.sqrt([squares / len(y) / A, float(pieces @ pieces) * len(pieces) / spread])
    return Slope(slope, errors, (len(y) - 1, spread), squares)
