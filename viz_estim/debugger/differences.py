"""Two branches side by side: their figures from the fork on, and the first thing in which they differ."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from viz_estim.debugger.branches import Branch
from viz_estim.debugger.live import Live
from viz_estim.debugger.recorded import Recorded, between
from viz_estim.debugger.sources import Source
from viz_estim.differences import first_difference
from viz_estim.recording.memory import collect
from viz_estim.recording.reader import Run


def side_by_side(one: Branch, other: Branch) -> str:
    """Figures of both over the steps that both have, from where they part, and the first difference."""
    if one.parent == other.number or other.parent == one.number:
        first = max(one.first, other.first)
    else:
        first = min(one.first, other.first)
    last = min(one.source.reached, other.source.reached)
    if first > last:
        return f"they part at step {first}, which branch {one.number} or {other.number} has not reached"
    runs = [_run(branch.source, first, last) for branch in (one, other)]
    figures = [_figures(run) for run in runs]
    width = max([24, *map(len, figures[0] | figures[1])])
    heads = f"{f'branch {one.number}':>12}  {f'branch {other.number}':>12}"
    lines = [f"steps {first} to {last}:{'':{max(1, width - 8 - len(str(first) + str(last)))}}{heads}"]
    for name in figures[0] | figures[1]:
        cells = [f"{figure[name]:12.5g}" if name in figure else f"{'':12}" for figure in figures]
        lines.append(f"  {name:{width}} {'  '.join(cells)}")
    return "\n".join([*lines, _difference(runs[0], runs[1], last)])


def _run(source: Source, first: int, last: int) -> Run:
    """Some steps of a branch, as arrays: those of a filter that runs are done again."""
    if isinstance(source, Live):
        found = collect(source.scenario, (source.step(k) for k in range(first, last + 1)))
    else:
        assert isinstance(source, Recorded)
        clouds = source.run.properties.get("particles")  # whose moments are known from the whole
        found = between(source.whole if clouds else source.run, first, last)
    return replace(found, properties=found.properties | {"facts": {}})


def _figures(run: Run) -> dict[str, float]:
    """A run's figures by name."""
    with np.errstate(all="ignore"):
        found: dict[str, Any] = run.summary()
    figures = dict(found["metrics"]) | {f"nis {name}": one["mean"] for name, one in found["nis"].items()}
    return figures | ({"nees": found["nees"]["mean"]} if found["nees"] else {})


def _difference(one: Run, other: Run, last: int) -> str:
    with np.errstate(all="ignore"):  # of covariances that are none
        found = first_difference(one, other)
    if found is None:
        return f"no difference up to step {last}"
    where = f"first difference: step {found.step}, {found.stage}"
    if found.quantity == "stage":
        return f"{where}: one of the two has no such stage"
    if found.by is None:
        return f"{where}: {found.quantity} is a number in one of the two alone"
    unit = {"mean": "σ", "residual": "σ of S", "cov": " of its size"}.get(found.quantity, "")
    return f"{where}: {found.quantity} by {found.by:.3g}{unit}"
