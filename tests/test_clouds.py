"""Particles against the truth: what they are moved by is told from the recording, wherever the cloud has gone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from viz_estim import load, record
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, run
from viz_estim.core.spaces import SE2, Euclidean, Product
from viz_estim.diagnose import diagnose
from viz_estim.diagnosis import clouds, evidence, motion
from viz_estim.recording.memory import collect
from viz_estim.scenarios import beacons


def steered(seed: int, by: tuple[float, float]) -> Scenario:
    """Speed and turn rate of the control multiplied."""
    scenario = beacons.beacons_pf(beacons.beacons(None, np.random.default_rng(seed)), particles=500)
    ticks = [replace(t, control=None if t.control is None else t.control * by) for t in scenario.ticks]
    return replace(scenario, ticks=ticks)


def case(scenario: Scenario, seed: int = 0) -> evidence.Case:
    return evidence.case(collect(scenario, run(scenario, seed)))


@pytest.mark.parametrize(("by", "words", "factor"), [
    ((1.0, -1.0), "heading is predicted to move by -", -1.0),
    ((1.0, 3.0), "heading is predicted to move by ", 3.0),
])  # fmt: skip
def test_a_wrong_control_is_the_first_finding(by: tuple[float, float], words: str, factor: float) -> None:
    scenario = steered(100, by)
    first = diagnose(collect(scenario, run(scenario, 1)))[0]
    assert (first.code, first.severity) == ("process_model", "error")
    assert words in first.cause
    assert first.evidence["factor"] == pytest.approx(factor, rel=0.1)


def test_a_wrong_speed_is_told_though_it_is_always_the_same() -> None:
    scenario = steered(100, (0.5, 1.0))
    first = diagnose(collect(scenario, run(scenario, 1)))[0]
    assert (first.code, first.severity) == ("process_model", "error")
    assert "the way ahead" in first.cause
    assert "0.5" in first.cause or first.evidence["drift"] == pytest.approx(1.0, rel=0.1)


def test_a_right_control_is_none() -> None:
    found = [f for seed in range(20) for f in motion.prediction(case(steered(seed, (1.0, 1.0))))]
    assert found == []


def test_the_told_motion_is_what_the_control_says_in_the_body_s_frame() -> None:
    scenario = steered(3, (1.0, 1.0))
    moves = clouds.moves(case(scenario))
    assert moves is not None
    controls: Array = np.array([scenario.ticks[k].control for k in moves.step])
    dt = np.array([scenario.ticks[k].dt for k in moves.step])
    error = 0.447 * dt / 500**0.5
    assert np.abs(moves.told[:, 0] - controls[:, 0] * dt).max() < 5 * error.max()
    assert np.abs(moves.told[:, 2] - controls[:, 1] * dt).max() < 5 * error.max()
    assert scenario.truth is not None
    np.testing.assert_array_equal(moves.truly, SE2().minus(scenario.truth[moves.step], scenario.truth[moves.step - 1]))


def test_readings_that_pull_a_well_moved_cloud_away_are_said_to() -> None:
    scenario = steered(5, (1.0, 1.0))
    off = {name: 2.0 * (i == 0) for i, name in enumerate(scenario.ticks[0].measurements)}
    ticks = [replace(t, measurements={k: z + off[k] for k, z in t.measurements.items()}) for t in scenario.ticks]
    found = diagnose(collect(scenario, run(replace(scenario, ticks=ticks), 1)))
    told = next(finding for finding in found if finding.code == "overconfident")
    assert "the readings pull the cloud away" in told.cause


def kept(states: list[Array], tmp_path: Path) -> list[str]:
    """The codes that a person's own particle filter raises: by turns a prediction's states and a resampling's."""
    with record(tmp_path / "own.rrd", Product(place=Euclidean(("x", "y"), "m"))) as rec:
        for k, cloud in enumerate(states):
            rec.stage("predict" if k % 2 else "resample", states=cloud)
            rec.step(time=0.1 * k)
    return [finding.code for finding in diagnose(load(tmp_path / "own.rrd"))]


def test_copies_that_part_in_one_direction_alone_are_held_nowhere(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    states = []
    cloud = rng.standard_normal((300, 2))
    for _ in range(20):
        cloud = cloud[np.sort(rng.integers(0, 300, 300))]  # many copies of the outermost too
        states.append(cloud)
        cloud = cloud + np.stack([np.full(300, 0.1), rng.standard_normal(300)], axis=1)  # noise along y alone
        states.append(cloud)
    assert "particles_clamped" not in kept(states, tmp_path)


def test_particles_held_at_a_wall_are_told(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    states = []
    cloud = rng.standard_normal((300, 2))
    for _ in range(20):
        states.append(cloud + 0)
        cloud = np.minimum(cloud + rng.standard_normal((300, 2)), 1.5)
        states.append(cloud)
    assert "particles_clamped" in kept(states, tmp_path)
