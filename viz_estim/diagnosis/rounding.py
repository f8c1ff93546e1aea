"""How far numbers may be off because they have so many digits, by how they were made; no chance is in it."""

from __future__ import annotations

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.finding import SOLVABLE, TINY
from viz_estim.recording.reader import Run

NANOSECOND = 1e-9  # s: to what stamps are kept


def epsilon(values: Array) -> float:
    """The rounding of numbers, a float32's where all of them are such, and more than a few."""
    single = np.array_equal(values.astype(np.float32).astype(float), values, equal_nan=True)
    single &= np.unique(values[:50]).size > values.shape[-1] ** 2
    return float(np.finfo(np.float32 if single else float).eps)


def rounding_of(before: Array, after: Array) -> Array:
    """What rounding leaves of covariances after a stage (M,): their terms are products of d × d matrices as large as
    those before it, some eight of them (`broken`)."""
    return np.asarray(8 * before.shape[-1] * epsilon(after) * np.abs(before).max((1, 2)))


def of_stamps(run: Run) -> float:
    """By how much (s) a dt of the run may miss the difference of two stamps, or another dt: each of the numbers is kept
    to the nanosecond and to a float's last digit, at either end."""
    return 4 * (NANOSECOND + float(np.spacing(np.abs(run.time).max())))


def of_logs(*logs: Array) -> float:
    """The same of logarithms (N,) of weights that were normalised, at their size, of the coarser floats (Higham 2002,
    section 3.1): some eight sums and differences."""
    size = max(float(np.abs(w[np.isfinite(w)]).max(initial=1.0)) for w in logs)
    return 8 * float(np.finfo(np.float32).eps) * size


def sound(P: Array) -> np.ndarray:
    """Which of covariances (M, d, d) are finite, positive definite, and well enough conditioned to be solved with."""
    finite: np.ndarray = np.asarray(np.isfinite(P).all((1, 2)))
    values = np.linalg.eigvalsh(np.where(finite[:, None, None], P, 0.0))
    return np.asarray(finite & (values[:, 0] > 0) & (values[:, -1] < SOLVABLE * np.maximum(values[:, 0], TINY)))
