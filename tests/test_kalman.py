"""The Kalman filter against oracles of other kinds: batch least squares, the information form, the unscented filter."""

from collections.abc import Mapping

import drawn
import numpy as np
import pytest

from viz_estim.core import kalman, quaternions, unscented
from viz_estim.core.beliefs import Gaussian, normal
from viz_estim.core.consistency import band, squared_distance
from viz_estim.core.kalman import KalmanFilter, finite_differences, linear, linear_sensor, predict, update
from viz_estim.core.measurement import Measurement, Sensor
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick
from viz_estim.core.spaces import S2, SE2, SO2, SO3, Euclidean, Product
from viz_estim.core.stages import LinearPredict, Update

RNG = np.random.default_rng()  # these filters draw nothing
UP = np.array([0.0, 0.0, 1.0])


def spd(rng: np.random.Generator, n: int, *batch: int) -> Array:
    L = rng.standard_normal((*batch, n, n))
    return L @ np.swapaxes(L, -1, -2) + 0.1 * np.eye(n)


def euclidean(n: int, name: str = "x") -> Euclidean:
    return Euclidean([f"{name}{i}" for i in range(n)])


def linear_system(rng: np.random.Generator) -> tuple[KalmanFilter, Gaussian, Array, Array, Array, dict[str, Array]]:
    """A filter on a random system of three states, two inputs and two sensors; and what it was made of."""
    F, Q, B = rng.standard_normal((3, 3)), spd(rng, 3), rng.standard_normal((3, 2))
    F *= 0.95 / np.abs(np.linalg.eigvals(F)).max()
    H = {"one": rng.standard_normal((1, 3)), "two": rng.standard_normal((2, 3))}
    sensors = {name: linear_sensor(euclidean(len(h), "z"), h, spd(rng, len(h))) for name, h in H.items()}
    start = Gaussian(euclidean(3), rng.standard_normal(3), spd(rng, 3))
    return linear(F, Q, sensors, B), start, F, Q, B, H


def some_ticks(rng: np.random.Generator, count: int) -> list[Tick]:
    """Ticks whose two sensors come at rates of their own: each, every third, now and then none."""
    ticks = []
    for k in range(count):
        readings = {"two": rng.standard_normal(2)} if k % 3 == 1 else {}
        readings |= {"one": rng.standard_normal(1)} if k % 4 else {}
        ticks.append(Tick(float(k), float(k > 0), rng.standard_normal(2), readings))
    return ticks


def last_belief(estimator: KalmanFilter, start: Gaussian, ticks: list[Tick]) -> Gaussian:
    belief = start
    for tick in ticks:
        for stage in estimator.step(belief, tick, RNG):
            belief = stage.belief
    return belief


@pytest.mark.parametrize("seed", range(8))
def test_it_ends_where_weighted_least_squares_over_the_whole_trajectory_does(seed: int) -> None:
    """The oracle solves for all states at once: rows for the prior, each transition and each reading, whitened."""
    rng = np.random.default_rng(seed)
    estimator, start, F, Q, B, H = linear_system(rng)
    ticks = some_ticks(rng, 12)
    rows: list[Array] = []
    values: list[Array] = []

    def add(blocks: Mapping[int, Array], value: Array, cov: Array) -> None:
        white = np.linalg.inv(np.linalg.cholesky(cov))
        row = np.zeros((len(value), 3 * len(ticks)))
        for k, block in blocks.items():
            row[:, 3 * k : 3 * k + 3] = block
        rows.append(white @ row)
        values.append(white @ value)

    add({0: np.eye(3)}, start.mean, start.cov)
    for k, tick in enumerate(ticks):
        if k:
            assert tick.control is not None
            add({k - 1: -F, k: np.eye(3)}, B @ tick.control, Q)
        for name, z in tick.measurements.items():
            add({k: H[name]}, z, estimator.sensors[name].noise)
    A, b = np.concatenate(rows), np.concatenate(values)
    cov = np.linalg.inv(A.T @ A)
    found = last_belief(estimator, start, ticks)
    np.testing.assert_allclose(found.mean, (cov @ A.T @ b)[-3:], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.cov, cov[-3:, -3:], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("seed", range(5))
def test_an_update_adds_information_and_sensors_may_come_jointly_or_in_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    estimator, start, *_, H = linear_system(rng)
    readings = {"one": rng.standard_normal(1), "two": rng.standard_normal(2)}
    joint = update(start, np.concatenate([*readings.values()]), Measurement(dict(estimator.sensors)))
    in_turn = last_belief(estimator, start, [Tick(0.0, 0.0, None, readings)])
    information, vector = np.linalg.inv(start.cov), np.linalg.inv(start.cov) @ start.mean
    for name, z in readings.items():
        weight = H[name].T @ np.linalg.inv(estimator.sensors[name].noise)
        information, vector = information + weight @ H[name], vector + weight @ z
    for belief in (joint.belief, in_turn):
        np.testing.assert_allclose(belief.cov, np.linalg.inv(information), rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(belief.mean, np.linalg.solve(information, vector), rtol=1e-8, atol=1e-10)
    seen = joint.innovation
    np.testing.assert_allclose(joint.gain @ seen.cov, seen.cross_cov, atol=1e-10)
    np.testing.assert_allclose(start.mean + joint.gain @ seen.residual, joint.belief.mean, atol=1e-12)


def test_stages_are_named_and_each_holds_what_it_did() -> None:
    rng = np.random.default_rng(1)
    estimator, start, F, Q, B, _ = linear_system(rng)
    tick = Tick(3.0, 1.0, np.ones(2), {"two": np.zeros(2), "one": np.zeros(1)})
    stages = list(estimator.step(start, tick, RNG))
    assert [stage.name for stage in stages] == ["predict", "update/one", "update/two"]  # the filter's order
    first = stages[0]
    assert isinstance(first, LinearPredict)
    np.testing.assert_allclose(first.belief.mean, F @ start.mean + B @ np.ones(2))
    np.testing.assert_allclose(first.belief.cov, F @ start.cov @ F.T + Q)
    np.testing.assert_array_equal(first.transition, F)
    alone = linear(F, Q, {"two": estimator.sensors["two"]}, B)
    assert [stage.name for stage in alone.step(start, Tick(0.0, 0.0, None, tick.measurements), RNG)] == ["update"]
    assert [stage.name for stage in alone.step(start, Tick(0.0, 1.0, np.ones(2)), RNG)] == ["predict"]
    assert list(alone.step(start, Tick(0.0, 0.0), RNG)) == []


@pytest.mark.parametrize("batch", [(1,), (7,), (2, 3)])
def test_a_batch_is_its_members_each_alone(batch: tuple[int, ...]) -> None:
    """Some of them with a reading that the gate refuses."""
    rng = np.random.default_rng(2)
    F, Q, H, R = rng.standard_normal((3, 3)), spd(rng, 3), rng.standard_normal((2, 3)), spd(rng, 2)
    sensors = {
        "a": linear_sensor(euclidean(2, "z"), H, R, gate=0.7),
        "b": linear_sensor(euclidean(1), H[:1], R[:1, :1]),
    }
    estimator = linear(F, Q, sensors, np.eye(3))
    start = Gaussian(euclidean(3), rng.standard_normal((*batch, 3)), spd(rng, 3, *batch))
    z = {"a": 4 * rng.standard_normal((*batch, 2)), "b": rng.standard_normal((*batch, 1))}
    control = rng.standard_normal((*batch, 3))
    together = list(estimator.step(start, Tick(1.0, 1.0, control, z), RNG))
    refused = 0
    for i in np.ndindex(*batch):
        tick = Tick(1.0, 1.0, control[i], {name: values[i] for name, values in z.items()})
        alone = list(estimator.step(Gaussian(start.space, start.mean[i], start.cov[i]), tick, RNG))
        for one, many in zip(alone, together, strict=True):
            np.testing.assert_allclose(many.belief.mean[i], one.belief.mean, atol=1e-11)
            np.testing.assert_allclose(many.belief.cov[i], one.belief.cov, atol=1e-11)
            if isinstance(one, Update) and isinstance(many, Update):
                np.testing.assert_allclose(many.gain[i], one.gain, atol=1e-11)
                np.testing.assert_array_equal(many.innovation.used[i], one.innovation.used)
                refused += int(not one.innovation.used.all())
    assert batch == (1,) or 0 < refused < np.prod(batch)


@pytest.mark.parametrize("seed", range(5))
def test_a_refused_sensor_moves_nothing_and_the_other_one_is_taken_in_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    H, R = rng.standard_normal((3, 4)), [spd(rng, 1), spd(rng, 2)]
    start = Gaussian(euclidean(4), rng.standard_normal(4), spd(rng, 4))
    good = linear_sensor(euclidean(1), H[:1], R[0], gate=0.999)
    bad = linear_sensor(euclidean(2), H[1:], R[1], gate=0.999)
    z = H @ start.mean + np.array([0.0, 90.0, -90.0])
    both = update(start, z, Measurement({"good": good, "bad": bad}))
    alone = update(start, z[:1], Measurement({"good": good}))
    np.testing.assert_array_equal(both.innovation.used, [True, False])
    np.testing.assert_array_equal(both.gain[:, 1:], 0.0)
    np.testing.assert_allclose(both.belief.mean, alone.belief.mean, atol=1e-12)
    np.testing.assert_allclose(both.belief.cov, alone.belief.cov, atol=1e-12)
    neither = update(start, z[1:], Measurement({"bad": bad})).belief
    np.testing.assert_array_equal(neither.mean, start.mean)
    np.testing.assert_allclose(neither.cov, start.cov, atol=1e-14)


def test_a_gate_lets_as_many_good_readings_pass_as_it_says() -> None:
    rng = np.random.default_rng(6)
    space, P, R = euclidean(2), spd(rng, 2), spd(rng, 2)
    sensor = linear_sensor(space, np.eye(2), R, gate=0.9)
    z = normal(space, np.zeros((20_000, 2)), P + R, rng)
    seen = update(Gaussian(space, np.zeros(2), P), z, Measurement({"z": sensor})).innovation
    assert seen.used.mean() == pytest.approx(0.9, abs=0.008)


@pytest.mark.parametrize("tiny", [1e-2, 1e-4, 1e-7])
def test_the_covariance_stays_positive_as_far_as_its_digits_go(tiny: float) -> None:
    """Far apart variances and near-exact readings of near-parallel directions, again and again."""
    rng = np.random.default_rng(4)
    space = euclidean(3)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    belief = Gaussian(space, np.zeros(3), turn @ np.diag([1e6, 1.0, tiny]) @ turn.T)
    for k in range(300):
        H = np.array([[1.0, 1.0, 1.0 + 1e-6 * rng.standard_normal()]])
        sensor = linear_sensor(space=euclidean(1, "z"), H=H, R=np.array([[tiny]]))
        before, after = belief.cov, update(belief, np.array([1.0]), Measurement({"z": sensor}))
        belief = after.belief
        np.testing.assert_array_equal(belief.cov, belief.cov.T)
        assert np.linalg.eigvalsh(belief.cov)[0] >= -1e-14 * np.linalg.eigvalsh(before)[-1], k
        assert np.trace(belief.cov) <= np.trace(before) * (1 + 1e-12)
    assert np.isfinite(belief.mean).all()


def test_a_state_that_is_known_exactly_stays_as_it_is() -> None:
    rng = np.random.default_rng(5)
    start = Gaussian(euclidean(2), np.array([3.0, 0.0]), np.diag([0.0, 4.0]))
    sensor = linear_sensor(euclidean(1, "z"), np.array([[1.0, 1.0]]), np.eye(1))
    belief = start
    for _ in range(50):
        belief = update(belief, 5 + rng.standard_normal(1), Measurement({"z": sensor})).belief
    assert belief.mean[0] == 3.0
    np.testing.assert_allclose(belief.cov, np.diag([0.0, 1 / (1 / 4 + 50)]), atol=1e-15)


def test_an_angle_goes_the_short_way_round() -> None:
    sensor = Sensor(SO2(), lambda x: x, np.array([[0.01]]), jacobian=lambda x: np.eye(1))
    start = Gaussian(SO2(), np.array([np.radians(179)]), np.array([[0.01]]))
    after = update(start, np.array([np.radians(-177)]), Measurement({"compass": sensor}))
    assert np.degrees(after.innovation.residual) == pytest.approx([4.0])
    assert np.degrees(after.belief.mean) == pytest.approx([-179.0])


def gravity_sensor(std: float) -> Sensor:
    """The world's up in body axes, with its derivative R(q)ᵀ·[up]× in a basis of the direction's tangent plane."""

    def measure(q: Array) -> Array:
        return quaternions.rotate(quaternions.conjugate(q), UP)

    def jacobian(q: Array) -> Array:
        up = measure(q)
        cross = np.cross(np.eye(3), up)  # rows: e_i × up; up moves by up × δ
        return S2().basis(up) @ -cross.T

    return Sensor(S2(), measure, std**2 * np.eye(2), None, measure, jacobian)


@pytest.mark.parametrize("seed", range(5))
def test_on_a_manifold_it_agrees_with_the_unscented_filter_where_the_model_is_nearly_linear(seed: int) -> None:
    rng = np.random.default_rng(seed)
    space, sensor = SO3(), gravity_sensor(1e-4)
    q = quaternions.normalise(rng.standard_normal(4))
    assert sensor.jacobian is not None
    np.testing.assert_allclose(finite_differences(sensor.measure, q, space, S2()), sensor.jacobian(q), atol=1e-8)
    start = Gaussian(space, q, 1e-8 * spd(rng, 3))
    z = S2().plus(sensor.measure(q), 2e-4 * rng.standard_normal(2))
    measurement = Measurement({"accel": sensor})
    one, other = update(start, z, measurement), unscented.update(start, z, measurement, unscented.symmetric(3))
    np.testing.assert_allclose(space.minus(one.belief.mean, other.belief.mean), 0, atol=5e-8)
    np.testing.assert_allclose(one.belief.cov, other.belief.cov, atol=1e-13)
    np.testing.assert_allclose(one.gain, other.gain, atol=1e-3)


def test_gravity_never_tells_the_heading() -> None:
    """Without the covariance's transport the blind direction would turn with each correction, and look seen."""
    rng = np.random.default_rng(3)
    sensor, space = gravity_sensor(0.02), SO3()
    belief = Gaussian(space, quaternions.from_euler(np.array([0.5, -0.4, 1.0])), 0.2**2 * np.eye(3))
    for k in range(200):
        z = S2().plus(sensor.measure(np.array([1.0, 0, 0, 0])), 0.02 * rng.standard_normal(2))
        belief = update(belief, z, Measurement({"accel": sensor})).belief
        heading = sensor.measure(belief.mean)
        assert heading @ belief.cov @ heading == pytest.approx(0.04, rel=0.02), k


@pytest.mark.parametrize(
    "space", [Euclidean(("x", "y")), SO2(), SO3(), SE2(), Product(q=SO3(), p=Euclidean(("x", "y", "z")))]
)
def test_finite_differences_of_plus_are_the_identity(space: kalman.Space) -> None:
    rng = np.random.default_rng(7)
    x = rng.standard_normal(len(space.names))
    if space.names[-1] != "angle" and any(name.endswith("qw") for name in space.names):
        x[:4] /= np.linalg.norm(x[:4])
    np.testing.assert_allclose(finite_differences(lambda y: y, x, space, space), np.eye(len(space.axes)), atol=1e-9)


def test_failures_name_their_stage() -> None:
    space = euclidean(2)
    no_noise = linear_sensor(euclidean(2, "z"), np.array([[1.0, 0.0], [1.0, 0.0]]), np.zeros((2, 2)))
    flat = Sensor(euclidean(2, "z"), lambda x: x, np.eye(2))
    start = Gaussian(space, np.zeros(2), np.eye(2))
    for sensor, error in ((no_noise, np.linalg.LinAlgError), (flat, ValueError)):
        estimator = linear(np.eye(2), np.eye(2), {"bad": sensor, "other": flat})
        with pytest.raises(error) as caught:
            list(estimator.step(start, Tick(0.0, 0.0, None, {"bad": np.zeros(2)}), RNG))
        assert getattr(caught.value, "stage", None) == "update/bad"
    with pytest.raises(ValueError, match="matmul") as caught_early:
        predict(start, np.zeros(2), np.eye(3), np.eye(3))
    assert getattr(caught_early.value, "stage", None) == "predict"


def test_it_is_consistent_on_data_of_its_own_model() -> None:
    """NIS of each of 50 runs in its band over time, NEES of each step in its band over the runs: 95 % of them."""
    rng = np.random.default_rng(8)
    estimator, start, *_ = linear_system(rng)
    batch = 50
    mean, cov = np.tile(start.mean, (batch, 1)), np.tile(start.cov, (batch, 1, 1))
    belief, x = Gaussian(start.space, mean, cov), normal(start.space, mean, cov, rng)
    nis, nees = [], []
    for k in range(300):
        tick = Tick(float(k), float(k > 0), rng.standard_normal(2))
        x = drawn.next_state(estimator, start.space, x, tick, rng)
        readings = drawn.readings(estimator, x, rng)
        for stage in estimator.step(belief, Tick(tick.time, tick.dt, tick.control, readings), RNG):
            belief = stage.belief
            if isinstance(stage, Update) and stage.name == "update/two":
                nis.append(squared_distance(stage.innovation.residual, stage.innovation.cov))
        nees.append(squared_distance(x - belief.mean, belief.cov))
    low, high = band(2, len(nis))
    by_run = np.mean(nis, axis=0)
    assert ((by_run >= low) & (by_run <= high)).mean() >= 0.86
    low, high = band(3, batch)
    by_step = np.mean(nees, axis=1)
    assert ((by_step >= low) & (by_step <= high)).mean() >= 0.9
