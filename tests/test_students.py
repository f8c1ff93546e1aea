"""Filters as their authors write and record them: sound ones are left alone, and what is not told is not judged."""

import warnings
from pathlib import Path

import numpy as np
import pytest

import viz_estim
from viz_estim.core import quaternions
from viz_estim.core.spaces import SO3, Euclidean, Product
from viz_estim.diagnose import diagnose
from viz_estim.diagnosis.finding import Finding
from viz_estim.recordings import Recording


def found(path: Path) -> list[Finding]:
    return diagnose(viz_estim.load(path))


def driven(path: Path, *, control: bool, steps: int = 300) -> Path:
    """A place and a speed that a noisy accelerometer moves on, and a fix each fifth step."""
    rng, dt, sigma, R = np.random.default_rng(0), 0.1, 0.5, np.array([[0.04]])
    F, Q = np.array([[1.0, dt], [0.0, 1.0]]), np.diag([1e-9, (sigma * dt) ** 2])
    H, true, x, P = np.array([[1.0, 0.0]]), np.zeros(2), np.zeros(2), 0.01 * np.eye(2)
    with viz_estim.record(path, {"p": "m", "v": "m/s"}) as rec:
        for k in range(steps):
            u = np.sin(0.05 * k)
            if k:
                true = F @ true + [0.0, u * dt]
                u = u + sigma * rng.standard_normal()
                x, P = F @ x + [0.0, u * dt], F @ P @ F.T + Q
                rec.stage("predict", mean=x, cov=P, transition=F, noise=Q)
            if k % 5 == 0:
                z = true[:1] + 0.2 * rng.standard_normal(1)
                S = H @ P @ H.T + R
                K, y = P @ H.T / S, z - H @ x
                x, P = x + K @ y, P - K @ S @ K.T
                rec.stage("gps", mean=x, cov=P, residual=y, residual_cov=S, gain=K, z=z, noise=R, sensor="gps")
            rec.step(time=dt * k, control=u if control else None)
    return path


@pytest.mark.parametrize("control", [True, False])
def test_a_prediction_by_a_noisy_control_is_no_sample_of_q(control: bool, tmp_path: Path) -> None:
    told = found(driven(tmp_path / "a.rrd", control=control))
    assert [(f.code, f.severity) for f in told] == ([] if control else [("noisy_prediction", "note")])
    assert control or "control" in told[0].remedy


@pytest.mark.parametrize("carried", [0.0, 0.5, 1.0])
def test_a_covariance_after_a_turn_may_stay_in_the_tangent_space_before_it(carried: float, tmp_path: Path) -> None:
    """As it is, by the reset of error-state filters (Solà 2017, eq. 287), or wholly; no other is."""
    rng, space = np.random.default_rng(1), Product(attitude=SO3(), bias=Euclidean(["x", "y", "z"], "rad/s"))
    up, R = np.array([0.0, 0.6, 0.8]), 0.01 * np.eye(3)
    for shrunk in (1.0, 0.9):
        x, P = np.r_[quaternions.exp(rng.normal(0, 0.5, 3)), np.zeros(3)], np.diag([0.3, 0.03, 0.1, 0.1, 0.1, 0.1])
        with viz_estim.record(tmp_path / "a.rrd", space) as rec:
            for k in range(40):
                P = P + np.diag([0.3, 0.003, 0.1, 0, 0, 0])
                rec.stage("predict", mean=x, cov=P)
                turned = quaternions.to_matrix(x[:4]).T @ up
                H = np.hstack([[[0, -turned[2], turned[1]], [turned[2], 0, -turned[0]], [-turned[1], turned[0], 0]],
                               np.zeros((3, 3))])  # fmt: skip
                y = up + 0.1 * rng.standard_normal(3) - turned
                S = H @ P @ H.T + R
                K = P @ H.T @ np.linalg.inv(S)
                A = space.transport(x, carried * (K @ y))
                x, P = space.plus(x, K @ y), shrunk * A @ (P - K @ S @ K.T) @ A.T
                rec.stage("up", mean=x, cov=P, residual=y, residual_cov=S, gain=K, z=up, predicted=turned, noise=R)
                rec.step(time=0.1 * k)
        of_claims = [f for f in found(tmp_path / "a.rrd") if f.evidence.get("kind") == "claims" or f.code == "update"]
        assert bool(of_claims) == (shrunk < 1.0)


@pytest.mark.parametrize("first", [0, 12])
def test_a_covariance_that_is_no_number_ends_no_recording_with_a_truth(first: int, tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    with viz_estim.record(path, {"x": "m", "v": "m/s"}) as rec:
        for k in range(20):
            rec.stage("predict", mean=np.zeros(2), cov=np.eye(2) if k < first else np.full((2, 2), np.nan))
            rec.step(time=0.1 * k, truth=np.zeros(2))
    run = viz_estim.load(path)
    assert len(run.step) == 20
    assert (run.summary()["nees"] or {"mean": None})["mean"] == (0.0 if first else None)
    assert found(path)[0].code == "failed"


def complementary(path: Path, *, unit: float = 1.0, truth: bool = True) -> Path:
    """An attitude by a gyro alone, without a covariance."""
    rng, q, estimate = np.random.default_rng(2), np.array([1.0, 0, 0, 0]), np.array([1.0, 0, 0, 0])
    with viz_estim.record(path, SO3()) as rec:
        for k in range(200):
            if k:
                rate = np.array([np.sin(0.05 * k), np.cos(0.03 * k), 0.5 * np.sin(0.02 * k)])
                q = quaternions.multiply(q, quaternions.exp(0.02 * rate))
                rate = unit * rate + 0.01 * rng.standard_normal(3)
                estimate = quaternions.multiply(estimate, quaternions.exp(0.02 * rate))
            rec.stage("predict", mean=estimate)
            rec.step(time=0.02 * k, truth=q if truth else None)
    return path


def test_a_filter_without_a_covariance_is_recorded_and_held_against_the_truth(tmp_path: Path) -> None:
    path = complementary(tmp_path / "a.rrd")
    run = viz_estim.load(path)
    assert np.isfinite(run.mean).all()
    assert np.isnan(run.cov).all()
    assert run.summary()["metrics"]["attitude_rmse_deg"] < 1
    assert [(f.code, f.severity) for f in found(path)] == [("untested", "note")]
    wrong = found(complementary(path, unit=np.pi / 180))
    assert (wrong[0].code, wrong[0].severity) == ("process_model", "error")


def test_where_nothing_tells_whether_a_filter_is_right_that_is_said(tmp_path: Path) -> None:
    (note,) = found(complementary(tmp_path / "a.rrd", truth=False))
    assert (note.code, note.severity) == ("untested", "note")
    assert "residual" in note.remedy


def test_a_covariance_is_told_of_at_each_stage_or_at_none(tmp_path: Path) -> None:
    with viz_estim.record(tmp_path / "a.rrd") as rec:
        rec.stage("predict", mean=[0.0])
        with pytest.raises(ValueError, match="stage update: a cov, but there was none before"):
            rec.stage("update", mean=[0.0], cov=[[1.0]])
        rec.step(time=0.0)


def steps(rec: Recording, count: int, value: float = 0.0) -> None:
    for k in range(count):
        rec.stage("predict", mean=[value], cov=[[1.0]])
        rec.step(time=float(k))


def test_a_recording_goes_where_it_began_and_a_later_one_of_its_name_ends_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rec = viz_estim.record("a.rrd")
    steps(rec, 3)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    rec.close()
    assert len(viz_estim.load(tmp_path / "a.rrd").step) == 3
    monkeypatch.chdir(tmp_path)
    first = viz_estim.record("a.rrd")  # a notebook's cell, run twice
    steps(first, 4)
    second = viz_estim.record("a.rrd")
    steps(second, 5, 1.0)
    with pytest.raises(ValueError, match=r"a\.rrd: this recording is closed"):
        first.stage("predict", mean=[0.0], cov=[[1.0]])
    first.close()
    second.close()
    assert viz_estim.load("a.rrd").mean.tolist() == [[1.0]] * 5


@pytest.mark.parametrize("unit", ["", "rad", "deg"])
@pytest.mark.parametrize("wrapped", [True, False])
def test_a_bearing_that_jumps_by_a_turn_is_no_outlier(unit: str, wrapped: bool, tmp_path: Path) -> None:
    rng, x, P, turn = np.random.default_rng(3), np.array([2.5]), np.eye(1), 360.0 if unit == "deg" else 2 * np.pi
    x, scale = x * turn / (2 * np.pi), turn / (2 * np.pi)
    with viz_estim.record(tmp_path / "a.rrd", ["heading"], sensors={"compass": {"bearing": unit}}) as rec:
        for k in range(100):
            P = P + (0.05 * scale) ** 2
            rec.stage("predict", mean=x, cov=P)
            z = (2.5 + 0.02 * k + 0.05 * rng.standard_normal(1)) * scale
            z = (z + turn / 2) % turn - turn / 2
            y, S = z - x, P + (0.05 * scale) ** 2
            y = (y + turn / 2) % turn - turn / 2 if wrapped else y
            x, P, K = x + P / S @ y, P - P @ P / S, P / S
            if wrapped:
                x = (x + turn / 2) % turn - turn / 2
            noise = (0.05 * scale) ** 2
            rec.stage("update", mean=x, cov=P, residual=y, residual_cov=S, gain=K, z=z, predicted=z - y, noise=noise,
                      sensor="compass")  # fmt: skip
            rec.step(time=0.1 * k)
    codes = [f.code for f in found(tmp_path / "a.rrd") if f.severity == "error"]
    assert codes[:1] == ([] if wrapped else ["angle_wrap"])


def test_a_start_that_the_first_readings_deny_is_no_matter_of_a_gate(tmp_path: Path) -> None:
    rng, x, P = np.random.default_rng(4), np.array([3.0]), np.array([[0.01]])
    with viz_estim.record(tmp_path / "a.rrd") as rec:
        for k in range(200):
            P = P + 0.01
            rec.stage("predict", mean=x, cov=P)
            y, S = 0.1 * rng.standard_normal(1) - x, P + 0.01
            x, P = x + P / S @ y, P - P @ P / S
            rec.stage("update", mean=x, cov=P, residual=y, residual_cov=S, gain=P / 0.01, noise=0.01)
            rec.step(time=0.1 * k)
    (first,) = [f for f in found(tmp_path / "a.rrd") if f.code == "outliers"]
    assert "starts elsewhere" in first.cause
    assert "set no gate" in first.remedy


def test_gravity_of_the_wrong_sign_is_named(tmp_path: Path) -> None:
    """By the speed that it changes and not by the place that follows."""
    rng, dt = np.random.default_rng(5), 0.1
    F, Q = np.array([[1.0, dt], [0.0, 1.0]]), np.diag([1e-6, 1e-4])
    H, true, x, P = np.array([[1.0, 0.0]]), np.zeros(2), np.zeros(2), np.eye(2)
    with viz_estim.record(tmp_path / "a.rrd", {"height": "m", "speed": "m/s"}) as rec:
        for k in range(200):
            force = 9.81 + np.sin(0.1 * k)
            if k:
                true = F @ true + np.array([0.5 * dt * dt, dt]) * (force - 9.81)
                x = F @ x + np.array([0.5 * dt * dt, dt]) * (force + 9.81)
                P = F @ P @ F.T + Q
                rec.stage("predict", mean=x, cov=P, transition=F, noise=Q)
            z = true[:1] + 0.1 * rng.standard_normal(1)
            S = H @ P @ H.T + 0.01
            K, y = P @ H.T / S, z - H @ x
            x, P = x + K @ y, P - K @ S @ K.T
            rec.stage("update", mean=x, cov=P, residual=y, residual_cov=S, gain=K, z=z, noise=0.01)
            rec.step(time=dt * k, truth=true, control=force)
    first = found(tmp_path / "a.rrd")[0]
    assert (first.code, first.evidence["component"]) == ("process_model", "state speed")
    assert "gravity is added with the wrong sign" in first.cause


def test_a_prediction_without_noise_is_named_where_readings_deny_it(tmp_path: Path) -> None:
    rng, true, x, P = np.random.default_rng(6), 0.0, np.zeros(1), np.eye(1)
    with viz_estim.record(tmp_path / "a.rrd") as rec:
        for k in range(200):
            true += 0.2 * rng.standard_normal()
            rec.stage("predict", mean=x, cov=P, transition=np.eye(1), noise=np.zeros((1, 1)))
            y, S = true + 0.1 * rng.standard_normal(1) - x, P + 0.01
            K = P / S
            x, P = x + K @ y, P - K @ P
            rec.stage("update", mean=x, cov=P, residual=y, residual_cov=S, gain=K, noise=0.01)
            rec.step(time=0.1 * k)
    assert "Q of the prediction is zero" in found(tmp_path / "a.rrd")[0].cause


@pytest.mark.parametrize("wrong", ["", "forgotten", "drawn"])
def test_weights_follow_from_what_they_are_made_of(wrong: str, tmp_path: Path) -> None:
    rng, N, true = np.random.default_rng(7), 100, 0.0
    x, w = rng.standard_normal(N), np.full(N, 1 / N)
    with viz_estim.record(tmp_path / "a.rrd") as rec:
        for k in range(40):
            true += 0.3 * rng.standard_normal()
            x = x + 0.3 * rng.standard_normal(N)
            rec.stage("predict", states=x, weights=w)
            z = true + 0.3 * rng.standard_normal()
            logs = -0.5 * ((z - x) / 0.3) ** 2
            w = np.exp(logs - logs.max()) * (1 if wrong == "forgotten" else w)
            w = w / w.sum()
            rec.stage("weigh", states=x, weights=w, log_likelihoods=logs, z=z)
            if 1 / (w**2).sum() < 0.4 * N:
                of = rng.integers(0, N, N) if wrong == "drawn" else rng.choice(N, N, p=w)
                x, w = x[of], np.full(N, 1 / N)
                rec.stage("resample", states=x, weights=w, ancestors=of)
            rec.step(time=0.1 * k)
    told = [f.evidence["kind"] for f in found(tmp_path / "a.rrd") if f.code == "weights"]
    assert told == ([wrong] if wrong else [])


@pytest.mark.parametrize("read", [True, False])
def test_a_variance_that_grows_with_the_distance_is_not_unread(read: bool, tmp_path: Path) -> None:
    rng, true, x, P = np.random.default_rng(8), 0.0, np.zeros(1), np.eye(1)
    with viz_estim.record(tmp_path / "a.rrd", ["x"]) as rec:
        for k in range(200):
            true += rng.standard_normal()
            P = P + 1.0
            rec.stage("predict", mean=x, cov=P)
            R = np.array([[0.01 * (k + 1.0) ** 2 if read else 1e14]])
            y, S = true + np.sqrt(R[0]) * rng.standard_normal(1) - x, P + R
            K = P / S
            x, P = x + K @ y, P - K @ P
            rec.stage("update", mean=x, cov=P, residual=y, residual_cov=S, gain=K, noise=R)
            rec.step(time=0.1 * k)
    assert [f.evidence.get("kind") for f in found(tmp_path / "a.rrd")] == ([] if read else ["growing"])


@pytest.mark.parametrize("control", [True, False])
def test_a_control_that_follows_the_state_makes_no_jacobian_wrong(control: bool, tmp_path: Path) -> None:
    rng, dt = np.random.default_rng(9), 0.1
    F, B, Q = np.array([[1.0, dt], [0.0, 1.0]]), np.array([0.0, dt]), 1e-3 * np.eye(2)
    H, true, x, P = np.array([[1.0, 0.0]]), np.array([3.0, 0.0]), np.array([3.0, 0.0]), 0.1 * np.eye(2)
    with viz_estim.record(tmp_path / "a.rrd") as rec:
        for k in range(200):
            u = -1.0 * x[0] - 1.5 * x[1]
            if k:
                true = F @ true + B * u + np.sqrt(1e-3) * rng.standard_normal(2)
                x, P = F @ x + B * u, F @ P @ F.T + Q
                rec.stage("predict", mean=x, cov=P, transition=F, noise=Q)
            z = true[:1] + 0.1 * rng.standard_normal(1)
            y, S = z - x[:1], H @ P @ H.T + 0.01
            K = P @ H.T / S
            x, P = x + K @ y, P - K @ S @ K.T
            rec.stage("update", mean=x, cov=P, residual=y, residual_cov=S, gain=K, z=z, noise=0.01)
            rec.step(time=dt * k, control=u if control else None)
    told = found(tmp_path / "a.rrd")
    assert [(f.code, f.severity) for f in told] == ([] if control else [("jacobian", "warning")])
    assert control or "control" in told[0].cause + told[0].remedy


def test_particles_that_are_all_but_copies_make_no_warning(tmp_path: Path) -> None:
    states = 1e-155 * np.array([[0.0, 0.0], [1.0, 0.9], [-1.0, -1.1]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with viz_estim.record(tmp_path / "a.rrd") as rec:
            for k in range(3):
                rec.stage("predict", states=states)
                rec.step(time=k, truth=[1.0, 1.0])
