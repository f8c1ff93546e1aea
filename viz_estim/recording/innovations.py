"""What updates plot over time: innovations, NIS, and which reading moved which direction of the state."""

from __future__ import annotations

import numpy as np

from viz_estim.core.consistency import band, nis
from viz_estim.core.measurement import split
from viz_estim.core.spaces import Product
from viz_estim.recording import schema
from viz_estim.recording.batch import Batch, StageRows
from viz_estim.recording.layout import Layout
from viz_estim.recording.lines import Lines


class Innovations:
    """Draws the innovations of a batch's updates."""

    def __init__(self, lines: Lines, layout: Layout) -> None:
        self._lines, self._layout = lines, layout

    def add(self, batch: Batch) -> dict[str, set[int]]:
        """Draws them; returns by sensor the steps at which a gate refused it."""
        gated: dict[str, set[int]] = {}
        for rows in batch.stages:
            for field, what in self._layout.stages[rows.name].items():
                if "innovation" in what:
                    self._draw(rows, field, gated)
                    if "gain" in self._layout.stages[rows.name]:
                        self._draw_moved(rows, field)
        return gated

    def _draw(self, rows: StageRows, field: str, gated: dict[str, set[int]]) -> None:
        space = getattr(rows.stages[0], field).space
        assert isinstance(space, Product)
        residual, S, used = (rows.array(f"{field}.{k}") for k in ("residual", "cov", "used"))
        found = nis(space, residual, S, rows.array(f"{field}.offered").astype(bool))
        for sensor, (name, part) in enumerate(space.parts.items()):
            refused = rows.at.step[used[:, sensor] == 0]
            if len(refused):
                gated.setdefault(name, set()).update(refused.tolist())
            colour, start = self._colour(name), space.axes_at[name].start
            for i, axis in enumerate(part.axes, start):
                path, unit = schema.plot("innovation", f"{name}.{axis}"), part.axis_units[i - start]
                line = ("residual", colour, residual[:, i])
                self._lines.within(path, rows.at, unit, line, S[:, i, i], gapless=True)
            low, high = (np.full(len(rows.at), bound) for bound in band(found[name].dof))
            path = schema.plot("nis", name)
            self._lines.draw(path, rows.at, "", [("97.5 %", schema.BAND, high), ("2.5 %", schema.BAND, low)])
            self._lines.broken(f"{path}/value", rows.at, "", ("NIS", colour, found[name].values), path)

    def _draw_moved(self, rows: StageRows, field: str) -> None:
        """Δ = K·ν split by component of the reading, K[:, j]·ν_j, in σ of the state before."""
        chosen = np.flatnonzero(rows.has_prior)
        if not len(chosen):
            return
        at = rows.at if len(chosen) == len(rows.at) else rows.at.pick(chosen)
        space = getattr(rows.stages[0], field).space
        std = np.sqrt(np.maximum(np.diagonal(rows.prior("cov"), axis1=1, axis2=2), 0))
        _, moved = split(rows.some("gain", chosen), rows.some(f"{field}.residual", chosen), std)
        names = [(name, axis) for name, part in space.parts.items() for axis in part.axes]
        shades = {name: schema.shades(self._colour(name), len(part.axes)) for name, part in space.parts.items()}
        colours = [shade for name in space.parts for shade in shades[name]]
        titles = [f"by {name} {axis}" if axis not in ("", name) else f"by {name}" for name, axis in names]
        for i, axis in enumerate(self._layout.space.axes):
            series = list(zip(titles, colours, moved[:, i, :].T, strict=True))
            plot = schema.plot("moved", axis)
            self._lines.draw(f"{plot}/{schema.as_part(rows.name)}", at, "σ", series, plot=plot)

    def _colour(self, sensor: str) -> schema.Colour:
        return schema.sensor_colour(self._layout.place(sensor))[1]
