"""Faults that readings, stamps and covariances show by themselves, before any filter is asked."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from test_causes import straight

from viz_estim.core.quaternions import Array
from viz_estim.core.run import run
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.diagnosis import covariance, evidence, repeats, stamps
from viz_estim.recording.memory import collect
from viz_estim.recording.reader import Run
from viz_estim.scenarios import imu
from viz_estim.scenarios.imu_health import frozen_accel


def log(time: Array, dt: Array | None = None, **inputs: Array) -> Run:
    """A recording of readings without any filter."""
    dt = np.diff(time, prepend=time[0]) if dt is None else dt
    n = len(time)
    named = {name.replace("_", ".", 1): values for name, values in inputs.items()}
    space = Product(x=Euclidean(("x",)))
    ends = {"mean": np.zeros((n, 1)), "cov": np.ones((n, 1, 1))}
    nothing = np.full((n, 1), np.nan)
    return Run(None, {}, space, (), np.arange(n), time, dt, nothing, named, {}, ends, None, True)  # type: ignore[arg-type]


def test_stamps_are_held_against_the_run_s_own() -> None:
    rng = np.random.default_rng(1)
    regular = 0.01 * np.arange(2000.0)
    jittered = np.cumsum(rng.uniform(0.006, 0.014, 2000))
    arrivals = regular + rng.uniform(0, 0.004, 2000)
    poisson = np.cumsum(rng.exponential(0.01, 2000))
    assert not [f for time in (regular, jittered, poisson) for f in stamps.stamps(log(time))]
    assert [(f.evidence["kind"], f.severity) for f in stamps.stamps(log(arrivals))] == [("jitter", "note")]
    for time in (regular, jittered):
        lost = np.delete(time, np.arange(700, 730))
        (gap,) = stamps.stamps(log(lost))
        assert (gap.evidence["kind"], gap.steps) == ("gaps", (700, 700))
    (wrong,) = stamps.stamps(log(jittered, dt=np.full(2000, 0.01)))
    assert (wrong.evidence["kind"], wrong.severity) == ("dt", "error")


def test_counts_at_rest_are_not_taken_for_readings_that_are_held() -> None:
    rng = np.random.default_rng(2)
    counts = np.round(rng.normal(500, 0.8, (900, 3))) / 34.3
    fine = counts / np.linalg.norm(counts, axis=1, keepdims=True)  # no longer multiples of one step
    time = 0.01 * np.arange(900)
    assert list(repeats.used_twice(log(time, z_accel=fine))) == []
    (twice,) = repeats.used_twice(log(time, z_accel=np.repeat(rng.normal(size=(300, 3)), 3, axis=0)))
    assert twice.code == "used_twice"
    doubled = np.repeat(rng.normal(size=(450, 3)), 2, axis=0)
    (same,) = repeats.used_twice(log(np.repeat(0.01 * np.arange(450), 2), z_accel=doubled))
    assert "samples are in the log twice" in same.cause


def test_an_accelerometer_that_sticks_is_told_from_one_at_rest() -> None:
    data = imu.imu(None, np.random.default_rng(100), duration=8.0, still=1.0, freeze=0.0)
    assert not frozen_accel(data.time, data.gyro, data.accel).any()
    begin, end = np.searchsorted(data.time - data.time[0], [4.0, 6.0])
    stuck = data.accel.copy()
    stuck[begin:end] = stuck[begin]
    flags = np.flatnonzero(frozen_accel(data.time, data.gyro, stuck))
    assert abs(flags[0] - begin) <= 3
    assert abs(flags[-1] - (end - 1)) <= 3


@functools.cache
def walk() -> Run:
    return collect(straight(1.0), run(straight(1.0)))


def changed(change: Callable[[Array], Array], stage: str = "update") -> evidence.Case:
    """The run with another covariance after a stage."""
    recorded = walk()
    table = recorded.stages[stage]
    stages = recorded.stages | {stage: replace(table, values=table.values | {"cov": change(table.cov.copy())})}
    return evidence.case(replace(recorded, stages=stages))


def kinds(case: evidence.Case, check: Callable[[evidence.Case], Any]) -> list[tuple[str, str]]:
    return [(f.evidence["kind"], f.severity) for f in check(case)]


def test_a_covariance_is_held_to_rounding() -> None:
    def skewed(by: float) -> Callable[[Array], Array]:
        def change(P: Array) -> Array:
            P[:, 0, 1] += by * np.sqrt(P[:, 0, 0] * P[:, 1, 1])
            return P

        return change

    assert kinds(changed(lambda P: P), covariance.broken) == []
    assert kinds(changed(skewed(1e-10)), covariance.broken) == [("rounding", "note")]
    assert kinds(changed(skewed(1e-3)), covariance.broken) == [("asymmetric", "error")]
    assert kinds(changed(lambda P: P - 2 * np.diag([0, 1]) * P), covariance.broken)[0] == ("negative", "error")
    single = changed(lambda P: P.astype(np.float32).astype(float))
    assert ("asymmetric", "error") not in kinds(single, covariance.broken)
    assert kinds(changed(lambda P: P), covariance.claims) == []
    assert kinds(changed(lambda P: 0.5 * P), covariance.claims) == [("claims", "error")]


def test_a_covariance_that_shrinks_as_readings_allow_has_not_collapsed() -> None:
    recorded, n = walk(), len(walk().step)
    for shape, found_kinds in (
        (1 / np.arange(1, n + 1), []),  # a constant, read again and again
        (1 / np.arange(1.0, n + 1) ** 3, []),  # a rate
        (np.exp(-np.arange(n) / 10), [("collapsed", "error")] * 2),
        (1e-40 + 0 * np.arange(n), []),  # as it began
        (np.arange(1.0, n + 1), [("growing", "note")] * 2),
    ):
        cov = shape[:, None, None] * np.eye(2)
        ends = recorded.ends | {"cov": cov}
        unread = replace(recorded, ends=ends, stages={})  # its updates are of another covariance
        case = replace(evidence.case(recorded), run=unread)
        assert kinds(case, covariance.bounds) == found_kinds
        assert kinds(replace(case, run=replace(unread, time=np.zeros(n))), covariance.bounds) == []


def test_one_reading_given_as_two_is_told_and_two_that_are_alike_are_not() -> None:
    rng = np.random.default_rng(4)
    time, z = 0.1 * np.arange(100), rng.normal(size=(100, 2))
    (same,) = repeats.one_for_two(log(time, z_range=z[:, [0, 0]]))
    assert (same.code, same.sensor, same.evidence["of"]) == ("used_twice", "range", ["range 1", "range 2"])
    counts = np.repeat(np.arange(100.0)[:, None] // 10, 2, axis=1)  # a coarse sensor's two axes may well agree
    nearly = np.stack([z[:, 0], np.where(np.arange(100) == 50, z[:, 1], z[:, 0])], axis=1)
    for sound in (z, counts, nearly):
        assert list(repeats.one_for_two(log(time, z_range=sound))) == []


def test_a_dt_that_is_off_is_an_error_from_the_size_on_that_a_calibration_would_mend() -> None:
    time = 0.1 * np.arange(300)
    for factor, severities in ((1.0, []), (1.04, ["warning"]), (1.06, ["error"])):
        told = stamps.stamps(log(time, dt=factor * np.diff(time, prepend=time[0])))
        assert [finding.severity for finding in told] == severities
