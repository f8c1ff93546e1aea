"""Two series of states on one clock: which of their rows belong together, and a state between two stamps."""

from __future__ import annotations

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space


def nanoseconds(times: Array) -> np.ndarray:
    """Stamps in s as whole nanoseconds, in which equal stamps are equal."""
    return np.round(times * 1e9).astype(np.int64)


def paired(first: Array, other: Array) -> tuple[np.ndarray, np.ndarray]:
    """The rows of two series (N,), (M,) of stamps in s with the same stamp to the nanosecond, in the first's order.

    Where a stamp occurs several times, its first row is paired with the other's first, its second with the second.
    """
    stamps = np.concatenate([nanoseconds(first), nanoseconds(other)])
    group = np.unique(stamps, return_inverse=True)[1]
    mine, theirs = (rows * len(stamps) + _occurrence(rows) for rows in (group[: len(first)], group[len(first) :]))
    _, rows, others = np.intersect1d(mine, theirs, assume_unique=True, return_indices=True)
    order = np.argsort(rows)
    return rows[order], others[order]


def _occurrence(group: np.ndarray) -> np.ndarray:
    """How many rows of the same group came before each row."""
    order = np.argsort(group, kind="stable")
    place = np.arange(len(group))
    starts = np.maximum.accumulate(np.where(np.diff(group[order], prepend=-1) != 0, place, 0))
    out = np.empty(len(group), np.int64)
    out[order] = place - starts
    return out


def on_stamps(space: Space, times: Array, states: Array, at: Array) -> Array:
    """States (K, n) at the stamps `at` (K,) from those (M, n) at `times` (M,), s; NaN beyond their ends.

    A stamp that is there gets its own state, bit for bit; between two, x·Exp(s·Log(x⁻¹y)), which for attitudes is the
    great circle's turn (Shoemake 1985) and for angles the shorter way round.
    """
    out = np.full((len(at), states.shape[-1]), np.nan)
    mine, theirs = paired(at, times)
    out[mine] = states[theirs]
    order = np.argsort(times, kind="stable")
    between = np.isnan(out).all(1) & (at > times[order[0]]) & (at < times[order[-1]])
    between[mine] = False
    if between.any():
        after = np.searchsorted(times[order], at[between], side="right")
        i, j = order[after - 1], order[after]
        share = (at[between] - times[i]) / (times[j] - times[i])
        with np.errstate(invalid="ignore"):  # a run that failed ends in NaN
            out[between] = space.plus(states[i], share[:, None] * space.minus(states[j], states[i]))
    return out
