"""A filter that runs only as far as it is asked, and goes back without a bit changed."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from viz_estim.core.beliefs import Belief
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Failure, Scenario, Step, run
from viz_estim.debugger.findings import Findings
from viz_estim.debugger.live_frames import frame_of
from viz_estim.debugger.quantities import Frame
from viz_estim.debugger.sources import NoSuchPlace, step_at


class Beliefs:
    """What was believed before each step: all of them, or where that takes more than `most` bytes every second, every
    fourth, …, and the last."""

    def __init__(self, most: int = 1 << 30) -> None:
        self._most, self._stride, self._bytes = most, 1, 0
        self._kept: dict[int, Belief] = {0: None}

    def put(self, step: int, belief: Belief) -> None:
        """Keeps the next step's."""
        if (step - 1) % self._stride:
            self._kept.pop(step - 1, None)
        self._kept[step] = belief
        self._bytes += sum(getattr(belief, name).nbytes for name in getattr(belief, "shapes", {})) // self._stride
        if self._bytes > self._most:
            self._stride, self._bytes = 2 * self._stride, self._bytes // 2
            self._kept = {k: b for k, b in self._kept.items() if k % self._stride == 0 or k == step}

    def nearest(self, step: int) -> tuple[int, Belief]:
        """The last one kept at or before a step, and that step."""
        at = step if step in self._kept else step - step % self._stride
        return at, self._kept[at]

    def until(self, step: int) -> Beliefs:
        """Those up to a step."""
        found = Beliefs(self._most)
        found._stride, found._kept = self._stride, {k: b for k, b in self._kept.items() if k <= step}
        return found


class Live:
    """A scenario that runs as far as it is asked. Going back is exact: the belief before each step is kept, and chance
    is each step's own. fork: the same run up to a step, another scenario from there on.

    told: called with each new step, once. findings: what is found in its steps, where somebody looks. forgetful: False
    once a step that was done again came out different, as with an estimator that carries on more than its belief.
    """

    def __init__(self, scenario: Scenario, seed: int, told: Callable[[Step], None] | None = None) -> None:
        self.seed, self.told = seed, told
        self.forgetful = True
        self.failure: Failure | None = None
        self.findings: Findings | None = None
        self._segments = [(0, scenario)]
        self._beliefs = Beliefs()
        self._starts = [0]  # by step, its first place; one more than there are steps so far
        self._done: dict[int, Step] = {}  # the latest few, as they came
        self._shown: tuple[int, Step, Frame] | None = None  # the frame that was asked for last: it is asked for again
        self._ahead: Iterator[Step] | None = None
        self._over = False

    def fork(self, step: int, scenario: Scenario, told: Callable[[Step], None] | None = None) -> Live:
        """The run whose steps before `step` are these, and which is another scenario's from there on."""
        self.span(step)
        other = Live(self._segments[0][1], self.seed, told)
        other._segments = [one for one in self._segments if one[0] < step] + [(step, scenario)]
        other._beliefs, other._starts = self._beliefs.until(step), self._starts[: step + 1]
        return other

    @property
    def scenario(self) -> Scenario:
        """That of its last steps."""
        return self._segments[-1][1]

    @property
    def times(self) -> Array:
        return np.array([tick.time for tick in self.scenario.ticks])

    @property
    def reached(self) -> int:
        return len(self._starts) - 2

    def steps(self) -> Iterator[Step]:
        """All steps that are known so far, done again."""
        return (self.step(k) for k in range(self.reached + 1))

    def span(self, step: int) -> range:
        while not self._over and step > self.reached:
            self._advance()
        if not 0 <= step <= self.reached:
            raise NoSuchPlace(f"no step {step}: the run has steps 0 to {self.reached}")
        return range(self._starts[step], self._starts[step + 1])

    def step_at(self, time: float) -> int:
        return step_at(self.times, time)

    def step(self, k: int) -> Step:
        """A step as it came, or done again."""
        self.span(k)
        if k not in self._done:
            step = self._again(k, self.before(k))
            at, kept = self._beliefs.nearest(k + 1)
            if at == k + 1 and step.stages and not _equal(step.stages[-1].belief, kept):
                self.forgetful = False
            self._keep(k, step)
        return self._done[k]

    def before(self, step: int) -> Belief:
        """What was believed before a step; of the one after the last, what was believed at the end."""
        if step:
            self.span(step - 1)
        at, belief = self._beliefs.nearest(step)
        for k in range(at, step):
            belief = _end(self._again(k, belief), belief)
        return belief

    def _again(self, k: int, belief: Belief) -> Step:
        return next(run(self._at(k), self.seed, first=k, belief=belief))

    def frame(self, place: int) -> Frame:
        if place < 0 or not self._exists(place):
            raise NoSuchPlace(f"no stage {place}: the run has stages 0 to {self._starts[-1] - 1}")
        k = bisect_right(self._starts, place) - 1
        step = self.step(k)
        if self._shown is None or self._shown[0] != place or self._shown[1] is not step:
            i = place - self._starts[k]
            before = step.stages[i - 1].belief if i else self.before(k)
            self._shown = place, step, frame_of(step, i, before, place, self.scenario)
        frame = self._shown[2]
        if self.findings is None:
            return frame
        begins = k in self.findings.begins and place + 1 == self._starts[k + 1]
        return replace(frame, findings=np.array([begins]))

    def ahead(self, place: int) -> Iterator[list[Frame]]:
        while self._exists(place := place + 1):
            yield [self.frame(place)]
            if self.findings and place + 1 == self._starts[-1] and self.findings.due():
                yield from self._new_findings(over=False)
        if self.findings and self.findings.due(over=True):
            yield from self._new_findings(over=True)

    def look(self, findings: Findings) -> None:
        """Has findings looked for from here on, and in the steps so far."""
        self.findings = findings
        findings.look(self.step, self.reached, over=self._over)

    def _new_findings(self, *, over: bool) -> Iterator[list[Frame]]:
        """The stages at which findings begin that were not known; they may lie behind."""
        assert self.findings
        steps = {one.steps[0] for one in self.findings.look(self.step, self.reached, over=over)}
        if steps:
            yield [self.frame(self.span(k)[-1]) for k in sorted(steps)]

    def behind(self, place: int) -> Iterator[list[Frame]]:
        return ([self.frame(p)] for p in range(place - 1, -1, -1))

    def _exists(self, place: int) -> bool:
        while not self._over and place >= self._starts[-1]:
            self._advance()
        return place < self._starts[-1]

    def _at(self, k: int) -> Scenario:
        return next(scenario for first, scenario in reversed(self._segments) if first <= k)

    def _advance(self) -> None:
        """Runs the next step, or finds that there is none."""
        k = len(self._starts) - 1
        if self._ahead is None:
            self._ahead = run(self._at(k), self.seed, first=k, belief=self.before(k))
        try:
            step = next(self._ahead, None)
        except BaseException:  # an interrupt: the step is begun anew when it is asked for again
            self._ahead = None
            raise
        if step is None:
            self._over = True
            return
        self._keep(k, step)
        self._starts.append(self._starts[-1] + max(1, len(step.stages)))
        self._beliefs.put(k + 1, _end(step, self._beliefs.nearest(k)[1]))
        if self.findings:
            self.findings.take(step)
        self.failure, self._over = step.error, step.error is not None
        if self.told:
            self.told(step)

    def _keep(self, k: int, step: Step) -> None:
        self._done[k] = step
        if len(self._done) > 8:
            self._done.pop(next(iter(self._done)))


def _end(step: Step, before: Belief) -> Belief:
    """What is believed after a step."""
    return step.stages[-1].belief if step.stages else before


def _equal(one: Belief, other: Belief) -> bool:
    names = getattr(one, "shapes", {})
    return all(np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in names)
