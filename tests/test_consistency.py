"""Errors, NEES, NIS and bands against their formulas; and the filters are consistent on data of their own model."""

import inspect
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drawn
import numpy as np
import pytest
from scipy.stats import chi2

from viz_estim.core import consistency, quaternions
from viz_estim.core.beliefs import Gaussian, normal
from viz_estim.core.consistency import Tally, band, metrics, nees, nees_summary, nis, rms, squared_distance
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, StandIn, Step, Tick, run
from viz_estim.core.spaces import S2, SE2, SO3, Euclidean, Product
from viz_estim.core.stages import Innovation, UnscentedUpdate, Update
from viz_estim.core.unscented import UnscentedFilter
from viz_estim.scenarios import imu

SEEDS, STEPS, WARM = 50, 700, 100  # WARM: the first second


def test_squared_distance_and_rms_are_their_formulas() -> None:
    rng = np.random.default_rng(1)
    e, L = rng.standard_normal((3, 5, 4)), rng.standard_normal((3, 5, 4, 4))
    P = L @ np.swapaxes(L, -1, -2) + np.eye(4)
    for i in np.ndindex(3, 5):
        assert squared_distance(e, P)[i] == pytest.approx(e[i] @ np.linalg.inv(P[i]) @ e[i])
    assert rms(np.array([[3.0, 4.0], [0.0, 0.0]])) == pytest.approx(np.sqrt(25 / 2))


def test_a_tally_keeps_the_numbers_of_a_long_run_and_nothing_else() -> None:
    """A step's records take some ten times the room of the numbers that its summary is made of."""
    rng, steps = np.random.default_rng(3), 2500
    space, reading = Product(state=Euclidean(("a", "b"))), Product(z=Euclidean(("z",)))
    means, truths, residuals = (
        rng.standard_normal((steps, 2)),
        rng.standard_normal((steps, 2)),
        rng.standard_normal(steps),
    )
    covs = rng.uniform(1, 2, (steps, 2))[..., None] * np.eye(2)
    tally = Tally(space)
    tracemalloc.start()
    for k in range(steps):
        one = np.full((1, 1), 2.0 + k % 3)
        told = Innovation(
            reading, residuals[k, None], np.zeros(1), residuals[k, None], one, one.copy(), np.zeros((2, 1)),
            np.ones(1, bool), np.ones(1, bool), np.zeros((2, 1)),
        )  # fmt: skip
        belief = Gaussian(space, means[k].copy(), covs[k].copy())
        tally.add(Step(k, Tick(0.1 * k, 0.1), (Update("update", belief, told, np.zeros((2, 1))),), truths[k].copy()))
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    numbers = 8 * (2 + 4 + 2 + 1 + 1) + 1
    assert held < 1.3 * steps * numbers + 1000 * 10 * 112  # but for the last thousand, in arrays of their own
    found = tally.summary()
    error = means - truths
    assert found["nees"]["mean"] == pytest.approx((error**2 / covs[:, [0, 1], [0, 1]]).sum(1).mean())
    assert found["nis"]["z"]["mean"] == pytest.approx((residuals**2 / (2.0 + np.arange(steps) % 3)).mean())


def test_the_band_holds_the_mean_of_as_many_draws_as_it_says() -> None:
    assert band(3) == pytest.approx((chi2.ppf(0.025, 3), chi2.ppf(0.975, 3)))
    assert band(6, 50) == pytest.approx((chi2.ppf(0.025, 300) / 50, chi2.ppf(0.975, 300) / 50))
    assert band(2, 1, 0.5) == pytest.approx((chi2.ppf(0.25, 2), chi2.ppf(0.75, 2)))
    means = np.random.default_rng(2).chisquare(3, (20_000, 40)).mean(1)
    low, high = band(3, 40)
    assert ((means >= low) & (means <= high)).mean() == pytest.approx(0.95, abs=0.006)


def test_metrics_name_each_error_with_its_unit_and_measure_it() -> None:
    rng, T = np.random.default_rng(3), 40
    space = Product(attitude=SO3(), rate=Euclidean(("x", "y", "z"), "rad/s"), place=Euclidean(("e", "n"), "m"), up=S2())
    level = quaternions.from_euler(np.stack([np.zeros(T), np.zeros(T), rng.uniform(-3.1, 3.1, T)], axis=1))
    truth = np.concatenate([level, rng.standard_normal((T, 5)), np.tile([0.0, 0.0, 1.0], (T, 1))], axis=1)
    mean = truth.copy()
    names = ["attitude_rmse_deg", "roll_rmse_deg", "pitch_rmse_deg", "yaw_rmse_deg", "tilt_rmse_deg"]
    names += ["rate_rmse_radps", "place_rmse_m", "up_rmse_rad"]
    for axis, want in ((0, [5, 5, 0, 0, 5]), (1, [5, 0, 5, 0, 5]), (2, [5, 0, 0, 5, 0])):
        turn = quaternions.exp(np.where(np.arange(T) % 2, 1, -1)[:, None] * np.radians(5) * np.eye(3)[axis])
        sign = rng.choice([-1.0, 1.0], (T, 1))  # q and −q are one attitude
        mean[:, :4] = sign * quaternions.multiply(level, turn)
        mean[:, 4:7] = truth[:, 4:7] + [0.2, 0.0, 0.0]
        mean[:, 7:9] = truth[:, 7:9] + np.where(np.arange(T) < T // 2, 3.0, 0.0)[:, None] * [0.6, 0.8]
        mean[:, 9:] = [0.0, np.sin(0.1), np.cos(0.1)]
        found = metrics(space, mean, truth)
        assert list(found) == names
        assert list(found.values()) == pytest.approx([*want, 0.2, 3 / np.sqrt(2), 0.1], abs=1e-6)
    assert list(metrics(SE2(), truth[:, :3], truth[:, :3])) == [
        "position_rmse_m", "final_position_error_m", "heading_rmse_rad"
    ]  # fmt: skip


def test_what_has_several_units_has_an_error_for_each() -> None:
    space = Euclidean(("x", "y", "vx", "vy", "scale"), ("m", "m", "m/s", "m/s", ""))
    truth = np.zeros((1, 5))
    assert metrics(space, np.array([[3.0, 4, 5, 12, 2]]), truth) == {
        "state_rmse_m": 5.0, "state_rmse_mps": 13.0, "state_rmse": 2.0
    }  # fmt: skip


def test_steps_without_truth_are_left_out_part_by_part() -> None:
    rng, T = np.random.default_rng(4), 30
    space = Product(attitude=SO3(), rate=Euclidean(("x", "y", "z"), "rad/s"))
    q = quaternions.normalise(rng.standard_normal((T, 4)))
    truth = np.concatenate([q, np.full((T, 3), np.nan)], axis=1)
    truth[10:20, :4] = np.nan
    mean = np.concatenate(
        [quaternions.multiply(q, quaternions.exp(np.array([0.0, 0.0, 0.1]))), np.ones((T, 3))], axis=1
    )
    mean[12, :4] = [0, 0, 0, 1]
    found = metrics(space, mean, truth)
    assert set(found) == {f"{k}_rmse_deg" for k in ("attitude", "roll", "pitch", "yaw", "tilt")}
    assert found["attitude_rmse_deg"] == pytest.approx(np.degrees(0.1))
    P = np.tile(np.diag([4.0, 4, 0.01, 1, 1, 1]), (T, 1, 1))
    values, dof = nees(space, mean, P, truth)
    assert dof == 3
    assert np.isnan(values[10:20]).all()
    np.testing.assert_allclose(np.delete(values, np.s_[10:20]), 0.1**2 / 0.01)
    P[3, 0, 0] = 0  # singular: no such number
    assert np.isnan(nees(space, mean, P, truth)[0][3])
    nothing = np.full_like(truth, np.nan)
    assert metrics(space, mean, nothing) == {}
    assert np.isnan(nees(space, mean, P, nothing)[0]).all()
    assert nees_summary(nees(space, mean, P, nothing)[0], 3) is None
    low, high = band(3)
    summary = nees_summary(np.array([np.nan, low - 0.01, 1.0, 2.0, high + 0.01]), 3)
    assert summary == {"mean": pytest.approx((low + high + 3) / 4), "dof": 3, "inside": 0.5}


def test_nis_takes_each_sensor_s_own_block_and_only_what_was_offered() -> None:
    rng, T = np.random.default_rng(5), 20
    space = Product(accel=Euclidean(("x", "y", "z")), gyro=Euclidean(("x", "y")))
    residual, L = rng.standard_normal((T, 5)), rng.standard_normal((T, 5, 5))
    S = L @ np.swapaxes(L, 1, 2) + np.eye(5)
    offered = np.stack([np.ones(T, bool), np.arange(T) % 3 > 0], axis=1)
    found = nis(space, residual, S, offered)
    gyro = np.array([r[3:] @ np.linalg.inv(s[3:, 3:]) @ r[3:] for r, s in zip(residual, S, strict=True)])
    np.testing.assert_allclose(found["gyro"].values, np.where(offered[:, 1], gyro, np.nan))
    assert (found["accel"].dof, found["gyro"].dof) == (3, 2)
    low, high = band(2, int(offered[:, 1].sum()))
    want = {"mean": pytest.approx(gyro[offered[:, 1]].mean()), "dof": 2, "low": low, "high": high}
    assert found["gyro"].summary() == want
    assert consistency.Nis(np.full(3, np.nan), 2).summary() is None


def small() -> imu.ImuData:
    return imu.imu(None, np.random.default_rng(0), duration=4, still=1, freeze=0)


def test_a_tally_counts_from_its_first_step_and_knows_stand_ins() -> None:
    scenario = imu.imu_ukf(small())
    ticks = list(scenario.ticks)
    ticks[60] = replace(ticks[60], stand_ins={"gyro": StandIn(np.zeros(3), 0.09 * np.eye(3))})
    tally, steps = Tally(scenario.space, 50), list(run(replace(scenario, ticks=ticks[:100])))
    for step in steps:
        tally.add(step)
    summary = tally.summary()
    mean = np.stack([step.stages[-1].belief.mean for step in steps[50:]])
    assert scenario.truth is not None
    assert summary["metrics"] == metrics(scenario.space, mean, scenario.truth[50:100])
    updates = [step.stages[-1].innovation for step in steps[50:]]
    for name, at, count in (("accel", slice(0, 3), 50), ("gyro", slice(3, 6), 49)):
        own = [squared_distance(u.residual[at], u.cov[at, at]) for k, u in enumerate(updates) if count == 50 or k != 10]
        assert summary["nis"][name]["mean"] == pytest.approx(np.mean(own))
        assert (summary["nis"][name]["low"], summary["nis"][name]["high"]) == band(3, count)
    assert summary["nees"]["dof"] == 3
    assert Tally(scenario.space, 0).summary() == {"metrics": {}, "nis": {}, "nees": None}


class Chances:
    """Generators 0 to 49 side by side: member i of a batch draws from seed i alone."""

    def __init__(self) -> None:
        self.seeds = [np.random.default_rng(seed) for seed in range(SEEDS)]

    def standard_normal(self, shape: tuple[int, ...]) -> Array:
        return np.stack([rng.standard_normal(shape[1:]) for rng in self.seeds])


def run_on_own_model(
    truth: UnscentedFilter, wrong: UnscentedFilter, start: Gaussian, controlled: bool, count: int
) -> tuple[dict[str, Array], Array]:
    """NIS by sensor and NEES, (T, seeds) each, of `wrong` on states and readings drawn from `truth`'s model.

    All seeds are one batch. Stamps jitter between 6 and 14 ms; the control, if any, is each seed's own smooth rate.
    """
    rng: Any = Chances()
    mean, cov = np.tile(start.mean, (SEEDS, 1)), np.tile(start.cov, (SEEDS, 1, 1))
    belief, x = Gaussian(start.space, mean, cov), normal(start.space, mean, cov, rng)
    waves = rng.standard_normal((SEEDS, 2, 3))
    dts = np.concatenate([[0.0], np.random.default_rng(0).uniform(0.006, 0.014, count - 1)])
    found: list[tuple[Array, ...]] = []
    for time, dt in zip(np.cumsum(dts), dts, strict=True):
        rate = 2 * np.sin(waves[:, 0] * time + 3 * waves[:, 1])
        x = drawn.next_state(truth, start.space, x, Tick(time, dt, rate), rng)
        control = rate[:, None] if controlled else None  # beside each member's sigma points
        *_, last = wrong.step(belief, Tick(time, dt, control, drawn.readings(truth, x, rng)), np.random.default_rng())
        assert isinstance(last, UnscentedUpdate)
        belief, seen = last.belief, last.innovation
        own = [squared_distance(seen.residual[:, at], seen.cov[:, at, at]) for at in seen.space.axes_at.values()]
        found.append((*own, squared_distance(start.space.minus(x, belief.mean), belief.cov)))
    *by_sensor, error = (np.stack(rows) for rows in zip(*found, strict=True))
    return dict(zip(truth.measurement.sensors, by_sensor, strict=True)), error


def within(values: Array, dof: int, count: int) -> float:
    low, high = band(dof, count)
    return float(((values >= low) & (values <= high)).mean())


def shares(
    scenario: Callable[..., Scenario], count: int = STEPS, **factors: float
) -> tuple[dict[str, float], float, str]:
    """With default noises, multiplied by `factors` in the filter but not in the data: by sensor the share of seeds with
    their mean NIS in its band; the share of steps after the first second whose NEES, averaged over the seeds, lies in
    its own; and all numbers as text."""
    defaults = inspect.signature(scenario).parameters
    right, other = scenario(small()), scenario(small(), **{k: f * defaults[k].default for k, f in factors.items()})
    nis_rows, error = run_on_own_model(
        right.estimator, other.estimator, right.beliefs[0], scenario is imu.imu_ukf_gyro, count
    )
    sensors, d = right.estimator.measurement.sensors, len(right.beliefs[0].cov)
    inside = {k: within(rows.mean(0), len(sensors[k].space.axes), count) for k, rows in nis_rows.items()}
    steps = within(error[WARM:].mean(1), d, SEEDS)
    means = ", ".join(f"{k} {rows.mean():.3f}" for k, rows in nis_rows.items())
    return (
        inside,
        steps,
        f"NIS inside {inside}, NEES inside {steps:.3f}; means: {means}, NEES {error.mean():.3f}",
    )


@pytest.mark.parametrize("scenario", [imu.imu_ukf, imu.imu_ukf_gyro])
def test_the_filters_are_consistent_on_data_of_their_own_model(scenario: Callable[..., Scenario]) -> None:
    inside, steps, numbers = shares(scenario)
    assert min(inside.values()) >= 43 / 50, numbers
    assert steps >= 0.9, numbers


@pytest.mark.parametrize(
    ("scenario", "factors", "sensor"),
    [
        (imu.imu_ukf, {"accel_noise": 1 / 4}, "accel"),
        (imu.imu_ukf, {"gyro_noise": 4}, "gyro"),
        (imu.imu_ukf_gyro, {"accel_noise": 1 / 4}, "accel"),
        (imu.imu_ukf_gyro, {"accel_noise": 4}, "accel"),
    ],
)
def test_a_noise_four_times_too_small_or_too_large_is_seen(
    scenario: Callable[..., Scenario], factors: dict[str, float], sensor: str
) -> None:
    inside, steps, numbers = shares(scenario, count=250, **factors)  # steps are enough to see it
    assert inside[sensor] == 0, numbers
    assert steps < 0.1, numbers
