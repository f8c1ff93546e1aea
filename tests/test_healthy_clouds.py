"""Healthy particle filters and registrations: data of their own models raise no error and hardly a warning."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.registration import to_state
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.diagnose import diagnose
from viz_estim.recording.memory import collect
from viz_estim.scenarios import beacons, scan, se2
from viz_estim.scenarios.ranges import distances
from viz_estim.scenarios.scan_files import ScanData
from viz_estim.scenarios.se2_files import Drive

SEEDS = 20


def drawn(scenario: Scenario, rng: np.random.Generator, read: Callable[[Array], dict[str, Array]]) -> Scenario:
    """The scenario over a way drawn from its own filter's motion, from one of its first particles on."""
    start = scenario.beliefs[max(scenario.beliefs)]
    x, ticks, truth = start.states[rng.integers(len(start.states))], [], []  # type: ignore[union-attr]
    for tick in scenario.ticks:
        if tick.dt > 0:
            x = moved(scenario, x, tick, rng)
        ticks.append(replace(tick, measurements=read(x) if tick.measurements else {}))
        truth.append(x)
    return replace(scenario, ticks=ticks, truth=np.array(truth))


def moved(scenario: Scenario, x: Array, tick: Tick, rng: np.random.Generator) -> Array:
    filter = scenario.estimator
    return np.asarray(filter.propagate(x[None], tick, rng)[0])  # type: ignore[attr-defined]


def drive(rng: np.random.Generator) -> Scenario:
    """Positions at each second step of six seconds: wheels of 1.5 and 2 rad/s with a noise of 0.3."""
    time, unknown = 0.1 * np.arange(61), np.full((61, 3), np.nan)
    positions = np.where(np.arange(61)[:, None] % 2 == 1, 0.0, np.nan) * np.ones(2)
    data = Drive(time, np.tile([1.5, 2.0], (61, 1)), positions, unknown, 0.3, ())
    return drawn(se2.se2_pf(data, particles=350), rng, lambda x: {"gps": x[:2] + 0.1 * rng.standard_normal(2)})


def to_beacons(rng: np.random.Generator) -> Scenario:
    """From an unknown start, with the filter's wide noises."""

    def read(x: Array) -> dict[str, Array]:
        return {
            f"range/{i + 1}": distances(x[None, :2], place[None])[0] + 0.837 * rng.standard_normal(1)
            for i, place in enumerate(beacons.BEACONS)
        }

    return drawn(beacons.beacons_pf(beacons.beacons(None, rng), particles=1000), rng, read)


def registration(rng: np.random.Generator) -> Scenario:
    """Clouds of the same points, so that a pair's error is its own, as the covariance takes it to be."""
    turn, shift = quaternions.exp(0.02 * rng.standard_normal(3)), 0.02 * rng.standard_normal(3)
    Y = rng.uniform(-2.0, 2.0, (300, 3))
    R = quaternions.to_matrix(turn)
    X = (Y + 0.004 * rng.standard_normal(Y.shape) - shift) @ R
    return scan.scan_icp(ScanData(X, Y, to_state(R, shift)))


@pytest.mark.parametrize("make", [drive, to_beacons, registration])
def test_no_error_and_at_most_one_warning_in_ten_runs(make: Callable[[np.random.Generator], Scenario]) -> None:
    found: Counter[str] = Counter()
    for seed in range(SEEDS):
        if seed == SEEDS // 2 and not found["warning"]:
            break  # a fifth of runs that warn shows as none in ten in 11 %, as two in twenty at most in 21 %
        scenario = make(np.random.default_rng(1000 + seed))
        for finding in diagnose(collect(scenario, run(scenario, seed))):
            found[finding.severity] += 1
            assert finding.severity != "error", (seed, finding)
    assert found["warning"] <= SEEDS / 10, found
