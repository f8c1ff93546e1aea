"""Particles: are there enough distinct ones, are they where the readings are, and is their mean somewhere they are?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.distributions import binom, chi2
from viz_estim.core.modes import moments, several
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Space
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import FEWEST, GROSS, ODDS, REPEATED, Finding, at_steps, level
from viz_estim.recording.tables import StageTable

_LOOKED_AT = 100  # steps at most, at which modes are looked for: each has its share of the check's rate

_NEAR = 0.1  # the share of a normal cloud that lies about its mean, to be held against what does: it decides no rate


def collapsed(case: Case) -> Iterator[Finding]:
    """Effective sample size 1/Σw² (Kong, Liu and Wong 1994) and distinct ancestors.

    A cloud is a sample: with n independent particles its variance is χ²(n − 1)/(n − 1) of the true one, and too small
    by GROSS with a chance πₙ. That is no odd case, one in ODDS, with fewer than 17. An error where it is none of the
    run either: the mean of πₙ over all steps, so that a first reading, which may be far narrower than all that was
    possible, is no error.
    """
    run, N = case.run, _count(case)
    left = np.full(len(run.step), np.inf)
    for table in run.stages.values():
        for name in ("ess", "distinct"):
            if name in table.values and "states" in table.values and table.values[name].ndim == 1:
                np.fmin.at(left, np.searchsorted(run.step, table.step), table.values[name])
    step, left = run.step[run.step >= case.first], left[run.step >= case.first]
    dof = np.clip(left - 1, np.finfo(float).eps, 1 / np.finfo(float).eps)  # 0 of a single one, endless where not known
    chance = chi2.cdf(dof / GROSS, dof)
    few = (chance > 1 / ODDS) & (left < N / GROSS)
    if not few.any():
        return
    steps, least = step[few].tolist(), float(left[few].min())
    evidence = {"least": least, "particles": N, "steps": len(steps)}
    yield Finding(
        "particles_collapsed", "error" if chance.mean() > 1 / ODDS else "warning", None, (steps[0], steps[-1]),
        evidence,
        f"{at_steps(len(steps))} hardly any of the {N} particles are left (as few as {least:.0f}): the readings are "
        "far narrower than the cloud, or the cloud has no particle where they are",
        "take more particles, or widen the noises (of readings, so that neighbours count; of the motion, so that "
        "copies part)",
    )  # fmt: skip


def _count(case: Case) -> int:
    held = case.run.properties.get("particles", {}).get("count")
    if held:
        return int(held)
    return next((t.values["states"].shape[1] for t in case.run.stages.values() if "states" in t.values), 0)


def clamped(case: Case) -> Iterator[Finding]:
    """Particles that are held at a bound: a prediction gave several one extreme number that were at several places, and
    are no copies of one another.

    Of N draws of a continuous number two are equal with N²·ε at most (a birthday among 1/ε values), so that three that
    are is no chance. An error where the share that is held is beyond 1/√N: an edge lies a standard deviation σ or more
    from the mean, so that they pull it by more than a sample of N scatters it, σ/√N.
    """
    found: list[int] = []
    most, scatter = 0.0, 1 / max(_count(case), 1) ** 0.5
    for table in case.run.stages.values():
        if not table.name.startswith("predict") or "states" not in table.values:
            continue
        for row, cloud in enumerate(table.values["states"]):
            before = _before(case, table, row)
            if not np.isfinite(cloud).all() or before is None:
                continue
            for x, x_before in zip(cloud.T, before.T, strict=True):
                for end in (x.min(), x.max()):
                    held = x == end
                    if held.sum() < REPEATED or end == x.mean():
                        continue
                    if _different(cloud[held]) > 2 and _different(x_before[held]) > 2:
                        found.append(int(table.step[row]))
                        most = max(most, float(held.mean()))
    if found:
        yield Finding(
            "particles_clamped", "error" if most > scatter else "warning", None, (min(found), max(found)),
            {"steps": len(set(found)), "largest_share": most},
            f"{at_steps(len(set(found)))} many particles share the very same number at the edge of the cloud: they are "
            "held at a bound, where they pile up and pull the mean",
            "let particles leave the area, and let their likelihood deal with them; or draw those anew that leave",
        )  # fmt: skip


def _before(case: Case, table: StageTable, row: int) -> Array | None:
    """The states (N, n) before a stage; None where they were not kept."""
    states = case.sequence.past(table, row, "states")
    if states is None or states.shape != table.values["states"][row].shape or not np.isfinite(states).all():
        return None
    return states


def _different(values: Array) -> int:
    return len(np.unique(values, axis=0))


def several_modes(case: Case) -> Iterator[Finding]:
    """Clouds of at least 5 % of the weight each (`core.modes`), between which the mean lies.

    A note, which is no alarm; of 800 normal clouds of 200 and 1000 particles in 2 and 3 dimensions (200 of each, seeds
    0 to 199) none has two. A warning where the mean is where nobody is: of as many independent particles as the
    effective sample size says, a normal cloud has a tenth within χ²'s quantile of 0.1 about its mean; how few do is
    binomial.
    """
    run = case.run
    apart: list[int] = []
    empty: list[int] = []
    ends = [table for table in run.stages.values() if "states" in table.values]
    if not ends:
        return
    last: dict[int, tuple[int, int, int]] = {}
    for i, table in enumerate(ends):
        for row, (step, place) in enumerate(zip(table.step.tolist(), table.place.tolist(), strict=True)):
            if step not in last or place > last[step][0]:
                last[step] = place, i, row
    every = max(1, -(-len(last) // _LOOKED_AT))
    looked = [at for k, at in enumerate(last.items()) if k % every == 0]
    for step, (_, i, row) in looked:
        states, weights = ends[i].values["states"][row], ends[i].values["log_weights"][row]
        if np.isfinite(states).all() and np.isfinite(weights).all() and several(run.space, states, weights):
            apart.append(step)
            if _hollow(run.space, states, weights) < level("warning", len(looked)):
                empty.append(step)
    if len(apart) >= REPEATED:
        share = len(apart) / len(looked)
        lasting = len(empty) >= REPEATED and (max(empty) == looked[-1][0] or len(empty) > 0.5 * len(looked))
        yield Finding(
            "several_modes", "warning" if lasting else "note", None, (min(apart), max(apart)),
            {"steps": len(apart) * every, "share": share, "hollow": len(empty) * every},
            f"{at_steps(len(apart) * every)} the particles form several clouds"
            + (f", at {len(empty) * every} of them the mean lies between them, where nobody is" if empty else ""),
            "report the heaviest mode instead of the mean until the readings have decided",
        )  # fmt: skip


def _hollow(space: Space, states: Array, log_weights: Array) -> float:
    """The chance of so little weight about the mean of a normal cloud."""
    mean, cov = moments(space, states, log_weights)
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(cov), space.minus(states, mean).T)
    except np.linalg.LinAlgError:
        return 1.0
    weights = np.exp(log_weights)
    n = 1 / float(weights @ weights)
    inside = float(weights @ ((whitened**2).sum(0) < chi2.ppf(_NEAR, cov.shape[-1])))
    return float(binom.cdf(np.round(n * inside), np.round(n), _NEAR))


def far(case: Case) -> Iterator[Finding]:
    """Weights far off the data: the particle that a reading fits best explains it worse than its noise allows.

    With normal noise a likelihood is ℓ = ℓ₀ − ½·χ²(m) for the true state, m numbers read, and larger for the best
    particle of a cloud that is about it. ℓ₀ is the largest of the run: no less than the truth would be too strict.
    Large are misfits that alone double the mean of all, as of `innovations.outliers`.
    """
    run = case.run
    inputs = [name for name in run.inputs if name.startswith("z.")]
    for table in run.stages.values():
        if not {"log_likelihoods", "states"} <= table.values.keys() or not inputs:
            continue
        best = np.nan_to_num(table.values["log_likelihoods"], nan=-np.inf).max(axis=1)
        row = np.searchsorted(run.step, table.step)
        m = np.sum([np.isfinite(run.inputs[name][row]).sum(1) for name in inputs], axis=0)
        rows = np.isfinite(best) & (m > 0) & (table.step >= case.first)
        if rows.sum() < FEWEST:
            continue
        top = {count: float(best[rows & (m == count)].max()) for count in np.unique(m[rows])}
        missed = 2 * (np.array([top[count] for count in m[rows]]) - best[rows])
        p = chi2.sf(missed, m[rows])
        bad = p < level("error", int(rows.sum()))
        large = (missed - m[rows])[bad].sum() > (GROSS - 1) * m[rows].sum()
        if bad.any():
            of = table.step[rows][bad]
            yield Finding(
                "particles_far", "error" if large else "warning", None, (int(of[0]), int(of[-1])),
                {"steps": int(bad.sum()), "least_p": float(p.min())},
                f"{at_steps(int(bad.sum()))} no particle is where the readings are: even the best one explains "
                "them worse than their noise allows",
                "take more particles or a wider motion noise; then check the units and the order of the readings",
            )  # fmt: skip
