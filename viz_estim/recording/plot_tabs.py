"""The plots over time, in tabs: is the filter right and does it know, single numbers, the state, what moved it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import rerun.blueprint as rrb
from rerun.encodings import TimeRange

from viz_estim.core.consistency import band
from viz_estim.core.descriptions import describe
from viz_estim.core.spaces import Euclidean, Space
from viz_estim.recording import schema
from viz_estim.recording.figure_names import COUNTED, figure_names, figures_once
from viz_estim.recording.layout import Layout
from viz_estim.recording.lines import sigma_plots

_Item = rrb.Container | rrb.View
_READABLE = 3  # rows of plots in a tab: of more, the axes have room for no number but 0
_MINUTE = 60.0  # s
_SMALL = 652  # pixels that views have above one another in a window 720 high
_LANE, _LANES_HEAD = 40, 48  # pixels of a lane with its name, and of what stands above all
_TABS_HEAD, _PLOT_HEAD = 28, 45  # pixels of the tabs' names, and of what stands above and below a plot's axis
_NAMED, _INSIDE = 20, 0.87  # pixels from which on a step of a power of ten is named; the axis without its edges
_TOPS = {"converged": 1}
_ERRORS = 3  # in a row, of parts of one or two axes


def lanes(origin: str, name: str) -> rrb.StateTimelineView:
    """Lanes, of the whole run."""
    return rrb.StateTimelineView(origin=origin, name=name, time_view=_whole_run())


def lanes_of(layout: Layout) -> int:
    """How many a run has: the stages, its inputs, and the truth of labels."""
    return len(layout.inputs) + 1 + bool(layout.labels)


def lanes_share(count: int) -> float:
    """The share of the height at which so many lanes are whole in a small window, up to half of it."""
    return min(0.5, (_LANES_HEAD + _LANE * count) / _SMALL)


def show_all(item: _Item, duration: float) -> _Item:
    """The same, where plots show the whole of a long run. Plots that are linked, so that they zoom together, show a
    minute around the cursor, half of which is empty at first."""
    if duration > _MINUTE:
        for view in _views(item):
            if isinstance(view, rrb.TimeSeriesView):
                view.properties["TimeAxis"] = _whole_run()
    return item


def _views(item: _Item) -> list[rrb.View]:
    return [view for inner in item.contents for view in _views(inner)] if isinstance(item, rrb.Container) else [item]


def _whole_run() -> rrb.TimeAxis:
    whole = TimeRange(start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite())
    return rrb.TimeAxis(link="Independent", view_range=whole)


def tabs(layout: Layout) -> list[_Item]:
    """All tabs, the one that says most first."""
    return [show_all(_with_axes(tab, layout), layout.duration) for tab in _tabs(layout)]


def _with_axes(tab: _Item, layout: Layout) -> _Item:
    """The same with the axes that were asked for, as high as the tab's rows are."""
    rows = len([*tab.contents]) if isinstance(tab, rrb.Container) else 1
    height = (1 - lanes_share(lanes_of(layout))) * _SMALL - _TABS_HEAD
    small = _INSIDE / _NAMED * (height / rows - _PLOT_HEAD)
    for view in _views(tab):
        if axis := layout.ranges.asked(str(view.origin), rows, small):
            view.properties["ScalarAxis"] = axis
    return tab


def _tabs(layout: Layout) -> list[_Item]:
    if layout.labels:
        return [rrb.Vertical(probabilities(), name="Belief")]
    health, figures = _health(layout), _figures(layout)
    # A registration's fit says more than its errors; without a truth there is no error at all.
    first = [*figures, *health] if layout.matched or not layout.true_parts else [*health[:1], *figures, *health[1:]]
    return [*first, *_state(layout), *_moved(layout)]


def probabilities() -> rrb.TimeSeriesView:
    """Of each label; the bars beside it are its legend."""
    name = "Probability of each label, in the colour of its bar"
    return graph("probability", "labels", name, rrb.ScalarAxis(range=(-0.02, 1.02)))


def _health(layout: Layout) -> list[_Item]:
    """Is the filter right, and does it know: errors, innovations, NIS; the innovations in a tab of their own where one
    would be crowded, and NIS with them where the errors alone crowd one."""
    parts = {name: part for name, part in layout.space.parts.items() if name in layout.true_parts}
    bands: list[_Item] = []
    for name, space in layout.sensors.items():
        dof = len(space.axes)
        axis = layout.ranges.upward(schema.plot("nis", name), 3 * band(dof)[1])
        title = f"NIS {name}: {dof} expected, 95 % between the lines" if len(layout.sensors) < 3 else f"NIS {name}"
        bands.append(graph("nis", name, title, axis))
    nis = _rows(bands)
    whole, bounds = "Consistency", ", ±3σ grey"
    beside_nis = len(_groups(_widths(parts), _ERRORS)) + len(nis)  # rows
    in_one = beside_nis + len(_groups(_widths(layout.sensors))) <= _READABLE
    in_two = bool(parts) and beside_nis <= _READABLE
    # In a tab of their own the tab says what they are; and four in a row leave no place for the word.
    errors = _each(layout, "error", parts, " error" if in_one or in_two else "", most=_ERRORS)
    what = " innov." if in_one and len(layout.sensors) < 4 else ""
    innovations = _each(layout, "innovation", layout.sensors, what)
    if in_one:
        rows = [*errors, *innovations, *nis]
        return [rrb.Vertical(*rows, name=whole + bounds)] if rows else []
    if in_two:
        return [
            rrb.Vertical(*errors, *nis, name=whole + bounds),
            *_in_tabs(innovations, "Innovations" + bounds, "Innovations"),
        ]
    return [
        *_in_tabs([*innovations, *nis], "Innovations" + bounds, "Innovations"),
        *_in_tabs(errors, "Errors" + bounds, "Errors"),
    ]


def _each(layout: Layout, group: str, parts: Mapping[str, Space], what: str, most: int = 4) -> list[_Item]:
    """Rows of a plot for each axis; what: the word for what is shown of it."""
    views: list[_Item] = [
        _framed(layout, group, f"{name}.{axis}", f"{titled(name, axis)}{what}{unit_of(part, i)}")
        for name, part in parts.items()
        for i, axis in enumerate(part.axes)
    ]
    return _rows(views, _widths(parts), most)


def _widths(parts: Mapping[str, Space]) -> list[int]:
    return [len(part.axes) for part in parts.values()]


def _figures(layout: Layout) -> list[_Item]:
    """The single numbers of stages, over time: one below the other, so that their times are."""
    views: list[_Item] = []
    by_stage = {s: [f for f, what in fs.items() if what.get("shape") == []] for s, fs in layout.stages.items()}
    for stage, numbers in figures_once(by_stage).items():
        named = figure_names(numbers, fit=layout.matched, particles=layout.particles or None)
        for field, words in named.items():
            top = _TOPS.get(field) if layout.matched else layout.particles if field in COUNTED else None
            axis = rrb.ScalarAxis(range=(-0.03 * top, 1.03 * top)) if top else None
            views.append(_framed(layout, "figure", f"{stage}.{field}", f"{stage}: {words}", axis))
    across = -(-len(views) // _READABLE)
    rows = [rrb.Horizontal(*views[i : i + across]) for i in range(0, len(views), max(across, 1))]
    return [rrb.Vertical(*rows, name="Figures")] if rows else []


def _state(layout: Layout) -> list[_Item]:
    """What the filter says: every component of the state, and its σ beneath, or where that is much in tabs apart."""
    parts = layout.space.parts.items()
    views = [
        _framed(layout, "state", f"{name}.{component}", f"{titled(name, component)}{unit_of(part, i, part.units)}")
        for name, part in parts
        for i, component in enumerate(part.names)
    ]
    rows = _rows(views, [len(part.names) for _, part in parts], most=3)
    sigmas = _rows(_sigmas(layout))
    colours = ["estimate amber", *(["truth white"] if layout.true_parts else []), *_readings(layout)]
    name = f"State: {', '.join(colours)}"
    if len(rows) + len(sigmas) <= _READABLE:
        return [rrb.Vertical(*rows, *sigmas, name=name)]
    return [*_in_tabs(rows, name, "State"), rrb.Vertical(*sigmas, name="σ")]


def _readings(layout: Layout) -> list[str]:
    """The sensors that read a part of the state as it is, each with its colour's name."""
    parts = [describe(part) for part in layout.space.parts.values() if isinstance(part, Euclidean) and any(part.units)]
    return [
        f"{sensor} {schema.sensor_colour(layout.place(sensor))[0]}"
        for sensor, space in layout.sensors.items()
        if describe(space) in parts
    ]


def _moved(layout: Layout) -> list[_Item]:
    """Which reading moved which direction of the state, in σ of the state before."""
    if not any("gain" in fields for fields in layout.stages.values()):
        return []
    parts = layout.space.parts.items()
    views: list[_Item] = []
    for name, part in parts:
        for axis in part.axes:
            views.append(
                _framed(layout, "moved", f"{name}.{axis}", f"K·ν on {titled(name, axis)} [σ]", legend=not views)
            )
    rows = _rows(views, [len(part.axes) for _, part in parts], most=3)
    return _in_tabs(rows, "What moved it, in σ before", "What moved it")


def _in_tabs(rows: list[_Item], first: str, others: str) -> list[_Item]:
    """Rows in as many tabs as keep them readable."""
    count = -(-len(rows) // _READABLE)
    size = -(-len(rows) // max(count, 1))
    parts = [rows[i : i + size] for i in range(0, len(rows), size)] if rows else []
    return [rrb.Vertical(*part, name=f"{others} {i}" if i > 1 else first) for i, part in enumerate(parts, 1)]


def _rows(views: Sequence[_Item], widths: list[int] | None = None, most: int = 4) -> list[_Item]:
    """The views in rows, those that belong together (`widths` of them) as `_groups` puts them."""
    return [rrb.Horizontal(*(views[i] for i in group)) for group in _groups(widths or [len(views)], most)]


def _groups(widths: list[int], most: int = 4) -> list[list[int]]:
    """By row the numbers of its views, at most four; those that belong together stay in one row, and few of them join
    the row before if that makes at most `most`."""
    groups: list[list[int]] = []
    start = 0
    for width in widths:
        group = list(range(start, start + width))
        start += width
        if groups and len(groups[-1]) + width <= most and width < 3:
            groups[-1] += group
        else:
            across = 3 if width % 3 == 0 or width == 5 else 4
            groups += [group[i : i + across] for i in range(0, width, across)]
    return groups


def _sigmas(layout: Layout) -> list[_Item]:
    """The σ of each part, one line a direction; a legend where the directions are others than in the plot before."""
    views: list[_Item] = []
    named: tuple[str, ...] = ()
    for name, part in layout.space.parts.items():
        for plot, at in sigma_plots(name, part).items():
            axes = tuple(part.axes[i] for i in at)
            several = len(axes) > 1
            views.append(
                _framed(layout, "sigma", plot, f"{name} σ{unit_of(part, at[0])}", legend=several and axes != named)
            )
            named = axes if several else named
    return views


def _framed(
    layout: Layout, group: str, component: str, name: str, axis: rrb.ScalarAxis | None = None, *, legend: bool = False
) -> rrb.TimeSeriesView:
    """A plot whose axis, unless it is given, shows most of its values; of some the jumps are what they have to say."""
    jumps = [10.0] * (group in ("moved", "figure"))
    if axis is None:
        layout.ranges.ask(schema.plot(group, component), *jumps)
    return graph(group, component, name, axis, legend=legend)


def graph(
    group: str, component: str, name: str, axis: rrb.ScalarAxis | None = None, *, legend: bool = False
) -> rrb.TimeSeriesView:
    """One plot of a group, in step with all others."""
    return rrb.TimeSeriesView(
        origin=schema.plot(group, component),
        name=name,
        axis_y=axis,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        # Most is settled at the end: at the start a legend would hide how it began.
        plot_legend=rrb.PlotLegend("RightTop", visible=legend),
    )


def titled(name: str, axis: str) -> str:
    """`accel x`, but `range/1` or `heading` alone where the axis adds nothing, and `range0` where the name does,
    or where it is `state`, as what has no parts is called."""
    if axis in (name.partition("/")[0], "angle"):
        return name
    axis = axis.removesuffix(".angle")
    return axis if name == "state" or re.fullmatch(rf"{re.escape(name)}\d+", axis) else f"{name} {axis}"


def unit_of(space: Space, i: int = 0, units: tuple[str, ...] | None = None) -> str:
    unit = (units or space.axis_units)[i]
    return f" [{'deg' if unit == 'rad' else unit}]" if unit else ""
