"""The distributions by scipy.special against scipy.stats, far into both tails and at the edges."""

from typing import Any

import numpy as np
import pytest
import scipy.stats

from viz_estim.core import distributions

X = np.concatenate([[-1.0, 0.0], np.geomspace(1e-3, 400, 30)])
P = np.array([1e-9, 1e-4, 0.01, 0.3, 0.5, 0.9, 0.9999])
DOF = np.array([[0.0], [1.0], [2.0], [3.5], [60.0], [5000.0]])
TRIALS = np.array([[1], [7], [300]])
CASES: dict[str, tuple[str, tuple[Any, ...]]] = {
    "chi2.cdf": ("cdf", (X, DOF)),
    "chi2.sf": ("sf", (X, DOF)),
    "chi2.ppf": ("ppf", (P, DOF)),
    "chi2.isf": ("isf", (P, DOF)),
    "chi2.median": ("median", (DOF,)),
    "norm.sf": ("sf", (np.concatenate([X, -X]),)),
    "norm.isf": ("isf", (P,)),
    "t.sf": ("sf", (np.concatenate([X, -X]), DOF)),
    "t.isf": ("isf", (P, DOF)),
    "f.sf": ("sf", (X, DOF[1:], DOF[::-1][:-1])),
    "f.isf": ("isf", (P[1:], DOF[1:], DOF[::-1][:-1])),  # scipy's own is right to eight digits at 1e-9
    "binom.cdf": ("cdf", (np.arange(-1, 302), TRIALS, 0.3)),
    "binom.sf": ("sf", (np.arange(-1, 302), TRIALS, 0.3)),
}


@pytest.mark.parametrize("name", CASES)
def test_it_is_scipy_s(name: str) -> None:
    kind, (method, arguments) = name.partition(".")[0], CASES[name]
    ours = getattr(getattr(distributions, kind), method)(*arguments)
    theirs = getattr(getattr(scipy.stats, kind), method)(*arguments)
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-300)
    one = getattr(getattr(distributions, kind), method)(*(np.ravel(a)[-1] for a in arguments))
    assert np.ndim(one) == 0


def test_far_in_the_tail_of_f_the_inverse_is_one() -> None:
    p, k, m = np.array([1e-60, 1e-12, 1e-9]), DOF[1:], DOF[::-1][:-1]
    np.testing.assert_allclose(distributions.f.sf(distributions.f.isf(p, k, m), k, m), p * np.ones_like(k), rtol=1e-9)
