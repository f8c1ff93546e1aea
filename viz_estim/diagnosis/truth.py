"""Sensors against the truth, where it is known: what is wrong with them, whatever the gains are.

A reading is off the truth's own by r, which is N(0, R) and white if the sensor is what the filter takes it for
(`against`). By how much the truth's own may be off is told: what is not larger than that is no finding.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from viz_estim.diagnosis import causes, frames
from viz_estim.diagnosis.against import against
from viz_estim.diagnosis.causes import Cause
from viz_estim.diagnosis.evidence import Case, parameter
from viz_estim.diagnosis.finding import EXPLAINED, GROSS, SHEET, Finding, Severity, judge
from viz_estim.diagnosis.fits import Against


def sensors(case: Case) -> Iterator[Finding]:
    """Of each sensor the one cause that explains its readings' misfit to the truth best.

    Each is fitted to r by least squares in R; of those that are significant the one with the largest gain in
    log-likelihood less ½·k·log M is told (Schwarz 1978), summed over the sensor's targets and parts, which one delay or
    one exchange concerns alike. p is of the t-test of the worst coefficient with a variance by 20 stretches of the run
    (Liang and Zeger 1986), so that truth and noise may be coloured. Large is a bias or a factor that doubles the
    squared error with which the filter foresees the reading, and a lag beyond half of a step.

    Which causes are named is a matter of size and not of chance, of which with enough readings none is left: a cause
    must be larger than the model's own error, by GROSS (that of any mean or slope is its root mean square at
    most, by Cauchy and Schwarz), must explain EXPLAINED of what is off beyond the noise, and must make the
    squared error with which the filter foresees the reading larger by SHEET at least (`_small`).
    """
    those = against(case)
    tests = sum(len(one.space.axes) + 2 for one in those)
    interval = float(np.median(np.diff(case.run.time))) if len(case.run.time) > 1 else 0.0
    total: dict[tuple[str, str], float] = {}
    found: dict[tuple[str, str], list[tuple[float, Against, Cause, Severity]]] = {}
    for one in those:
        name, small = one.name.partition("/")[0], _small(one)
        slip = GROSS * float(np.sqrt(np.mean(np.square(one.slip))))
        for kind, cause in _causes(one, those, interval):
            severity, score = judge(cause.p, tests, large=cause.large), cause.score(len(one.step))
            total[name, kind] = total.get((name, kind), 0.0) + max(score, 0.0)
            if severity and cause.size > max(slip, small) and cause.explained > EXPLAINED:
                found.setdefault((name, kind), []).append((score, one, cause, severity))
    for name in dict.fromkeys(name for name, _ in found):
        likeliest = max((key for key in found if key[0] == name), key=lambda key: total[key])
        _, one, cause, severity = max(found[likeliest], key=lambda entry: entry[0])
        steps = int(one.step[0]), int(one.step[-1])
        evidence = cause.evidence | {"p": float(np.max(cause.p)), "explained": cause.explained, "against": "truth"}
        evidence |= {"by_control": True} if one.by_control else {}
        known = parameter(case.run, f"{name}_bias")
        estimated = f"set {known[0]}=estimate; or " if known and known[1] != "estimate" and not cause.known else ""
        yield Finding(cause.code, severity, name, steps, evidence, cause.cause, estimated + cause.remedy)


def _small(one: Against) -> float:
    """The size, in standard deviations of R, from which on an effect adds the share SHEET to the squared error with
    which the filter foresees the reading: what is smaller matters to no filter."""
    R = np.diagonal(one.noise, axis1=1, axis2=2)
    return float(np.sqrt(SHEET * np.mean(one.foreseen / R)))


def _causes(one: Against, those: list[Against], interval: float) -> Iterator[tuple[str, Cause]]:
    """Each with its kind. Of one kind the best counts: a rotation with an offset and one without are the same."""
    made = {
        "map": causes.mapped(one),
        "scale": causes.scaled(one),
        "bias": causes.bias(one),
        "lag": causes.lag(one, interval),
        "lever arm": causes.lever_arm(one),
        "turn": chain(frames.turned(one), frames.turned_attitudes(one)),
        "convention": frames.conventions(one),
        "place": frames.misplaced(one),
        "exchange": frames.exchanged(one, those),
    }
    for kind, tried in made.items():
        best = max(tried, key=lambda cause: cause.score(len(one.step)), default=None)
        if best is not None:
            yield kind, best
