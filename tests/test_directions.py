"""A force of the body that is added to the world's velocity as it is: told as that, and never as a unit."""

from pathlib import Path

import numpy as np
import pytest

import viz_estim
from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO2, SO3, Euclidean, Product
from viz_estim.diagnose import diagnose
from viz_estim.diagnosis.directions import NOT_TURNED, TURNED_BACK
from viz_estim.diagnosis.finding import Finding
from viz_estim.diagnosis.geometry import singled_out

DT, STEPS = 0.05, 80


def about(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def planar(path: Path, times: int, *, heading: float, swing: float, known: bool) -> list[Finding]:
    """A force turns with the body, and is added turned by `times` the heading; a fix of the place each 4th step.

    Where it points ahead and is not turned, x moves by cos(heading) of what is predicted: at 73.9° as km/h for m/s."""
    rng, n = np.random.default_rng(0), 5 if known else 4
    parts = {"position": Euclidean(["x", "y"], "m"), "velocity": Euclidean(["x", "y"], "m/s")}
    space = Product(**parts, **({"heading": SO2()} if known else {}))
    F, H, Q, R = np.eye(n), np.eye(2, n), np.diag([1e-8, 1e-8, 1e-6, 1e-6, 1e-6])[:n, :n], 0.05**2 * np.eye(2)
    F[0, 2] = F[1, 3] = DT
    true = np.array([0, 0, 0, 0, heading])[:n]
    x, P = true, 0.01 * np.eye(n)
    with viz_estim.record(path, space, sensors={"gps": {"x": "m", "y": "m"}}) as rec:
        for k in range(STEPS):
            force, turn = (
                np.array([2 * np.sin(1.3 * DT * k), np.cos(0.9 * DT * k) * known]),
                swing * np.cos(0.5 * DT * k) * DT,
            )
            if k:
                told = about(times * heading) @ (force + 0.02 * rng.standard_normal(2))
                moved = about(heading) @ force
                true = F @ true + np.array([0, 0, *(DT * moved), turn])[:n]
                x, P = F @ x + np.array([0, 0, *(DT * told), turn])[:n], F @ P @ F.T + Q
                heading += turn
                rec.stage("predict", mean=x, cov=P, transition=F, noise=Q)
            if k % 4 == 0:
                z = true[:2] + 0.05 * rng.standard_normal(2)
                S = H @ P @ H.T + R
                K, y = P @ H.T @ np.linalg.inv(S), z - H @ x
                x, P = x + K @ y, P - K @ S @ K.T
                rec.stage("gps", mean=x, cov=P, residual=y, residual_cov=S, gain=K, z=z, noise=R, sensor="gps")
            rec.step(time=DT * k, truth=true)
    return [f for f in diagnose(viz_estim.load(path)) if f.severity == "error"]


def spatial(path: Path, times: int) -> list[Finding]:
    """The same of an IMU's force that moves a velocity in space, whose attitude the gyro turns."""
    rng, g = np.random.default_rng(1), np.array([0, 0, -9.81])
    space = Product(attitude=SO3(), velocity=Euclidean(["x", "y", "z"], "m/s"))
    H, R, Q = np.eye(3, 6, 3), 0.01 * np.eye(3), 1e-6 * np.eye(6)
    q, v = np.array([1.0, 0, 0, 0]), np.zeros(3)
    x, P = np.r_[q, v], 1e-3 * np.eye(6)
    with viz_estim.record(path, space, sensors={"z": dict.fromkeys("xyz", "m/s")}) as rec:
        for k in range(2 * STEPS):
            if k:
                t = DT * k
                rate = np.array([0.3 * np.cos(0.8 * t), 0.3 * np.sin(1.1 * t), 0.5])
                a = np.array([np.sin(t), np.cos(0.7 * t), 0.5 * np.sin(0.5 * t)])
                middle = quaternions.multiply(q, quaternions.exp(0.5 * DT * rate))
                force = quaternions.rotate(quaternions.conjugate(middle), a - g) + 0.05 * rng.standard_normal(3)
                q, v = quaternions.multiply(q, quaternions.exp(DT * rate)), v + DT * a
                middle = quaternions.multiply(x[:4], quaternions.exp(0.5 * DT * rate))
                told = {1: middle, 0: np.array([1.0, 0, 0, 0]), -1: quaternions.conjugate(middle)}[times]
                turned = quaternions.multiply(x[:4], quaternions.exp(DT * rate))
                x, P = np.r_[turned, x[4:] + DT * (quaternions.rotate(told, force) + g)], P + Q
                rec.stage("predict", mean=x, cov=P)
            if k % 4 == 0:
                z = v + 0.1 * rng.standard_normal(3)
                S = H @ P @ H.T + R
                K, y = P @ H.T @ np.linalg.inv(S), z - x[4:]
                x, P = np.r_[x[:4], x[4:] + K[3:] @ y], P - K @ S @ K.T
                rec.stage("update", mean=x, cov=P, residual=y, residual_cov=S, gain=K, z=z, noise=R)
            rec.step(time=DT * k, truth=np.r_[q, v])
    return [f for f in diagnose(viz_estim.load(path)) if f.severity == "error"]


@pytest.mark.parametrize(("known", "what"), [(True, NOT_TURNED), (False, "turned by -74°")])
def test_a_planar_force_that_is_not_turned_is_no_unit(known: bool, what: str, tmp_path: Path) -> None:
    first = planar(tmp_path / "a.rrd", 0, heading=1.29, swing=0.4 if known else 0.0, known=known)[0]
    assert first.evidence["map"] == what
    assert "into the world's axes" in first.remedy


@pytest.mark.parametrize(("times", "what"), [(0, NOT_TURNED), (-1, TURNED_BACK)])
def test_a_specific_force_that_is_not_turned_is_no_unit(times: int, what: str, tmp_path: Path) -> None:
    told = spatial(tmp_path / "a.rrd", times)
    assert told[0].evidence["map"] == what
    assert not any("for m/s" in f.cause for f in told)


def test_a_unit_is_named_by_innovations_only_where_no_other_would_do() -> None:
    """Readings in km/h of what was expected, against an estimate that has gone elsewhere and is as large as that."""
    rng, n = np.random.default_rng(3), 200
    expected, one = np.cumsum(rng.standard_normal((n, 2)), axis=0), np.broadcast_to(np.eye(2), (n, 2, 2))
    noise = 0.1 * rng.standard_normal((n, 2))
    assert singled_out(3.6 * expected + noise, expected, one, "km/h for m/s", "m/s")
    assert not singled_out(3.6 * expected + noise, expected, one, "feet for m", "m/s")
    astray = 3.6 * expected + 3.6 * np.cumsum(rng.standard_normal((n, 2)), axis=0)
    assert not singled_out(astray, expected, one, "km/h for m/s", "m/s")
