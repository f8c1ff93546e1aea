"""Particles: are there enough distinct ones, are they where the readings are, and is their mean somewhere they are?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.modes import modes
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import Finding

_FEW = 0.02  # of the particles: fewer distinct ancestors or effective particles, and the cloud is copies of a few
_PILED = 0.02  # the share of a cloud that holds one and the same number; chance gives none
_APART = 3.0  # standard deviations of the heaviest mode from the cloud's mean
_FAR = 1e-3  # how well the best particle explains a reading, against a cloud that was drawn around it


def collapsed(case: Case) -> Iterator[Finding]:
    """Effective sample size 1/Σw² (Kong, Liu and Wong 1994) and distinct ancestors, as shares of the particles."""
    run = case.run
    low: list[int] = []
    least, count = np.inf, 0
    for table in run.stages.values():
        for name in ("ess", "distinct"):
            if name in table.values and "states" in table.values and table.values[name].ndim == 1:
                count = count if count else table.values["states"].shape[1]
                rows = (table.values[name] < max(_FEW * _count(case), 1.5)) & (table.step >= case.first)
                low += table.step[rows].tolist()
                if rows.any():
                    least = min(least, float(table.values[name][rows].min()))
    steps = sorted(set(low))
    if not steps:
        return
    N = _count(case)
    lasting = len(steps) > 0.1 * len(run.step) or min(steps) > case.first + 3
    evidence = {"least": least, "particles": N, "steps": len(steps)}
    yield Finding(
        "particles_collapsed", "error" if lasting and len(steps) > 2 else "warning", None, (steps[0], steps[-1]),
        evidence,
        f"at {len(steps)} steps hardly any of the {N} particles are left (as few as {least:.0f}): the readings are far "
        "narrower than the cloud, or the cloud has no particle where they are",
        "take more particles, or widen the noises (of readings, so that neighbours count; of the motion, so that "
        "copies part)",
    )  # fmt: skip


def _count(case: Case) -> int:
    held = case.run.properties.get("particles", {}).get("count")
    if held:
        return int(held)
    return next((t.values["states"].shape[1] for t in case.run.stages.values() if "states" in t.values), 0)


def clamped(case: Case) -> Iterator[Finding]:
    """Particles that are held at a bound: many share one extreme number that are no copies of one another."""
    found: list[int] = []
    for table in case.run.stages.values():
        if not table.name.startswith("predict") or "states" not in table.values:
            continue
        for row, cloud in enumerate(table.values["states"]):
            if not np.isfinite(cloud).all():
                continue
            for x in cloud.T:
                for end in (x.min(), x.max()):
                    if end != x.mean() and (x == end).mean() > _PILED and (x == end).sum() > 3:
                        others = np.unique(cloud[x == end], axis=0)
                        if len(others) > 2:
                            found.append(int(table.step[row]))
    if found:
        yield Finding(
            "particles_clamped", "error", None, (min(found), max(found)), {"steps": len(set(found))},
            f"at {len(set(found))} steps many particles share the very same number at the edge of the cloud: they are "
            "held at a bound, where they pile up and pull the mean",
            "let particles leave the area, and let their likelihood deal with them; or draw those anew that leave",
        )  # fmt: skip


def several_modes(case: Case) -> Iterator[Finding]:
    """Clouds of at least 5 % of the weight each, between which the mean lies (`core.modes`)."""
    run = case.run
    apart: list[int] = []
    ends = [table for table in run.stages.values() if "states" in table.values]
    if not ends:
        return
    last: dict[int, tuple[int, int, int]] = {}
    for i, table in enumerate(ends):
        for row, (step, place) in enumerate(zip(table.step.tolist(), table.place.tolist(), strict=True)):
            if step not in last or place > last[step][0]:
                last[step] = place, i, row
    for step, (_, i, row) in last.items():
        states, weights = ends[i].values["states"][row], ends[i].values["log_weights"][row]
        if np.isfinite(states).all() and np.isfinite(weights).all() and len(modes(run.space, states, weights)) > 1:
            apart.append(step)
    if len(apart) > 2:
        share = len(apart) / len(run.step)
        at_end = max(apart) == int(run.step[-1])
        yield Finding(
            "several_modes", "warning" if at_end or share > 0.5 else "note", None, (min(apart), max(apart)),
            {"steps": len(apart), "share": share},
            f"at {len(apart)} steps the particles form several clouds: the mean lies between them, where nobody is",
            "report the heaviest mode instead of the mean until the readings have decided",
        )  # fmt: skip
