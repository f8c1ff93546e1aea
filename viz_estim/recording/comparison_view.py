"""The view of a comparison: the runs' scenes side by side under one eye, and below them what they did over time."""

from __future__ import annotations

from itertools import groupby
from typing import Any

import numpy as np
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SE2, Space
from viz_estim.recording import schema
from viz_estim.recording.compared import Compared
from viz_estim.recording.layout import flat3, is_position, place_of
from viz_estim.recording.pictures import CANVAS, PANORAMA
from viz_estim.recording.sheet import Plot

_Item = rrb.Container | rrb.View
_PLAIN: dict[str, Any] = {"background": [13, 14, 16]}
_NO_SCENES = {"stages", "steps", "events", "lanes"}
_FEW = 3  # runs up to which a plot has room for their legend
_NAMES = {"attitude": "attitude", "world": "world [m]", "bars": "probabilities", "canvas": "mosaic [deg]"}
_TABS = {
    "difference": "Difference", "belief": "Belief", "error": "Errors", "state": "State, truth white", "sigma": "σ",
    "innovation": "Innovations", "nis": "NIS", "moved": "What moved it", "figure": "Figures",
}  # fmt: skip


class Scenes:
    """What the recordings draw in space, learnt from their chunks: by scene (`/world`, `/sensors/accel`), which runs
    move something in it; truths: the scenes that have the first run's truth; standing: places (M, 3) in the world of
    what stands still; sizes: a sphere's radius, or the height of an unrolled one."""

    def __init__(self) -> None:
        self.runs: dict[str, list[int]] = {}
        self.truths: set[str] = set()
        self.panorama = False  # the true one
        self.standing: list[Array] = []
        self.sizes: dict[str, float] = {}

    def learn(self, run: Compared, chunk: Chunk) -> None:
        scene = scene_of(chunk.entity_path)
        if not scene:
            return
        parts = chunk.entity_path.strip("/").split("/")
        if not chunk.is_static and run.place not in self.runs.setdefault(scene, []):
            self.runs[scene].append(run.place)
        if run.place == 0 and parts[1:2] == ["truth"]:
            self.truths.add(parts[0])
        self.panorama |= run.place == 0 and scene == PANORAMA
        if chunk.is_static:
            self._learn_static(scene, chunk)

    def _learn_static(self, scene: str, chunk: Chunk) -> None:
        batch = chunk.to_record_batch()
        for name, n in (("Points3D:positions", 3), ("LineStrips3D:strips", 3), ("Ellipsoids3D:half_sizes", 3),
                        ("LineStrips2D:strips", 2)):  # fmt: skip
            if name in batch.schema.names:
                column = batch.column(name).flatten()
                while hasattr(column.type, "value_type"):
                    column = column.flatten()
                points = column.to_numpy().reshape(-1, n)
                if scene == schema.WORLD:
                    self.standing.append(points)
                elif not name.startswith("Points") and len(points):
                    self.sizes[scene] = max(self.sizes.get(scene, 0.0), float(points[:, 1].max()))


def scene_of(entity: str) -> str | None:
    """The scene that an entity belongs to; None where it is not drawn in space."""
    parts = entity.strip("/").split("/")
    if parts[0] in _NO_SCENES or (parts[0] == "sensors" and len(parts) < 2):
        return None
    return "/" + "/".join(parts[: 2 if parts[0] == "sensors" else 1])


def build(runs: list[Compared], scenes: Scenes, plots: list[Plot]) -> rrb.Blueprint:
    """Scenes above, by kind in tabs where there are several; plots beneath in tabs, with lanes and the figures."""
    above = _scenes(runs, scenes)
    beneath: list[_Item] = []
    for tab in _TABS:
        if members := [plot for plot in plots if plot.tab == tab]:
            beneath += _tabs(_TABS[tab], members, len(runs), named=bool(above))
    lanes = [
        rrb.StateTimelineView(
            origin=f"{run.path}{schema.LANES}", name=f"{run.title}: stage, and each sensor's readings"
        )
        for run in runs
    ]
    notes = rrb.TextDocumentView(origin=schema.NOTES, name="What was compared")
    beneath += [rrb.Grid(*lanes, grid_columns=1 if len(runs) <= 3 else 3, name="Lanes"), notes]
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
        views = [_view(scene, [one], runs[0], scenes, f"{one.title}: {word}", wide) for one in holders]
        if scene == CANVAS and scenes.panorama:
            views.append(_flat(f"{runs[0].path}{PANORAMA}", None, scenes.sizes.get(PANORAMA), "True world [deg]"))
            across = len(views) if len(views) <= 3 else -(-len(views) // 2)
        found.append(rrb.Grid(*views, grid_columns=across, name=word.capitalize()))
        if scene in (schema.WORLD, schema.ATTITUDE) and len(holders) > 1:
            title = ", ".join(one.title for one in holders)
            found.append(_view(scene, holders, runs[0], scenes, f"{word.capitalize()} overlaid: {title}", 4.2))
    return found


def _view(scene: str, holders: list[Compared], first: Compared, scenes: Scenes, name: str, wide: float) -> rrb.View:
    """A scene of one run, or of several in one; with the first run's truth where they share it. wide: by its height."""
    contents = []
    for one in holders:
        inside = f"{one.path}{scene}"
        contents += [f"+ {inside}/**"] if len(holders) == 1 else [f"+ {inside}/estimate/**", f"+ {inside}/moved/**"]
    if len(holders) > 1:
        contents += [f"+ {holders[0].path}{scene}/{what}/**" for what in ("scenery", "sphere")]
    if scene[1:] in scenes.truths and any(one.of_first for one in holders):
        contents.append(f"+ {first.path}{scene}/truth/**")
    origin = f"{holders[0].path}{scene}"
    if scene == CANVAS:
        return _flat(origin, contents, scenes.sizes.get(scene), name)
    trail: Any = {f"{one.path}{scene}/estimate/trail": [rrb.VisibleTimeRanges(_since_start())] for one in holders}
    return rrb.Spatial3DView(
        origin=origin, contents=contents, name=name, eye_controls=_eye(scene, holders, first, scenes, wide),
        line_grid=False,
        overrides=trail if scene == schema.WORLD else {}, **_PLAIN,
    )  # fmt: skip


def _flat(origin: str, contents: list[str] | None, height: float | None, name: str) -> rrb.View:
    """An unrolled sphere, whole: twice as wide as high."""
    bounds = None
    if height:
        room = 0.02 * height
        bounds = rrb.VisualBounds2D(x_range=[-room, 2 * height + room], y_range=[-room, height + room])
    return rrb.Spatial2DView(
        origin=origin, contents=contents or "$origin/**", name=name, visual_bounds=bounds, **_PLAIN
    )  # fmt: skip


def _since_start() -> list[rrb.VisibleTimeRange]:
    start, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    return [rrb.VisibleTimeRange(timeline, start=start, end=now) for timeline in ("step", "time", "stage")]


def _eye(scene: str, holders: list[Compared], first: Compared, scenes: Scenes, wide: float) -> rrb.EyeControls3D:
    """The same for all runs: the first's places decide."""
    if scene == schema.BARS:
        count = max(len(one.run.labels) for one in holders)
        middle = 0.5 * schema.BAR * (count - 1)
        return rrb.EyeControls3D(
            position=[middle, 0.45, 1.3 + 0.35 * count], look_target=[middle, 0.45, 0], eye_up=[0, 1, 0], kind="Orbital"
        )
    if scene != schema.WORLD:
        size = scenes.sizes.get(scene, 1.0)
        place = [1.6 * size, -1.9 * size, 1.1 * size]
        return rrb.EyeControls3D(position=place, look_target=[0, 0, 0], eye_up=[0, 0, 1], kind="Orbital")
    places = _places(first) if _position(first) else _places(holders[0])
    points = np.concatenate([places, *scenes.standing])
    points = points[np.isfinite(points).all(1)]
    low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(3), np.ones(3))
    (x, y, z), reach = 0.5 * (low + high), max(0.5, float(0.5 * np.abs(high - low).max()))
    if low[2] == high[2]:
        # The eye sees about as much upwards as it is away, and `wide` times that across; a fifth is left as a margin.
        height = 1.25 * max(1.0, (high - low)[1], (high - low)[0] / wide)
        return rrb.EyeControls3D(position=[x, y, height], look_target=[x, y, 0], eye_up=[0, 1, 0], kind="Orbital")
    place = [x + 1.5 * reach, y - 1.85 * reach, z + 1.25 * reach]
    return rrb.EyeControls3D(position=place, look_target=[x, y, z], eye_up=[0, 0, 1], kind="Orbital")


def _position(one: Compared) -> tuple[str, Space] | None:
    parts = one.space.parts.items()
    return next(((name, part) for name, part in parts if is_position(part) or isinstance(part, SE2)), None)


def _places(one: Compared) -> Array:
    """Where the body was (M, 3): by the truth if there is one, else by the estimate without its wildest hundredth."""
    found = _position(one)
    if found is None:
        return np.empty((0, 3))
    name, part = found
    for values, wild in ((one.run.truth, 0.0), (one.run.mean, 0.01)):
        place = flat3(place_of(part, values[:, one.space.at[name]]))
        place = place[np.isfinite(place).all(1)]
        if len(place):
            return np.quantile(place, [wild, 1 - wild], axis=0)
    return np.empty((0, 3))


def _tabs(title: str, plots: list[Plot], runs: int, *, named: bool) -> list[_Item]:
    """Plots in rows, those of one part of the state together; in as many tabs as keep them readable.

    One legend a tab, in its first plot; of many runs where it has a row for itself, or where no scene above names them.
    """
    rows: list[tuple[str, list[Plot]]] = []
    for name, members in groupby(plots, key=lambda plot: plot.row):
        views = list(members)
        if rows and len(rows[-1][1]) + len(views) <= 4 and len(views) < 3:
            rows[-1] = (f"{rows[-1][0]}, {name}", rows[-1][1] + views)
            continue
        across = 3 if len(views) % 3 == 0 else 4
        rows += [(name, views[i : i + across]) for i in range(0, len(views), across)]
    count = -(-len(rows) // (3 if runs <= _FEW else 2))
    size = -(-len(rows) // count)
    found: list[_Item] = []
    for i in range(0, len(rows), size):
        some = rows[i : i + size]
        legend = runs <= _FEW or len(some[0][1]) == 1 or not named
        names = ", ".join(dict.fromkeys(name for name, _ in some))
        lines = [
            rrb.Horizontal(*(_plot(plot, legend=legend and plot is some[0][1][0]) for plot in members))
            for _, members in some
        ]
        found.append(rrb.Vertical(*lines, name=f"{title}: {names}" if count > 1 else title))
    return found


def _plot(plot: Plot, *, legend: bool) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=plot.path,
        name=plot.title,
        axis_y=None if plot.top is None else rrb.ScalarAxis(range=(0.0, plot.top)),
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
    )
