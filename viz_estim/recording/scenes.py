"""What the stages draw in space, by the types of their fields: sigma points, readings, what an update moved."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from viz_estim.core.descriptions import describe
from viz_estim.core.quaternions import Array
from viz_estim.core.scenery import Landmarks
from viz_estim.core.spaces import S2, SE2, SO3, Euclidean
from viz_estim.recording import schema
from viz_estim.recording.batch import Batch, StageRows
from viz_estim.recording.bodies import Bodies, sphere, tips
from viz_estim.recording.columns import Style, Times, send_static
from viz_estim.recording.layout import Layout, as_product, flat3, is_position, leaves, place_of
from viz_estim.recording.readings import told
from viz_estim.recording.standing import Standing


class Scenes:
    """Draws batches into the spatial views of a stream."""

    def __init__(
        self, stream: rr.RecordingStream, layout: Layout, bodies: Bodies, standing: Standing, every: int
    ) -> None:
        self._stream, self._layout, self._bodies, self._every = stream, layout, bodies, every
        self._standing = standing
        self._spheres: set[str] = set()
        self._drew: dict[tuple[str, str], bool] = {}  # by stage and field of points: whether it last drew its own
        landmarks = [thing for thing in layout.scenery.values() if isinstance(thing, Landmarks)]
        self._landmarks = {
            label: flat3(np.asarray(place, float))
            for one in landmarks
            for label, place in zip(one.labels, one.positions, strict=True)
        }

    def add(self, batch: Batch) -> None:
        for rows in batch.stages:
            kept = np.flatnonzero(rows.at.step % self._every == 0)
            if len(kept):
                at = rows.at.pick(kept) if len(kept) < len(rows.at) else rows.at
                for field, what in self._layout.stages[rows.name].items():
                    if "points" in what:
                        self._draw_points(rows, field, at, kept, what.get("same_as"))
                    elif "innovation" in what:
                        self._draw_readings(rows, field, at, kept)
                        if self._layout.position and rows.has_prior.all():
                            self._draw_moved(rows, field, at, kept)

    def _draw_points(self, rows: StageRows, field: str, at: Times, kept: np.ndarray, same_as: Any) -> None:
        """Sigma points: places in the world, an attitude's as tips of the body's axes on the sphere, a sensor's in its
        own space. Those that the stage before has drawn already stand on."""
        shared = rows.shared(field, *same_as)[kept] if same_as else np.zeros(len(kept), bool)
        if not shared.all():
            own = np.flatnonzero(~shared)
            self._draw_own_points(rows, field, at if not shared.any() else at.pick(own), kept[own])
        if same_as:
            self._standing.also(rows.name, same_as[0], same_as[1])
            ends = shared & np.concatenate([[self._drew.get((rows.name, field), False)], ~shared[:-1]])
            if ends.any():
                self._standing.take_away(rows.name, field, at.pick(np.flatnonzero(ends)))
        self._drew[rows.name, field] = not shared[-1]

    def _draw_own_points(self, rows: StageRows, field: str, at: Times, kept: np.ndarray) -> None:
        points = rows.some(f"{field}.points", kept)
        space = as_product(getattr(rows.stages[0], field).space)
        count = points.shape[1]
        faint = 0.55 if field == "drawn" else 1.0  # what a prediction starts from stands back
        of_state = describe(self._layout.space) in (describe(space), describe(space.parts.get("state", space)))
        for name, part, where in leaves(space):
            x = points[..., where]
            if isinstance(part, SO3) and name == self._layout.attitude:
                colours = [tuple(shade) for shade in (faint * np.array(schema.AXES)).astype(int)] * count
                style = Style(rr.Points3D, colors=colours, radii=[0.014 / faint**0.5])
                path = f"{schema.ATTITUDE}/{schema.as_part(rows.name)}/{field}"
                self._standing.draw(rows.name, field, path, at, style, 3 * count, positions=tips(x))
            elif name == self._layout.position:
                colour = tuple((faint * np.array(schema.ESTIMATE)).astype(int))
                style = Style(rr.Points3D, colors=[colour], radii=[-2.5])
                path = schema.drawn(rows.name, field)
                self._standing.draw(rows.name, field, path, at, style, count, positions=flat3(place_of(part, x)))
            elif not of_state and name in self._layout.sensors and own_scene(self._layout, name):
                size = self._layout.reach[name]
                style = Style(rr.Points3D, colors=[schema.ESTIMATE], radii=[0.014 * size])
                path = f"{schema.sensor(name)}/{schema.as_part(rows.name)}/{field}"
                self._standing.draw(rows.name, field, path, at, style, count, positions=x)

    def _draw_readings(self, rows: StageRows, field: str, at: Times, kept: np.ndarray) -> None:
        """A reading where it belongs: a place or a range in the world, three components as an arrow in a scene of the
        sensor's own, beside what was expected."""
        space = getattr(rows.stages[0], field).space
        z = rows.some(f"{field}.z", kept)
        for name in space.parts:
            colour = schema.sensor_colour(self._layout.place(name))[1]
            mine = z[:, space.at[name]]
            if self._reads_place(name):
                style = Style(rr.Points3D, colors=[colour], radii=[-4.0])
                path = schema.drawn(rows.name, name)
                assert self._layout.position
                known = told(self._layout, rows, field, name, self._layout.position)[kept]
                places = flat3(mine[known, : 2 if self._layout.planar else 3])
                self._standing.draw(rows.name, field, path, at, style, known.astype(int), positions=places)
            elif own_scene(self._layout, name):
                expected = rows.some(f"{field}.predicted", kept)[:, space.at[name]]
                self._draw_arrows(rows.name, field, name, at, mine, expected, colour)
            else:
                self._draw_ranges(rows, field, name, at, kept, mine, colour)

    def _draw_arrows(
        self, stage: str, field: str, name: str, at: Times, z: Array, expected: Array, colour: schema.Colour
    ) -> None:
        path, size = schema.sensor(name), self._layout.reach[name]
        if path not in self._spheres:
            self._spheres.add(path)
            send_static(self._stream, f"{path}/sphere", sphere(size))
        for what, values, shade in (("measured", z, colour), ("predicted", expected, schema.ESTIMATE)):
            style = Style(rr.Arrows3D, colors=[shade], radii=[0.012 * size])
            self._standing.draw(stage, field, f"{path}/{schema.as_part(stage)}/{what}", at, style, 1, vectors=values)

    def _draw_ranges(
        self, rows: StageRows, field: str, name: str, at: Times, kept: np.ndarray, z: Array, colour: schema.Colour
    ) -> None:
        """Ranges to landmarks that bear the name of the target or of the component: from the landmark towards where
        the estimate was, as long as the reading; the gap to the estimate is the residual."""
        part = self._layout.sensors[name]
        targets = [name.rpartition("/")[2]] if "/" in name else list(part.names)
        if not (self._layout.position and rows.has_prior.all() and all(one in self._landmarks for one in targets)):
            return
        of = self._layout.space.parts[self._layout.position]
        estimate = flat3(place_of(of, rows.prior("mean")[kept][:, self._layout.space.at[self._layout.position]]))
        posts = np.stack([self._landmarks[one] for one in targets])  # (m, 3)
        towards = estimate[:, None, :] - posts
        length = np.linalg.norm(towards, axis=-1, keepdims=True)
        vectors = z[:, :, None] * towards / np.maximum(length, 1e-9)
        style = Style(rr.Arrows3D, colors=[colour], radii=[-1.5])
        origins = np.broadcast_to(posts, vectors.shape)
        path = schema.drawn(rows.name, name)
        self._standing.draw(rows.name, field, path, at, style, len(targets), vectors=vectors, origins=origins)

    def _draw_moved(self, rows: StageRows, field: str, at: Times, kept: np.ndarray) -> None:
        """The place's 3σ before the update, and the way that each component of the reading moved it: K[:, j]·ν_j."""
        layout = self._layout
        assert layout.position
        mean = rows.prior("mean")[kept]
        path = schema.drawn(rows.name, "before")
        self._bodies.draw_before(path, at)
        self._standing.add(rows.name, field, path, rr.Ellipsoids3D, "half_sizes")
        if "gain" not in layout.stages[rows.name]:
            return
        part, where = layout.space.parts[layout.position], layout.space.axes_at[layout.position]
        K, residual = rows.some("gain", kept), rows.some(f"{field}.residual", kept)
        moves = flat3(np.swapaxes(K[:, where, :] * residual[:, None, :], 1, 2)[..., : len(place_of(part, np.empty(3)))])
        if isinstance(part, SE2):
            turn = mean[:, layout.space.at[layout.position]][:, 2, None]
            c, s, x, y = np.cos(turn), np.sin(turn), moves[..., 0], moves[..., 1]
            moves = np.stack([c * x - s * y, s * x + c * y, 0 * x], axis=-1)
        start = flat3(place_of(part, mean[:, layout.space.at[layout.position]]))[:, None, :]
        origins = start + np.cumsum(moves, axis=1) - moves  # one after the other, from the old place to the new
        space = getattr(rows.stages[0], field).space
        colours = [schema.sensor_colour(layout.place(name))[1] for name, one in space.parts.items() for _ in one.axes]
        style = Style(rr.Arrows3D, colors=colours, radii=[-2.0])
        path = schema.drawn(rows.name, "moved")
        self._standing.draw(rows.name, field, path, at, style, len(colours), vectors=moves, origins=origins)

    def _reads_place(self, name: str) -> bool:
        """Whether the sensor reads the position itself, alone or before other things (as a pose does)."""
        position = self._layout.position
        if not position:
            return False
        space, part = self._layout.sensors[name], self._layout.space.parts[position]
        first = next(iter(getattr(space, "parts", {"": space}).values()))
        return describe(first) == describe(part) and (is_position(first) or isinstance(first, SE2))


def own_scene(layout: Layout, name: str) -> bool:
    """Whether a sensor's readings stand in a scene of their own: three components in the body, beside an attitude."""
    if not layout.attitude:
        return False
    space = layout.sensors[name]
    three = len(space.names) == 3 and isinstance(space, (Euclidean, S2))
    return three and not is_position(space)
