"""Filters and models that write into the arrays they are given: a recording holds what each stage said all the same."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from viz_estim.core.beliefs import Categorical, Gaussian
from viz_estim.core.kalman import KalmanFilter, linear_sensor
from viz_estim.core.measurement import Measurement
from viz_estim.core.particle import ParticleFilter, equal
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.core.stages import Innovation, Stage, Update
from viz_estim.core.unscented import AugmentedFilter, UnscentedFilter, scaled, symmetric

LINE = Product(line=Euclidean(["x"], "m"))
RULER = Product(ruler=Euclidean(["x"], "m"))
TICKS = [
    Tick(0.1 * k, 0.1 * (k > 0), measurements={"ruler": z})
    for k, z in enumerate(np.random.default_rng(1).random((40, 1)))
]


class Kalman:
    """The textbook's filter; in place as numpy's users write it, or with a new array for each result."""

    def __init__(self, in_place: bool) -> None:
        self.in_place = in_place

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        x, P, z = belief.mean, belief.cov, tick.measurements["ruler"]
        P = self.sum(P, 0.1 * tick.dt)
        yield Stage("predict", Gaussian(LINE, x, P))
        residual, S, R, one = z - x, P + 0.5, np.full((1, 1), 0.5), np.ones(1, bool)
        K = P / S
        said = Innovation(RULER, z, x.copy(), residual, S, R, P.copy(), one, one, np.zeros((1, 1)))
        x, P = self.sum(x, K @ residual), self.sum(P, -K @ P)
        yield Update("update", Gaussian(LINE, x, P), said, K)
        if self.in_place:  # what was yielded is still in these hands
            for array in (x, P, residual, S, K):
                array[...] = np.nan

    def sum(self, a: Array, b: Array | float) -> Array:
        if self.in_place:
            a += b
            return a
        return a + b


def flat(stage: Any) -> list[Array]:
    said = [getattr(stage.innovation, name) for name in ("residual", "cov")] if isinstance(stage, Update) else []
    return [stage.belief.mean, stage.belief.cov, *said]


def test_a_filter_that_works_in_place_is_recorded_as_one_that_does_not() -> None:
    kept = []
    for in_place in (True, False):
        scenario = Scenario(Kalman(in_place), {0: Gaussian(LINE, np.zeros(1), np.eye(1))}, TICKS)
        kept.append([stage for step in run(scenario) for stage in step.stages])
    assert len(kept[0]) == 1 + 2 * len(TICKS)
    for one, other in zip(*kept, strict=True):
        assert one.name == other.name
        assert all(np.array_equal(a, b) for a, b in zip(flat(one), flat(other), strict=True))


def test_what_was_worked_out_from_a_belief_is_worked_out_anew() -> None:
    class Moving:
        def step(self, belief: Any, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
            assert np.isfinite(belief.mean).all()  # kept by the belief from now on
            belief.states[...] += 1
            yield Stage("move", belief)

    steps = list(run(Scenario(Moving(), {0: equal(LINE, np.zeros((5, 1)))}, TICKS)))
    assert [step.stages[-1].belief.mean[0] for step in steps] == pytest.approx(np.arange(1, len(TICKS) + 1))


@dataclass(frozen=True, slots=True)
class Told(Stage):
    """A person's own record, which works something out as it is made."""

    z: Array
    norm: float = field(init=False)
    twice: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "norm", float(np.linalg.norm(self.z)))
        object.__setattr__(self, "twice", 2 * self.norm)


def test_what_a_record_works_out_as_it_is_made_stays() -> None:
    class Telling:
        def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
            yield Told("told", belief, tick.measurements["ruler"])

    for step in run(Scenario(Telling(), {0: Gaussian(LINE, np.zeros(1), np.eye(1))}, TICKS)):
        told: Any = step.stages[-1]
        assert (told.norm, told.twice) == (abs(told.z[0]), 2 * abs(told.z[0]))


def test_a_belief_of_labels_is_copied_too() -> None:
    class Surer:
        def step(self, belief: Categorical, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
            log_p = belief.log_probabilities
            log_p[0] += 1.0
            log_p -= np.log(np.exp(log_p).sum())
            yield Stage("sure", belief)

    steps = list(run(Scenario(Surer(), {0: Categorical(("a", "b"), np.log([0.5, 0.5]))}, TICKS)))
    odds = [np.diff(step.stages[-1].belief.log_probabilities)[0] for step in steps]
    assert odds == pytest.approx(-np.arange(1, len(TICKS) + 1))


def pushed(x: Array, *rest: Any) -> Array:
    x += 0.1
    return x


SENSOR = linear_sensor(Euclidean(["x"], "m"), np.eye(1), np.eye(1))
WRITING: dict[str, Callable[[], Any]] = {
    "Kalman's": lambda: KalmanFilter(pushed, lambda x, tick: np.eye(1), lambda x, tick: np.eye(1), {"ruler": SENSOR}),
    "unscented": lambda: UnscentedFilter(pushed, lambda tick: np.eye(1), Measurement({"ruler": SENSOR}), symmetric(1)),
    "augmented": lambda: AugmentedFilter(pushed, lambda tick: np.eye(1), {"ruler": SENSOR}, scaled),
    "particle": lambda: ParticleFilter(pushed, lambda x, tick: -np.square(x[..., 0])),
}


@pytest.mark.parametrize("name", WRITING)
def test_a_model_that_writes_into_what_it_is_shown_is_told_so(name: str) -> None:
    start = equal(LINE, np.zeros((7, 1))) if name == "particle" else Gaussian(LINE, np.zeros(1), np.eye(1))
    *_, last = run(Scenario(WRITING[name](), {0: start}, TICKS))
    assert last.index == 1
    assert last.error
    assert last.error.stage in ("predict", "after start", "first")
    assert "write x = x + d for x += d" in last.error.message


def test_particles_that_a_model_leaves_where_they_are_are_the_same() -> None:
    pf = ParticleFilter(lambda x, tick, rng: x, lambda x, tick: -np.square(x[..., 0]), threshold=0.01)
    for step in run(Scenario(pf, {0: equal(LINE, np.zeros((7, 1)))}, TICKS)):
        assert len({id(stage.belief.states) for stage in step.stages}) == 1
