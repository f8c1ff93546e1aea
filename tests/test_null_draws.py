"""Thresholds of what is held against the truth: readings drawn of their own noise raise no more than is stated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2
from test_thresholds import case_of, severities

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.diagnosis import (
    clocks,
    confidence,
    errors,
    evidence,
    fits,
    kinematics,
    linear,
    rounding,
    sensors,
    truth,
    weighing,
)
from viz_estim.diagnosis.finding import _FAMILIES, GROSS, Chance, judge, level, times
from viz_estim.diagnosis.fits import Against
from viz_estim.diagnosis.outlying import outlying
from viz_estim.scenarios.imu_health import GRAVITY, frozen_gyro, still_prefix

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


@pytest.mark.parametrize("rho", [0.0, 0.3, 0.6])
def test_a_fit_keeps_to_its_rate_where_noise_is_coloured(rho: float) -> None:
    """Of AR(1) noise, whose mean is (1 + ρ)/(1 − ρ) times as uncertain, up to 4: by the larger p of a `Chance`."""
    rng, draws = np.random.default_rng(21), 300
    X = np.stack([np.ones(400), np.sin(0.02 * np.arange(400))], axis=-1)[:, None, :]
    noise = lfilter([(1 - rho**2) ** 0.5], [1.0, -rho], rng.standard_normal((draws, 500)), axis=1)[:, 100:]
    p = np.array([max(fits.least_squares(X, y[:, None]).p(0)) for y in noise])
    for rate in (0.05, SHARE):
        assert (p < rate).sum() <= draws * rate + 3 * (draws * rate) ** 0.5


def test_an_error_s_share_is_of_white_noise_and_a_warning_s_of_coloured_noise_too() -> None:
    error, warning = level("error", 2) / 2, level("warning", 2) / 2
    assert judge(Chance(error, warning), 2, large=True) == "error"
    assert judge(Chance(warning, error), 2, large=True) == "warning"
    assert judge(Chance(error, 4 * warning), 2, large=True) is None
    assert judge(Chance(error, error), 2, large=Chance(error, 4 * warning)) == "warning"
    assert judge(Chance(error, float("nan")), 2, large=True) is None


@pytest.mark.parametrize("speed", [0.3, 3.0])
def test_a_lag_is_a_matter_of_a_rate_as_long_as_the_way_is_straight(speed: float) -> None:
    """Of a circle at ω, the line leaves sin²(½ωτ) of the way in τ: a half at ωτ = π/2."""
    time = 0.01 * np.arange(3000)
    way = np.stack([np.cos(speed * time), np.sin(speed * time)], axis=-1)
    told = [
        linear.straight(Euclidean(("x", "y"), "m"), way, time, s * np.pi / 2 / speed) for s in (-0.95, 0.1, 0.95, 1.05)
    ]
    assert told == [True, True, True, False]
    assert linear.straight(Euclidean(("x", "y"), "m"), time[:, None] * [1.0, 2.0], time, 14.0)


def test_a_covariance_is_sound_where_it_can_be_solved_with() -> None:
    turn = np.linalg.qr(np.random.default_rng(22).standard_normal((3, 3)))[0]
    told = {(1.0, 1.0, 1.0): True, (1e-12, 1.0, 1.0): True, (1e-15, 1.0, 1.0): False, (-1e-3, 1.0, 1.0): False}
    P = np.array([turn @ np.diag(values) @ turn.T for values in told] + [np.full((3, 3), np.nan)])
    assert rounding.sound(P).tolist() == [*told.values(), False]


def test_a_start_is_the_start_s_until_readings_or_the_process_have_changed_it() -> None:
    P = np.array([1.0, 0.6, 0.4, 1.5, 3.0])[:, None, None] * np.eye(2)
    case = case_of(np.zeros((5, 1)))
    plane = Euclidean(("x", "y"), "m")
    ends = {"mean": np.zeros((5, 2)), "cov": P}
    run = replace(case.run, space=plane, step=np.arange(5), ends=ends, truth=np.zeros((5, 2)))
    assert [errors._of_the_start(replace(case, run=run), k) for k in range(5)] == [True, True, False, True, False]


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


@pytest.mark.parametrize("count", [0.0, 0.017])
@pytest.mark.parametrize("noise", [0.003, 0.05, 0.5])
def test_noise_alone_is_neither_motion_nor_a_freeze(noise: float, count: float) -> None:
    """At 1e-4 a run; also of readings in whole counts, and of far more noise than a cheap sensor's."""
    rng, stamps = np.random.default_rng(14), 0.01 * np.arange(1500)
    for _ in range(15):
        gyro = rng.uniform(-0.2, 0.2, 3) + noise * rng.standard_normal((1500, 3))
        accel = [0.0, 0.0, GRAVITY] + noise * rng.standard_normal((1500, 3))
        if count:
            gyro, accel = count * np.round(gyro / count), 6 * count * np.round(accel / (6 * count))
        assert still_prefix(stamps, gyro, accel) == 1500
        assert not frozen_gyro(stamps, gyro, accel, gyro[:50].mean(0)).any()


def test_a_slow_motion_from_the_start_is_no_rest_whatever_the_noise() -> None:
    rng, stamps = np.random.default_rng(15), 0.01 * np.arange(1500)
    for noise in (0.003, 0.03):
        gyro = 0.3 * np.sin(6 * stamps)[:, None] * [1.0, 0.5, 0.2] + noise * rng.standard_normal((1500, 3))
        accel = [0.0, 0.0, GRAVITY] + noise * rng.standard_normal((1500, 3))
        assert still_prefix(stamps, gyro, accel) == 0


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_errors_that_follow_one_another_keep_to_the_share(rho: float) -> None:
    """AR(1) errors of the covariance's own size: no more of their mean squares lie outside than is stated."""
    rng, draws, found = np.random.default_rng(16), 200, 0
    for _ in range(draws):
        drawn = (1 - rho**2) ** 0.5 * rng.standard_normal((500, 2))
        white = lfilter([1.0], [1.0, -rho], drawn, axis=0)[200:]
        n = max(1.0, len(white) / errors._correlation_time(white))
        total = n * float((white**2).sum(1).mean())
        found += 2 * min(chi2.sf(total, 2 * n), chi2.cdf(total, 2 * n)) < SHARE / 2
    assert found <= draws * SHARE + 3 * (draws * SHARE) ** 0.5


@pytest.mark.parametrize("dof", [1, 3])
def test_outliers_are_set_apart_without_more_alarms_of_size_and_a_large_noise_has_none(dof: int) -> None:
    rng, draws = np.random.default_rng(17), 600
    found = sum(confidence.size(rng.chisquare(dof, 200), dof, 1)[1] < SHARE for _ in range(draws))
    assert found <= draws * SHARE + 3 * (draws * SHARE) ** 0.5
    for factor in (1.0, 1.5, 3.0):  # also of a noise that is too small
        alarms = sum(outlying(factor * rng.chisquare(dof, 400), dof, 1).far.any() for _ in range(draws))
        assert alarms <= draws * SHARE + 3 * (draws * SHARE) ** 0.5
    glitches = np.append(rng.chisquare(dof, 400), [60.0] * 8)
    assert outlying(glitches, dof, 1).far[-8:].all()


@pytest.mark.parametrize(("lost", "longest"), [(0.0, 1), (0.02, 1), (0.3, 1), (0.02, 7)])
def test_readings_lost_by_chance_are_no_silence(lost: float, longest: int) -> None:
    """longest: of the sensor's own intervals, in steps; the shortest is half of it."""
    rng, draws, found = np.random.default_rng(18), 300, 0
    for _ in range(draws):
        at = np.cumsum(rng.integers(max(1, longest // 2), longest + 1, 600))
        at = at[(at < 600) & (rng.random(600) >= lost)]
        z = np.full((600, 1), np.nan)
        z[at] = rng.standard_normal((len(at), 1))
        of = case_of(np.zeros((600, 1))).run
        of = replace(of, inputs={"z.range": z}, step=np.arange(600), time=0.1 * np.arange(600))
        found += bool(list(sensors.silent(of)))
    assert found <= draws * SHARE + 3 * (draws * SHARE) ** 0.5


@pytest.mark.parametrize("kind", ["sine", "noise", "both"])
def test_a_smooth_signal_or_noise_in_counts_is_not_saturated(kind: str) -> None:
    rng, t = np.random.default_rng(19), 0.01 * np.arange(3000)
    for _ in range(30):
        smooth = 10 * np.sin(rng.uniform(0.1, 3.0) * t + rng.uniform(0, 6))
        z = (kind != "noise") * smooth + (kind != "sine") * rng.standard_normal(3000)
        count = rng.choice([0.02, 0.1, 0.3])
        of = case_of(np.zeros((10, 1))).run
        of = replace(of, inputs={"z.range": count * np.round(z / count)[:, None]}, step=np.arange(3000), time=t)
        assert not list(sensors.saturated(of))


@pytest.mark.parametrize("shared", [1, 4, 10])
def test_the_windows_that_share_a_push_are_counted(shared: int) -> None:
    rng = np.random.default_rng(20)
    pushes = [np.repeat(np.square(rng.standard_normal((40, 3))).sum(1), shared) for _ in range(50)]
    assert np.median([kinematics._dependent(left) for left in pushes]) == pytest.approx(shared, rel=0.3)


def test_a_factor_near_one_keeps_three_digits() -> None:
    assert [times(x) for x in (1.052, 0.983, 1.43, 22.1, 0.3)] == ["1.05×", "0.983×", "1.4×", "22×", "0.3×"]
