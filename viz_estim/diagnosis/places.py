"""From which place does each distance come? Also where a bias and a scale of it are part of the state.

What `truth` holds readings to needs a truth of all that the model takes, and of a bias there is none. But a filter's
own pairs of state and expected distance tell its place (`recovered`), and from which place readings are is seen from
how they go up and down along the true way, whatever their bias and their scale.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.diagnosis.evidence import Case, tells_gain, tells_reading
from viz_estim.diagnosis.finding import FEWEST, GROSS, TINY, Finding, by_ratio, judge
from viz_estim.diagnosis.recovered import distance_place
from viz_estim.recording.layout import is_position


class Distances(NamedTuple):
    """A sensor's readings z (M,) at true positions (M, d), at these steps, and the place (d,) its model has."""

    name: str
    step: np.ndarray
    position: Array
    z: Array
    place: Array


def exchanged(case: Case) -> Iterator[Finding]:
    """Readings that follow the distance from another sensor's place, and not that from their own: z = a + c·d by least
    squares, of each place in turn. A likelihood ratio of two fits with as many numbers (Ville 1939), for as many pairs
    of places as there are; large is GROSS in the variance that is left."""
    those = list(_distances(case))
    pairs = len(those) * (len(those) - 1)
    for one in those:
        own = _left(one, one.place)
        others = [(_left(one, other.place), other.name) for other in those if other is not one]
        if not others:
            continue
        left, whose = min(others)
        p = by_ratio(0.5 * len(one.z) * float(np.log(own / max(left, TINY))))
        severity = judge(p, pairs, large=own > GROSS * left)
        if severity == "error":
            yield Finding(
                "units_or_axes", severity, one.name.partition("/")[0], (int(one.step[0]), int(one.step[-1])),
                {"map": f"{whose} for {one.name}", "p": p, "explained": 1 - left / own, "against": "truth"},
                f"the readings of {one.name} go up and down as the distance from the place of {whose} does (which "
                f"leaves {left / own:.1%} of the variance that its own place leaves)",
                f"check which reading is whose: those of {one.name} and {whose} are exchanged, or their places are",
            )  # fmt: skip
            return


def _left(one: Distances, place: Array) -> float:
    """Σ of the squares that z = a + c·d leaves; all of them where z falls as d grows."""
    d = np.linalg.norm(one.position - place, axis=1)
    about, z = d - d.mean(), one.z - one.z.mean()
    c = max(float(about @ z) / max(float(about @ about), TINY), 0.0)
    return float(np.square(z - c * about).sum())


def _distances(case: Case) -> Iterator[Distances]:
    run, space = case.run, case.space
    position = next((space.at[name] for name, part in space.parts.items() if is_position(part)), None)
    if run.labels or position is None or "mean" not in run.ends:
        return
    plain = [space.at[name] for name, part in space.parts.items() if isinstance(part, Euclidean)]
    beside = [k for at in plain for k in range(at.start, at.stop) if not position.start <= k < position.stop]
    for table in run.stages.values():
        if not tells_gain(table) or not tells_reading(table.values["innovation.predicted"]):
            continue
        kind = table.spaces["innovation"]
        assert isinstance(kind, Product)
        mean, _ = case.sequence.before(table)
        true = run.truth[np.searchsorted(run.step, table.step)][:, position]
        for i, (name, part) in enumerate(kind.parts.items()):
            if list(part.axis_units) != ["m"]:
                continue
            z, predicted = (table.values[f"innovation.{key}"][:, kind.at[name]][:, 0] for key in ("z", "predicted"))
            rows = (table.values["innovation.offered"][:, i] > 0) & (table.step >= case.first)
            rows &= np.isfinite(true).all(1) & np.isfinite(z) & np.isfinite(predicted) & np.isfinite(mean).all(1)
            if rows.sum() < FEWEST:
                continue
            std = float(
                np.sqrt(
                    np.median(
                        table.values["innovation.noise"][rows, kind.axes_at[name].start][:, kind.axes_at[name].start]
                    )
                )
            )
            place = distance_place(mean[rows][:, position], mean[rows][:, beside], predicted[rows], std)
            if place is not None:
                yield Distances(name, table.step[rows], true[rows], z[rows], place)
