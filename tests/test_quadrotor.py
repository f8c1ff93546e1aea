"""The quadrotor: its model and filters against transcriptions of the course's, and their consistency."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from viz_estim.core import quaternions, unscented
from viz_estim.core.beliefs import Gaussian, normal
from viz_estim.core.consistency import Tally, band, metrics, squared_distance
from viz_estim.core.descriptions import describe, rebuild
from viz_estim.core.kalman import linear_sensor
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.core.spaces import Euclidean
from viz_estim.core.unscented import AugmentedFilter, scaled
from viz_estim.scenarios import quadrotor_simulation as simulation
from viz_estim.scenarios.quadrotor import quadrotor, quadrotor_ukf_pose, quadrotor_ukf_velocity
from viz_estim.scenarios.quadrotor_data import QuadrotorData, together
from viz_estim.scenarios.quadrotor_model import BODY_CAMERA, Chart, Model

SEEDS, WARM = 50, 100  # WARM: the first second
charts = pytest.mark.parametrize("chart", ["so3", "zxy"])
both = pytest.mark.parametrize("scenario", [quadrotor_ukf_pose, quadrotor_ukf_velocity])
Make = Callable[..., Scenario]


def simulated(seed: int = 1, **settings: float) -> QuadrotorData:
    return quadrotor(None, np.random.default_rng(seed), **settings)


def summary(scenario: Scenario) -> dict[str, Any]:
    tally = Tally(scenario.space, max(scenario.beliefs))
    for step in run(scenario):
        assert step.error is None
        tally.add(step)
    return tally.summary()


def course_R(angles: Array) -> Array:
    """The course's rotation, body → world, of roll, pitch, yaw."""
    return Rotation.from_euler("ZXY", angles[[2, 0, 1]]).as_matrix()


def course_move(x: Array, w: Array, u: Array, dt: float) -> Array:
    """The course's process model x + dt·f(x, u, w) over (p, roll pitch yaw, v, bg, ba); but the attitude at the step's
    middle turns the specific force, which moves the position too."""
    (roll, pitch, _), v = x[3:6], x[6:9]
    rate, force = u[:3] - x[9:12] - w[:3], u[3:] - x[12:] - w[3:6]
    G = np.array([
        [np.cos(pitch), 0, -np.cos(roll) * np.sin(pitch)],
        [0, 1, np.sin(roll)],
        [np.sin(pitch), 0, np.cos(roll) * np.cos(pitch)],
    ])  # fmt: skip
    middle = course_R(x[3:6]) @ Rotation.from_rotvec(0.5 * dt * rate).as_matrix()
    a = middle @ force + [0, 0, -9.81]
    turned = x[3:6] + dt * np.linalg.solve(G, rate)
    return np.concatenate([x[:3] + dt * v + 0.5 * dt**2 * a, turned, v + dt * a, x[9:] + w[6:]])


def test_a_step_is_the_course_s_process_model() -> None:
    rng, model = np.random.default_rng(1), Model("zxy")
    x, w, u, dt = rng.uniform(-1, 1, (7, 15)), 0.1 * rng.standard_normal((7, 12)), rng.standard_normal(6), 0.03
    want = np.array([course_move(*one, u, dt) for one in zip(x, w, strict=True)])
    np.testing.assert_allclose(model.move(x, w, Tick(0.0, dt, u)), want, atol=1e-12)


def test_both_charts_say_the_same_of_a_motion() -> None:
    rng, so3, zxy = np.random.default_rng(2), Model("so3"), Model("zxy")
    q = Rotation.random(20, rng=rng).as_quat(scalar_first=True)
    x = np.concatenate([rng.standard_normal((20, 3)), q, rng.standard_normal((20, 9))], axis=1)
    angles = zxy.of(x)[:, 3:6]
    np.testing.assert_allclose([course_R(one) for one in angles], quaternions.to_matrix(q), atol=1e-12)
    tick, w = Tick(0.0, 1e-4, rng.standard_normal(6)), rng.standard_normal((20, 12))
    off = zxy.space.minus(zxy.of(so3.move(x, w, tick)), zxy.move(zxy.of(x), w, tick))
    gentle = np.abs(np.cos(angles[:, 0])) > 0.1  # Euler's rates are infinite at roll ±90°
    np.testing.assert_allclose(off[gentle], 0, atol=1e-5)
    np.testing.assert_allclose(zxy.camera_velocity(zxy.of(x), tick), so3.camera_velocity(x, tick), atol=1e-12)


def test_both_charts_are_told_by_the_same_figures() -> None:
    """Also of a recording, which knows the space by its description."""
    rng, so3, zxy = np.random.default_rng(5), Model("so3"), Model("zxy")
    a, b = Rotation.random(20, rng=rng), Rotation.random(20, rng=rng)
    states = [np.pad(rng.standard_normal((20, 3)), ((0, 0), (0, 13))) for _ in range(2)]
    for x, turn in zip(states, (a, b), strict=True):
        x[:, 3:7] = turn.as_quat(scalar_first=True)
    want = metrics(so3.space, *states)
    assert want["attitude_rmse_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean((b.inv() * a).magnitude() ** 2))))
    for space in (zxy.space, rebuild(describe(zxy.space))):
        assert metrics(space, *map(zxy.of, states)) == pytest.approx(want, rel=1e-9)


def test_the_camera_s_velocity_is_that_of_a_point_of_the_body() -> None:
    rng, dt = np.random.default_rng(3), 1e-5
    R, p, v, rate, bias = Rotation.random(rng=rng), *rng.standard_normal((4, 3))
    ahead, behind = (p + s * v + (R * Rotation.from_rotvec(s * rate)).apply(BODY_CAMERA) for s in (dt, -dt))
    # Its x and y axes lie in the body's x, y plane, turned by π/4; its z looks down.
    half = np.sqrt(0.5)
    mount = np.array([[half, -half, 0], [-half, -half, 0], [0, 0, -1]])  # its axes in the body's, as columns
    want = mount.T @ R.inv().apply((ahead - behind) / (2 * dt))
    x = np.concatenate([p, R.as_quat(scalar_first=True), v, bias, np.zeros(3)])
    found = Model("so3").camera_velocity(x, Tick(0.0, 0.0, np.concatenate([rate + bias, np.zeros(3)])))
    np.testing.assert_allclose(found, want, atol=1e-8)


def test_the_filter_is_the_course_s_augmented_one() -> None:
    """Sigma points of (state, noise) through the course's model, then the plain Kalman update by a linear pose."""
    scenario = quadrotor_ukf_pose(simulated(duration=0.5), attitude="zxy", alpha=0.001, kappa=1.0)
    m, P = scenario.beliefs[0].mean, scenario.beliefs[0].cov
    n, lam, H = 27, 0.001**2 * 28 - 27, np.eye(6, 15)
    R, seen = np.diag([0.005**2] * 3 + [0.01**2] * 3), 0
    for step in run(scenario):
        tick = step.tick
        if tick.dt > 0:
            Q = np.diag([0.01**2] * 3 + [0.1**2] * 3 + [1e-6 * tick.dt] * 3 + [1e-4 * tick.dt] * 3)
            L = np.linalg.cholesky((n + lam) * block_diag(P, Q))
            points = np.concatenate([m, np.zeros(12)]) + np.concatenate([np.zeros((1, n)), L.T, -L.T])
            moved = np.array([course_move(one[:15], one[15:], tick.control, tick.dt) for one in points])
            weights = np.full(2 * n + 1, 0.5 / (n + lam))
            weights[0] = lam / (n + lam)
            m = weights @ moved
            weights[0] += 1 - 0.001**2 + 2
            P = (moved - m).T @ np.diag(weights) @ (moved - m)
        if "pose" in tick.measurements:
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            m, P, seen = m + K @ (tick.measurements["pose"] - H @ m), P - K @ H @ P, seen + 1
        np.testing.assert_allclose(step.stages[-1].belief.mean, m, atol=1e-7)
        np.testing.assert_allclose(step.stages[-1].belief.cov, P, rtol=1e-3, atol=1e-8)
    assert seen == 10


def test_sensors_are_read_at_their_own_rates_and_one_by_one() -> None:
    rng, space = np.random.default_rng(4), Euclidean(tuple("abc"))
    F, B, W = rng.standard_normal((3, 3)), rng.standard_normal((3, 2)), np.diag([0.5, 2.0])
    H = {name: rng.standard_normal((1, 3)) for name in ("one", "two")}
    sensors = {name: linear_sensor(Euclidean(("u",)), H[name], np.eye(1)) for name in H}
    expected = {"two": lambda x, tick: x @ H["two"].T + tick.control}
    estimator = AugmentedFilter(lambda x, w, tick: x @ F.T + w @ B.T, lambda tick: W, sensors, scaled, expected)
    belief, m, P = Gaussian(space, np.ones(3), np.eye(3)), np.ones(3), np.eye(3)
    for k, offered in enumerate([("one",), (), ("one", "two"), ("two",)]):
        z = {name: rng.standard_normal(1) for name in offered}
        stages = list(estimator.step(belief, Tick(k, float(k > 0), np.array([3.0]), z), rng))
        names = [f"update/{name}" for name in offered]
        assert [stage.name for stage in stages] == (["predict", *names] if k else names)
        if k:
            m, P = F @ m, F @ P @ F.T + B @ W @ B.T
        for name in offered:
            K = P @ H[name].T / (H[name] @ P @ H[name].T + 1)
            m, P = m + K @ (z[name] - H[name] @ m - 3 * (name == "two")), P - K @ H[name] @ P
        belief = stages[-1].belief
        np.testing.assert_allclose(belief.mean, m, atol=1e-6)
        np.testing.assert_allclose(belief.cov, P, atol=1e-6)


def nees_and_nis(scenario: Make, steps: int, **factors: float) -> tuple[Array, Array]:
    """(steps, seeds) and (readings, seeds), of simulated flights whose start is drawn from the prior, run as one batch;
    the defaults of `factors` are multiplied in the filter, not in the flights."""
    stamps = np.cumsum(np.concatenate([[0.0], np.random.default_rng(9).uniform(0.009, 0.011, steps - 1)]))
    rngs = [np.random.default_rng(seed) for seed in range(SEEDS)]
    defaults = scenario.__kwdefaults__ or {}
    settings = {name: factor * defaults[name] for name, factor in factors.items()}
    flights = [scenario(together(*simulation.fly(rng, stamps), ""), **settings) for rng in rngs]
    space, cov, estimator = flights[0].space, flights[0].beliefs[0].cov, flights[0].estimator
    truth = np.stack([flight.truth for flight in flights], axis=1)
    start = np.stack([normal(space, x, cov, rng) for x, rng in zip(truth[0], rngs, strict=True)])
    belief, nees, nis = Gaussian(space, start, np.tile(cov, (SEEDS, 1, 1))), [], []
    for k in range(steps):
        ticks = [flight.ticks[k] for flight in flights]
        z = {name: np.stack([tick.measurements[name] for tick in ticks]) for name in ticks[0].measurements}
        control = np.stack([tick.control for tick in ticks])[:, None]  # beside each member's sigma points
        for stage in estimator.step(belief, Tick(ticks[0].time, ticks[0].dt, control, z), rngs[0]):
            belief = stage.belief
            if isinstance(stage, unscented.UnscentedUpdate):
                nis.append(squared_distance(stage.innovation.residual, stage.innovation.cov))
        nees.append(squared_distance(space.minus(truth[k], belief.mean), belief.cov))
    return np.array(nees), np.array(nis)


def share(values: Array, dof: int) -> float:
    """Of the rows, those whose mean over the seeds lies in its 95 % band."""
    low, high = band(dof, SEEDS)
    return float(((values.mean(1) >= low) & (values.mean(1) <= high)).mean())


@both
def test_on_simulated_flights_the_filters_are_consistent(scenario: Make) -> None:
    # Errors last, so that the share of steps scatters much: over 200 flights with pose it is 0.97, NEES 14.7 of 15.
    nees, nis = nees_and_nis(scenario, 400 if scenario is quadrotor_ukf_pose else 250)
    assert share(nees[WARM:], 15) >= 0.9, nees.mean(1)
    low, high = band(6 if scenario is quadrotor_ukf_pose else 3, nis.size)
    assert low <= nis.mean() <= high


def test_a_noise_four_times_too_small_or_too_large_is_seen() -> None:
    for factor in (1 / 4, 4):
        nees, nis = nees_and_nis(quadrotor_ukf_pose, 120, position_noise=factor, attitude_noise=factor)
        assert (share(nees[60:], 15), share(nis[10:], 6)) == (0, 0)


@charts
@both
def test_a_flight_is_followed_in_either_chart(scenario: Make, chart: Chart) -> None:
    found = summary(scenario(simulated(2, duration=4), attitude=chart))["metrics"]
    assert found["attitude_rmse_deg"] < (0.6 if scenario is quadrotor_ukf_pose else 4)
    assert found["position_rmse_m"] < (0.01 if scenario is quadrotor_ukf_pose else 0.15)
    assert found["velocity_rmse_mps"] < 0.12
    assert {"gyro_bias_rmse_radps", "accel_bias_rmse_mps2"} <= set(found)


def test_an_exact_imu_integrated_is_the_path_it_was_carried_along() -> None:
    stamps = np.cumsum(np.random.default_rng(5).uniform(0.003, 0.05, 300))
    flight, camera = simulation.fly(np.random.default_rng(6), stamps, noise_scale=0)
    model, x = Model("so3"), flight.states[0]
    for k in range(1, 300):
        control = np.concatenate([flight.gyro[k], flight.accel[k]])
        x = model.move(x, np.zeros(12), Tick(stamps[k], stamps[k] - stamps[k - 1], control))
        np.testing.assert_allclose(model.space.minus(x, flight.states[k])[:9], 0, atol=5e-4)
    np.testing.assert_allclose(camera.pose, flight.states[::5, :7])
    np.testing.assert_allclose(np.linalg.norm(flight.accel[:, :2], axis=1), 0, atol=0.15)  # thrust is along z


def test_a_smooth_path_is_found_through_noisy_poses_with_a_gap() -> None:
    rng, stamps = np.random.default_rng(7), np.arange(0.0, 10.0, 0.02)
    stamps = stamps[(stamps < 4.0) | (stamps > 4.7)]
    states = simulation.fly(rng, stamps, noise_scale=0)[0].states[:, :10]
    noisy = quaternions.multiply(states[:, 3:7], quaternions.exp(0.01 * rng.standard_normal((len(stamps), 3))))
    pose = np.concatenate([states[:, :3] + 0.005 * rng.standard_normal((len(stamps), 3)), noisy], axis=1)
    path = simulation.smooth_path(stamps, pose)
    far = np.abs(stamps - 4.35) > 0.6
    off = Model("so3").space.minus(*(np.pad(x[far], ((0, 0), (0, 6))) for x in (path, states)))
    rms = np.sqrt((off.reshape(-1, 5, 3) ** 2).sum(2).mean(0))
    assert (rms[:3] < [0.005, 0.01, 0.06]).all(), rms


def test_the_course_s_camera_is_followed_to_5_cm_and_bettered_in_velocity(real_data: Path) -> None:
    file = real_data / "nyu6213" / "proj2_dataset1.mat"
    data = quadrotor([file], np.random.default_rng(0))
    assert (len(data.time), np.isfinite(data.velocity).all(1).sum()) == (864, 863)
    pose, velocity = quadrotor_ukf_pose(data), quadrotor_ukf_velocity(data)
    assert summary(pose)["metrics"]["position_rmse_m"] < 0.005
    own = velocity.facts["camera_velocity_rmse_mps"]
    assert own == pytest.approx(0.084, abs=0.001)  # with the camera turned by −π/4 instead: 0.66
    assert summary(velocity)["metrics"]["velocity_rmse_mps"] < 0.95 * own
    again = quadrotor([file], np.random.default_rng(0))
    np.testing.assert_array_equal(again.accel, data.accel)
    assert "truth here" in pose.notes
