"""The view of a diagnosis: what is wrong in words, and beside it the scene, the evidence over time and the lanes."""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TextLogColumnKind

from viz_estim.core.consistency import band
from viz_estim.recording import links, plot_tabs, schema
from viz_estim.recording.compared import Alone, is_figure
from viz_estim.recording.figure_names import figure_names, figures_once
from viz_estim.recording.layout import as_product
from viz_estim.recording.lines import shown
from viz_estim.recording.pictures import CANVAS
from viz_estim.recording.plot_tabs import graph
from viz_estim.recording.ranges import Ranges
from viz_estim.recording.scene_views import Scenes, view
from viz_estim.recording.sheet import titled

FINDINGS = "/findings"
LIST = f"{FINDINGS}/list"
_ROWS = 2  # of plots in one tab
_LANES = 0.42  # of the height at most: those of the worst findings stand first, and evidence is more to read
_Item = rrb.Container | rrb.View
_Plots = list[rrb.TimeSeriesView]
_NAMES = {schema.WORLD: "World [m]", schema.ATTITUDE: "Attitude", schema.BARS: "Probabilities", CANVAS: "Mosaic [deg]"}


def build(alone: Alone, scenes: Scenes, ranges: Ranges, findings: int, markdown: str) -> rrb.Blueprint:
    """Findings at the left, above the scene and a list to jump by where there are any; evidence and lanes at the
    right."""
    columns = [TextLogColumn(kind) for kind in (TextLogColumnKind.LogLevel, TextLogColumnKind.Body)]
    left: list[_Item] = [links.panel(FINDINGS, "What is wrong", markdown)]
    if spatial := _spatial(alone, scenes):
        left.append(rrb.Tabs(*spatial, active_tab=0))
    if findings:
        columned = rrb.archetypes.TextLogColumns(text_log_columns=columns)
        left.append(rrb.TextLogView(origin=LIST, name="Click a time to go there", columns=columned))
    duration = float(alone.run.time[-1] - alone.run.time[0])
    tabs = [
        plot_tabs.show_all(tab, duration) for title, plots in _evidence(alone, ranges) for tab in _tabs(title, plots)
    ]
    sensors = {name.partition(".")[2] for name in alone.run.inputs if "." in name}
    low = min(_LANES, plot_tabs.lanes_share(findings + len(sensors) + 1 + bool(alone.run.labels)))
    right: list[_Item] = [
        *([rrb.Tabs(*tabs, active_tab=0)] if tabs else []),
        plot_tabs.lanes(schema.LANES, "Lanes: findings, stages, readings"),
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[2.4, *[1.6] * bool(spatial), *[1.0] * bool(findings)]),
            rrb.Vertical(*right, row_shares=[1 - low, low] if tabs else [1.0]),
            column_shares=[2, 3],
        ),
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _spatial(alone: Alone, scenes: Scenes) -> list[rrb.View]:
    found = []
    for scene, word in _NAMES.items():
        if scene in scenes.runs:
            truth = ", fixed grey" if _registered(alone) else ", truth white" if scene[1:] in scenes.truths else ""
            name = f"{word}: {_shown(alone)} amber{truth}" if scene in (schema.ATTITUDE, schema.WORLD) else word
            found.append(view(scene, [alone], alone, scenes, name, 2.2))
    return found


def _shown(alone: Alone) -> str:
    """What stands for the estimate."""
    if _registered(alone):
        return "moved cloud"
    return "particles" if alone.run.properties.get("particles") else "estimate"


def _registered(alone: Alone) -> bool:
    return "align" in alone.run.stages


def _evidence(alone: Alone, ranges: Ranges) -> list[tuple[str, list[_Plots]]]:
    """Tabs by title, each with its plots, those of one thing together."""
    tabs = [
        ("Innovations", _innovations(alone, ranges)),
        ("Errors", _errors(alone, ranges)),
        ("Belief", _belief(alone)),
        ("Figures", _figures(alone)),
    ]
    if _registered(alone):  # its matches and its RMSE say most
        tabs.insert(0, tabs.pop())
    return [(title, groups) for title, groups in tabs if groups]


def _innovations(alone: Alone, ranges: Ranges) -> list[_Plots]:
    groups = []
    for table in alone.run.stages.values():
        for name, part in as_product(table.spaces.get("innovation")).parts.items():
            dof = len(part.axes)
            top = ranges.upward(schema.plot("nis", name), 4 * band(dof)[1])
            views = [graph("nis", name, f"NIS {name}", top)]
            for axis, unit in zip(part.axes, part.axis_units, strict=True):
                # Beside their NIS, which names the sensor, three have no room for that and a unit.
                title = f"{axis} [{shown(unit)[0]}]" if dof == 3 and unit else titled(name, axis, shown(unit)[0])
                views.append(_framed(ranges, "innovation", f"{name}.{axis}", title))
            groups.append(views)
    return groups


def _errors(alone: Alone, ranges: Ranges) -> list[_Plots]:
    run, space = alone.run, alone.space
    return [
        [
            _framed(ranges, "error", f"{name}.{axis}", titled(name, axis, shown(unit)[0], "error"))
            for axis, unit in zip(part.axes, part.axis_units, strict=True)
        ]
        for name, part in space.parts.items()
        if np.isfinite(run.truth[:, space.at[name]]).any()
    ]


def _framed(ranges: Ranges, group: str, component: str, name: str) -> rrb.TimeSeriesView:
    return graph(group, component, name, ranges.axis(schema.plot(group, component)))


def _belief(alone: Alone) -> list[_Plots]:
    if not alone.run.labels:
        return []
    return [[plot_tabs.probabilities()]]


def _figures(alone: Alone) -> list[_Plots]:
    by_stage = {
        table.name: [f for f, values in table.values.items() if is_figure(f, values) and np.isfinite(values).any()]
        for table in alone.run.stages.values()
    }
    particles = alone.run.properties.get("particles", {}).get("count")
    groups = [
        [
            graph("figure", f"{stage}.{name}", f"{stage}: {words}")
            for name, words in figure_names(numbers, fit=_registered(alone), particles=particles).items()
        ]
        for stage, numbers in figures_once(by_stage).items()
    ]
    return [group for group in groups if group]


def _tabs(title: str, groups: list[_Plots]) -> list[_Item]:
    """The plots in rows of at most four, in as many tabs as keep them readable."""
    rows: list[_Plots] = []
    for group in groups:
        if rows and len(rows[-1]) + len(group) <= 4:
            rows[-1] += group
        else:
            across = 3 if len(group) % 3 == 0 else 4
            rows += [group[i : i + across] for i in range(0, len(group), across)]
    count = -(-len(rows) // _ROWS)
    size = -(-len(rows) // count)
    parts = [rows[i : i + size] for i in range(0, len(rows), size)]
    return [
        rrb.Vertical(*(rrb.Horizontal(*row) for row in part), name=f"{title} {i}" if i > 1 else title)
        for i, part in enumerate(parts, 1)
    ]
