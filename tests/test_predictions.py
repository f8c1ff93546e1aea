"""A prediction against its own numbers: what its covariance is made of is named, and sound filters' hold."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.core.stages import LinearPredict, Stage
from viz_estim.diagnose import diagnose
from viz_estim.diagnosis import evidence, predictions
from viz_estim.diagnosis.finding import Finding
from viz_estim.recording.memory import collect
from viz_estim.scenarios import diffdrive, landmarks, plaza

Made = Callable[[Array, Array, Array, Array], Array]  # of F, P, Q and the covariance a stage before


class Changed:
    """A filter whose predictions leave another covariance, and is carried on so."""

    def __init__(self, filter: Any, made: Made) -> None:
        self.filter, self.made, self.past = filter, made, np.empty(0)

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        for part in (replace(tick, measurements={}), replace(tick, dt=0.0)):
            for stage in self.filter.step(belief, part, rng):
                made = stage
                if isinstance(stage, LinearPredict):
                    past = self.past if self.past.size else belief.cov
                    cov = self.made(stage.transition, belief.cov, stage.noise, past)
                    made = replace(stage, belief=Gaussian(belief.space, stage.belief.mean, 0.5 * (cov + cov.T)))
                    self.past = made.belief.cov
                yield made
                belief = made.belief


WRONG: dict[str, Made] = {
    "Fᵀ·P·F": lambda F, P, Q, past: F.T @ P @ F + Q,
    "is F·P·Fᵀ alone": lambda F, P, Q, past: F @ P @ F.T,
    "is P + Q": lambda F, P, Q, past: P + Q,
    "2× Q": lambda F, P, Q, past: F @ P @ F.T + 2 * Q,
    "the one before the update": lambda F, P, Q, past: F @ past @ F.T + Q,
    "3× what": lambda F, P, Q, past: 3 * (F @ P @ F.T + Q),
}


def healthy(duration: float = 8.0) -> Scenario:
    return landmarks.landmarks_ekf(landmarks.landmarks(None, np.random.default_rng(0), duration=duration))


def told(scenario: Scenario) -> list[Finding]:
    return list(predictions.predictions(evidence.case(collect(scenario, run(scenario)))))


@pytest.mark.parametrize("words", WRONG)
def test_what_the_covariance_is_made_of_is_named(words: str) -> None:
    scenario = replace(healthy(), estimator=Changed(healthy().estimator, WRONG[words]))
    (finding,) = told(scenario)
    assert words in finding.cause
    assert finding.severity == "error"


def test_a_transposed_jacobian_is_the_first_finding() -> None:
    scenario = replace(healthy(), estimator=Changed(healthy().estimator, WRONG["Fᵀ·P·F"]))
    first = diagnose(collect(scenario, run(scenario)))[0]
    assert (first.code, first.severity) == ("prediction", "error")


@pytest.mark.parametrize("made", [
    lambda F, P, Q, past: F @ P @ F.T + Q + 1e-9 * np.eye(len(P)),  # a jitter
    lambda F, P, Q, past: 1.02 * F @ P @ F.T + Q,  # a fading memory
    lambda F, P, Q, past: (F @ P @ F.T + Q).astype(np.float32).astype(float),
    lambda F, P, Q, past: F @ (P + Q) @ F.T,  # the noise before the motion
])  # fmt: skip
def test_what_a_filter_may_choose_is_no_finding(made: Made) -> None:
    assert told(replace(healthy(), estimator=Changed(healthy().estimator, made))) == []


@pytest.mark.parametrize("scenario", [
    healthy(),
    diffdrive.diffdrive_ekf(diffdrive.diffdrive(None, np.random.default_rng(1), duration=10.0)),
    plaza.range_ekf(plaza.plaza(None, np.random.default_rng(1), duration=30.0)),
])  # fmt: skip
def test_sound_predictions_hold(scenario: Scenario) -> None:
    assert told(scenario) == []
