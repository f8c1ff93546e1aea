"""The view: a pure function of what a recording holds."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from viz_estim.core.consistency import band
from viz_estim.core.spaces import Space
from viz_estim.recording import pictures, schema
from viz_estim.recording.layout import Layout
from viz_estim.recording.scenes import own_scene

_Item = rrb.Container | rrb.View
_BACKGROUND = [13, 14, 16]
_MANY = 5  # rows of plots that one tab holds


def build(layout: Layout) -> rrb.Blueprint:
    """Scenes at the left, plots in tabs at the right, lanes and notes below."""
    scenes = _scenes(layout)
    figures = _figures(layout)
    tabs = [_probabilities()] if layout.labels else [*_health(layout), _state(layout), *_moved(layout)]
    tabs = (
        [*figures, *tabs] if figures and (layout.matched or not layout.true_parts) else [*tabs[:1], *figures, *tabs[1:]]
    )
    plots = rrb.Tabs(*tabs, name="plots", active_tab=0)
    lanes = rrb.StateTimelineView(origin=schema.LANES, name="Lanes: stage, and what became of each sensor's reading")
    notes = rrb.TextDocumentView(origin=schema.NOTES, name="What to look at")
    left: list[_Item] = [*scenes, notes]
    shares: list[float] = {1: [1.0], 2: [2.6, 1.0], 3: [3.0, 2.0, 1.6]}[len(left)]
    if layout.camera:
        shares = [2.3, 2.4, 1.6]  # the unrolled sphere is twice as wide as high
    low = min(0.4, 0.054 + 0.044 * (len(layout.inputs) + 1 + bool(layout.labels)))  # a lane is some 37 pixels high
    whole = rrb.Horizontal(
        rrb.Vertical(*left, row_shares=shares),
        rrb.Vertical(plots, lanes, row_shares=[1 - low, low]),
        column_shares=[2, 3] if scenes else [1, 3],
    )
    return rrb.Blueprint(
        whole,
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def legend(layout: Layout) -> str:
    """What the colours of this recording mean, as markdown."""
    if layout.labels:
        said = "each label has its own, in the bars, over time and in the lane of the truth"
    else:
        truth = ", white the truth" if layout.true_parts else ""
        what = "the moved cloud and its pose" if layout.matched else "the estimate"
        said = f"amber is {what}{truth}, grey lines its bounds"
        if layout.particles:
            said += ", yellow each of several modes"
        if layout.matched:
            said += ", grey points the fixed cloud"
        elif layout.attitude:
            said += ", each sensor has its own; red, green and blue are the axes x, y, z"
        elif not layout.particles:
            said += ", each sensor has its own"
    return f"**Colours:** {said}. On the `stage` timeline each stage shows what it alone drew."


def _scenes(layout: Layout) -> list[_Item]:
    """At most two panels: places in the world, or the bars of a belief over labels; attitudes and sensors below."""
    points = any("points" in what for fields in layout.stages.values() for what in fields.values())
    truth = ", truth white" if layout.true_parts else ""
    first: list[_Item] = []
    if layout.labels:
        middle = 0.5 * schema.BAR * (len(layout.labels) - 1)
        eye = rrb.EyeControls3D(
            position=[middle, 0.45, 1.3 + 0.35 * len(layout.labels)], look_target=[middle, 0.45, 0],
            eye_up=[0, 1, 0], kind="Orbital",
        )  # fmt: skip
        name = "Belief: the probability of each label at this moment"
        first.append(rrb.Spatial3DView(
            origin=schema.BARS, name=name, eye_controls=eye, line_grid=False, background=_BACKGROUND
        ))  # fmt: skip
    if layout.position:
        kind = "Plan from above" if layout.planar else "World"
        title = f"estimate amber with 3σ{truth}, before the update grey"
        if layout.particles:
            title = f"particles blue (light) to amber (heavy), modes yellow{truth}"
        elif layout.matched:
            title = "moved cloud amber, fixed grey, pairs blue (near) to red (far)"
        first.append(_world(layout, f"{kind} [m]: {title}"))
    second: list[_Item] = [*pictures.views(layout)]
    if layout.attitude and not layout.matched:
        title = f"Attitude: estimate amber{truth}{', sigma points on the sphere' if points else ''}"
        (second if layout.position else first).append(_scene(schema.ATTITUDE, title, 1.0))
    for name, space in layout.sensors.items():
        if own_scene(layout, name):
            colour, _ = schema.sensor_colour(layout.place(name))
            title = f"{name}, body axes{_unit(space, 0, space.units)}: measured {colour}, predicted amber"
            second.append(_scene(schema.sensor(name), title, layout.reach[name]))
    if second:
        first.append(rrb.Tabs(*second, active_tab=0) if len(second) > 1 else second[0])
    return first


def _world(layout: Layout, name: str) -> rrb.Spatial3DView:
    """The world, whole at first; a plan is seen from above. The estimate's trail reaches back to the start."""
    assert layout.extent
    (x, y, z), reach = layout.extent
    if layout.planar:
        eye = rrb.EyeControls3D(position=[x, y, 2.9 * reach], look_target=[x, y, 0], eye_up=[0, 1, 0], kind="Orbital")
    else:
        place = [x + 1.3 * reach, y - 1.6 * reach, z + 1.1 * reach]
        eye = rrb.EyeControls3D(position=place, look_target=[x, y, z], eye_up=[0, 0, 1], kind="Orbital")
    start, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    since = [rrb.VisibleTimeRange(timeline, start=start, end=now) for timeline in ("step", "time", "stage")]
    return rrb.Spatial3DView(
        origin=schema.WORLD,
        name=name,
        eye_controls=eye,
        line_grid=rrb.LineGrid3D(visible=True, spacing=_round(reach / 4), color=(45, 46, 50)),
        background=_BACKGROUND,
        overrides={f"{schema.WORLD}/estimate/trail": [rrb.VisibleTimeRanges(since)]},
    )


def _scene(origin: str, name: str, size: float) -> rrb.Spatial3DView:
    eye = rrb.EyeControls3D(
        position=[1.6 * size, -1.9 * size, 1.1 * size], look_target=[0, 0, 0], eye_up=[0, 0, 1], kind="Orbital"
    )
    return rrb.Spatial3DView(origin=origin, name=name, eye_controls=eye, line_grid=False, background=_BACKGROUND)


def _probabilities() -> rrb.Container:
    axis = rrb.ScalarAxis(range=(0.0, 1.0))
    return rrb.Vertical(graph("probability", "labels", "Probability of each label", axis, legend=True), name="Belief")


def _health(layout: Layout) -> list[_Item]:
    """Is the filter right, and does it know: errors, innovations, NIS; in two tabs where one would be crowded."""
    errors: list[_Item] = []
    for name, part in layout.space.parts.items():
        if name in layout.true_parts:
            views = [
                graph("error", f"{name}.{axis}", f"{_titled(name, axis)} error{_unit(part, i)} ±3σ")
                for i, axis in enumerate(part.axes)
            ]
            errors += _rows(views)
    what = " innov." if len(layout.sensors) < 4 else ""  # four in a row leave no place for the word
    views = [
        graph("innovation", f"{name}.{axis}", f"{_titled(name, axis)}{what}{_unit(space, i)} ±3σ")
        for name, space in layout.sensors.items()
        for i, axis in enumerate(space.axes)
    ]
    widths = [len(space.axes) for space in layout.sensors.values()]
    innovations = _rows(views, widths)
    if layout.sensors:
        bands = []
        for name, space in layout.sensors.items():
            dof = len(space.axes)
            axis = rrb.ScalarAxis(range=(0.0, 3 * band(dof)[1]))
            title = f"NIS {name}: {dof} expected, 95 % between the lines" if len(layout.sensors) < 3 else f"NIS {name}"
            bands.append(graph("nis", name, title, axis))
        innovations += _rows(bands)
    if len(errors) + len(innovations) > _MANY and errors and innovations:
        return [rrb.Vertical(*innovations, name="Innovations"), rrb.Vertical(*errors, name="Errors")]
    rows = [*errors, *innovations] or _sigmas(layout)
    return [rrb.Vertical(*rows, name="Consistency")]


def _figures(layout: Layout) -> list[_Item]:
    """The single numbers of stages, over time."""
    views = [
        graph("figure", f"{stage}.{field}", f"{stage}: {field}")
        for stage, fields in layout.stages.items()
        for field, what in fields.items()
        if what.get("shape") == []
    ]
    return [rrb.Vertical(*_rows(views, [1] * len(views)), name="Figures")] if views else []


def _state(layout: Layout) -> rrb.Container:
    """What the filter says: every component of the state, and its σ."""
    rows: list[_Item] = []
    for name, part in layout.space.parts.items():
        views = [
            graph(
                "state", f"{name}.{component}", f"{_titled(name, component)}{_unit(part, i, part.units)}", legend=i == 0
            )
            for i, component in enumerate(part.names)
        ]
        rows += _rows(views)
    rows += _rows(_sigmas(layout))
    return rrb.Vertical(*rows, name="State")


def _moved(layout: Layout) -> list[_Item]:
    """Which reading moved which direction of the state, in σ of the state before."""
    if not any("gain" in fields for fields in layout.stages.values()):
        return []
    rows: list[_Item] = []
    for name, part in layout.space.parts.items():
        views = [
            graph("moved", f"{name}.{axis}", f"K·ν on {_titled(name, axis)} [σ before]", legend=not rows and i == 0)
            for i, axis in enumerate(part.axes)
        ]
        rows += _rows(views)
    return [rrb.Vertical(*rows, name="What moved it")]


def _rows(views: Sequence[_Item], widths: list[int] | None = None) -> list[_Item]:
    """The views in rows of at most four; those that belong together (`widths` of them) stay in one row."""
    groups: list[list[_Item]] = []
    start = 0
    for width in widths or [len(views)]:
        group = list(views[start : start + width])
        start += width
        if groups and len(groups[-1]) + width <= 4 and width < 3:
            groups[-1] += group
        else:
            across = 3 if width % 3 == 0 else 4
            groups += [group[i : i + across] for i in range(0, width, across)]
    return [rrb.Horizontal(*group) for group in groups]


def _sigmas(layout: Layout) -> list[_Item]:
    return [graph("sigma", name, f"{name} σ{_unit(part)}", legend=True) for name, part in layout.space.parts.items()]


def graph(
    group: str, component: str, name: str, axis: rrb.ScalarAxis | None = None, *, legend: bool = False
) -> rrb.TimeSeriesView:
    """One plot of a group, in step with all others."""
    return rrb.TimeSeriesView(
        origin=schema.plot(group, component),
        name=name,
        axis_y=axis,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
    )


def _titled(name: str, axis: str) -> str:
    """`accel x`, but `range/1` or `heading` alone where the axis adds nothing."""
    return name if axis in (name.partition("/")[0], "angle") else f"{name} {axis}"


def _unit(space: Space, i: int = 0, units: tuple[str, ...] | None = None) -> str:
    unit = (units or space.axis_units)[i]
    return f" [{'deg' if unit == 'rad' else unit}]" if unit else ""


def _round(length: float) -> float:
    """A round number near a length, for a grid."""
    power = 10.0 ** int(f"{length:e}".partition("e")[2])
    return power * min((1.0, 2.0, 5.0, 10.0), key=lambda nice: abs(nice - length / power))
