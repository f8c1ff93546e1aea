"""What is drawn in space, by the types of the fields: bodies, sigma points, readings as arrows; and their clearing."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import rerun as rr

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario
from viz_estim.core.scenery import Box
from viz_estim.core.spaces import S2, SO3, Euclidean
from viz_estim.recording import schema
from viz_estim.recording.batch import Batch, StageRows
from viz_estim.recording.columns import Times, drawn, send_static
from viz_estim.recording.layout import Layout, as_product

_DEFAULT_BODY = (0.6, 0.4, 0.15)
_NOTHING = np.empty((0, 3))
_SHAPES: dict[Any, str] = {rr.Points3D: "positions", rr.Arrows3D: "vectors"}


class Scenes:
    """Draws batches into the spatial views of a stream; remembers what the last stage left there."""

    def __init__(self, stream: rr.RecordingStream, layout: Layout, scenario: Scenario, every: int) -> None:
        self._stream, self._layout, self._every = stream, layout, every
        self._styled: set[str] = set()
        self._paths: dict[str, dict[str, Any]] = {}  # by stage: the geometry it draws, as path and archetype
        self._last: tuple[str, ...] = ()  # the stages whose geometry the last step drew
        body = scenario.scenery.get("body")
        self._body = np.array(body.sizes if isinstance(body, Box) else _DEFAULT_BODY) / 2
        if any(isinstance(part, SO3) for part in layout.space.parts.values()):
            send_static(stream, schema.WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
            self._sphere(f"{schema.WORLD}/sphere", 1.0)

    def add(self, batch: Batch) -> None:
        self._draw_bodies(batch)
        for rows in batch.stages:
            kept = np.flatnonzero(rows.at.step % self._every == 0)
            if len(kept):
                at = rows.at.pick(kept) if len(kept) < len(rows.at) else rows.at
                for field, what in self._layout.stages[rows.name].items():
                    if "points" in what:
                        self._draw_points(rows, field, at, kept)
                    elif "innovation" in what:
                        self._draw_readings(rows, field, at, kept)
        self._clear(batch)

    def _draw_bodies(self, batch: Batch) -> None:
        """The body and its axes: the estimate after each stage, the truth once a step."""
        space = self._layout.space
        for name, part in space.parts.items():
            if isinstance(part, SO3):
                for rows in batch.stages:
                    q = rows.array("belief.mean")[:, space.at[name]]
                    self._body_at("estimate", rows.at, q, schema.ESTIMATE, 1.0)
                if name in self._layout.true_parts:
                    q = batch.truth[:, space.at[name]]
                    self._body_at("truth", batch.times, q, schema.TRUTH, 1.25)

    def _body_at(self, name: str, at: Times, q: Array, colour: schema.Colour, reach: float) -> None:
        box, axes = f"{schema.WORLD}/{name}", f"{schema.WORLD}/{name}/axes"
        if box not in self._styled:
            self._styled.add(box)
            estimated = name == "estimate"
            edges = rr.Boxes3D.from_fields(colors=[colour], labels=[name], show_labels=False, radii=[0.006])
            send_static(self._stream, box, edges)
            pale = [tuple(np.add(c, schema.TRUTH) // 2) for c in schema.AXES]
            arrows = rr.Arrows3D.from_fields(
                colors=schema.AXES if estimated else pale, radii=[0.012 if estimated else 0.006] * 3
            )
            send_static(self._stream, axes, arrows)
        known = np.isfinite(q).all(1)
        q = q[known]
        sizes = np.broadcast_to(self._body, (len(q), 3))
        self._send(box, at, drawn(rr.Boxes3D, known.astype(int), len(at), half_sizes=sizes, quaternions=xyzw(q)))
        self._send(axes, at, drawn(rr.Arrows3D, 3 * known.astype(int), len(at), vectors=reach * _tips(q)))

    def _draw_points(self, rows: StageRows, field: str, at: Times, kept: np.ndarray) -> None:
        """Sigma points: an attitude's as tips of the body's axes on the sphere, a sensor's in its own space."""
        points = rows.array(f"{field}.points")[kept]
        space = as_product(getattr(rows.stages[0], field).space)
        count = points.shape[1]
        for name, part in space.parts.items():
            x = points[..., space.at[name]]
            if isinstance(part, SO3):
                faint = 0.55 if field == "drawn" else 1.0  # what a prediction starts from stands back
                shades = (faint * np.array(schema.AXES)).astype(int)
                colours = [tuple(shades[i % 3]) for i in range(3 * count)]
                path = schema.drawn(rows.name, field)
                self._stand(rows.name, path, at, rr.Points3D, _tips(x), 3 * count, colours, 0.014 / faint**0.5)
            elif name in self._layout.sensors and len(part.names) == 3:
                size = self._layout.reach[name]
                path = f"{schema.sensor(name)}/{rows.name}/{field}"
                self._stand(rows.name, path, at, rr.Points3D, x, count, [schema.ESTIMATE], 0.014 * size)

    def _draw_readings(self, rows: StageRows, field: str, at: Times, kept: np.ndarray) -> None:
        """A reading of three components, and what was expected of it, as arrows in the sensor's own space."""
        space = getattr(rows.stages[0], field).space
        for name, part in space.parts.items():
            if len(part.names) == 3 and isinstance(part, (Euclidean, S2)):
                path, size = schema.sensor(name), self._layout.reach[name]
                z, expected = (rows.array(f"{field}.{k}")[kept][:, space.at[name]] for k in ("z", "predicted"))
                if path not in self._styled:
                    self._styled.add(path)
                    self._sphere(f"{path}/sphere", size)
                colour = schema.sensor_colour(self._layout.place(name))[1]
                self._stand(rows.name, f"{path}/{rows.name}/measured", at, rr.Arrows3D, z, 1, [colour], 0.012 * size)
                self._stand(
                    rows.name,
                    f"{path}/{rows.name}/predicted",
                    at,
                    rr.Arrows3D,
                    expected,
                    1,
                    [schema.ESTIMATE],
                    0.012 * size,
                )

    def _stand(
        self, stage: str, path: str, at: Times, kind: Any, values: Array, count: int,
        colours: Sequence[tuple[int, ...]], radius: float,
    ) -> None:  # fmt: skip
        """Points or arrows that stand while their stage does: `_clear` takes them away."""
        if path not in self._styled:
            self._styled.add(path)
            self._paths.setdefault(stage, {})[path] = kind
            send_static(self._stream, path, kind.from_fields(colors=colours, radii=[radius]))
        self._send(path, at, drawn(kind, count, len(at), **{_SHAPES[kind]: values}))

    def _clear(self, batch: Batch) -> None:
        """Takes each stage's geometry away when the next stage comes, on the stage timeline alone; and on all three
        at the first step that lacks the stage."""
        if not self._paths:
            return
        # Steps with the same stages, after a step with the same, are treated alike.
        alike: dict[tuple[tuple[str, ...], tuple[str, ...], bool], list[int]] = {}
        for row, (names, step) in enumerate(zip(batch.names, batch.times.step.tolist(), strict=True)):
            kept = step % self._every == 0
            alike.setdefault((self._last, names, kept), []).append(row)
            self._last = names if kept else ()
        within: dict[str, list[np.ndarray]] = {}
        absent: dict[str, list[np.ndarray]] = {}
        for (before, names, kept), rows in alike.items():
            now = names if kept else ()
            for name in set(before) - set(now):
                absent.setdefault(name, []).append(np.array(rows))
            follows = [(before[-1], 0)] if before and before[-1] in now and before[-1] != names[0] else []
            follows += [(name, i + 1) for i, (name, after) in enumerate(pairwise(now)) if name != after]
            for name, offset in follows:
                within.setdefault(name, []).append(batch.times.stage[rows] + offset)
        for name, found in within.items():
            places = np.sort(np.concatenate(found))
            for path, kind in self._paths.get(name, {}).items():
                nothing = drawn(kind, 0, len(places), **{_SHAPES[kind]: _NOTHING})
                index = [rr.TimeColumn("stage", sequence=places)]
                rr.send_columns(path, index, nothing, recording=self._stream, strict=True)
        for name, found in absent.items():
            at = batch.times.pick(np.sort(np.concatenate(found)))
            for path, kind in self._paths.get(name, {}).items():
                self._send(path, at, drawn(kind, 0, len(at), **{_SHAPES[kind]: _NOTHING}))

    def _sphere(self, path: str, radius: float) -> None:
        sphere = rr.Ellipsoids3D(
            centers=[[0, 0, 0]], half_sizes=[[radius] * 3], fill_mode="MajorWireframe",
            colors=[(70, 70, 78)], line_radii=[0.003 * radius],
        )  # fmt: skip
        send_static(self._stream, path, sphere)

    def _send(self, path: str, at: Times, columns: list[rr.ComponentColumn]) -> None:
        rr.send_columns(path, at.columns, columns, recording=self._stream, strict=True)


def xyzw(q: Array) -> Array:
    """Our quaternions (w first) in Rerun's order; nothing else in the project turns one into the other."""
    return q[..., [1, 2, 3, 0]]


def _tips(q: Array) -> Array:
    """The tips (*, 3, 3) of the body's x, y and z axes in the world, for quaternions (*, 4)."""
    return np.swapaxes(quaternions.to_matrix(q), -1, -2)
