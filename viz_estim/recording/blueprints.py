"""The view: a pure function of what a recording holds."""

from __future__ import annotations

import rerun.blueprint as rrb

from viz_estim.recording import eyes, pictures, plot_tabs, schema
from viz_estim.recording.layout import Layout
from viz_estim.recording.plot_tabs import unit_of
from viz_estim.recording.scenes import own_scene

_Item = rrb.Container | rrb.View
_BACKGROUND = [13, 14, 16]


def build(layout: Layout) -> rrb.Blueprint:
    """Scenes at the left, plots in tabs at the right, lanes and notes below."""
    scenes = _scenes(layout)
    plots = rrb.Tabs(*plot_tabs.tabs(layout), name="plots", active_tab=0)
    lanes = plot_tabs.lanes(schema.LANES, "Lanes: stage, and what became of each sensor's reading")
    notes = rrb.TextDocumentView(origin=schema.NOTES, name="What to look at")
    left: list[_Item] = [*scenes, notes]
    shares: list[float] = {1: [1.0], 2: [2.1, 1.0], 3: [3.0, 1.9, 2.0]}[len(left)]
    if layout.camera:
        shares = [2.0, 2.2, 2.1]  # the unrolled sphere is twice as wide as high
    low = plot_tabs.lanes_share(plot_tabs.lanes_of(layout))
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
            said += ", yellow each of several modes; particles are blue where they are light, amber where heavy"
        if layout.matched:
            said += ", grey points the fixed cloud"
        elif layout.attitude:
            said += ", each sensor has its own; red, green and blue are the axes x, y, z"
        elif not layout.particles:
            said += ", each sensor has its own"
    colours = f"**Colours:** {said}. On the `stage` timeline each stage shows what it alone drew."
    return colours if layout.explained or layout.labels or layout.matched else f"{_guide(layout)}\n\n{colours}"


def _guide(layout: Layout) -> str:
    """How the first tab is read, where nobody says what to look at."""
    said = ["An **error** outside its grey ±3σ: the filter is surer than it has reason to be."] * bool(
        layout.true_parts
    )
    if layout.particles:
        said.append("A cloud of few distinct particles is as good as lost.")
    else:
        said += [
            "**NIS** mostly above its upper line says the same, mostly near 0 that it trusts its readings too little.",
            "An innovation off zero on one side: something systematic is left out.",
            "*What moved it* says which reading pulled the estimate.",
        ]
    return " ".join(said)


def _scenes(layout: Layout) -> list[_Item]:
    """At most two panels: places in the world, or the bars of a belief over labels; attitudes and sensors below."""
    points = any("points" in what for fields in layout.stages.values() for what in fields.values())
    truth = ", truth white" if layout.true_parts else ""
    first: list[_Item] = []
    if layout.labels:
        name = "Belief: the probability of each label at this moment"
        first.append(rrb.Spatial3DView(
            origin=schema.BARS, name=name, eye_controls=eyes.bars(len(layout.labels)), line_grid=False,
            background=_BACKGROUND,
        ))  # fmt: skip
    if layout.position:
        assert layout.extent
        # Of more than 64 letters the last are out of sight where a window is 1280 wide.
        title = f"estimate amber with 3σ, prior grey{truth}"
        if layout.particles:
            title = f"weight blue to amber, modes yellow{truth}"
        elif layout.matched:
            title = "moved amber, fixed grey, pairs blue (near) to red"
        first.append(_world(layout, f"{eyes.spacing(layout.extent[1]):g} m grid: {title}"))
    second: list[_Item] = [*pictures.views(layout)]
    if layout.attitude and not layout.matched:
        title = f"Attitude: estimate amber{truth}{', sigma points on the sphere' if points else ''}"
        (second if layout.position else first).append(_scene(schema.ATTITUDE, title, 1.0))
    for name, space in layout.sensors.items():
        if own_scene(layout, name):
            colour, _ = schema.sensor_colour(layout.place(name))
            title = f"{name}{unit_of(space, 0, space.units)}: measured {colour}, predicted amber"
            second.append(_scene(schema.sensor(name), title, 0.87 * layout.reach[name]))  # it has no axes outside
    if second:
        first.append(rrb.Tabs(*second, active_tab=0) if len(second) > 1 else second[0])
    return first


def _world(layout: Layout, name: str) -> rrb.Spatial3DView:
    """The world, whole at first; a plan is seen from above. Trails reach back to the start."""
    assert layout.extent
    centre, reach = layout.extent
    eye = eyes.above(centre, 2.5 * reach) if layout.planar else eyes.aside(centre, layout.half_sizes)
    start, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    since = [rrb.VisibleTimeRange(timeline, start=start, end=now) for timeline in ("step", "time", "stage")]
    return rrb.Spatial3DView(
        origin=schema.WORLD,
        name=name,
        eye_controls=eye,
        line_grid=eyes.ground(reach),
        background=_BACKGROUND,
        overrides={f"{schema.WORLD}/{of}/trail": [rrb.VisibleTimeRanges(since)] for of in ("estimate", "truth")},
    )


def _scene(origin: str, name: str, size: float) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin=origin, name=name, eye_controls=eyes.around(size), line_grid=False, background=_BACKGROUND
    )
