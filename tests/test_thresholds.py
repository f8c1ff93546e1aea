"""Thresholds: no more false alarms than stated, also at the size from which on an effect is an error."""

import functools
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from viz_estim.core.distributions import chi2
from viz_estim.core.modes import modes
from viz_estim.core.quaternions import Array
from viz_estim.core.run import run
from viz_estim.core.spaces import Euclidean
from viz_estim.diagnose import diagnose
from viz_estim.diagnosis import confidence, evidence, gates, innovations, models, motion, particles, sensors
from viz_estim.diagnosis.finding import GROSS, Finding, judge, level
from viz_estim.recording.memory import collect
from viz_estim.recording.reader import Run
from viz_estim.scenarios import diffdrive, flawed_data, imu, landmarks, scan


@functools.cache
def walk(gate: float | None = None, noise: float = 0.3, seed: int = 7, duration: float = 60.0) -> Run:
    data = landmarks.landmarks(None, np.random.default_rng(seed), duration=duration)
    scenario = landmarks.landmarks_ekf(data, gate=gate, range_noise=noise)
    return collect(scenario, run(scenario), {"gate": gate, "range_noise": noise})


@functools.cache
def walked() -> evidence.Sequence:
    return evidence.Sequence(walk())


def case_of(white: Array, used: np.ndarray | None = None, gate: float | None = None) -> evidence.Case:
    """A run's case in which one sensor has these whitened innovations (N, m), S = 1 and R = 0.75."""
    N, m = white.shape
    readings = evidence.Readings(
        "range", Euclidean(tuple("abc"[:m]), "m"), np.arange(N), 0.1 * np.arange(N), np.zeros(N, int), white,
        np.zeros((N, m)), white, np.tile(np.eye(m), (N, 1, 1)), np.tile(0.75 * np.eye(m), (N, 1, 1)),
        np.ones(N, bool) if used is None else used,
    )  # fmt: skip
    recorded = replace(walk(), properties=walk().properties | {"params": {"gate": gate}})
    return evidence.Case(recorded, {"range": readings}, walked())


def severities(found: Any) -> list[tuple[str, str]]:
    return [(finding.code, finding.severity) for finding in found]


CHECKS = {
    "size": (functools.partial(confidence.by_sensor, tune=False), lambda w: GROSS**0.5 * w),
    "bias": (innovations.biased, lambda w: w + 0.5),  # (S − R)/S = 1/4
    "colour": (innovations.coloured, lambda w: coloured(w, 1 / 3)),
}


def coloured(white: Array, rho: float) -> Array:
    found = white.copy()
    for k in range(1, len(white)):
        found[k] = rho * found[k - 1] + (1 - rho**2) ** 0.5 * white[k]
    return found


@pytest.mark.parametrize("name", CHECKS)
def test_an_effect_as_large_as_an_error_s_is_none_yet_and_a_larger_one_is(name: str) -> None:
    check, effect = CHECKS[name]
    rng = np.random.default_rng(3)
    kinds = Counter(s for _ in range(100) for s in severities(check(case_of(effect(rng.standard_normal((400, 2)))))))
    assert {severity for _, severity in kinds} == {"warning"}
    assert sum(kinds.values()) > 90
    twice = {
        "size": lambda w: 2 * w,
        "bias": lambda w: w + 1.0,
        "colour": lambda w: coloured(w, 0.8),
    }[name]
    assert {s for _, s in severities(check(case_of(twice(rng.standard_normal((400, 2))))))} == {"error"}


@pytest.mark.parametrize("name", CHECKS)
def test_white_innovations_raise_no_more_than_their_share(name: str) -> None:
    rng = np.random.default_rng(4)
    found = [s for _ in range(1000) for s in severities(CHECKS[name][0](case_of(rng.standard_normal((200, 2)))))]
    assert len(found) <= 1000 * 0.05 / 30 + 3 * (1000 * 0.05 / 30) ** 0.5
    assert not [severity for _, severity in found if severity == "error"]


def test_judge_takes_the_p_of_a_large_effect_or_says_that_it_is() -> None:
    p = level("error", 1) / 2
    assert [judge(p, 1, large=large) for large in (True, p, np.True_, 0.0)] == ["error"] * 4
    assert [judge(p, 1, large=large) for large in (False, 0.01, 1.0)] == ["warning"] * 3


def passed_by(white: Array, g: float) -> np.ndarray:
    return np.asarray((white**2).sum(1) <= chi2.ppf(g, white.shape[1]))


@pytest.mark.parametrize("g", [0.95, 0.99, 0.999])
def test_a_sound_gate_is_no_finding(g: float) -> None:
    rng, found = np.random.default_rng(5), []
    for _ in range(1000):
        white = rng.standard_normal((300, 2))
        found += list(gates.gates(case_of(white, passed_by(white, g), g)))
    assert len(found) <= 1000 * 0.05 / 30 + 3 * (1000 * 0.05 / 30) ** 0.5, found


def test_gates_that_refuse_too_much_or_nothing_are_told() -> None:
    white = np.random.default_rng(6).standard_normal((1000, 2))
    words = {
        "narrow": (white, passed_by(white, 0.4), 0.4, "it is set to pass no more than 0.4"),
        "refuses too few": (0.3 * white, passed_by(0.3 * white, 0.99), 0.99, "should refuse about 10"),
        "compares another thing": (white, passed_by(white, 0.999), 0.9, "compares something else"),
        "locked out": (1 + 9 * (np.arange(1000)[:, None] > 500) + white, np.arange(1000) < 500, 0.999, "all of them"),
    }
    for name, (values, used, g, text) in words.items():
        (found,) = gates.gates(case_of(values, used, g))
        assert text in found.cause, (name, found)
    far = white.copy()
    far[::50] += 3.5
    (wide,) = gates.gates(case_of(far, passed_by(far, 1 - 1e-9), 1 - 1e-9))
    assert "too wide" in wide.cause
    assert list(gates.gates(case_of(far, None, None))) == []  # no gate, none to judge


def test_a_gate_of_a_filter_is_judged_by_its_parameter() -> None:
    assert [f for f in diagnose(walk(0.999)) if f.code == "gate"] == []
    data = landmarks.landmarks(None, np.random.default_rng(8), duration=60.0)
    scenario = flawed_data.with_glitches(landmarks.landmarks_ekf(data, gate=1 - 1e-12), 0.05, 1.6)
    found = diagnose(collect(scenario, run(scenario), {"gate": 1 - 1e-12}))
    assert "gate" in {finding.code for finding in found}, found


def jacobian_off_by(share: float) -> list[Finding]:
    recorded = walk(duration=30.0)
    name = next(name for name in recorded.stages if "innovation.cross_cov" in recorded.stages[name].values)
    table = recorded.stages[name]
    values = table.values | {"innovation.cross_cov": (1 + share) * table.values["innovation.cross_cov"]}
    return list(
        models.measured(
            evidence.case(replace(recorded, stages={**recorded.stages, name: replace(table, values=values)}))
        )
    )


def test_a_jacobian_is_held_to_what_the_trapezoid_rule_may_miss() -> None:
    assert jacobian_off_by(0.0) == []
    assert jacobian_off_by(1e-6) == []
    assert severities(jacobian_off_by(0.2)) == [("jacobian", "warning")]
    (wrong,) = jacobian_off_by(1.0)
    assert wrong.severity == "error"
    assert wrong.evidence["unexplained"] == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize("seed", range(100, 104))
@pytest.mark.parametrize("planar", [False, True])
def test_a_healthy_registration_is_judged_where_it_settles_and_gets_a_note(seed: int, planar: bool) -> None:
    scenario = scan.scan_icp(scan.scan(None, np.random.default_rng(seed), points=600, planar=planar))
    assert {(f.code, f.severity) for f in diagnose(collect(scenario, run(scenario)))} <= {("overconfident", "note")}


def test_a_registration_that_settles_in_a_wrong_place_is_told() -> None:
    scenario = scan.scan_icp(scan.scan(None, np.random.default_rng(2), points=600))
    assert scenario.truth is not None
    turned = scenario.beliefs[0].space.plus(scenario.beliefs[0].mean, np.array([0.3, -0.5, 0.1, 0.0, 0.0, 2.4]))
    beside = replace(scenario, beliefs={0: replace(scenario.beliefs[0], mean=turned)})
    found = diagnose(collect(beside, run(beside)))
    assert ("diverged", "error") in severities(found), found
    assert "local minimum" in next(f for f in found if f.code == "diverged").cause


def imu_run(change: Any, duration: float) -> list[Finding]:
    data = imu.imu(None, np.random.default_rng(6), duration=duration, freeze=0.0)
    scenario = imu.imu_ukf_gyro(replace(data, gyro=change(data.gyro)))
    return diagnose(collect(scenario, run(scenario)))


def test_a_gyro_s_sensitivity_is_told_by_how_gravity_turns() -> None:
    first = imu_run(lambda rate: 1.25 * rate, 14.0)[0]
    assert (first.code, first.sensor, first.severity) == ("units_or_axes", "gyro", "error")
    assert float(first.evidence["map"].removeprefix("a factor of ")) == pytest.approx(1.25, abs=0.06)


def test_a_rate_that_gravity_belies_is_a_bias_and_no_slow_turn() -> None:
    first = imu_run(lambda rate: rate + np.array([0.0, 0.08, 0.03]), 6.0)[0]
    assert (first.code, first.sensor, first.severity) == ("biased_innovation", "gyro", "error")
    assert first.evidence["bias"] == pytest.approx(0.08, abs=0.01)


def test_a_wrong_sign_in_the_transition_is_told_where_the_control_is_recorded() -> None:
    scenario = diffdrive.diffdrive_ekf(diffdrive.diffdrive(None, np.random.default_rng(5)))
    filter: Any = scenario.estimator
    sign = np.array([[1, 1, -1], [1, 1, 1], [1, 1, 1]])
    wrong = replace(filter, jacobian=lambda x, tick: sign * filter.jacobian(x, tick))
    first = diagnose(collect(scenario, run(replace(scenario, estimator=wrong))))[0]
    assert (first.code, first.severity) == ("jacobian", "error")


@pytest.mark.parametrize("N", [200, 1000])
def test_a_normal_cloud_has_one_mode(N: int) -> None:
    plane = Euclidean(("x", "y"), "m")
    clouds = (np.random.default_rng(seed).standard_normal((N, 2)) for seed in range(200))
    assert all(len(modes(plane, cloud, np.full(N, -np.log(N)))) == 1 for cloud in clouds)


def motions(factor: float, drift: float, rng: np.random.Generator) -> list[tuple[str, str]]:
    """What is told of a motion of 1 m/s ± 0.5 that is predicted so, with noise of a tenth."""
    told = 0.1 * (1 + 0.5 * rng.standard_normal(300))
    truly = told / factor + 0.1 * drift + 0.01 * rng.standard_normal(300)
    found = motion._moves_as("x", "m", np.arange(300), truly - told, told, np.full(300, 0.1), np.zeros(300), 6)
    return severities(finding for _, finding in found)


def test_a_motion_s_factor_and_drift_keep_to_the_budget() -> None:
    rng = np.random.default_rng(7)
    sound = [one for _ in range(1000) for one in motions(1.0, 0.0, rng)]
    assert len(sound) <= 1000 * 0.05 / 30 + 3 * (1000 * 0.05 / 30) ** 0.5
    as_large = [one for _ in range(100) for one in motions(1.05, 0.0, rng) + motions(1.0, 0.05, rng)]
    assert {severity for _, severity in as_large} == {"warning"}
    assert {severity for _ in range(20) for _, severity in motions(1.2, 0.0, rng)} == {"error"}
    assert {severity for _ in range(20) for _, severity in motions(1.0, 0.3, rng)} == {"error"}


@pytest.mark.parametrize(("share", "severity"), [(0.0, set()), (0.02, {"warning"}), (0.15, {"error"})])
def test_a_clipped_sensor_is_an_error_where_more_than_a_fiftieth_is_lost(share: float, severity: set[str]) -> None:
    rng, found = np.random.default_rng(8), []
    for _ in range(30):
        z = np.cumsum(rng.standard_normal((4000, 1)), axis=0)
        given = {"z.range": np.minimum(z, np.quantile(z, 1 - share))}
        of = replace(walk(), inputs=given, step=np.arange(4000), time=0.1 * np.arange(4000))
        found += severities(sensors.saturated(of))
    assert {one for _, one in found} == severity


@pytest.mark.parametrize(
    ("left", "share", "severity"), [(20, 1.0, []), (16, 0.01, ["warning"]), (16, 1.0, ["error"]), (3, 0.3, ["error"])]
)
def test_few_particles_are_an_error_where_the_run_s_variance_is_too_small_too_often(
    left: float, share: float, severity: list[str]
) -> None:
    table = next(t for t in walk().stages.values() if t.name.startswith("update"))
    M = len(table.step)
    values = {"ess": np.where(np.arange(M) < share * M, left, 400.0), "states": np.zeros((M, 800, 1))}
    stages = {table.name: replace(table, values=values)}
    of = evidence.Case(replace(walk(), stages=stages, step=table.step), {}, evidence.Sequence(walk()))
    assert [finding.severity for finding in particles.collapsed(of)] == severity
