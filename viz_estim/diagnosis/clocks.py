"""Are the stamps in seconds? By the truth's own motion, whatever the filter does."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.spaces import Euclidean
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import FEWEST, SHEET, Finding, judge
from viz_estim.diagnosis.fits import slope
from viz_estim.diagnosis.naming import likeliest

_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9, "minutes": 1 / 60}


def clock(case: Case) -> Iterator[Finding]:
    """The truth's way against its own velocity times the stamps' differences: a slope, which is 1 where these are in
    seconds. By t-tests with a variance by 20 stretches of the run (Liang and Zeger 1986), of which only a slope whose
    unit has a name is told; a twentieth off is no alarm, for velocities of a truth are often differences themselves."""
    run, space = case.run, case.space
    dt = np.diff(run.time)
    for name, part in space.parts.items():
        for rate, other in space.parts.items():
            alike = isinstance(part, Euclidean) and isinstance(other, Euclidean) and part.axes == other.axes
            if not alike or set(part.axis_units) != {"m"} or set(other.axis_units) != {"m/s"} or rate == name:
                continue
            x, v = run.truth[:, space.at[name]], run.truth[:, space.at[rate]]
            way, foreseen = np.diff(x, axis=0), 0.5 * (v[1:] + v[:-1]) * dt[:, None]
            rows = np.isfinite(way).all(1) & np.isfinite(foreseen).all(1) & (dt > 0)
            if rows.sum() < FEWEST:
                continue
            forth, back = (slope(a[rows].ravel(), b[rows].ravel()) for a, b in ((way, foreseen), (foreseen, way)))
            units = likeliest(back.value, _UNITS, back.error)
            off = slope((way - foreseen)[rows].ravel(), foreseen[rows].ravel())
            severity = judge(off.p(SHEET), 1, large=True)
            if severity and units:
                yield Finding(
                    "stamps", severity, None, case.whole, {"kind": "unit", "factor": back.value, "slope": forth.value},
                    f"by its own velocity the truth would go {back.value:.3g}× as far between two stamps as it does: "
                    f"the stamps are in {units[0]} and are taken for seconds",
                    f"divide the stamps by {_UNITS[units[0]]:g} before anything takes their differences",
                )  # fmt: skip
                return
