"""The view: a pure function of what a recording holds."""

from __future__ import annotations

import rerun.blueprint as rrb

from viz_estim.core.consistency import band
from viz_estim.core.spaces import S2, SO3, Euclidean, Space
from viz_estim.recording import schema
from viz_estim.recording.layout import Layout

_Item = rrb.Container | rrb.View


def build(layout: Layout) -> rrb.Blueprint:
    """Scenes at the left, plots in tabs at the right, lanes and notes below."""
    scenes = _scenes(layout)
    plots = rrb.Tabs(_health(layout), _state(layout), name="plots", active_tab=0)
    lanes = rrb.StateTimelineView(origin=schema.LANES, name="Lanes: stage, and what became of each sensor's reading")
    notes = rrb.TextDocumentView(origin=schema.NOTES, name="What to look at")
    left: list[_Item] = [*scenes, notes]
    shares = [3, 2, 1.6] if len(scenes) == 2 else [3, 1]
    whole = rrb.Horizontal(
        rrb.Vertical(*left, row_shares=shares[: len(left)] if scenes else None),
        rrb.Vertical(plots, lanes, row_shares=[4, 1]),
        column_shares=[2, 3],
    )
    return rrb.Blueprint(
        whole,
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _scenes(layout: Layout) -> list[_Item]:
    scenes: list[_Item] = []
    if any(isinstance(part, SO3) for part in layout.space.parts.values()):
        points = any("points" in what for fields in layout.stages.values() for what in fields.values())
        title = f"World: estimate amber{', truth white' if layout.true_parts else ''}"
        scenes.append(_scene(schema.WORLD, f"{title}{', sigma points on the sphere' if points else ''}", 1.0))
    sensors = [
        (name, space)
        for name, space in layout.sensors.items()
        if len(space.names) == 3 and isinstance(space, (Euclidean, S2))
    ]
    views: list[_Item] = []
    for name, space in sensors:
        colour, _ = schema.sensor_colour(layout.place(name))
        title = f"{name}, body axes{_unit(space, 0, space.units)}: measured {colour}, predicted amber"
        views.append(_scene(schema.sensor(name), title, layout.reach[name]))
    if views:
        scenes.append(rrb.Tabs(*views, active_tab=0) if len(views) > 1 else views[0])
    return scenes


def _scene(origin: str, name: str, size: float) -> rrb.Spatial3DView:
    eye = rrb.EyeControls3D(
        position=[1.6 * size, -1.9 * size, 1.1 * size], look_target=[0, 0, 0], eye_up=[0, 0, 1], kind="Orbital"
    )
    return rrb.Spatial3DView(origin=origin, name=name, eye_controls=eye, line_grid=False, background=[13, 14, 16])


def _health(layout: Layout) -> rrb.Container:
    """Is the filter right, and does it know: errors, innovations, NIS."""
    rows: list[_Item] = []
    if layout.true_parts:
        for name, part in layout.space.parts.items():
            if name in layout.true_parts:
                views = [
                    _plot("error", f"{name}.{axis}", f"{name} error {axis}{_unit(part, i)} ±3σ")
                    for i, axis in enumerate(part.axes)
                ]
                rows.append(rrb.Horizontal(*views))
    for name, space in layout.sensors.items():
        views = [
            _plot("innovation", f"{name}.{axis}", f"{name} innov. {axis}{_unit(space, i)} ±3σ")
            for i, axis in enumerate(space.axes)
        ]
        rows.append(rrb.Horizontal(*views))
    if layout.sensors:
        views = []
        for name, space in layout.sensors.items():
            dof = len(space.axes)
            axis = rrb.ScalarAxis(range=(0.0, 3 * band(dof)[1]))
            views.append(_plot("nis", name, f"NIS {name}: {dof} expected, 95 % between the lines", axis))
        rows.append(rrb.Horizontal(*views))
    if not rows:
        rows = _sigmas(layout)
    return rrb.Vertical(*rows, name="Consistency")


def _state(layout: Layout) -> rrb.Container:
    """What the filter says: every component of the state, and its σ."""
    rows: list[_Item] = []
    for name, part in layout.space.parts.items():
        views = [
            _plot("state", f"{name}.{component}", f"{name} {component}{_unit(part, i, part.units)}", legend=i == 0)
            for i, component in enumerate(part.names)
        ]
        rows += [rrb.Horizontal(*views[i : i + 4]) for i in range(0, len(views), 4)]
    rows.append(rrb.Horizontal(*_sigmas(layout)))
    return rrb.Vertical(*rows, name="State")


def _sigmas(layout: Layout) -> list[_Item]:
    return [
        _plot("sigma", name, f"{name} σ = √ of the covariance's diagonal{_unit(part)}", legend=True)
        for name, part in layout.space.parts.items()
    ]


def _plot(
    group: str, component: str, name: str, axis: rrb.ScalarAxis | None = None, *, legend: bool = False
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=schema.plot(group, component),
        name=name,
        axis_y=axis,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
    )


def _unit(space: Space, i: int = 0, units: tuple[str, ...] | None = None) -> str:
    unit = (units or space.axis_units)[i]
    return f" [{'deg' if unit == 'rad' else unit}]" if unit else ""
