"""Mistakes of a first filter, beside the gallery's: each told by its right words, and none where there is none."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.core.stages import Stage, Update
from viz_estim.diagnose import diagnose
from viz_estim.diagnosis import clocks, copies, durations, evidence, forces, mirrored, places, weighing
from viz_estim.diagnosis.finding import Finding
from viz_estim.diagnosis.naming import likeliest, named, of_motion, of_reading
from viz_estim.recording.memory import collect
from viz_estim.scenarios import beacons, diffdrive, imu, landmarks, plaza, quadrotor, scan
from viz_estim.scenarios.diffdrive_calibration import DOCUMENTED
from viz_estim.scenarios.diffdrive_model import effect
from viz_estim.scenarios.flawed_filters import with_process_noise
from viz_estim.scenarios.flawed_habits import PredictingTwice

Check = Callable[[evidence.Case], Iterator[Finding]]


def found(scenario: Scenario) -> list[Finding]:
    return diagnose(collect(scenario, run(scenario)))


@functools.cache
def sound(make: Callable[[], Scenario]) -> evidence.Case:
    return evidence.case(collect(make(), run(make())))


def drive(duration: float = 8.0) -> Scenario:
    return diffdrive.diffdrive_ekf(diffdrive.diffdrive(None, np.random.default_rng(3), duration=duration))


def points() -> Scenario:
    return landmarks.landmarks_ekf(landmarks.landmarks(None, np.random.default_rng(3), duration=5.0))


def flight(change: Callable[[Array, Array], tuple[Array, Array]] = lambda g, a: (g, a)) -> Scenario:
    data = quadrotor.quadrotor(None, np.random.default_rng(3), duration=1.4)
    gyro, accel = change(data.gyro, data.accel)
    return quadrotor.quadrotor_ukf_velocity(replace(data, gyro=gyro, accel=accel))


def among(noise: float = 0.51) -> Scenario:
    data = beacons.beacons(None, np.random.default_rng(3), duration=4.0)
    return beacons.beacons_pf(data, particles=300, range_noise=noise)


def mower() -> Scenario:
    return plaza.range_ekf(plaza.plaza(None, np.random.default_rng(3), duration=40.0))


def room() -> Scenario:
    return scan.scan_icp(scan.scan(None, np.random.default_rng(3), points=600, planar=True))


SOUND: dict[str, tuple[Check, tuple[Callable[[], Scenario], ...]]] = {
    "durations": (durations.carried, (points, flight)),
    "together": (copies.together, (among,)),
    "weighed again": (copies.weighed_again, (among,)),
    "clock": (clocks.clock, (points, flight)),
    "forces": (forces.forces, (flight,)),
    "noises": (weighing.noises, (among,)),
    "places": (places.exchanged, (mower,)),
    "mirrored": (mirrored.mirrored, (room,)),
}


@pytest.mark.parametrize("name", SOUND)
def test_a_sound_filter_has_no_finding(name: str) -> None:
    check, made = SOUND[name]
    assert not [finding for make in made for finding in check(sound(make))]


def steered(change: Callable[[Array], Array]) -> Scenario:
    scenario = drive()
    ticks = [replace(t, control=None if t.control is None else change(t.control)) for t in scenario.ticks]
    return replace(scenario, ticks=ticks)


@pytest.mark.parametrize(("factor", "words"), [(3.6, "km/h for m/s"), (1 / 0.3048, "feet for m")])
def test_kilometres_an_hour_are_told_from_feet(factor: float, words: str) -> None:
    first = found(steered(lambda u: u * [factor, 1.0]))[0]
    assert first.code == "process_model"
    assert first.cause.endswith(words)


def test_causes_that_are_as_likely_are_both_named() -> None:
    assert named(3.45, of_reading("m/s"), 0.1) == "km/h for m/s, or feet for m"
    assert likeliest(3.6, of_reading("m/s"), 0.01) == ["km/h for m/s"]
    assert likeliest(1.4, of_reading("m"), 0.01) == []
    assert "2 times a step" in named(2.0, of_motion("m", 0.1, times=2))


def test_a_q_without_its_dt_is_no_lag() -> None:
    def noise(x: Array, tick: Tick) -> Array:
        G = effect(x, 1.0)
        return G @ DOCUMENTED.input_cov @ np.swapaxes(G, -1, -2)

    scenario = drive()
    findings = found(replace(scenario, estimator=replace(scenario.estimator, process_noise=noise)))  # type: ignore[type-var]
    assert "lag" not in {finding.code for finding in findings}
    assert "underconfident" in {finding.code for finding in findings}


def test_a_q_that_is_too_large_by_its_dt_is_said_to_lack_it() -> None:
    scenario = landmarks.landmarks_ekf(landmarks.landmarks(None, np.random.default_rng(3), duration=30.0))
    larger = with_process_noise(scenario.estimator, 100.0)  # type: ignore[arg-type]
    (first, *_) = found(replace(scenario, estimator=larger, truth=None))
    assert first.code == "underconfident"
    assert "not multiplied by dt²" in first.cause


def test_exchanged_noises_of_two_sensors_are_named() -> None:
    data = imu.imu(None, np.random.default_rng(3), duration=2.6, still=0.6, freeze=0.0)
    first = found(imu.imu_ukf(data, gyro_noise=0.35, accel_noise=0.015))[0]
    assert (first.code, first.severity) == ("overconfident", "error")
    assert "the noises of accel and gyro are exchanged" in first.cause


FORCES: dict[str, Callable[[Array, Array], tuple[Array, Array]]] = {
    "gyro and accelerometer are exchanged": lambda g, a: (a, g),
    "(g for m/s²)": lambda g, a: (g, a / 9.81),
    "axes +x +z +y": lambda g, a: (g, a[:, [0, 2, 1]]),
    "axes +x +y −z": lambda g, a: (g, a * [1.0, 1.0, -1.0]),
}


@pytest.mark.parametrize("words", FORCES)
def test_a_force_that_is_another_one_is_the_cause_of_all(words: str) -> None:
    first, *others = found(flight(FORCES[words]))
    assert (first.code, first.severity) == ("process_model", "error")
    assert words in first.cause
    assert not [finding for finding in others if finding.severity == "error"], others


@pytest.mark.parametrize("make", [points, drive])
def test_a_prediction_that_is_done_twice_is_told(make: Callable[[], Scenario]) -> None:
    scenario = make()
    filter: Any = scenario.estimator
    first = found(replace(scenario, estimator=PredictingTwice(filter)))[0]
    assert (first.code, first.severity) == ("process_model", "error")
    assert "done 2 times a step" in first.cause


class Adding:
    """Adds Q in the update, in place of the prediction or besides."""

    def __init__(self, filter: Any, besides: bool, times: float = 1.0) -> None:
        self.filter, self.besides, self.times = filter, besides, times

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        Q = self.filter.process_noise(belief.mean, tick)
        moving = self.filter if self.besides else replace(self.filter, process_noise=lambda x, tick: 0 * Q)
        for part in (replace(tick, measurements={}), replace(tick, dt=0.0)):
            for stage in moving.step(belief, part, rng):
                made = stage
                if isinstance(stage, Update):
                    after: Any = stage.belief
                    added = self.times * self.filter.process_noise(after.mean, tick)  # of the heading after the update
                    made = replace(stage, belief=replace(after, cov=after.cov + added))
                yield made
                belief = made.belief  # type: ignore[assignment]


@pytest.mark.parametrize(
    ("besides", "words"), [(True, "as well as in the prediction"), (False, "adds no process noise")]
)
def test_a_q_in_the_update_is_told_though_it_is_small(besides: bool, words: str) -> None:
    scenario = points()
    findings = found(replace(scenario, estimator=Adding(scenario.estimator, besides)))
    assert words in next(finding.cause for finding in findings if finding.code == "update")


@pytest.mark.parametrize(
    ("besides", "times", "words"), [(True, 1, "and Q besides"), (True, 4, "4× Q"), (False, 1, "no process")]
)
def test_a_q_in_the_update_is_told_of_another_heading_and_another_time(besides: bool, times: float, words: str) -> None:
    scenario = drive(16.0)
    findings = found(replace(scenario, estimator=Adding(scenario.estimator, besides, times)))
    assert words in next(finding.cause for finding in findings if finding.code == "update")


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("seed", [2, 3, 5])
def test_a_mirrored_cloud_is_told_where_the_true_pose_shows_it(seed: int, planar: bool) -> None:
    data = scan.scan(None, np.random.default_rng(seed), points=600, planar=planar)
    scenario = scan.scan_icp(replace(data, X=data.X[:, [1, 0] if planar else [1, 0, 2]]))
    (finding,) = mirrored.mirrored(evidence.case(collect(scenario, run(scenario))))
    assert finding.evidence["map"] == ("axes +y +x" if planar else "axes +y +x +z")
    assert "mirrored" in finding.cause
