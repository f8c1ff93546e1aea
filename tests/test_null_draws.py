"""Thresholds of what is held against the truth: readings drawn of their own noise raise no more than is stated."""

from dataclasses import replace

import numpy as np
import pytest
from test_thresholds import case_of, severities

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.diagnosis import clocks, evidence, truth, weighing
from viz_estim.diagnosis.finding import _FAMILIES, GROSS
from viz_estim.diagnosis.fits import Against

SHARE = 0.05 / _FAMILIES  # of a check: warnings a run


def held(r: Array, belief: str) -> evidence.Case:
    """A run of one sensor that misses a truth on a winding way by r (N, 2), with R = 1."""
    N = len(r)
    time = 0.1 * np.arange(N)
    true = np.stack([20 * np.sin(0.3 * time), 12 * np.sin(0.5 * time + 1)], axis=-1)
    one = Against(
        "gps", Euclidean(("x", "y"), "m"), np.arange(N), time, true + r, true, r, np.tile(np.eye(2), (N, 1, 1)),
        np.full((N, 2), 0.25), np.zeros(N), "", True, None,
    )  # fmt: skip
    case = case_of(np.zeros((N, 2)))
    case = replace(case, run=replace(case.run, properties=case.run.properties | {"belief": belief}))
    object.__setattr__(case, "_against", [one])
    return case


def test_readings_of_their_own_noise_have_no_cause() -> None:
    rng = np.random.default_rng(11)
    found = [s for _ in range(120) for s in severities(truth.sensors(held(rng.standard_normal((150, 2)), "Gaussian")))]
    assert len(found) <= 120 * SHARE + 3 * (120 * SHARE) ** 0.5, found
    assert "error" not in {severity for _, severity in found}


@pytest.mark.parametrize(("factor", "most"), [(1.0, {"warning"}), (GROSS, {"warning"}), (2 * GROSS, {"error"})])
def test_a_likelihood_s_noise_is_an_error_where_it_is_surely_too_small_by_gross(factor: float, most: set[str]) -> None:
    rng, draws = np.random.default_rng(12), 300
    found = [
        severity
        for _ in range(draws)
        for _, severity in severities(weighing.noises(held(factor**0.5 * rng.standard_normal((150, 2)), "Particles")))
    ]
    assert set(found) <= most
    if factor == 1:
        assert len(found) <= draws * SHARE + 3 * (draws * SHARE) ** 0.5
    else:
        assert len(found) > 0.9 * draws
    assert list(weighing.noises(held(0.5 * rng.standard_normal((150, 2)), "Particles"))) == []  # too large costs only


def clocked(scale: float, rng: np.random.Generator) -> evidence.Case:
    """A truth whose velocity, times the stamps' differences, goes `scale` times as far as it does."""
    case, N = case_of(np.zeros((200, 1))), 200
    time = 0.1 * np.arange(N)
    v = np.stack([1 + 0.5 * np.sin(time), np.cos(0.7 * time)], axis=-1)
    x = np.concatenate([np.zeros((1, 2)), np.cumsum(0.05 * (v[1:] + v[:-1]), axis=0)])
    noisy = np.concatenate([x + 0.002 * rng.standard_normal(x.shape), v + 0.01 * rng.standard_normal(v.shape)], axis=1)
    space = Product(position=Euclidean(("x", "y"), "m"), velocity=Euclidean(("x", "y"), "m/s"))
    recorded = replace(case.run, space=space, step=np.arange(N), time=scale * time, dt=np.full(N, 0.1), truth=noisy)
    return replace(case, run=recorded)


def test_a_clock_is_told_by_its_unit_alone() -> None:
    rng = np.random.default_rng(13)
    assert not [f for scale in (1.0, 1.05, 0.95, 1.3) for _ in range(50) for f in clocks.clock(clocked(scale, rng))]
    for scale, unit in ((1e3, "milliseconds"), (1e9, "nanoseconds")):
        (finding,) = clocks.clock(clocked(scale, rng))
        assert (finding.code, finding.severity) == ("stamps", "error")
        assert unit in finding.cause
