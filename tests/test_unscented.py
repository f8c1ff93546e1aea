"""The unscented filter: Kraft's paper and the exact Kalman filter as oracles; gates, failures, the unseen heading."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from viz_estim.core import quaternions, unscented
from viz_estim.core.beliefs import Gaussian, normal
from viz_estim.core.measurement import Measurement, Sensor
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick, run
from viz_estim.core.spaces import SO3, Euclidean, Product
from viz_estim.core.stages import SigmaPoints
from viz_estim.core.unscented import Rule, scaled, symmetric, update
from viz_estim.scenarios import imu

RULES = [symmetric, *(partial(scaled, alpha=a, beta=b, kappa=k) for a, b, k in [(1, 2, 0), (0.5, 0, 1), (1e-2, 2, -1)])]
rules = pytest.mark.parametrize("make", RULES, ids=["symmetric", "scaled-1-2-0", "scaled-0.5-0-1", "scaled-0.01-2--1"])
PLACE, SPEED = (Sensor(Euclidean(("u", "v")), lambda x, i=i: x[..., i : i + 2], 0.5 * np.eye(2)) for i in (0, 2))
INDEFINITE = np.diag([1.0, 1, 1, 1, 1, -1])
NOISE = {"gyro_noise": 0.07, "accel_noise": 0.5, "attitude_walk": 0.02, "rate_walk": 1.3}


def multiply(p: list[float], q: list[float]) -> list[float]:
    (a, b, c, d), (e, f, g, h) = p, q
    return [
        a * e - b * f - c * g - d * h, a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f, a * h + b * g - c * f + d * e,
    ]  # fmt: skip


def inverse(q: list[float]) -> list[float]:
    return [q[0], -q[1], -q[2], -q[3]]


def of_vector(v: Array) -> list[float]:
    """The quaternion of a rotation vector."""
    angle = float(np.sqrt(v @ v))
    return [float(np.cos(angle / 2)), *(float(c) for c in 0.5 * np.sinc(angle / (2 * np.pi)) * v)]


def to_vector(q: list[float]) -> Array:
    """The rotation vector of a quaternion, the short way round."""
    return Rotation.from_quat(q, scalar_first=True).as_rotvec()


def turn(q: list[float]) -> Array:
    """T = blockdiag(R(q), I): body-frame errors of (attitude, rate) to world-frame ones."""
    return block_diag(Rotation.from_quat(q, scalar_first=True).as_matrix(), np.eye(3))


def krafts_filter(q: list[float], w: Array, P: Array, ticks: list[Tick], R: Array, Q_per_s: Array) -> list[tuple]:
    """E. Kraft, "A quaternion-based unscented Kalman filter for orientation tracking" (2003), line by line.

    P is over (e, ω) with the paper's error quaternion e = q·q̄⁻¹: a rotation in the world's frame.
    """
    n, history = 6, []
    for tick in ticks:
        # The paper multiplies the disturbance on the right, where it turns about the body's axes, and takes
        # the errors on the left. One covariance serves both after a change of frame: P_body = Tᵀ P_world T.
        S = np.linalg.cholesky(n * (turn(q).T @ P @ turn(q) + Q_per_s * tick.dt))
        W = [sign * column for sign in (1, -1) for column in S.T]
        X = [(multiply(q, of_vector(Wi[:3])), w + Wi[3:]) for Wi in W]
        Y = [(multiply(qi, of_vector(wi * tick.dt)), wi) for qi, wi in X]
        if tick.dt > 0:
            q = Y[0][0]
            for _ in range(50):  # section 3.4: the mean of the error vectors, until it vanishes
                step = sum(to_vector(multiply(qi, inverse(q))) for qi, _ in Y) / (2 * n)
                q = multiply(of_vector(step), q)
                if np.abs(step).max() < 1e-14:
                    break
            w = sum(wi for _, wi in Y) / (2 * n)
        W = [np.concatenate([to_vector(multiply(qi, inverse(q))), wi - w]) for qi, wi in Y]
        P = sum(np.outer(Wi, Wi) for Wi in W) / (2 * n)
        # H2, gravity in the body's frame, and H1, the rate
        Z = [np.concatenate([multiply(multiply(inverse(qi), [0, 0, 0, 9.81]), qi)[1:], wi]) for qi, wi in Y]
        z_mean = sum(Z) / (2 * n)
        nu = np.concatenate([tick.measurements["accel"], tick.measurements["gyro"]]) - z_mean
        Pvv = sum(np.outer(Zi - z_mean, Zi - z_mean) for Zi in Z) / (2 * n) + R
        Pxz = sum(np.outer(Wi, Zi - z_mean) for Wi, Zi in zip(W, Z, strict=True)) / (2 * n)
        K = Pxz @ np.linalg.inv(Pvv)
        q, w, P = multiply(of_vector((K @ nu)[:3]), q), w + (K @ nu)[3:], P - K @ Pvv @ K.T
        q = [c / sum(c * c for c in q) ** 0.5 for c in q]
        history.append((q, w, P, Pvv, nu))
    return history


@pytest.fixture(scope="module")
def data() -> imu.ImuData:
    return imu.imu(None, np.random.default_rng(3), duration=8, still=0.4, freeze=0)


def test_the_filter_is_the_one_in_krafts_paper(data: imu.ImuData) -> None:
    scenario = imu.imu_ukf(data, **NOISE)
    scenario = replace(scenario, ticks=scenario.ticks[:140])  # a second of motion: the paper's own loops take long
    start, R = scenario.beliefs[0], np.diag([0.5**2] * 3 + [0.07**2] * 3)
    q, T, Q_per_s = list(start.mean[:4]), turn(list(start.mean[:4])), np.diag([0.02**2] * 3 + [1.3**2] * 3)
    paper = krafts_filter(q, start.mean[4:], T @ start.cov @ T.T, list(scenario.ticks), R, Q_per_s)
    assert len(paper) > 120
    for step, (q, w, P, Pvv, nu) in zip(run(scenario), paper, strict=True):
        last, T = step.stages[-1], turn(list(step.stages[-1].belief.mean[:4]))
        assert np.abs(to_vector(multiply(list(last.belief.mean[:4]), inverse(q)))).max() < 1e-9
        np.testing.assert_allclose(last.belief.mean[4:], w, rtol=0, atol=1e-9)
        np.testing.assert_allclose(T @ last.belief.cov @ T.T, P, rtol=1e-7, atol=1e-11)
        np.testing.assert_allclose(last.innovation.cov, Pvv, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(last.innovation.residual, nu, rtol=0, atol=1e-8)


def covariance(rng: np.random.Generator, d: int, condition: float = 10.0, shape: tuple[int, ...] = ()) -> Array:
    U = np.linalg.qr(rng.standard_normal((*shape, d, d)))[0]
    return U * np.logspace(0, -np.log10(condition), d) @ np.swapaxes(U, -1, -2)


@rules
@pytest.mark.parametrize("shape", [(), (7,), (3, 5)], ids=str)
def test_on_a_linear_model_it_is_the_kalman_filter(make: Callable[[int], Rule], shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(5)
    A, H, B = rng.standard_normal((4, 4)), rng.standard_normal((3, 4)), rng.standard_normal((4, 2))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    Q, W, R, space = covariance(rng, 4), covariance(rng, 2), covariance(rng, 3), Euclidean(tuple("abcd"))
    m, P = rng.standard_normal((*shape, 4)), covariance(rng, 4, shape=shape)
    sensor = Measurement({"one": Sensor(Euclidean(("u", "v", "w")), lambda x: x @ H.T, R)})
    belief, augmented = Gaussian(space, m, P), Gaussian(space, m, P)
    for _ in range(10):
        augmented = unscented.predict_augmented(augmented, lambda x, w: x @ A.T + w @ B.T, W, make(6)).belief
        belief = unscented.predict(belief, lambda x: x @ A.T, Q, make(4)).belief
        for found, added in ((augmented, B @ W @ B.T), (belief, A @ Q @ A.T)):
            np.testing.assert_allclose(found.mean, m @ A.T, rtol=0, atol=1e-10)
            np.testing.assert_allclose(found.cov, A @ P @ A.T + added, rtol=0, atol=1e-10)
        m, P, z = m @ A.T, A @ (P + Q) @ A.T, rng.standard_normal((*shape, 3))
        stage = update(belief, z, sensor, make(4))
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        m, P = m + (K @ (z - m @ H.T)[..., None])[..., 0], P - K @ S @ np.swapaxes(K, -1, -2)
        belief = augmented = stage.belief
        for ours, exact in ((belief.mean, m), (belief.cov, P), (stage.gain, K), (stage.innovation.cov, S)):
            np.testing.assert_allclose(ours, exact, rtol=0, atol=1e-10)


@rules
@pytest.mark.parametrize("condition", [10.0, 1e12])
def test_points_have_the_moments_they_were_drawn_for(make: Callable[[int], Rule], condition: float) -> None:
    rng, space = np.random.default_rng(6), Product(attitude=SO3(), rate=Euclidean(("x", "y", "z")))
    assert make(6).mean_weights.sum() == pytest.approx(1)
    mean = np.concatenate([quaternions.normalise(rng.standard_normal((5, 4))), rng.standard_normal((5, 3))], axis=1)
    cov = 0.1 * covariance(rng, 6, condition, (5,))
    found, spread, _ = unscented.moments(unscented.draw(space, mean, cov, make(6)))
    np.testing.assert_allclose(space.minus(found, mean), 0, atol=1e-9)
    np.testing.assert_allclose(spread, cov, rtol=0, atol=1e-12)


@pytest.mark.parametrize("alpha", [1.0, 1e-2, 1e-3, 1e-4])
def test_scaled_points_of_an_attitude_have_a_mean_however_close_they_lie(alpha: float) -> None:
    rng = np.random.default_rng(7)
    mean, cov = quaternions.normalise(rng.standard_normal((50, 4))), 0.01 * covariance(rng, 3, shape=(50,))
    # Of x ~ N(0, 1), x² has mean 1 and variance 2: what β = 2 is for.
    square = SigmaPoints(Euclidean(("x²",)), scaled(1, alpha).unit ** 2, *scaled(1, alpha)[1:])
    np.testing.assert_allclose(np.concatenate(unscented.moments(square)[:2], axis=None), [1, 2], rtol=1e-6)
    found, spread, _ = unscented.moments(unscented.draw(SO3(), mean, cov, scaled(3, alpha)))
    np.testing.assert_allclose(SO3().minus(found, mean), 0, atol=1e-7)
    np.testing.assert_allclose(spread, cov, atol=1e-7)


def gated(gate: float) -> Measurement:
    return Measurement({"place": replace(PLACE, gate=gate), "speed": replace(SPEED, gate=gate)})


def test_a_gated_sensor_moves_nothing_and_members_of_a_batch_are_gated_alone() -> None:
    rng, space, rule = np.random.default_rng(8), Euclidean(tuple("abcd")), symmetric(4)
    used = np.array([[True, True], [False, True], [True, False], [False, False]])
    refused = ~used.repeat(2, axis=1)
    belief = Gaussian(space, rng.standard_normal((4, 4)), covariance(rng, 4, shape=(4,)))
    z = belief.mean + 0.1 * rng.standard_normal((4, 4)) + 50 * refused
    stage = update(belief, z, gated(0.99), rule)
    np.testing.assert_array_equal(stage.innovation.used, used)
    assert stage.innovation.offered.all()
    np.testing.assert_array_equal(stage.gain[np.broadcast_to(refused[:, None], stage.gain.shape)], 0)
    for i, sensors in enumerate([{"place": PLACE, "speed": SPEED}, {"speed": SPEED}, {"place": PLACE}, {}]):
        one = Gaussian(space, belief.mean[i], belief.cov[i])
        alone = update(one, z[i][~refused[i]], Measurement(sensors), rule).belief if sensors else one
        for other in (alone, update(one, z[i], gated(0.99), rule).belief):
            np.testing.assert_allclose(stage.belief.mean[i], other.mean, atol=1e-12)
            np.testing.assert_allclose(stage.belief.cov[i], other.cov, atol=1e-12)


@pytest.mark.parametrize("gate", [0.9, 0.99])
def test_a_gate_refuses_good_readings_as_often_as_it_says(gate: float) -> None:
    rng, N = np.random.default_rng(9), 20_000
    belief = Gaussian(Euclidean(tuple("abcd")), np.zeros((N, 4)), np.broadcast_to(covariance(rng, 4), (N, 4, 4)))
    x = normal(belief.space, belief.mean, belief.cov, rng)
    stage = update(belief, x + np.sqrt(0.5) * rng.standard_normal((N, 4)), gated(gate), symmetric(4))
    np.testing.assert_allclose(1 - stage.innovation.used.mean(0), 1 - gate, atol=4 * np.sqrt(gate * (1 - gate) / N))


@pytest.mark.parametrize("k", [1, 7])
@pytest.mark.parametrize("fault", ["covariance", "reading"])
def test_a_failure_becomes_its_step_s_error_and_ends_the_run(data: imu.ImuData, fault: str, k: int) -> None:
    scenario = imu.imu_ukf(data)
    ticks, healthy = list(scenario.ticks), scenario.estimator.process_noise
    estimator, came, stage, text = scenario.estimator, ["predict", "update"], "update", "NotFinite"
    if fault == "reading":
        ticks[k] = replace(ticks[k], measurements=ticks[k].measurements | {"gyro": np.array([0.1, np.nan, 0.1])})
    else:
        came, stage, text = [], "predict", "LinAlgError"
        estimator = replace(estimator, process_noise=lambda t: INDEFINITE if t is ticks[k] else healthy(t))
    steps = list(run(replace(scenario, estimator=estimator, ticks=ticks)))
    assert [step.error is None for step in steps] == [True] * k + [False]
    error, found = steps[-1].error, [one.name for one in steps[-1].stages]
    assert (found, error.step, error.stage, error.message.split(":")[0]) == (came, k, stage, text)


def test_a_covariance_that_is_not_positive_definite_is_refused(data: imu.ImuData) -> None:
    start = replace(imu.imu_ukf(data).beliefs[0], cov=INDEFINITE)
    with pytest.raises(np.linalg.LinAlgError):
        unscented.predict(start, lambda x: x, np.zeros((6, 6)), symmetric(6))
    with pytest.raises(np.linalg.LinAlgError):
        update(start, np.zeros(6), imu.imu_ukf(data).estimator.measurement, symmetric(6))


def pushed(rule: Rule, heading_std: float, turning: float, transported: bool) -> tuple[float, float]:
    """500 readings of gravity by a tilted body under a sideways push of 1 m/s², its direction turning by `turning` rad
    each: how far the heading went at most (deg), and the least of its variance over that of the start."""
    q = quaternions.from_euler(np.array([0.4, -0.3, 0.2]))
    up, headings, variances = imu._up_in_body(q), [0.0], []
    belief = Gaussian(SO3(), q, 0.05**2 * np.eye(3) + heading_std**2 * np.outer(up, up))
    gravity = Sensor(Euclidean(("x", "y", "z")), lambda x: imu.GRAVITY * imu._up_in_body(x), 0.6**2 * np.eye(3))
    for k in range(500):
        z = imu.GRAVITY * imu._up_in_body(q) + np.array([-np.sin(turning * k), np.cos(turning * k), 0.0])
        variances.append(up @ belief.cov @ up)
        now = update(belief, z, Measurement({"accel": gravity}), rule)
        headings.append(headings[-1] + up @ now.gain @ now.innovation.residual)  # about the world's up
        kept = belief.cov - now.gain @ now.innovation.cov @ now.gain.T
        belief = now.belief if transported else replace(now.belief, cov=0.5 * (kept + kept.T))
        up = imu._up_in_body(belief.mean)
    return float(np.degrees(np.abs(headings).max())), float(min(variances) / variances[0])


@pytest.mark.parametrize(("rule", "heading_std"), [(symmetric(3), 0.1), (scaled(3, 1e-2), 1.0)], ids=["2n", "2n+1"])
@pytest.mark.parametrize("turning", [0.0, 1 / 15])
def test_gravity_moves_no_heading_and_makes_none_sure(rule: Rule, heading_std: float, turning: float) -> None:
    moved, least = pushed(rule, heading_std, turning, transported=True)
    assert (moved < 0.1, least > 0.9999) == (True, True)
    # The covariance kept as it is, in the body's axes: what was heading is tilt after a correction, and looks seen.
    moved, least = pushed(rule, heading_std, turning, transported=False)
    assert least < 0.95
    assert moved > 10 or turning == 0
