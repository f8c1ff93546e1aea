"""Do particles' weights follow from what they are made of, and copies from the weights?

Bayes' rule is exact: log w⁺ = log w + log p(z | x) but for a constant (Gordon, Salmond and Smith 1993). And whoever
draws N copies by the weights takes one of a set of particles with the chance N·Σw at most, by any scheme that is
unbiased (Markov's inequality): copies of particles that hardly weigh anything are drawn by other weights.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import REPEATED, Finding, at_steps, level
from viz_estim.diagnosis.rounding import of_logs


def forgotten(case: Case) -> Iterator[Finding]:
    """Weights that are the last likelihoods alone, though the particles had unequal ones before."""
    for table in case.run.stages.values():
        if not {"log_likelihoods", "log_weights"} <= table.values.keys():
            continue
        steps: list[int] = []
        holds = False
        for row, after in enumerate(table.values["log_weights"]):
            before, told = case.sequence.past(table, row, "log_weights"), table.values["log_likelihoods"][row]
            if before is None or before.shape != after.shape:
                continue
            size = of_logs(before, after, told)
            if not _spread(before) > 2 * size:  # else it is the same with them and without
                continue
            holds |= _spread(after - told - before) < size
            if _spread(after - told) < size:
                steps.append(int(table.step[row]))
        if len(steps) >= REPEATED and not holds:
            yield Finding(
                "weights", "error", None, (steps[0], steps[-1]), {"kind": "forgotten", "times": len(steps)},
                f"{at_steps(len(steps))} the weights are the last readings' likelihoods alone: those from before are "
                "forgotten, though no resampling has drawn by them",
                "multiply the weights by the likelihoods, w = w·p(z | x), and set them to 1/N after a resampling alone",
            )  # fmt: skip


def drawn(case: Case) -> Iterator[Finding]:
    """Copies of particles that hardly weigh anything."""
    for table in case.run.stages.values():
        if "ancestors" not in table.values:
            continue
        steps: list[int] = []
        rarest = 1.0
        for row, of in enumerate(table.values["ancestors"]):
            before = case.sequence.past(table, row, "log_weights")
            if before is None or len(before) != len(of) or not np.isfinite(of).all():
                continue
            w = np.exp(before - before.max())
            ordered = np.sort(w)
            light = np.searchsorted(np.cumsum(ordered) / ordered.sum(), level("error", len(table.step)) / len(w))
            copied = w[of.astype(int) % len(w)] < (ordered[light] if light < len(w) else 0.0)
            if copied.any():
                steps.append(int(table.step[row]))
                rarest = min(rarest, float(1 - copied.mean()))
        if len(steps) >= REPEATED:
            yield Finding(
                "weights", "error", None, (steps[0], steps[-1]), {"kind": "drawn", "times": len(steps)},
                f"{at_steps(len(steps))} the resampling copies particles that hardly weigh anything (up to "
                f"{1 - rarest:.0%} of the copies): it does not draw by the weights",
                "draw ancestors by the weights, as `searchsorted(cumsum(w), (arange(N) + u)/N)`, by those after the "
                "update",
            )  # fmt: skip


def _spread(logs: Array) -> float:
    held = logs[np.isfinite(logs)]
    return float(np.ptp(held)) if len(held) > 1 else 0.0
