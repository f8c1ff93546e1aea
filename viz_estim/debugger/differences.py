"""Two branches side by side: their figures from the fork on, and the first thing in which they differ."""

from __future__ import annotations

from typing import Any

import numpy as np

from viz_estim.core.consistency import summary
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product
from viz_estim.debugger.branches import Branch
from viz_estim.debugger.expressions import Absent
from viz_estim.debugger.quantities import Frame
from viz_estim.debugger.sources import Source

_COMPARED = ("mean", "cov", "log_probabilities", "innovation.residual")


def side_by_side(one: Branch, other: Branch) -> str:
    """Figures of both over the steps that both have, from where they part, and the first difference."""
    if one.parent == other.number or other.parent == one.number:
        first = max(one.first, other.first)
    else:
        first = min(one.first, other.first)
    last = min(one.source.reached, other.source.reached)
    if first > last:
        return f"they part at step {first}, which branch {one.number} or {other.number} has not reached"
    figures = [_figures(branch.source, first, last) for branch in (one, other)]
    width = max([24, *map(len, figures[0] | figures[1])])
    heads = f"{f'branch {one.number}':>12}  {f'branch {other.number}':>12}"
    lines = [f"steps {first} to {last}:{'':{max(1, width - 8 - len(str(first) + str(last)))}}{heads}"]
    for name in figures[0] | figures[1]:
        cells = [f"{figure[name]:12.5g}" if name in figure else f"{'':12}" for figure in figures]
        lines.append(f"  {name:{width}} {'  '.join(cells)}")
    return "\n".join([*lines, _difference(one.source, other.source, first, last)])


def _figures(source: Source, first: int, last: int) -> dict[str, float]:
    """A run's figures over some of its steps, by name."""
    ends: dict[str, list[Array]] = {}
    truths: list[Array] = []
    innovations: dict[str, list[tuple[Product, Frame]]] = {}
    for step in range(first, last + 1):
        frames = [source.frame(place) for place in source.span(step)]
        for frame in frames:
            space = frame.spaces.get("innovation")
            if isinstance(space, Product):
                innovations.setdefault(frame.stage, []).append((space, frame))
        names = ("log_probabilities",) if frames[-1].labels else ("mean", "cov")
        if not all(name in frames[-1].values for name in names):
            continue
        for name in names:
            ends.setdefault(name, []).append(frames[-1].values[name][0])
        size = 1 if frames[-1].labels else ends["mean"][-1].shape[-1]
        truth = frames[-1].truth
        truths.append(np.full(size, np.nan) if truth is None else truth[0])
    rows = []
    for of_stage in innovations.values():
        residual, cov, offered = (
            np.stack([frame.values[f"innovation.{k}"][0] for _, frame in of_stage])
            for k in ("residual", "cov", "offered")
        )
        rows.append((of_stage[0][0], residual, cov, offered.astype(bool)))
    space = source.frame(source.span(first)[0]).space
    stacked = {name: np.stack(values) for name, values in ends.items()}
    found: dict[str, Any] = summary(space, stacked, np.stack(truths) if truths else np.empty(0), rows, {})
    figures = dict(found["metrics"]) | {f"nis {name}": one["mean"] for name, one in found["nis"].items()}
    return figures | ({"nees": found["nees"]["mean"]} if found["nees"] else {})


def _difference(one: Source, other: Source, first: int, last: int) -> str:
    for step in range(first, last + 1):
        spans = one.span(step), other.span(step)
        frames = [[source.frame(place) for place in span] for source, span in zip((one, other), spans, strict=True)]
        stages = [[frame.stage for frame in of_one] for of_one in frames]
        if stages[0] != stages[1]:
            return f"first difference: step {step} has the stages {', '.join(stages[0])} and {', '.join(stages[1])}"
        for a, b in zip(*frames, strict=True):
            for name in _COMPARED:
                try:
                    x, y = a.lookup(name), b.lookup(name)
                except Absent:
                    continue
                if not np.array_equal(x, y, equal_nan=True):
                    return f"first difference: step {step}, {a.stage}: {name}{_by(a, name, x, y)}"
    return f"no difference up to step {last}"


def _by(frame: Frame, name: str, x: Array, y: Array) -> str:
    """By how much: a mean in σ of the first run; else relative to its size."""
    if name == "mean" and frame.space is not None:
        std = np.maximum(frame.lookup("std"), np.finfo(float).tiny)
        return f" by {np.abs(frame.space.minus(y, x) / std).max():.3g}σ"
    if x.shape != y.shape:
        return " in shape"
    return f" by {np.linalg.norm(y - x) / max(float(np.linalg.norm(x)), np.finfo(float).tiny):.3g} of its size"
