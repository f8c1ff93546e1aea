"""What the stages of all runs gave over time: residuals, NIS, what moved the estimate, and their single numbers."""

from __future__ import annotations

import numpy as np

from viz_estim.core.consistency import FIT, band, nis
from viz_estim.core.measurement import split
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product
from viz_estim.recording.columns import Times
from viz_estim.recording.compared import Compared, is_figure
from viz_estim.recording.figure_names import figure_names, figures_once
from viz_estim.recording.layout import as_product
from viz_estim.recording.reader import Run
from viz_estim.recording.sheet import Sheet, titled
from viz_estim.recording.tables import StageTable


def draw(sheet: Sheet) -> None:
    """Draws them all."""
    for drawing in (_draw_residuals, _draw_nis):
        for one in sheet.runs:
            for table in one.run.stages.values():
                if "innovation.residual" in table.values:
                    at = sheet.times(one, table.place, table.step)
                    drawing(sheet, one, table, as_product(table.spaces["innovation"]), at)
    for one in sheet.runs:
        _draw_moved(sheet, one)
    for one in sheet.runs:
        tables = one.run.stages.values()
        by_stage = {t.name: [name for name, values in t.values.items() if is_figure(name, values)] for t in tables}
        for table, numbers in zip(tables, figures_once(by_stage).values(), strict=True):
            clouds = 0 if "particles" in one.run.properties else None
            for name, words in figure_names(numbers, fit=table.values.keys() >= FIT, particles=clouds).items():
                at, title = sheet.times(one, table.place, table.step), f"{table.name}: {words}"
                sheet.line("figure", f"{table.name}.{name}", one, at, table.values[name], table.name, title)


def _draw_residuals(sheet: Sheet, one: Compared, table: StageTable, space: Product, at: Times) -> None:
    residual, S = table.values["innovation.residual"], table.values["innovation.cov"]
    for name, part in space.parts.items():
        axes = space.axes_at[name]
        bounds = None
        if sheet.bounded:
            bounds = 3 * np.sqrt(np.maximum(np.diagonal(S, axis1=1, axis2=2)[:, axes], 0))
        sheet.per_axis("innovation", name, part, one, at, residual[:, axes], "innov.", bounds)


def _draw_nis(sheet: Sheet, one: Compared, table: StageTable, space: Product, at: Times) -> None:
    """NIS between χ²'s 95 % bounds, which are drawn once."""
    residual, S, offered = (table.values[f"innovation.{k}"] for k in ("residual", "cov", "offered"))
    for name, found in nis(space, residual, S, offered.astype(bool)).items():
        low, high = band(found.dof)
        row = ("NIS", f"NIS {name}: {found.dof} expected")
        path, new = sheet.plot("nis", name, *row, top=4 * high)
        if new:
            sheet.band(path, at, [("97.5 %", high), ("2.5 %", low)])
        sheet.line("nis", name, one, at, found.values, *row)


def _draw_moved(sheet: Sheet, one: Compared) -> None:
    """K·ν of a step, all readings together."""
    place, step, total = moved(one.run)
    if not len(step):
        return
    at = sheet.times(one, place, step)
    for name, part in one.space.parts.items():
        for axis, values in zip(part.axes, total[:, one.space.axes_at[name]].T, strict=True):
            title = f"K·ν on {titled(name, axis, 'σ before')}"
            sheet.line("moved", f"{name}.{axis}", one, at, values, name, title)


def moved(run: Run) -> tuple[np.ndarray, np.ndarray, Array]:
    """Of each step with updates the place (M,) of the last of them, its number (M,), and how far they moved each
    direction (M, d): the sum of their K·ν, each in σ of the state before; one with no stage before it does not count.
    """
    d = len(run.space.axes)
    places, steps, moves = [np.empty(0, np.int64)], [np.empty(0, np.int64)], [np.empty((0, d))]
    for table in run.stages.values():
        if {"gain", "innovation.residual"} <= table.values.keys():
            std = _std_before(run, table)
            _, by_component = split(table.values["gain"], table.values["innovation.residual"], std)
            total = by_component.sum(2)
            known = np.isfinite(total).all(1)
            places.append(table.place[known])
            steps.append(table.step[known])
            moves.append(total[known])
    place, step, all_moves = np.concatenate(places), np.concatenate(steps), np.concatenate(moves)
    found, which = np.unique(step, return_inverse=True)
    sums, last = np.zeros((len(found), d)), np.zeros(len(found), np.int64)
    np.add.at(sums, which, all_moves)
    np.maximum.at(last, which, place)
    return last, found, sums


def _std_before(run: Run, table: StageTable) -> Array:
    """σ (M, d) of the belief before each of a stage's rows, NaN where none was."""
    others = [other for other in run.stages.values() if len(other.place)]
    place = np.concatenate([other.place for other in others])
    variance = np.concatenate([np.diagonal(other.cov, axis1=1, axis2=2) for other in others])
    order = np.argsort(place)
    row = order[np.clip(np.searchsorted(place[order], table.place - 1), 0, len(place) - 1)]
    std: Array = np.where((place[row] == table.place - 1)[:, None], np.sqrt(np.maximum(variance[row], 0)), np.nan)
    return std
