"""The loop: ticks in, steps out. A numerical failure is a step's data, not an exception."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, NamedTuple, Protocol

import numpy as np

from viz_estim.core.beliefs import Belief
from viz_estim.core.quaternions import Array
from viz_estim.core.scenery import Scenery
from viz_estim.core.stages import Stage, Start
from viz_estim.core.yielded import Yielded


class StandIn(NamedTuple):
    """What an estimator reads in place of a sensor that is known to be wrong: z (n,) with noise (m, m)."""

    z: Array
    noise: Array


@dataclass(frozen=True, slots=True)
class Tick:
    """All that an estimator may see of one moment; never the truth.

    time (s), dt (s) since the tick before (0: no prediction is due), control (c,), the sensors' readings by name and
    the raw numbers they came from; faults: what is known to be wrong with a sensor ("frozen"); stand_ins: what to
    read instead. Readings may carry leading batch axes.
    """

    time: float
    dt: float
    control: Array | None = None
    measurements: Mapping[str, Array] = field(default_factory=dict)
    raw: Mapping[str, Array] = field(default_factory=dict)
    faults: Mapping[str, str] = field(default_factory=dict)
    stand_ins: Mapping[str, StandIn] = field(default_factory=dict)


class Estimator(Protocol):
    """Turns a belief and a tick into the stages of a step; the belief is all that it carries on.

    One that says `pure = True` never writes into an array that it was given or has yielded. Of others, which may well
    say `x += K @ y`, each belief and stage is copied as it comes and goes.
    """

    def step(self, belief: Belief, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]: ...


class NotFinite(ArithmeticError):
    """A stage's belief holds NaN or infinity."""


@dataclass(frozen=True, slots=True)
class Failure:
    """What ended a run: at which step, in which stage, and the exception's text."""

    step: int
    stage: str
    message: str


FIRST = "first"  # for a stage: there was none yet


def failed_where(stage: str) -> str:
    """A failure's stage in words: in one, after one, or before the step's first."""
    if stage == FIRST:
        return "before its first stage"
    return stage if stage.startswith("after ") else f"in {stage}"


@dataclass(frozen=True, slots=True)
class Step:
    """What is recorded of one moment: the tick, the stages in order, the truth (n,) or None, the failure if any."""

    index: int
    tick: Tick
    stages: tuple[Stage, ...]
    truth: Array | None = None
    error: Failure | None = None


@dataclass(frozen=True)
class Scenario:
    """An estimator over data.

    beliefs: by step, the belief that is set there; step 0 must have one. The steps before the last one count in no
    metric. truth (T, n), or of labels their index (T, 1), NaN where it is absent; or None. scenery: what else stands in
    the scene, by name. notes: what to look at, as markdown. facts: figures known beforehand, printed among the metrics;
    names carry their units. until: the run ends after the first step of which it is true. figures: of a run that ended
    with this step, printed among the metrics too.
    """

    estimator: Estimator
    beliefs: Mapping[int, Belief]
    ticks: Sequence[Tick]
    truth: Array | None = None
    scenery: Mapping[str, Scenery] = field(default_factory=dict)
    notes: str = ""
    facts: Mapping[str, float] = field(default_factory=dict)
    until: Callable[[Step], bool] | None = None
    figures: Callable[[Step], dict[str, float]] | None = None

    @property
    def space(self) -> Any:
        """The space of the belief; None where it is over labels."""
        return getattr(self.beliefs[0], "space", None)


class Chance:
    """The generator of each step, Philox with the key (seed, step), so that a step can be done again alone."""

    def __init__(self, seed: int) -> None:
        self._bits = np.random.Philox(key=np.array([seed, 0], dtype=np.uint64))
        self._generator = np.random.Generator(self._bits)
        self._state = self._bits.state

    def at(self, step: int) -> np.random.Generator:
        """The step's generator, valid until the next call: resetting one is ten times as fast as making one."""
        self._state["state"]["key"][1] = step
        self._bits.state = self._state
        return self._generator


def run(scenario: Scenario, seed: int = 0, *, first: int = 0, belief: Belief | None = None) -> Iterator[Step]:
    """The scenario's steps, one a tick, or fewer: the last one carries a failure where the estimator raised one.

    first, belief: to begin with that step, given what was believed before it; the steps are then the whole run's.
    """
    chance = Chance(seed)
    pure = getattr(scenario.estimator, "pure", False)
    yielded = Yielded(scenario.beliefs[0], trusted=pure)
    for k in range(first, len(scenario.ticks)):
        tick = scenario.ticks[k]
        stages: list[Stage] = []
        error = None
        if k in scenario.beliefs:
            belief = scenario.beliefs[k]
            stages.append(Start("start", belief))
        assert belief is not None, "a scenario sets a belief at step 0"
        try:
            for made in scenario.estimator.step(belief if pure else _own(belief), tick, chance.at(k)):
                yielded.check(made, belief)
                stage = made if pure else _own(made)
                stages.append(stage)
                before, belief = belief, stage.belief
                for name in yielded.shapes:
                    values = getattr(belief, name)
                    if values is not getattr(before, name) and not _finite(values):  # else they were looked at
                        raise NotFinite("the belief is no longer finite")
        except Exception as failure:  # whatever a person's filter raises is what they came to see
            text = f"{type(failure).__name__}: {failure}"
            if "read-only" in text:
                text += "; what a model is given is recorded too: write x = x + d for x += d, or work on x.copy()"
            error = Failure(k, _failing_stage(stages, failure), text)
        truth = None if scenario.truth is None else scenario.truth[k]
        step = Step(k, tick, tuple(stages), truth, error)
        yield step
        if error or (scenario.until and scenario.until(step)):
            return


def _own(value: Any) -> Any:
    """A belief, a stage or what they hold, with arrays of its own; what it keeps for itself (a belief's moments, once
    they were asked for) is forgotten, for the arrays may have changed since."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    owned = copy.copy(value)
    for one in dataclasses.fields(value):
        forgotten = not one.init and one.name.startswith("_") and one.default is not dataclasses.MISSING
        object.__setattr__(owned, one.name, one.default if forgotten else _own(getattr(value, one.name)))
    return owned


def _finite(values: Array) -> bool:
    """Whether all values are."""
    # A finite sum has finite terms, and takes no memory to see; one that is not may have overflowed. Of many not by
    # BLAS, which then wakes a thread on each core that waits there in a busy loop.
    flat = values.ravel()
    total = flat.dot(flat) if flat.size <= 10_000 else np.add.reduce(flat)
    return isfinite(total) or bool(np.isfinite(flat).all())


def _failing_stage(stages: list[Stage], failure: Exception) -> str:
    """The stage that failed: by the name left on the exception, or the last one where its belief was refused."""
    last = stages[-1].name if stages else "start"
    if isinstance(failure, NotFinite):
        return last
    return str(getattr(failure, "stage", f"after {last}" if stages else FIRST))
