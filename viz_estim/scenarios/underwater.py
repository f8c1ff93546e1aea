"""An underwater robot before an unknown: a hazard, a strong current, or clear water; a sonar and a flow sensor warn.

At most one of the two events holds, so that they and `clear` are three labels of which exactly one is true. Each sensor
reads 0 or 1: it warns of its own event with its detection probability, of anything else with its false alarms.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from viz_estim.core.discrete import DiscreteFilter, categorical, redrawn
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick
from viz_estim.errors import BadInput
from viz_estim.scenarios import underwater_files
from viz_estim.scenarios.checks import at_most
from viz_estim.scenarios.underwater_files import LABELS, UnderwaterData

# The exercise's figures, from which the simulation draws: what each event has beforehand, and how often each sensor
# warns, by label.
_PRIOR = np.array([0.35, 0.15, 0.5])
_WARNS = {"sonar": np.array([0.9, 0.02, 0.02]), "flow": np.array([0.04, 0.45, 0.04])}
_SONAR_VARIANCE = 7.0
_SURE = 0.9


def underwater(
    source: list[Path] | None, rng: np.random.Generator, *, steps: int = 120, stay: float = 0.95
) -> UnderwaterData:
    """Readings from a CSV file, or `steps` simulated ones, a second apart, of a label that changes as `stay` says."""
    if source is not None:
        return underwater_files.load(underwater_files.find(source))
    _probabilities(stay=stay)
    if steps < 1:
        raise BadInput(f"steps must be at least 1, got {steps}")
    at_most(1e6, steps=steps)
    # The label is drawn at step 0 and wherever it does not stay, and holds until it is drawn anew.
    drawn = rng.choice(len(LABELS), steps, p=_PRIOR)
    anew = rng.random(steps) >= stay
    label = drawn[np.maximum.accumulate(np.where(anew, np.arange(steps), 0))]
    sonar, flow = ((rng.random(steps) < _WARNS[sensor][label]).astype(float) for sensor in ("sonar", "flow"))
    return UnderwaterData(np.arange(float(steps)), sonar, flow, label.astype(float))


def save(data: UnderwaterData, folder: Path) -> list[Path]:
    """Writes simulated data as `underwater.csv`."""
    return underwater_files.save(folder / "underwater.csv", data)


def underwater_bayes(
    data: UnderwaterData,
    *,
    hazard: float = 0.35,
    current: float = 0.15,
    sonar_detection: float = 0.9,
    sonar_false_alarm: float = 0.02,
    flow_detection: float = 0.45,
    flow_false_alarm: float = 0.04,
    stay: float = 0.95,
) -> Scenario:
    """Hazard, strong current or clear water: a Bayes filter over labels, with a sonar's and a flow sensor's warnings.

    hazard, current: their probabilities beforehand, the rest is `clear`. stay: with it the label stays from reading to
    reading, else it is drawn anew from those (1: it never changes).
    """
    _probabilities(
        hazard=hazard,
        current=current,
        sonar_detection=sonar_detection,
        sonar_false_alarm=sonar_false_alarm,
        flow_detection=flow_detection,
        flow_false_alarm=flow_false_alarm,
        stay=stay,
    )
    if hazard + current > 1:
        raise BadInput(
            f"hazard={hazard:g} and current={current:g} exclude each other, so that they sum to at most 1; lower one"
        )
    prior = np.array([hazard, current, max(0.0, 1 - hazard - current)])
    sonar = np.array([sonar_detection, sonar_false_alarm, sonar_false_alarm])
    flow = np.array([flow_false_alarm, flow_detection, flow_false_alarm])
    dt = np.diff(data.time, prepend=data.time[:1])
    readings = np.stack([data.sonar, data.flow], axis=1)[..., None]
    ticks = [
        Tick(float(time), float(dt[k]), measurements={"sonar": readings[k, 0], "flow": readings[k, 1]})
        for k, time in enumerate(data.time - data.time[0])
    ]
    known = figures(prior, sonar, flow)
    estimator = DiscreteFilter(redrawn(prior, stay), {"sonar": sonar, "flow": flow})
    return Scenario(
        estimator,
        {0: categorical(LABELS, prior)},
        ticks,
        data.truth[:, None],
        notes=_notes(known, sonar, flow),
        facts={name: value for name, value in known.items() if math.isfinite(value)},
    )


def figures(prior: Array, sonar: Array, flow: Array) -> dict[str, float]:
    """What can be worked out before any reading; NaN or infinity where there is no such number.

    prior (3,) by label; sonar, flow (3,) the probability of a warning, by label. With C the current, s and f the two
    warnings, d and a the flow sensor's detection and false alarms:

    - p_current_given_warning = P(C)·P(s or f | C) / (P(s) + P(f) − P(s)·P(f)), 0.1745295 (0.17452 as the course's
      solution cuts it off). Its denominator takes the warnings as independent, its numerator the events as
      disjoint. Both cannot be: the one label that is true moves both sensors.
    - p_current_given_warning_exact = P(C)·P(s or f | C) / Σⱼ P(j)·P(s or f | j), 0.1665663: the warnings are
      independent given the label alone, P(s or f | j) = 1 − (1 − P(s | j))·(1 − P(f | j)).
    - readings: the smallest n with 1 − (1 − d)ⁿ ≥ 0.9, so that n flow readings hold a detection; 4.
    - warnings_to_be_sure: the smallest n with P(C | n flow warnings and no other reading) ≥ 0.9, the posterior odds
      being P(C)/(1 − P(C))·(d/a)ⁿ; 2.
    - variance = readings·7: what a single flow reading may have for the mean of so many to be as good as the sonar's
      one reading, whose variance is 7 (the mean of n has a variance n times smaller); 28.
    """
    warns = 1 - (1 - sonar) * (1 - flow)
    p_sonar, p_flow, p_current = prior @ sonar, prior @ flow, prior[1]
    false_alarm, detection = flow[:2]
    with np.errstate(divide="ignore", invalid="ignore"):
        readings = _times(-np.log(1 - _SURE), -np.log(1 - detection))
        needed = np.log(_SURE / (1 - _SURE)) - np.log(p_current / (1 - p_current))
        found = {
            "p_current_given_warning": p_current * warns[1] / (p_sonar + p_flow - p_sonar * p_flow),
            "p_current_given_warning_exact": p_current * warns[1] / (prior @ warns),
            "readings": readings,
            "warnings_to_be_sure": _times(needed, np.log(detection / false_alarm)),
            "variance": readings * _SONAR_VARIANCE,
        }
    return {name: float(value) for name, value in found.items()}


def _times(target: float, step: float) -> float:
    """The smallest whole number of steps that reaches the target; infinity where none does."""
    if target <= 0:
        return 0.0
    # Rounding must not ask for one more where the target is met exactly.
    n = target / step if step > 0 else math.inf
    return max(1.0, math.ceil(n - 1e-9)) if n < math.inf else math.inf


def _notes(known: dict[str, float], sonar: Array, flow: Array) -> str:
    with np.errstate(divide="ignore", invalid="ignore"):
        sonar_says, flow_says, flow_silent = sonar[0] / sonar[1], flow[1] / flow[0], (1 - flow[1]) / (1 - flow[0])
    text = (
        "The three labels exclude each other: a reading that lifts one lowers the others. Step through **update** and "
        f"read its log-likelihoods: a warning of the sonar multiplies the odds of *hazard* by {sonar_says:.3g}, one of "
        f"the flow sensor those of *current* by {flow_says:.3g}, and its silence by {flow_silent:.2g}, which is little "
        "news. So a current is found late and lost slowly. **predict** lets the bars sink back towards the priors, "
        "since the label may have changed.\n\n"
    )
    if not all(math.isfinite(value) for value in known.values()):
        return text
    return text + (
        f"**Before any reading:** P(current | a warning) is {known['p_current_given_warning_exact']:.5f}. The course "
        f"gets {known['p_current_given_warning']:.5f} by taking the two warnings as independent; but events that "
        "exclude each other move both sensors. "
        f"{known['readings']:.0f} flow readings hold a detection with {_SURE:g}; to be that sure of a current takes "
        f"{known['warnings_to_be_sure']:.0f} warnings. The mean of {known['readings']:.0f} flow readings is as good as "
        f"the sonar's one of variance {_SONAR_VARIANCE:g} if a single one's variance is at most "
        f"{known['variance']:.0f}."
    )


def _probabilities(**values: float) -> None:
    for name, value in values.items():
        if not 0 <= value <= 1:
            raise BadInput(f"{name} is a probability between 0 and 1, got {value:g}")
