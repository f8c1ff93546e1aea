"""The view of a comparison: the runs' scenes side by side under one eye, and below them what they did over time."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import rerun.blueprint as rrb

from viz_estim.recording import links, plot_tabs, schema
from viz_estim.recording.compared import Compared
from viz_estim.recording.pictures import CANVAS, PANORAMA
from viz_estim.recording.ranges import Ranges
from viz_estim.recording.scene_views import Scenes, flat, view
from viz_estim.recording.sheet import Plot

_Item = rrb.Container | rrb.View
_LOWER = 2  # times as low as in a run's own view are plots below the scenes
_FEW, _MORE = 3, 4  # runs up to which a plot has room for their legend; and one that has a row for itself
_NAMES = {"attitude": "attitude", "world": "world [m]", "bars": "probabilities", "canvas": "mosaic [deg]"}
_TABS = {
    "difference": "Difference", "belief": "Belief", "error": "Errors", "state": "State", "sigma": "σ",
    "innovation": "Innovations", "nis": "NIS", "moved": "What moved it", "figure": "Figures",
}  # fmt: skip


def build(runs: list[Compared], scenes: Scenes, plots: list[Plot], ranges: Ranges, notes: str) -> rrb.Blueprint:
    """Scenes above, by kind in tabs where there are several; plots beneath in tabs, with lanes and the figures."""
    above = _scenes(runs, scenes)
    beneath: list[_Item] = []
    for tab in _TABS:
        if members := [plot for plot in plots if plot.tab == tab]:
            white = ", truth white" if tab == "state" and any(np.isfinite(run.run.truth).any() for run in runs) else ""
            beneath += _tabs(_TABS[tab] + white, members, ranges, len(runs), named=bool(above))
    lanes = [
        plot_tabs.lanes(f"{run.path}{schema.LANES}", f"{run.title}: stage, and each sensor's readings") for run in runs
    ]
    beneath.append(rrb.Grid(*lanes, grid_columns=1 if len(runs) <= 3 else 3, name="Lanes"))
    beneath.append(links.panel(schema.NOTES, "What was compared", notes))
    duration = max(float(run.run.time[-1] - run.run.time[0]) for run in runs)
    beneath = [plot_tabs.show_all(tab, duration) for tab in beneath]
    tabs = rrb.Tabs(*beneath, name="over time", active_tab=0)
    rows: list[_Item] = [rrb.Tabs(*above, active_tab=0) if len(above) > 1 else above[0], tabs] if above else [tabs]
    shares = [1.0] if not above else [0.85, 1.0] if len(runs) <= 3 else [1.1, 1.0]
    return rrb.Blueprint(
        rrb.Vertical(*rows, row_shares=shares),
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _scenes(runs: list[Compared], scenes: Scenes) -> list[_Item]:
    found: list[_Item] = []
    order = ["/world", "/attitude", "/bars", "/canvas", *scenes.runs]
    for scene in dict.fromkeys(scene for scene in order if scene in scenes.runs):
        holders = [runs[i] for i in scenes.runs[scene]]
        word = _NAMES.get(scene[1:], scene[1:].removeprefix("sensors/"))
        across = len(holders) if len(holders) <= 3 else -(-len(holders) // 2)
        wide = (4.2 if len(holders) <= 3 else 7.0) / across  # a view's width by its height in a window of 1.6
        views = [view(scene, [one], runs[0], scenes, f"{one.title}: {word}", wide) for one in holders]
        if scene == CANVAS and scenes.panorama:
            views.append(flat(f"{runs[0].path}{PANORAMA}", None, scenes.sizes.get((PANORAMA, 0)), "True world [deg]"))
            across = len(views) if len(views) <= 3 else -(-len(views) // 2)
        found.append(rrb.Grid(*views, grid_columns=across, name=word.capitalize()))
        if scene in (schema.WORLD, schema.ATTITUDE) and len(holders) > 1:
            title = ", ".join(one.title for one in holders)
            found.append(view(scene, holders, runs[0], scenes, f"{word.capitalize()} overlaid: {title}", 4.2))
    return found


def _tabs(title: str, plots: list[Plot], ranges: Ranges, runs: int, *, named: bool) -> list[_Item]:
    """Plots in rows, those of one part of the state together; in as many tabs as keep them readable.

    A legend where a plot has a run that none before it on the tab has; of more runs where that plot has a row for
    itself. Of those that are too many for that, which would be cut off, only where no scene above names them.
    """
    rows: list[list[Plot]] = []
    for _, members in groupby(plots, key=lambda plot: plot.row):
        group = list(members)
        if rows and len(rows[-1]) + len(group) <= 4 and len(group) < 3:
            rows[-1] += group
        else:
            across = 3 if len(group) % 3 == 0 else 4
            rows += [group[i : i + across] for i in range(0, len(group), across)]
    count = -(-len(rows) // (3 if runs <= _FEW else 2))
    size = -(-len(rows) // count)
    found: list[_Item] = []
    for i in range(0, len(rows), size):
        shown: set[int] = set()
        lines, tab = [], rows[i : i + size]
        for row in tab:
            roomy = runs <= _FEW or (len(row) == 1 and runs <= _MORE)
            line = []
            for plot in row:
                new = not plot.runs <= shown
                line.append(_plot(plot, ranges, rows=_LOWER * len(tab), legend=new and (roomy or not named)))
                shown |= plot.runs
            lines.append(rrb.Horizontal(*line))
        found.append(rrb.Vertical(*lines, name=f"{title} {len(found) + 1}" if found else title))
    return found


def _plot(plot: Plot, ranges: Ranges, *, rows: float, legend: bool) -> rrb.TimeSeriesView:
    """rows: of plots, as many as have their height in a run's own view."""
    return rrb.TimeSeriesView(
        origin=plot.path,
        name=plot.title,
        axis_y=ranges.axis(plot.path, rows=rows) if plot.top is None else rrb.ScalarAxis(range=(0.0, plot.top)),
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
    )
