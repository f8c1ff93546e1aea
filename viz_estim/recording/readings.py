"""Which readings are readings: a loop of a person's own may tell what is left of one, the residual, alone."""

from __future__ import annotations

import numpy as np

from viz_estim.recording.batch import StageRows
from viz_estim.recording.layout import Layout


def told(layout: Layout, rows: StageRows, field: str, sensor: str, part: str) -> np.ndarray:
    """Which rows (M,) hold a sensor's reading of a part of the state: where a loop told the residual alone, zero stands
    for what was expected though the estimate was elsewhere, and the residual for the reading."""
    space = getattr(rows.stages[0], field).space
    found = np.asarray(rows.array(f"{field}.predicted")[:, space.at[sensor]].any(1))
    if not found.all() and not layout.particles:
        prior = np.full((len(rows.stages), len(layout.space.names)), np.nan)
        prior[rows.has_prior] = rows.prior("mean")
        found |= ~prior[:, layout.space.at[part]].any(1)
    return found
