"""Is one reading taken in as two?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.distributions import binom
from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.finding import FEWEST, Finding, judge
from viz_estim.diagnosis.sensors import continuous, given, held
from viz_estim.recording.layout import as_product
from viz_estim.recording.reader import Run

_HELD = "a reading is held and given again until the next one comes"


def used_twice(run: Run) -> Iterator[Finding]:
    """One reading taken in twice: by two updates of a step, or held and given again at the next tick.

    Equal neighbours may be chance where readings are counts. Then a reading is equal to the one before it as often as
    to the one before that alone: of A and B such pairs A is binomial with 1/(2 − q), q the share of the first.
    """
    seen: dict[tuple[str, int], list[Array]] = {}
    twice: dict[str, set[int]] = {}
    for table in run.stages.values():
        if "innovation.z" in table.values:
            space = as_product(table.spaces["innovation"])
            for i, name in enumerate(space.parts):
                offered = table.values["innovation.offered"][:, i] > 0
                z = table.values["innovation.z"][:, space.at[name]]
                for row in np.flatnonzero(offered):
                    known = seen.setdefault((name, int(table.step[row])), [])
                    if any(np.array_equal(z[row], other) for other in known):
                        twice.setdefault(name, set()).add(int(table.step[row]))
                    known.append(z[row])
    for name, steps in twice.items():
        yield _twice(name, (min(steps), max(steps)), len(steps), "at one step two updates take in the same reading")
    readings = given(run)
    for name, (rows, values) in readings.items():
        if name in twice or not continuous(values):
            continue
        same = (np.diff(values, axis=0) == 0).all(1)
        short = same.copy()
        for first, last in held(same, len(readings)):  # stuck
            short[first : last + 1] = False
        again = int(((values[2:] == values[:-2]).all(1) & ~same[1:]).sum())
        count, q = int(short.sum()), float(short.mean())
        if judge(float(binom.sf(count - 1, count + again, 1 / (2 - q))), len(readings), large=True) == "error":
            at = np.flatnonzero(short) + 1
            steps_held = int(run.step[rows[at[0]]]), int(run.step[rows[at[-1]]])
            doubled = float((np.diff(run.time)[np.maximum(rows[at] - 1, 0)] == 0).mean()) > 0.5
            how = "samples are in the log twice, with one stamp" if doubled else _HELD
            yield _twice(name, steps_held, len(at), how)


def one_for_two(run: Run) -> Iterator[Finding]:
    """Two components that are the same number at every tick: one reading is given as both, for no chance makes two
    readings as fine as a float equal."""
    whole = {name: values for name, values in run.inputs.items() if name.startswith("z.")}
    columns = [
        (name[2:] + (f" {i + 1}" if values.shape[1] > 1 else ""), values[:, i])
        for name, values in whole.items()
        for i in range(values.shape[1])
        if continuous(values[np.isfinite(values).all(1)][:, [i]])
    ]
    for k, (name, values) in enumerate(columns):
        for other, others in columns[:k]:
            both = np.flatnonzero(np.isfinite(values) & np.isfinite(others))
            if len(both) >= FEWEST and (values[both] == others[both]).all():
                yield Finding(
                    "used_twice", "error", name.partition("/")[0].partition(" ")[0],
                    (int(run.step[both[0]]), int(run.step[both[-1]])), {"times": len(both), "of": [other, name]},
                    f"the readings of {other} and {name} are the same number at all of {len(both)} ticks: one is "
                    "given as both",
                    f"check the columns or indices from which {other} and {name} are read",
                )  # fmt: skip


def _twice(name: str, steps: tuple[int, int], count: int, how: str) -> Finding:
    return Finding(
        "used_twice", "error", name, steps, {"times": count},
        f"{how}: {count} readings of {name} count double, so that the covariance is too small",
        f"take each reading of {name} in once: update only at ticks at which a new one came",
    )  # fmt: skip
