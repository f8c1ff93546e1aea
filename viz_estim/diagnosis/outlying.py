"""What an outlier is: one rule for what is told of them, what is set apart from a noise, and what passes a gate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from viz_estim.core.distributions import binom, chi2
from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.finding import level

TAIL = 1e-3  # of good readings: what a gate of 0.999 refuses, which is the one that remedies name


class Outlying(NamedTuple):
    """Which of the NIS (M,) are outliers, the NIS beyond which they lie, and the chance of such tails."""

    far: np.ndarray
    bound: float
    p: float


def outlying(nis: Array, dof: int, sensors: int) -> Outlying:
    """Those beyond χ²'s quantile of 1 − TAIL, where there are more than chance has, at a warning's share of a run with
    so many sensors: binomial, if the tails are normal; or by how far the largest is.

    NIS are first brought to their median, where that is above χ²'s: a noise that is too small is no outlier.
    """
    scale = max(1.0, float(np.median(nis)) / chi2.median(dof)) if len(nis) else 1.0
    bound = float(scale * chi2.isf(TAIL, dof))
    far = nis > bound
    p = min(binom.sf(far.sum() - 1, len(nis), TAIL), len(nis) * chi2.sf(nis.max(initial=0.0) / scale, dof))
    return Outlying(far & (p < level("warning", 2 * sensors)), bound, float(p))
