"""The distributions that tests of significance need, by scipy.special: importing scipy.stats takes a second or more.

Named as in scipy.stats, and equal to it: `cdf`, `sf` = 1 − cdf, and their inverses `ppf` and `isf`; all broadcast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy


class chi2:
    """χ² with k > 0 degrees of freedom; NaN for k ≤ 0."""

    @staticmethod
    def cdf(x: Any, k: Any) -> Any:
        return scipy.special.chdtr(_positive(k), np.maximum(x, 0.0))

    @staticmethod
    def sf(x: Any, k: Any) -> Any:
        return scipy.special.chdtrc(_positive(k), np.maximum(x, 0.0))

    @staticmethod
    def ppf(p: Any, k: Any) -> Any:
        return 2 * scipy.special.gammaincinv(0.5 * _positive(k), np.asarray(p, float))

    @staticmethod
    def isf(p: Any, k: Any) -> Any:
        return scipy.special.chdtri(_positive(k), p)

    @staticmethod
    def median(k: Any) -> Any:
        return chi2.ppf(0.5, k)


class norm:
    """The standard normal distribution."""

    @staticmethod
    def sf(x: Any) -> Any:
        return scipy.special.ndtr(-np.asarray(x, float))

    @staticmethod
    def isf(p: Any) -> Any:
        return -scipy.special.ndtri(np.asarray(p, float))


class t:
    """Student's t with k > 0 degrees of freedom; NaN for k ≤ 0."""

    @staticmethod
    def sf(x: Any, k: Any) -> Any:
        return scipy.special.stdtr(_positive(k), -np.asarray(x, float))

    @staticmethod
    def isf(p: Any, k: Any) -> Any:
        return -scipy.special.stdtrit(_positive(k), np.asarray(p, float))


class f:
    """Fisher's F with k and m degrees of freedom."""

    @staticmethod
    def sf(x: Any, k: Any, m: Any) -> Any:
        return scipy.special.fdtrc(_positive(k), _positive(m), np.maximum(x, 0.0))

    @staticmethod
    def isf(p: Any, k: Any, m: Any) -> Any:
        # The inverse has m and k: 1 − p would be 1 for small p.
        return 1 / scipy.special.fdtri(_positive(m), _positive(k), p)


class binom:
    """How many of n independent trials succeed, each with probability q."""

    @staticmethod
    def cdf(k: Any, n: Any, q: Any) -> Any:
        """P(at most k) = I₁₋q(n − k, k + 1), the incomplete beta function."""
        k = np.floor(k)
        inside = scipy.special.betainc(np.maximum(n - k, 1), np.maximum(k + 1, 1), 1.0 - q)
        return np.where(k < 0, 0.0, np.where(k >= n, 1.0, inside))[()]

    @staticmethod
    def sf(k: Any, n: Any, q: Any) -> Any:
        """P(more than k) = I_q(k + 1, n − k)."""
        k = np.floor(k)
        inside = scipy.special.betainc(np.maximum(k + 1, 1), np.maximum(n - k, 1), q)
        return np.where(k < 0, 1.0, np.where(k >= n, 0.0, inside))[()]


def _positive(k: Any) -> Any:
    return np.where(np.asarray(k) > 0, k, np.nan)
