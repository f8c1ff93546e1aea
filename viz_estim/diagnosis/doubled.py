"""An update that takes in one reading twice, by the covariance that it leaves."""

from __future__ import annotations

import numpy as np

from viz_estim.core.measurement import symmetrised
from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.finding import SHEET, TINY, Severity
from viz_estim.diagnosis.rounding import sound

LINE: tuple[Severity, str, str, str] = (
    "error", "twice", "the covariance after an update is what two updates by one reading leave: it is taken in twice, "
    "and the filter becomes too sure", "take each reading in once",
)  # fmt: skip


def doubled(P: Array, C: Array, S: Array, R: Array, after: Array, once: Array) -> bool:
    """Whether the covariances after (M, d, d) are those of two readings and not `once` what one leaves.

    Of P (M, d, d) before, C = P·Hᵀ (M, d, m), S, R (M, m, m): information adds up, P⁺⁻¹ = P⁻¹ + 2·HᵀR⁻¹H, which is
    P⁺ = P − 2·C·(2·S − R)⁻¹·Cᵀ by the matrix inversion lemma.
    """
    D = 2 * S - R
    if not R.any() or not sound(symmetrised(D)).all():
        return False
    twice = P - 2 * C @ np.linalg.solve(D, np.swapaxes(C, 1, 2))
    size, left, told = (np.linalg.norm(A, axis=(1, 2)) for A in (after, after - twice, twice - once))
    return bool(np.median(told / size) > SHEET**2 and np.median(left / np.maximum(told, TINY)) < SHEET)
