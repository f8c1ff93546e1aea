"""An update against its own numbers: each line of it that a filter has wrong is named, and sound filters' hold."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.core.stages import Stage, Update
from viz_estim.diagnose import diagnose
from viz_estim.diagnosis import evidence, updates
from viz_estim.diagnosis.finding import Finding
from viz_estim.recording.memory import collect
from viz_estim.scenarios import diffdrive, imu, landmarks, plaza, quadrotor

Change = Callable[[Gaussian, Update], Update]
DEGREES = np.diag([3.0, 0.5])


class Changed:
    """A filter whose updates are made otherwise, and carried on so."""

    def __init__(self, filter: Any, change: Change) -> None:
        self.filter, self.change = filter, change

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        for part in (replace(tick, measurements={}), replace(tick, dt=0.0)):
            for stage in self.filter.step(belief, part, rng):
                made = self.change(belief, stage) if isinstance(stage, Update) else stage
                yield made
                belief = made.belief


def redone(before: Gaussian, stage: Update, **numbers: Array) -> Update:
    """The update with another S, K, residual or covariance, and all that follows from it."""
    innovation, C = stage.innovation, stage.innovation.cross_cov
    S = numbers.get("S", innovation.cov)
    K = numbers.get("K", C @ np.linalg.inv(S))
    residual = numbers.get("residual", innovation.residual)
    cov = numbers.get("cov", before.cov - K @ C.T)
    belief = Gaussian(before.space, before.space.plus(before.mean, numbers.get("moved", K @ residual)), cov)
    return replace(stage, belief=belief, gain=K, innovation=replace(innovation, cov=S, residual=residual))


def again(before: Gaussian, stage: Update) -> Update:
    """The update with the reading's information added twice."""
    innovation = stage.innovation
    informs = np.linalg.solve(before.cov, innovation.cross_cov) @ np.linalg.inv(innovation.noise)  # Hᵀ·R⁻¹
    H = np.linalg.solve(before.cov, innovation.cross_cov).T
    cov = np.linalg.inv(np.linalg.inv(before.cov) + 2 * informs @ H)
    return redone(before, stage, cov=cov, moved=2 * cov @ informs @ innovation.residual)


WRONG: dict[str, tuple[str, Change]] = {
    "ẑ − z": ("residual", lambda b, u: redone(b, u, residual=-u.innovation.residual)),
    "noise R of the reading is missing": ("S", lambda b, u: redone(b, u, S=u.innovation.cov - u.innovation.noise)),
    "S is smaller": ("S", lambda b, u: redone(b, u, S=u.innovation.cov - 0.9 * u.innovation.noise)),
    "S is larger": ("S", lambda b, u: redone(b, u, S=u.innovation.cov + 3 * u.innovation.noise)),
    "gain is not": ("gain", lambda b, u: redone(b, u, K=u.gain @ DEGREES)),
    "−K·ν": ("mean", lambda b, u: redone(b, u, moved=-u.gain @ u.innovation.residual)),
    "stays as it was": ("mean", lambda b, u: redone(b, u, moved=0 * b.cov[0])),
    "2× as far": ("mean", lambda b, u: redone(b, u, moved=2 * u.gain @ u.innovation.residual)),
    "is the one before it": ("covariance", lambda b, u: redone(b, u, cov=b.cov)),
    "(I + K·H)": ("covariance", lambda b, u: redone(b, u, cov=b.cov + u.gain @ u.innovation.cross_cov.T)),
    "taken in twice": ("twice", again),
    "process noise Q": ("covariance", lambda b, u: redone(b, u, cov=u.belief.cov + np.diag([0.1, 0.1, 0, 0]))),
}  # fmt: skip


def told(scenario: Scenario) -> list[Finding]:
    return list(updates.updates(evidence.case(collect(scenario, run(scenario)))))


@pytest.mark.parametrize("words", WRONG)
def test_the_line_that_does_not_hold_is_named(words: str) -> None:
    line, change = WRONG[words]
    healthy = landmarks.landmarks_ekf(landmarks.landmarks(None, np.random.default_rng(0), duration=8.0))
    (finding,) = told(replace(healthy, estimator=Changed(healthy.estimator, change)))
    assert finding.evidence["line"] == line
    assert words in finding.cause + finding.remedy


def test_a_wrong_update_is_the_first_finding() -> None:
    healthy = diffdrive.diffdrive_ekf(diffdrive.diffdrive(None, np.random.default_rng(0), duration=10.0))
    change: Change = lambda b, u: redone(b, u, S=u.innovation.cov - u.innovation.noise + 1e-9 * np.eye(2))  # noqa: E731
    wrong = replace(healthy, estimator=Changed(healthy.estimator, change))
    first = diagnose(collect(wrong, run(wrong)))[0]
    assert (first.code, first.sensor, first.severity) == ("update", "gps", "error")


@pytest.mark.parametrize("scenario", [
    landmarks.landmarks_ekf(landmarks.landmarks(None, np.random.default_rng(1), duration=20.0), gate=0.9),
    diffdrive.diffdrive_ekf(diffdrive.diffdrive(None, np.random.default_rng(1), duration=10.0)),
    plaza.range_ekf(plaza.plaza(None, np.random.default_rng(1), duration=30.0)),
    quadrotor.quadrotor_ukf_pose(quadrotor.quadrotor(None, np.random.default_rng(1), duration=1.0)),
    imu.imu_ukf(imu.imu(None, np.random.default_rng(1), duration=2.6, still=0.6, freeze=0.0)),
    imu.imu_ukf_gyro(imu.imu(None, np.random.default_rng(1), duration=2.6, still=0.6, freeze=0.0)),
])  # fmt: skip
def test_sound_updates_hold(scenario: Scenario) -> None:
    assert told(scenario) == []
