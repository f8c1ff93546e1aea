"""The numbers of a stage as columns: the belief after it, and all that its record holds, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.stages import Innovation, Matches
from viz_estim.recording.batch import Batch, StageRows
from viz_estim.recording.columns import Column, indices, numbers, once
from viz_estim.recording.layout import Layout

_STAGE = "viz_estim.Stage"


def stage_columns(layout: Layout, batch: Batch, rows: StageRows, every: int) -> list[Column]:
    """All columns of one stage's rows; geometry (points, clouds, matches) at every N-th step alone."""
    kept = rows.at.step % every == 0
    fields = layout.stages[rows.name]
    if layout.particles:
        columns = _moments(rows, batch)
        states = fields.get("belief.states")
        columns += _thinned(rows, "belief.states", _own(rows, "belief.states", states, kept), "states")
        columns += _log_weights(rows, kept)
    else:
        columns = [_column(rows, f"belief.{name}", name) for name in rows.stages[0].belief.shapes]
    for field, what in fields.items():
        if "points" in what:
            columns += _thinned(rows, f"{field}.points", _own(rows, field, what, kept))
        elif "matches" in what:
            for part in Matches.__slots__:
                columns += (_indices if part.endswith("_index") else _thinned)(rows, f"{field}.{part}", kept)
        elif "innovation" in what:
            columns += [_column(rows, f"{field}.{part}") for part in Innovation.__slots__ if part != "space"]
        elif "cloud" in what:
            columns += (_indices if field == "ancestors" else _thinned)(rows, field, kept)
        elif "shape" in what:
            columns.append(_column(rows, field))
    # A stage has its rows also where nothing of them is kept.
    return columns or [numbers(_STAGE, "log_weights", [None] * len(kept))]


def _own(rows: StageRows, field: str, what: dict[str, list[str]] | None, kept: np.ndarray) -> np.ndarray:
    """Which of the kept rows hold geometry that is not the stage before's own, or copies of it."""
    if not what or "same_as" not in what:
        return kept
    return kept & ~(rows.copied(what["same_as"][0]) if "by" in what else rows.shared(field, *what["same_as"]))


def _log_weights(rows: StageRows, kept: np.ndarray) -> list[Column]:
    """Those of clouds; one for all, where they are the same."""
    weights = zip(rows.objects("belief.log_weights"), rows.equal_weights, strict=True)
    found: list[Any] = [one[:1] if equal else one for one, equal in weights]
    if not kept.all():
        found = [one if keep else None for one, keep in zip(found, kept, strict=True)]
    return [numbers(_STAGE, "log_weights", found)] if kept.any() else []


def _moments(rows: StageRows, batch: Batch) -> list[Column]:
    """Mean and covariance of clouds, at the end of each step alone: of the others the reader works them out."""
    if not rows.last.any():
        return []
    at = np.searchsorted(batch.end_rows, rows.rows)
    values = zip(("mean", "cov"), batch.end_moments, strict=True)
    at = np.minimum(at, len(batch.end_rows) - 1)  # of those that end no step, whichever
    return [numbers(_STAGE, name, found[at], rows.last) for name, found in values]


def _thinned(rows: StageRows, path: str, kept: np.ndarray, name: str | None = None) -> list[Column]:
    """Geometry, in the rows where it is kept."""
    if not kept.any():
        return []
    values: Array | list[Any] = rows.values(path)
    if isinstance(values, list):
        values = [value if keep else None for value, keep in zip(values, kept, strict=True)]
    return [numbers(_STAGE, name or path, values, kept)]


def _indices(rows: StageRows, path: str, kept: np.ndarray) -> list[Column]:
    """Which rows of a cloud a stage names, in the rows where they are kept."""
    values = [value if keep else None for value, keep in zip(rows.objects(path), kept, strict=True)]
    return [indices(_STAGE, path, values)] if kept.any() else []


def _column(rows: StageRows, path: str, name: str | None = None) -> Column:
    """A quantity of the stage; once, where all rows hold the same object (a constant noise, say)."""
    found = rows.objects(path)
    if len(found) > 1 and found[0] is found[-1] and all(value is found[0] for value in found):
        return once(_STAGE, name or path, found[0], len(found))
    return numbers(_STAGE, name or path, rows.values(path))
