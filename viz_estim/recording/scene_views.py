"""Scenes of recorded runs as views, one run each or several in one, learnt from the recordings' chunks."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SE2, Space
from viz_estim.recording import eyes, schema
from viz_estim.recording.compared import Compared
from viz_estim.recording.layout import flat3, is_position, place_of
from viz_estim.recording.pictures import CANVAS, PANORAMA

_PLAIN: dict[str, Any] = {"background": [13, 14, 16]}
_NO_SCENES = {"stages", "steps", "events", "lanes", "plots", "notes", "findings", "__properties"}


class Scenes:
    """What the recordings draw in space, learnt from their chunks: by scene (`/world`, `/sensors/accel`), which runs
    move something in it; truths: the scenes that have the first run's truth; standing: by run the places (M, 3) in the
    world of what stands still; sizes: by scene and run a sphere's radius, or the height of an unrolled one."""

    def __init__(self) -> None:
        self.runs: dict[str, list[int]] = {}
        self.truths: set[str] = set()
        self.panorama = False  # the true one
        self.standing: dict[int, list[Array]] = {}
        self.sizes: dict[tuple[str, int], float] = {}

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
            self._learn_static(scene, run.place, chunk)

    def _learn_static(self, scene: str, place: int, chunk: Chunk) -> None:
        batch = chunk.to_record_batch()
        for name, n in (("Points3D:positions", 3), ("LineStrips3D:strips", 3), ("Ellipsoids3D:half_sizes", 3),
                        ("LineStrips2D:strips", 2)):  # fmt: skip
            if name in batch.schema.names:
                column = batch.column(name).flatten()
                while hasattr(column.type, "value_type"):
                    column = column.flatten()
                points = column.to_numpy().reshape(-1, n)
                if scene == schema.WORLD:
                    self.standing.setdefault(place, []).append(points)
                elif not name.startswith("Points") and len(points):
                    size = float(points[:, 1].max())
                    self.sizes[scene, place] = max(self.sizes.get((scene, place), 0.0), size)


def scene_of(entity: str) -> str | None:
    """The scene that an entity belongs to; None where it is not drawn in space."""
    parts = entity.strip("/").split("/")
    if parts[0] in _NO_SCENES or (parts[0] == "sensors" and len(parts) < 2):
        return None
    return "/" + "/".join(parts[: 2 if parts[0] == "sensors" else 1])


def view(scene: str, holders: list[Compared], first: Compared, scenes: Scenes, name: str, wide: float) -> rrb.View:
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
        return flat(origin, contents, scenes.sizes.get((scene, holders[0].place)), name)
    trails = [*(f"{one.path}{scene}/estimate/trail" for one in holders), f"{first.path}{scene}/truth/trail"]
    trail: Any = {path: [rrb.VisibleTimeRanges(_since_start())] for path in trails}
    eye, ground = _eye(scene, holders, first, scenes, wide)
    return rrb.Spatial3DView(
        origin=origin, contents=contents, name=name, eye_controls=eye, line_grid=ground,
        overrides=trail if scene == schema.WORLD else {}, **_PLAIN,
    )  # fmt: skip


def flat(origin: str, contents: list[str] | None, height: float | None, name: str) -> rrb.View:
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


def _eye(
    scene: str, holders: list[Compared], first: Compared, scenes: Scenes, wide: float
) -> tuple[rrb.EyeControls3D, rrb.LineGrid3D | bool]:
    """Where a scene is seen from, and its ground. The same for all runs on the first's data, whose places decide, and
    each of another world by its own; round a sphere as far away as it is large."""
    if scene == schema.BARS:
        return eyes.bars(max(len(one.run.labels) for one in holders)), False
    if scene != schema.WORLD:
        return eyes.around(scenes.sizes.get((scene, holders[0].place), 1.0)), False
    whose = [first if one.of_first and _position(first) else one for one in holders]
    standing = [points for one in [*whose, *holders] for points in scenes.standing.get(one.place, [])]
    points = np.concatenate([*map(_places, whose), *standing])
    points = points[np.isfinite(points).all(1)]
    low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(3), np.ones(3))
    ground = eyes.ground(0.5 * float((high - low).max()))
    if low[2] == high[2]:
        # The eye sees about as much upwards as it is away, and `wide` times that across; a quarter is left as a margin.
        height = 1.32 * max(1.0, (high - low)[1], (high - low)[0] / wide)
        return eyes.above(0.5 * (low + high), height), ground
    return eyes.aside(0.5 * (low + high), 0.5 * (high - low)), ground


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
