"""Are a registration's clouds of one hand and in one order of axes? By how they lie at the truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy

from viz_estim.core.distributions import binom
from viz_estim.core.quaternions import Array
from viz_estim.core.registration import moved, to_pose
from viz_estim.diagnosis.axes import maps
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import FEWEST, GROSS, Finding, judge


def clouds(case: Case) -> tuple[Array, Array, float] | None:
    """The points of the moved cloud in its own frame (N, d) and of the fixed one (M, d), those of the scene, or else
    those that ever had a match; and the middle distance of the last pairs."""
    table = next(
        (t for t in case.run.stages.values() if "matches.source_index" in t.values and "mean" in t.values), None
    )
    if table is None:
        return None
    last = float(np.median(table.values["matches.distance"][-1]))
    if (whole := _of_the_scene(case)) is not None:
        return *whole, last
    X: dict[int, Array] = {}
    Y: dict[int, Array] = {}
    names = ("source", "target", "source_index", "target_index")
    for state, *row in zip(table.mean, *(table.values[f"matches.{name}"] for name in names), strict=True):
        source, target, i, j = row
        if len(i) and np.isfinite(state).all():
            R, t = to_pose(state)
            X.update(zip(i.astype(int).tolist(), (source - t) @ R, strict=True))
            Y.update(zip(j.astype(int).tolist(), target, strict=True))
    if min(len(X), len(Y)) < FEWEST:
        return None
    return np.array(list(X.values())), np.array(list(Y.values())), last


def _of_the_scene(case: Case) -> tuple[Array, Array] | None:
    """The one cloud (N, d) that moves and the one (M, d) that stands, whole; None where there are not just these."""
    d = 2 if len(case.space.axes) == 3 else 3
    found = sorted(case.run.clouds.values(), key=lambda cloud: not cloud[1])
    if [moves for _, moves in found] != [True, False] or min(len(points) for points, _ in found) < FEWEST:
        return None
    return found[0][0][:, :d], found[1][0][:, :d]


def mirrored(case: Case) -> Iterator[Finding]:
    """The map of the moved cloud's axes with which its points lie nearest to the fixed one at the true pose, in the
    middle: told where they lie as near as the last pairs do, within GROSS in the squares, so that it is a fit and no
    accident. By a sign test (Conover 1999, section 3.4): of the points that it brings nearer or away by GROSS in the
    squares each second one comes nearer, or fewer, if it is no better; for as many maps as are tried."""
    found = clouds(case)
    truth = case.run.truth[-1]
    if found is None or not np.isfinite(truth).all():
        return
    X, Y, last = found
    tree, d = scipy.spatial.cKDTree(Y), X.shape[1]
    own, _ = tree.query(moved(truth, X))
    tried = [(tree.query(moved(truth, X @ A.T))[0], title) for title, A in maps(d, "m") if title.startswith("axes")]
    best, what = min(tried, key=lambda one: float(np.median(one[0])))
    nearer, away = int((GROSS * best**2 < own**2).sum()), int((GROSS * own**2 < best**2).sum())
    p = float(binom.sf(nearer - 1, nearer + away, 0.5)) if np.median(best) ** 2 < GROSS * last**2 else 1.0
    if (severity := judge(p, len(tried), large=True)) != "error":
        return
    ratio = float(np.median(own) / np.median(best))
    hand = np.linalg.det(dict(maps(d, "m"))[what]) < 0
    how = "mirrored, which no pose undoes" if hand else "turned by right angles"
    yield Finding(
        "units_or_axes", severity, None, (int(case.run.step[0]), int(case.run.step[-1])),
        {"map": what, "ratio": ratio, "p": p, "against": "truth"},
        f"at the true pose the moved cloud lies on the fixed one with its axes as {what}, {ratio:.2g}× as near as "
        f"it is: one of the two is {how}",
        f"check order and signs of the cloud's columns (a scan that counts its angles clockwise is a mirror image): "
        f"the best map is `{what}`",
    )  # fmt: skip
