"""Where and how the body is: estimate and truth, the way they came, the covariance's ellipse, and the scenery."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario
from viz_estim.core.scenery import Box, Landmarks, Path
from viz_estim.core.spaces import SE2
from viz_estim.recording import schema
from viz_estim.recording.batch import Batch
from viz_estim.recording.columns import Column, Style, Times, drawn, send, send_static
from viz_estim.recording.layout import Layout, flat3, place_of

_DEFAULT_BODY = (0.6, 0.4, 0.15)
_PATH: schema.Colour = (185, 185, 185)  # the truth's, thin and so less bright than what stands on it
_OVER = {"estimate": 0.004, "truth": 0.008}  # a planar body's height by the scene's width: particles don't hide it
_LINE, _TRAIL, _ARROW, _LANDMARK = -1.2, -1.5, -3.0, -5.0  # radii in points on the screen


class _Ellipsoids(NamedTuple):
    """Ellipsoids (M, …): where, how long, turned how (in Rerun's order), and whether they are known."""

    centers: Array
    half_sizes: Array
    quaternions: Array
    known: np.ndarray

    def pick(self, rows: Any) -> _Ellipsoids:
        return _Ellipsoids(*(values[rows] for values in self))


class Bodies:
    """Draws the estimate after each stage, and the truth once a step: an attitude in its own scene, places in the
    world's."""

    def __init__(self, stream: rr.RecordingStream, layout: Layout, scenario: Scenario) -> None:
        self._stream, self._layout = stream, layout
        self._styled: set[str] = set()
        self._ellipses: _Ellipsoids  # of the batch's stages, with that of the stage before them in front
        self._places: np.ndarray | None = None  # of their stages, but the first's
        self._way = False  # whether the true path is known beforehand
        body = next((thing for thing in scenario.scenery.values() if isinstance(thing, Box)), None)
        self._body = np.array(body.sizes if body else _DEFAULT_BODY) / 2
        if layout.attitude:
            send_static(stream, schema.ATTITUDE, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
            send_static(stream, f"{schema.ATTITUDE}/sphere", sphere(1.0))
        if layout.position:
            send_static(stream, schema.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
            self._draw_scenery(scenario)

    def add(self, batch: Batch) -> None:
        if not batch.stages or not self._layout.space.parts or self._layout.matched:
            return  # the cloud that moves shows the pose
        # After each stage; the mean of a cloud at the end of each step alone: the cloud itself shows the rest.
        cloud = bool(self._layout.particles)
        at = batch.at.pick(batch.ends) if cloud else batch.at
        mean, cov = batch.end_moments if cloud else (batch.beliefs("mean"), batch.beliefs("cov"))
        self._draw("estimate", at, mean, schema.ESTIMATE)
        if self._layout.position:
            self._measure_ellipses(at, mean, cov)
            now = self._ellipses.pick(slice(1, None))
            self._draw_ellipses(f"{schema.WORLD}/estimate/cov", at, now, schema.ESTIMATE)
        if self._layout.true_parts:
            self._draw("truth", batch.times, batch.truth, schema.TRUTH)

    def _draw(self, name: str, at: Times, states: Array, colour: schema.Colour) -> None:
        layout = self._layout
        of = {part: states[:, layout.space.at[part]] for part in layout.space.parts}
        if layout.attitude:
            self._draw_attitude(f"{schema.ATTITUDE}/{name}", at, of[layout.attitude], colour, self._body, 1.0)
        if not layout.position:
            return
        place = flat3(place_of(layout.space.parts[layout.position], of[layout.position]))
        known = np.isfinite(place).all(1)
        path = f"{schema.WORLD}/{name}"
        if name == "estimate" or not self._way:
            shade = colour if name == "estimate" else _dim(colour)
            self._style(f"{path}/trail", Style(rr.Points3D, colors=[shade], radii=[_TRAIL]))
            self._send(f"{path}/trail", at, drawn(rr.Points3D, known.astype(int), len(at), positions=place[known]))
        assert layout.extent
        reach = 0.08 * layout.extent[1]
        if layout.attitude:
            half = self._body / self._body.max() * reach
            self._draw_attitude(path, at, of[layout.attitude], colour, half, 1.6 * reach, place)
        elif layout.heading:
            turn = of[layout.heading][:, -1]
            ahead = reach * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1)
            rows = known & np.isfinite(turn)
            self._style(path, Style(rr.Arrows3D, colors=[colour], radii=[_ARROW]))
            tails = place[rows]
            if layout.planar:
                tails[:, 2] += _OVER[name] * layout.extent[1]
            columns = drawn(rr.Arrows3D, rows.astype(int), len(at), vectors=ahead[rows], origins=tails)
            self._send(path, at, columns)
        else:
            self._style(path, Style(rr.Points3D, colors=[colour], radii=[2 * _ARROW]))
            self._send(path, at, drawn(rr.Points3D, known.astype(int), len(at), positions=place[known]))

    def _draw_attitude(
        self, path: str, at: Times, q: Array, colour: schema.Colour, half: Array, reach: float,
        origins: Array | None = None,
    ) -> None:  # fmt: skip
        """A box and the body's axes, at the origin or at the places given."""
        estimated = colour == schema.ESTIMATE
        pale = [tuple(np.add(c, schema.TRUTH) // 2) for c in schema.AXES]
        thin = 1.0 if estimated else 0.5
        name = path.rpartition("/")[2]
        self._style(path, Style(rr.Boxes3D, colors=[colour], labels=[name], show_labels=False, radii=[_LINE]))
        arrows = Style(rr.Arrows3D, colors=schema.AXES if estimated else pale, radii=[0.012 * reach * thin] * 3)
        self._style(f"{path}/axes", arrows)
        known = np.asarray(np.isfinite(q).all(1))
        box: dict[str, Array] = {}
        tails: dict[str, Array] = {}
        if origins is not None:
            known &= np.isfinite(origins).all(1)
            box["centers"] = _those(origins, known)
            tails["origins"] = np.repeat(box["centers"], 3, axis=0)
        q = _those(q, known)
        sizes = np.broadcast_to(half, (len(q), 3))
        self._send(
            path, at, drawn(rr.Boxes3D, known.astype(int), len(at), half_sizes=sizes, quaternions=xyzw(q), **box)
        )
        vectors = (reach if estimated else 1.25 * reach) * tips(q)
        self._send(f"{path}/axes", at, drawn(rr.Arrows3D, 3 * known.astype(int), len(at), vectors=vectors, **tails))

    def draw_before(self, path: str, at: Times) -> None:
        """The 3σ ellipsoid of the belief before stages of the batch, in grey; each had one before it."""
        assert self._places is not None
        self._draw_ellipses(path, at, self._ellipses.pick(np.searchsorted(self._places, at.stage)), schema.BAND)

    def _measure_ellipses(self, at: Times, mean: Array, cov: Array) -> None:
        """The 3σ ellipsoids of the position after each stage, turned into the world where the covariance is along the
        body's axes; with that of the stage before the batch in front."""
        layout = self._layout
        assert layout.position
        part = layout.space.parts[layout.position]
        where = layout.space.axes_at[layout.position]
        block = cov[:, where, where]
        state = mean[:, layout.space.at[layout.position]]
        if isinstance(part, SE2):
            c, s = np.cos(state[:, 2]), np.sin(state[:, 2])
            R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
            block = R @ block[:, :2, :2] @ np.swapaxes(R, -1, -2)
        known = np.asarray(np.isfinite(block).all((1, 2)))
        sizes, turns = axes_of(np.where(known[:, None, None], block, 0.0))
        now = _Ellipsoids(flat3(place_of(part, state)), 3 * sizes, xyzw(turns), known)
        before = (now if self._places is None else self._ellipses).pick(slice(-1, None))
        self._ellipses = _Ellipsoids(*(np.concatenate(pair) for pair in zip(before, now, strict=True)))
        self._places = at.stage

    def _draw_ellipses(self, path: str, at: Times, drawn_ones: _Ellipsoids, colour: schema.Colour) -> None:
        self._style(path, Style(rr.Ellipsoids3D, colors=[colour], line_radii=[_LINE], fill_mode="MajorWireframe"))
        known = drawn_ones.known.astype(bool)
        shown = drawn_ones if known.all() else drawn_ones.pick(known)
        columns = drawn(
            rr.Ellipsoids3D, known.astype(int), len(at), half_sizes=shown.half_sizes, quaternions=shown.quaternions,
            centers=shown.centers,
        )  # fmt: skip
        self._send(path, at, columns)

    def _draw_scenery(self, scenario: Scenario) -> None:
        """What stands still: landmarks, other paths, and the whole true path as a thin line."""
        layout = self._layout
        for name, thing in scenario.scenery.items():
            path = f"{schema.WORLD}/scenery/{name}"
            if isinstance(thing, Landmarks):
                points = rr.Points3D(
                    flat3(thing.positions), colors=[schema.SCENERY], radii=[_LANDMARK], labels=list(thing.labels)
                )
                send_static(self._stream, path, points)
            elif isinstance(thing, Path):
                strip = rr.LineStrips3D(
                    [flat3(thing.positions)], colors=[schema.OTHER_PATH], radii=[_LINE / 2],
                    labels=[name.replace("_", " ")], show_labels=name != "path",
                )  # fmt: skip
                send_static(self._stream, path, strip)
        if layout.position in layout.true_parts and scenario.truth is not None:
            place = place_of(layout.space.parts[layout.position], scenario.truth[:, layout.space.at[layout.position]])
            known = np.asarray(np.isfinite(place).all(1))
            pieces = np.split(flat3(place), np.flatnonzero(known[1:] != known[:-1]) + 1)
            strips = [piece for piece in pieces if np.isfinite(piece).all() and len(piece) > 1]
            if strips:
                self._way = True
                way = rr.LineStrips3D(strips, colors=[_PATH], radii=[_LINE / 2])
                send_static(self._stream, f"{schema.WORLD}/truth/path", way)

    def _style(self, path: str, style: Style) -> None:
        if path not in self._styled:
            self._styled.add(path)
            send_static(self._stream, path, style.made())

    def _send(self, path: str, at: Times, columns: list[Column]) -> None:
        send(self._stream, path, at, columns)


def _those(values: Array, known: np.ndarray) -> Array:
    """The known rows; all of them are not copied."""
    return values if known.all() else values[known]


def axes_of(cov: Array) -> tuple[Array, Array]:
    """The half axes (M, 3) of the 1σ ellipsoids of covariances (M, 2, 2) or (M, 3, 3), and their turns (M, 4)."""
    values, vectors = np.linalg.eigh(cov)
    sizes = np.sqrt(np.maximum(values, 0))
    if cov.shape[-1] == 2:
        half = 0.5 * np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
        zero = np.zeros_like(half)
        return flat3(sizes[:, ::-1]), np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)
    vectors[:, :, 0] *= np.linalg.det(vectors)[:, None]  # a rotation, not a mirror
    return sizes, quaternions.from_rotation(vectors)


def sphere(radius: float) -> rr.Ellipsoids3D:
    return rr.Ellipsoids3D(
        centers=[[0, 0, 0]], half_sizes=[[radius] * 3], fill_mode="MajorWireframe",
        colors=[(70, 70, 78)], line_radii=[0.003 * radius],
    )  # fmt: skip


def _dim(colour: schema.Colour) -> tuple[int, ...]:
    return tuple(np.array(colour) // 2)


def xyzw(q: Array) -> Array:
    """Our quaternions (w first) in Rerun's order; nothing else in the project turns one into the other."""
    return q[..., [1, 2, 3, 0]]


def tips(q: Array) -> Array:
    """The tips (*, 3, 3) of the body's x, y and z axes in the world, for quaternions (*, 4), as they are drawn."""
    inverse = np.array(q, np.float32)  # whose rows are the columns
    inverse[..., 0] *= -1
    return quaternions.to_matrix(inverse)
