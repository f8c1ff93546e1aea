"""Iterated closest points: did it settle, on enough matches, and on a fit that got better?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.distributions import binom, f
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import Finding, judge, level
from viz_estim.recording.tables import StageTable

_HALF = 0.5  # of the cloud's points: the breakdown point, beyond which no estimate tells which half is right


def _fits(case: Case) -> StageTable | None:
    return next((t for t in case.run.stages.values() if "rmse" in t.values and "converged" in t.values), None)


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
    count, N = len(matched.values["matches.distance"][-1]), _points(case)
    severity = judge(float(binom.cdf(count, N, _HALF)), 1, large=count < 0.5 * _HALF * N)
    if severity or count < 3:
        steps = int(matched.step[0]), int(matched.step[-1])
        yield Finding(
            "icp_few_matches", severity or "error", None, steps, {"matches": count, "points": N},
            f"only {count} of {N} points have a match at the end: the clouds hardly overlap, or max_distance is too "
            "small for the way that was to go",
            "raise max_distance (start with the distance that the clouds are apart), or start nearer",
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
    ratio, dof = np.square(rmse[1:] / np.maximum(rmse[:-1], 1e-300)), _dimensions(case) * count[1:]
    by_chance = f.isf(level("warning", len(ratio)), np.maximum(dof, 1), np.maximum(dof, 1))
    rises = np.flatnonzero((ratio > by_chance) & (count[1:] <= count[:-1])) + 1
    if len(rises):
        yield Finding(
            "icp_rmse_rises", "warning", None, (int(fits.step[rises[0]]), int(fits.step[rises[-1]])),
            {"times": len(rises)},
            "the matches' RMSE rises while they become no more: the pairs get worse, the fit walks away",
            "start nearer, or lower max_distance once the clouds have come close",
        )  # fmt: skip
