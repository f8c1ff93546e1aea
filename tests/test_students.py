"""Filters as their authors write and record them: a sound one is left alone, and nothing is claimed of what is not told."""

from pathlib import Path

import numpy as np
import pytest

import viz_estim
from viz_estim.core.quaternions import Array
from viz_estim.diagnose import diagnose
from viz_estim.diagnosis.finding import Finding


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
