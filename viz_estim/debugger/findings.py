"""What a diagnosis finds in a run while it goes on: looked for now and then, in all steps so far."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from viz_estim.core.run import Scenario, Step
from viz_estim.diagnose import diagnose
from viz_estim.diagnosis.finding import Finding
from viz_estim.recording.memory import collect
from viz_estim.recording.reader import Run

HOW = (
    "of a run that goes on, findings are looked for after 50 steps, after twice as many, and so on, and at its end; it "
    "stops at the step where one begins, once the evidence is in"
)
_FIRST, _GROWTH = 50, 2  # so that all looks together cost twice what the last does
_MOST = 1 << 30  # bytes of beliefs that are kept for it
_OF_THE_END = {"icp_not_converged"}  # what says how a run ended means nothing before


def of_run(run: Run) -> dict[int, list[str]]:
    """What is found in a whole run, by the step at which it begins."""
    return _by_step(diagnose(run))


class Findings:
    """The findings of a run's steps so far, by the step at which each begins.

    An error counts when it is seen first. Anything else counts once two looks in a row have it, or the run is over:
    each look is held to a rate of false alarms, and many looks are not one. Once it counts, a finding keeps its first
    step, though later looks may see it begin a little elsewhere.
    """

    def __init__(self, scenario: Scenario, params: dict[str, Any]) -> None:
        self._scenario, self._params = scenario, params
        self._steps: list[Step] = []
        self._bytes = 0
        self._looked = 0  # steps at the last look
        self._doubted: list[Finding] = []  # seen at the last look, for the first time
        self._known: list[tuple[int, Finding]] = []  # with the steps at the look that settled it
        self.begins: dict[int, list[str]] = {}  # what begins, by step
        self.given_up = ""  # why nobody looks any more

    def take(self, step: Step) -> None:
        """Keeps a step, the one after the last."""
        if self.given_up or step.index != len(self._steps):
            return
        self._steps.append(step)
        self._bytes += sum(
            getattr(stage.belief, name).nbytes for stage in step.stages for name in getattr(stage.belief, "shapes", {})
        )
        if self._bytes > _MOST:
            self.given_up = f"the beliefs of {len(self._steps)} steps take more than 1 GB"
            self._steps = []

    def due(self, *, over: bool = False) -> bool:
        """Whether there is enough new to look at."""
        count, left = len(self._steps), len(self._scenario.ticks) - len(self._steps)
        enough = count >= max(_FIRST, _GROWTH * self._looked) and left > count / 4  # else the end is near
        return not self.given_up and (enough or (over and count > self._looked))

    def look(self, missing: Callable[[int], Step], reached: int, *, over: bool) -> list[Finding]:
        """Diagnoses the steps up to `reached`, and tells what is new; missing(k): a step that was not taken."""
        for k in range(len(self._steps), reached + 1):
            self.take(missing(k))
        if self.given_up:
            return []
        self._looked = len(self._steps)
        try:
            found = diagnose(collect(self._scenario, self._steps, self._params))
        except Exception as error:  # of odd numbers; it must not cost the session
            self.given_up = f"the diagnosis raised {type(error).__name__}: {' '.join(str(error).split())}"
            return []
        if not over:
            found = [one for one in found if one.code not in _OF_THE_END]
        new = [one for one in found if not any(_alike(one, known) for _, known in self._known)]
        sure = [
            one
            for one in new
            if over or one.severity == "error" or any(_alike(one, before) for before in self._doubted)
        ]
        self._doubted = [one for one in new if one not in sure]
        self._learn([(self._looked, one) for one in sure])
        return sure

    def until(self, step: int, scenario: Scenario, params: dict[str, Any]) -> Findings:
        """Those of a run that shares the steps before `step`: what was known by then."""
        other = Findings(scenario, params)
        for one in self._steps[:step]:
            other.take(one)
        other._learn([(looked, one) for looked, one in self._known if looked <= step])
        other._looked = min(self._looked, step)
        other.given_up = other.given_up or self.given_up
        return other

    def _learn(self, sure: list[tuple[int, Finding]]) -> None:
        self._known += sure
        self.begins = _by_step([one for _, one in self._known])


def _by_step(findings: list[Finding]) -> dict[int, list[str]]:
    found: dict[int, list[str]] = {}
    for one in findings:
        text = f"{one.code}{f' of {one.sensor}' if one.sensor else ''}: {one.cause}"
        found.setdefault(one.steps[0], []).append(text)
    return found


def _alike(one: Finding, other: Finding) -> bool:
    """Whether two looks saw the same: code, sensor, and intervals that overlap."""
    same = (one.code, one.sensor) == (other.code, other.sensor)
    return same and one.steps[0] <= other.steps[1] and other.steps[0] <= one.steps[1]
