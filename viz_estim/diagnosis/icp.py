"""Iterated closest points: did it settle, on enough matches, on a fit that got better, and where the truth is?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.consistency import FIT
from viz_estim.core.distributions import binom, chi2, f
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import GROSS, REPEATED, TINY, Finding, judge, level
from viz_estim.recording.tables import StageTable

_HALF = 0.5  # of the cloud's points: the breakdown point, beyond which no estimate tells which half is right


def is_registration(case: Case) -> bool:
    """Whether a step of the run is an iteration towards one estimate, and not an estimate of its own."""
    return any("matches.distance" in t.values for t in case.run.stages.values()) or _fits(case) is not None


def _fits(case: Case) -> StageTable | None:
    return next((t for t in case.run.stages.values() if t.values.keys() >= FIT), None)


def settled(case: Case) -> Iterator[Finding]:
    """The error of the last fit, once it has settled; those on the way there are nobody's estimate.

    A fit's covariance takes its K pairs as independent, while neighbours share their errors (Censi 2007): over 32
    simulated scans its σ is 5 to 16 times too small. If all pairs had one error in common it were K times as large, and
    no larger: an error that even that can't explain is a place beside the truth, a local minimum. What lies between the
    two is a note, for no healthy registration is free of it.
    """
    fits, run = _fits(case), case.run
    if fits is None or not len(fits.step) or not fits.values["converged"].ravel()[-1]:
        return
    row, count = run.row(step=int(fits.step[-1])), float(fits.values["count"].ravel()[-1])
    error, P = case.space.minus(run.mean[row], run.truth[row]), run.cov[row]
    if not np.isfinite(error).all() or not np.isfinite(P).all() or np.linalg.eigvalsh(P)[0] <= 0:
        return
    dof = len(error)
    nees = float(error @ np.linalg.solve(P, error))
    step = int(fits.step[-1])
    evidence = {"nees": nees, "dof": dof, "matches": int(count)}
    apart = nees / max(count, 1.0)
    severity = judge(float(chi2.sf(apart, dof)), 1, large=float(chi2.sf(apart / GROSS, dof)))
    if severity:
        yield Finding(
            "diverged", severity, None, (step, step), evidence,
            "the registration has settled, but beside the truth, further than the spread of its pairs explains: a "
            "local minimum, where wrong pairs hold each other",
            "start nearer to the truth, or with a larger max_distance; look which of the last matches are wrong",
        )  # fmt: skip
    elif judge(float(chi2.sf(nees, dof)), 1, large=False):
        yield Finding(
            "overconfident", "note", None, (step, step), evidence | {"factor_on_sigma": (nees / dof) ** 0.5},
            f"the settled pose is {(nees / dof) ** 0.5:.2g}× as far off as its covariance says, which takes each pair "
            "of points as right and its error as its own, while neighbours share them (Censi 2007)",
            "do not weigh by this covariance; take the spread of registrations from several starts, or a fixed one",
        )  # fmt: skip


def not_converged(case: Case) -> Iterator[Finding]:
    """At the last iteration the matches had not repeated: the next one would move the pose on."""
    fits = _fits(case)
    if fits is None or not len(fits.step) or fits.values["converged"].ravel()[-1]:
        return
    rmse = fits.values["rmse"].ravel()
    evidence = {"iterations": len(rmse), "rmse": float(rmse[-1])}
    yield Finding(
        "icp_not_converged", "error", None, (int(fits.step[0]), int(fits.step[-1])), evidence,
        f"after {len(rmse)} iterations the matches still change: the registration was stopped before it settled",
        "set iterations=0 (until the matches repeat), or a larger number",
    )  # fmt: skip


def few_matches(case: Case) -> Iterator[Finding]:
    """Fewer than half of the moved cloud's points have a match at the end, by more than a draw of them scatters.

    Half is the breakdown point of any fit that leaves the worst out (Rousseeuw 1984; of ICP, Chetverikov et al. 2002);
    the number of matches among N points that overlap by half is binomial.
    """
    matched = next((t for t in case.run.stages.values() if "matches.distance" in t.values), None)
    if matched is None or not len(matched.step):
        return
    fits, N, count = _fits(case), _points(case), len(matched.values["matches.distance"][-1])
    # The fit's own count is kept where the matches are thinned; one that failed has none.
    if fits is not None and len(fits.step) and "count" in fits.values and case.run.error is None:
        count = int(fits.values["count"].ravel()[-1])
    severity = judge(float(binom.cdf(count, N, _HALF)), 1, large=count < _HALF / GROSS * N)
    if severity or count < REPEATED:
        steps = int(matched.step[0]), int(matched.step[-1])
        yield Finding(
            "icp_few_matches", severity or "error", None, steps, {"matches": count, "points": N},
            f"{f'only {count} of {N} points have' if count else 'no point has'} a match at the end: the clouds hardly "
            "overlap, are in another unit, or max_distance is too small for the way that was to go",
            "check that both clouds are in metres; raise max_distance (start with the distance that they are apart), "
            "or start nearer",
        )  # fmt: skip


def _points(case: Case) -> int:
    """About the points of the moved cloud: the largest row that was ever matched."""
    rows = [index for table in case.run.stages.values() for index in table.values.get("matches.source_index", [])]
    return max((int(index.max()) + 1 for index in rows if len(index)), default=0)


def _dimensions(case: Case) -> int:
    """Of the clouds."""
    rows = [points for table in case.run.stages.values() for points in table.values.get("matches.source", [])]
    return next((int(points.shape[1]) for points in rows if len(points)), 2)


def rising(case: Case) -> Iterator[Finding]:
    """RMSE that rises while the matches become no more: each fit is the best to its matches, so the pairs got worse.

    By how much a draw of other points would let it: a ratio of two variances of d·K numbers each is F(d·K, d·K).
    """
    fits = _fits(case)
    if fits is None or len(fits.step) < 3:
        return
    rmse, count = fits.values["rmse"].ravel(), fits.values["count"].ravel()
    ratio, dof = np.square(rmse[1:] / np.maximum(rmse[:-1], TINY)), _dimensions(case) * count[1:]
    by_chance = f.isf(level("warning", len(ratio)), np.maximum(dof, 1), np.maximum(dof, 1))
    rises = np.flatnonzero((ratio > by_chance) & (count[1:] <= count[:-1])) + 1
    if len(rises):
        yield Finding(
            "icp_rmse_rises", "warning", None, (int(fits.step[rises[0]]), int(fits.step[rises[-1]])),
            {"times": len(rises)},
            "the matches' RMSE rises while they become no more: the pairs get worse, the fit walks away",
            "start nearer, or lower max_distance once the clouds have come close",
        )  # fmt: skip
