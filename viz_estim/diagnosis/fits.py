"""Least squares of what a sensor's readings miss the truth by, with standard errors that hold where it is coloured."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from viz_estim.core.distributions import chi2, t
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space
from viz_estim.diagnosis.finding import level

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
    """A fit's coefficients (k,), their p against 0, the standard errors and degrees of freedom (k,) of that test, its
    gain in log-likelihood, and the share that it explains."""

    coefficients: Array
    p: Array
    error: Array
    dof: Array
    gain: float
    explained: float

    def p_beyond(self, i: int, size: float) -> float:
        """The chance of such a coefficient where it is of this size."""
        beyond = max(abs(float(self.coefficients[i])) - size, 0.0)
        return float(2 * t.sf(beyond / max(float(self.error[i]), 1e-300), self.dof[i]))


def fitted(one: Against, design: Array) -> Fitted:
    """r (M, m) on a design (M, m, k) by least squares in R; explained: the share of Σ|r|² beyond what noise may be, its
    χ² quantile at a warning's level."""
    X, y = white(one, design), white(one, one.r)
    M, m, k = X.shape
    A = np.einsum("tmi,tmj->ij", X, X)
    if not np.isfinite(A).all() or np.linalg.matrix_rank(A) < k:
        return Fitted(np.zeros(k), np.ones(k), np.ones(k), np.ones(k), 0.0, 0.0)
    beta = np.linalg.solve(A, np.einsum("tmi,tm->i", X, y))
    left = y - X @ beta
    scores = np.einsum("tmi,tm->ti", X, left)
    pieces = np.array([part.sum(0) for part in np.array_split(scores, min(STRETCHES, M // 5))])
    B = len(pieces)
    inverse = np.linalg.inv(A)
    robust = inverse @ (pieces.T @ pieces) @ inverse * B / (B - 1)
    model = inverse * max(1.0, float((left**2).mean()))
    error = np.sqrt(np.maximum(np.diag(robust), np.diag(model)))
    # Where the scatter over stretches is no larger than the noise's own, this is normal: a t of 19 would waste power.
    plain = np.diag(robust) < np.diag(model) * chi2.isf(0.01, B - 1) / (B - 1)
    error, dof = np.where(plain, np.sqrt(np.diag(model)), error), np.where(plain, M - k, B - 1)
    p = 2 * t.sf(np.abs(beta) / np.maximum(error, 1e-300), dof)
    own, rest = float((y**2).sum()), float((left**2).sum())
    noise = float(chi2.isf(level("warning", 1), M * m))
    # In the least variance that explains the rest, so that an R that is too small does not count for a cause.
    gain = 0.5 * M * m * np.log(own / max(rest, 1e-300))
    return Fitted(beta, p, error, dof, gain, (own - rest) / max(own - min(noise, rest), 1e-300))


class Slope(NamedTuple):
    """A slope through zero, its standard error and degrees of freedom, and Σ of the squares that are left."""

    value: float
    error: float
    dof: float
    left: float

    def p_beyond(self, size: float) -> float:
        """The chance of such a slope where it is of this size."""
        return float(2 * t.sf(max(abs(self.value) - size, 0.0) / max(self.error, 1e-300), self.dof))


def slope(y: Array, x: Array) -> Slope:
    """Of y on x (M,), with a standard error by 20 stretches of the run where that is larger."""
    A = float(x @ x)
    if A <= 0:
        return Slope(0.0, 1.0, 1.0, float(y @ y))
    slope = float(x @ y) / A
    left = y - slope * x
    pieces = np.array([part.sum() for part in np.array_split(x * left, min(STRETCHES, len(y) // 5))])
    B = len(pieces)
    scatter, model = float(pieces @ pieces) * B / (B - 1) / A**2, float(left @ left) / len(y) / A
    if scatter < model * chi2.isf(0.01, B - 1) / (B - 1):
        return Slope(slope, float(np.sqrt(model)), len(y) - 1, float(left @ left))
    return Slope(slope, float(np.sqrt(scatter)), B - 1, float(left @ left))
