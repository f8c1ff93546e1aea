"""Particles that are copies of one another: do they part, and do their weights count once?

Both are exact: a copy that draws a noise of its own is the same again with the chance 0, and copies that are drawn by
their weights stand for these by their number (Gordon, Salmond and Smith 1993).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import REPEATED, Finding, at_steps
from viz_estim.diagnosis.rounding import of_logs


def together(case: Case) -> Iterator[Finding]:
    """Copies that the prediction leaves copies: it adds no noise to them, or one draw to all."""
    for table in case.run.stages.values():
        if not table.name.startswith("predict") or "states" not in table.values:
            continue
        steps: list[int] = []
        parted = False
        for row, cloud in enumerate(table.values["states"]):
            before = case.sequence.past(table, row, "states")
            if before is None or before.shape != cloud.shape or (cloud == before).all():
                continue
            order = np.lexsort(before.T)
            same = (before[order[1:]] == before[order[:-1]]).all(1)
            still = (cloud[order[1:]] == cloud[order[:-1]]).all(1)
            if same.any():
                parted = parted or not still[same].all()
                steps.append(int(table.step[row]))
        if len(steps) >= REPEATED and not parted:
            yield Finding(
                "particles_collapsed", "error", None, (steps[0], steps[-1]), {"steps": len(steps), "kind": "together"},
                "copies of a particle stay copies in the prediction: no noise is added to them, or one draw to all, so "
                "that each resampling leaves fewer different ones",
                "draw a noise for each particle: `rng.normal(size=(N, …))`, not once a step",
            )  # fmt: skip


def weighed_again(case: Case) -> Iterator[Finding]:
    """Weights that the copies keep after they were drawn by them."""
    for table in case.run.stages.values():
        if "ancestors" not in table.values or "log_weights" not in table.values:
            continue
        steps: list[int] = []
        ancestors = table.values["ancestors"]
        for row, after in enumerate(table.values["log_weights"]):
            before = case.sequence.past(table, row, "log_weights")
            if before is None or before.shape != after.shape or not np.ptp(after) > 0:
                continue
            of = np.asarray(ancestors[row]).astype(int)
            if of.shape != after.shape or of.max() >= len(before):
                continue  # a cloud that was thinned
            kept, drawn = before[of], (of != np.arange(len(of))).any()
            shift = kept - after
            if drawn and np.ptp(shift[np.isfinite(shift)]) < of_logs(kept, after):
                steps.append(int(table.step[row]))
        if len(steps) >= REPEATED:
            yield Finding(
                "used_twice", "error", None, (steps[0], steps[-1]), {"times": len(steps)},
                f"{at_steps(len(steps))} particles that were copied by their weights keep these weights: what was read "
                "counts twice, by how many copies there are and by what each weighs",
                "set all weights to 1/N after a resampling",
            )  # fmt: skip
