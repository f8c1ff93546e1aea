"""The models as straight lines: F and H, as they are recorded or follow from what is, and how far a line is one."""

from __future__ import annotations

from typing import Any

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space
from viz_estim.diagnosis.evidence import Case, once
from viz_estim.diagnosis.finding import EXPLAINED, SOLVABLE, TINY
from viz_estim.recording.tables import StageTable


def jacobians(case: Case, table: StageTable) -> Array:
    """H (M, m, d) = Cᵀ·P⁻¹ of an update by its cross-covariances C (M, d, m), NaN where C or P before it is not finite;
    by the pseudo-inverse where P is singular."""
    return once(case, f"_jacobians of {table.name}", lambda case: _jacobians(case, table))


def _jacobians(case: Case, table: StageTable) -> Array:
    P, C = case.sequence.before(table)[1], table.values["innovation.cross_cov"]
    H = np.full((*C.shape[:1], C.shape[2], C.shape[1]), np.nan)
    ok = np.isfinite(P).all((1, 2)) & np.isfinite(C).all((1, 2))
    fine = ok & case.sequence.sound_before(table)
    H[fine] = np.swapaxes(np.linalg.solve(P[fine], C[fine]), 1, 2)
    if (ok & ~fine).any():
        solved = np.linalg.pinv(P[ok & ~fine], rcond=1 / SOLVABLE, hermitian=True) @ C[ok & ~fine]
        H[ok & ~fine] = np.swapaxes(solved, 1, 2)
    return H


def transitions(case: Case, table: StageTable) -> Array | None:
    """F (M, d, d) of a prediction: as recorded, or by least squares over its sigma points."""
    return once(case, f"_transitions of {table.name}", lambda case: _transitions(case, table))


def _transitions(case: Case, table: StageTable) -> Array | None:
    if "transition" in table.values and table.values["transition"].shape[1:] == case.run.cov.shape[1:]:
        return table.values["transition"]
    drawn, moved = table.values.get("drawn.points"), table.values.get("propagated.points")
    if drawn is None or moved is None or np.isnan(drawn).any() or np.isnan(moved).any():
        return None
    space: Any = case.space
    mean, _ = case.sequence.before(table)
    d, extra = len(space.axes), drawn.shape[-1] - len(space.names)
    x = space.minus(drawn[..., : len(space.names)], mean[:, None, :])
    if extra:  # noise among the points
        x = np.concatenate([x, drawn[..., len(space.names) :]], axis=-1)
    y = space.minus(moved, table.mean[:, None, :])
    # Scaled, since states of very unlike size would lose the small ones; without those whose spread is rounding.
    size = np.abs(x).max(1, keepdims=True)
    size = np.where(size > 8 * np.finfo(float).eps * np.abs(drawn).max(), size, np.inf)
    x = x / size
    xT = np.swapaxes(x, 1, 2)
    fit = np.linalg.pinv(xT @ x, rcond=1 / SOLVABLE, hermitian=True) @ (xT @ y)
    return np.swapaxes(fit / np.swapaxes(size, 1, 2), 1, 2)[:, :, :d]


def tangents(space: Space, mean: Array, moved: Array) -> list[Array]:
    """The matrices (M, d, d) by which filters carry a covariance on when the mean (M, n) is moved (M, d).

    Not at all; by the half of it, as error-state filters reset (Solà 2017, eq. 287); or to the tangent space at the new
    mean. They differ to the first order of the move, and none is wrong.
    """
    shares = (0.0,) if space.flat else (0.0, 0.5, 1.0)
    return [np.asarray(space.transport(mean, share * moved), float) for share in shares]


def straight(space: Space, values: Array, time: Array, lag: float) -> bool:
    """Whether values (M, n) go along a line for as long as a lag τ (s), so that it is a matter of their rate alone.

    A line leaves ½·τ²·z̈ (Taylor): half of what the ways in τ before and after a reading differ by. It must explain
    EXPLAINED of the squares of these ways. It decides no rate: of false alarms it can but take some away."""
    k = max(1, round(abs(lag) / max(float(np.median(np.diff(time))), TINY))) if len(time) > 1 else 1
    if 2 * k >= len(values):
        return False
    way = space.minus(values[k:-k], values[: -2 * k])
    bent = 0.5 * (space.minus(values[2 * k :], values[k:-k]) - way)
    return bool(np.square(bent).sum() < (1 - EXPLAINED) * np.square(way).sum())
