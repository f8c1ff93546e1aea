"""Registration of two clouds by iterated closest points: the pose that takes X into Y's frame, y ≈ R·x + t.

Besl and McKay (1992), with matches within a distance only. The fit is Horn's (1987), by singular values (Arun, Huang
and Blostein 1987) with the determinant's sign, so that it is never a reflection (Umeyama 1991). One iteration is one
step: `match`, then `align`.

Letters: d = 2 or 3 dimensions; X (N, d) and Y (M, d) the clouds in m; x, y (K, d) their matched points; R (*, d, d),
t (*, d) the pose; H (*, d, d) the covariance of x with y, times K; G (g, d, d) the generators of rotation, g = 1 or 3.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from viz_estim.core import quaternions
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.measurement import symmetrised, transposed
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick
from viz_estim.core.spaces import SO2, SO3, Euclidean, Product
from viz_estim.core.stages import Align, Match, Matches, Stage, names_its_failures

SPACES = {
    2: Product(position=Euclidean(("x", "y"), "m"), heading=SO2()),
    3: Product(position=Euclidean(("x", "y", "z"), "m"), attitude=SO3()),
}
_GENERATORS = {
    2: np.array([[[0.0, -1.0], [1.0, 0.0]]]),
    3: np.array(
        [
            [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
            [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
            [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
        ]
    ),
}
_DEGENERATE = 1e-12  # of the largest singular value: a cloud that is a millionth as wide as it is long


def to_state(R: Array, t: Array) -> Array:
    """The pose as a state (*, 3) or (*, 7) of its space in SPACES."""
    turn = np.arctan2(R[..., 1, :1], R[..., 0, :1]) if t.shape[-1] == 2 else quaternions.from_matrix(R)
    return np.concatenate([t, turn], axis=-1)


def to_pose(state: Array) -> tuple[Array, Array]:
    """R (*, d, d) and t (*, d) of a state (*, 3) or (*, 7)."""
    if state.shape[-1] == 7:
        return quaternions.to_matrix(state[..., 3:]), state[..., :3]
    c, s = np.cos(state[..., 2]), np.sin(state[..., 2])
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2), state[..., :2]


def moved(state: Array, points: Array) -> Array:
    """R·x + t (*, N, d) of points (*, N, d)."""
    R, t = to_pose(state)
    return points @ transposed(R) + t[..., None, :]


class Fit(NamedTuple):
    """R (*, d, d) and t (*, d); residual y − R·x − t (*, K, d); cov (*, p, p) over the axes of the space in SPACES."""

    R: Array
    t: Array
    residual: Array
    cov: Array


def fit(x: Array, y: Array) -> Fit:
    """The pose with the least Σ|y − R·x − t|² over pairs x, y (*, K, d), and its covariance by least squares.

    cov = s²·(JᵀJ)⁻¹ with s² = Σ|residual|²/(d·K − p), p = d(d + 1)/2: it takes each pair as right and the residuals as
    independent noise. ICP's errors come from wrong pairs, and neighbours share them: this covariance is known to be far
    too small (Censi 2007). It is zero where the pairs fit exactly. ArithmeticError where the pairs do not determine a
    rotation: at one place, on one line in 3-D, or mirrored so that several are as good.
    """
    x_mean, x = _centred(x)
    y_mean, y = _centred(y)
    H = transposed(x) @ y
    U, sizes, Vt = np.linalg.svd(H)
    sign = np.copysign(1.0, np.linalg.det(U) * np.linalg.det(Vt))
    if (sizes[..., -2] + sign * sizes[..., -1] <= _DEGENERATE * sizes[..., 0]).any():
        raise ArithmeticError(
            "the matches do not determine a rotation: they lie at one place, on one line, or mirror each other"
        )
    Vt[..., -1, :] *= sign[..., None]
    R = transposed(U @ Vt)
    residual = y - x @ transposed(R)
    return Fit(R, y_mean - (R @ x_mean[..., None])[..., 0], residual, _covariance(x_mean, x, residual, R))


def _centred(points: Array) -> tuple[Array, Array]:
    """The mean (*, d) of points (*, K, d), and the points from there."""
    mean = np.einsum("...ki->...i", points) / points.shape[-2]  # numpy's own takes four times as long, of so short rows
    return mean, points - mean[..., None, :]


def _covariance(centre: Array, x: Array, residual: Array, R: Array) -> Array:
    """s²·(JᵀJ)⁻¹ of a fit to points x (*, K, d), given from their centre (*, d)."""
    K, d = x.shape[-2:]
    G = _GENERATORS[d]
    p = d + len(G)
    # About the centre J's columns are orthogonal: K·I for its place, B for the rotation. The frame's origin moves by
    # −W·δ when δ turns the cloud about its centre.
    B = np.einsum("kji,ljm,...mi->...kl", G, G, transposed(x) @ x)
    W = np.einsum("...ij,kjm,...m->...ik", R, G, centre)
    WB = transposed(np.linalg.solve(B, transposed(W)))
    A = np.empty((*centre.shape[:-1], p, p))
    A[..., :d, :d] = np.eye(d) / K + WB @ transposed(W)
    A[..., :d, d:], A[..., d:, :d] = -WB, -transposed(WB)
    A[..., d:, d:] = np.linalg.solve(B, np.broadcast_to(np.eye(len(G)), B.shape))
    variance = np.einsum("...ki,...ki->...", residual, residual) / (d * K - p)
    return symmetrised(variance[..., None, None] * A)


def start(X: Array, max_distance: float) -> Gaussian:
    """The belief that the clouds lie in one frame already, to within what a match can bridge.

    Standard deviations: max_distance along each axis, and about each the angle that moves X's points by as much (their
    root mean squared distance from the origin), at most a half turn.
    """
    space = SPACES[X.shape[-1]]
    d, p = X.shape[-1], len(space.axes)
    radius = np.sqrt(np.einsum("ni,ni->", X, X) / len(X))
    std = np.full(p, max_distance)
    std[d:] = np.pi if max_distance >= np.pi * radius else max_distance / radius
    return Gaussian(space, to_state(np.eye(d), np.zeros(d)), np.diag(std**2))


def nearest(points: Array, tree: scipy.spatial.cKDTree, max_distance: float) -> Matches:
    """Each of the points (N, d) that has one of the tree's within max_distance (m), with the nearest."""
    # The tree takes its bound as excluded.
    distance, index = tree.query(points, distance_upper_bound=np.nextafter(max_distance, np.inf))
    rows = np.flatnonzero(index < tree.n)
    if len(rows) < len(points):
        points, distance, index = points.take(rows, axis=0), distance[rows], index[rows]
    return Matches(points, tree.data.take(index, axis=0), distance, rows, index)


@names_its_failures
def align(belief: Gaussian, X: Array, matches: Matches, *, name: str = "align") -> Align:
    """The pose that fits the matches best, whatever the belief was; `converged` is left to who knows the next ones.

    ArithmeticError where fewer than d points have a match, or the matches do not determine a pose.
    """
    (N, d), K = X.shape, len(matches.distance)
    if d > K:
        raise ArithmeticError(
            f"{K} of {N} points have a match, a pose takes at least {d}: the clouds lie further apart than the largest "
            "distance of a match"
        )
    x = X if K == N else X.take(matches.source_index, axis=0)
    R, t, residual, cov = fit(x, matches.target)
    rmse = float(np.sqrt(np.einsum("ki,ki->", residual, residual) / K))
    return Align(name, Gaussian(belief.space, to_state(R, t), cov), rmse, K, converged=False)


class ClosestPoints:
    """An estimator: one iteration a step, at ticks with a dt; it takes cloud X (N, d) on to cloud Y (M, d), in m."""

    pure = True

    def __init__(self, X: Array, Y: Array, max_distance: float) -> None:
        self.X, self.max_distance = X, max_distance
        self._tree = scipy.spatial.cKDTree(Y)
        self._last: tuple[Array, Matches] | None = None

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        if tick.dt == 0:
            return
        matches = self._matches(belief.mean)
        yield Match("match", belief, matches)
        stage = align(belief, self.X, matches)
        after = self._matches(stage.belief.mean)
        same = all(np.array_equal(getattr(matches, k), getattr(after, k)) for k in ("source_index", "target_index"))
        yield replace(stage, converged=same)

    def _matches(self, state: Array) -> Matches:
        """The matches at a pose. The last are kept, for the next step begins where this one ended: it saves the search,
        and no answer depends on it."""
        if self._last is None or not np.array_equal(self._last[0], state):
            self._last = state, nearest(moved(state, self.X), self._tree, self.max_distance)
        return self._last[1]
