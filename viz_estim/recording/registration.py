"""A registration in its scene: the fixed cloud, the moved one, and the pairs that each iteration matched."""

from __future__ import annotations

import numpy as np
import rerun as rr

from viz_estim.core.quaternions import Array
from viz_estim.core.scenery import Cloud
from viz_estim.recording import schema
from viz_estim.recording.batch import Batch, StageRows
from viz_estim.recording.bodies import xyzw
from viz_estim.recording.columns import Style, drawn, send, send_static
from viz_estim.recording.layout import Layout, flat3, place_of
from viz_estim.recording.standing import Standing

_PAIRS = 3000  # drawn of one iteration's, at most; all are kept


class Registration:
    """Draws clouds of the scenery, those that move where the estimate puts them, and matches coloured by distance."""

    def __init__(self, stream: rr.RecordingStream, layout: Layout, standing: Standing, every: int) -> None:
        self._stream, self._layout, self._standing, self._every = stream, layout, standing, every
        self._far = 0.0  # the longest distance of the first matches: what the colours are measured by
        clouds = {name: thing for name, thing in layout.scenery.items() if isinstance(thing, Cloud)}
        for name, cloud in clouds.items():
            path = f"{schema.WORLD}/{'moved' if cloud.moves else 'scenery'}/{name}"
            colour = schema.ESTIMATE if cloud.moves else schema.SCENERY
            points = rr.Points3D(flat3(np.asarray(cloud.points, float)), colors=[colour], radii=[-0.8])
            send_static(stream, path, points)

    def add(self, batch: Batch) -> None:
        if self._layout.matched and batch.stages:
            self._move(batch)
        for rows in batch.stages:
            for field, what in self._layout.stages[rows.name].items():
                if "matches" in what:
                    self._draw_matches(rows, field)

    def _move(self, batch: Batch) -> None:
        """The moved clouds stand where the belief after each stage puts them."""
        layout = self._layout
        assert layout.position
        mean = batch.beliefs("mean")
        place = flat3(place_of(layout.space.parts[layout.position], mean[:, layout.space.at[layout.position]]))
        if layout.attitude:
            q = mean[:, layout.space.at[layout.attitude]]
        else:
            assert layout.heading
            half = 0.5 * mean[:, layout.space.at[layout.heading]][:, -1]
            q = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
        columns = drawn(rr.Transform3D, 1, len(batch.at), translation=place, quaternion=xyzw(q))
        send(self._stream, f"{schema.WORLD}/moved", batch.at, columns)

    def _draw_matches(self, rows: StageRows, field: str) -> None:
        kept = np.flatnonzero(rows.at.step % self._every == 0)
        if not len(kept):
            return
        pairs = [getattr(rows.stages[i], field) for i in kept]
        strides = [max(1, -(-len(one.distance) // _PAIRS)) for one in pairs]
        chosen = list(zip(pairs, strides, strict=True))
        origins, ends = (
            flat3(np.concatenate([getattr(one, name)[::step] for one, step in chosen])) for name in ("source", "target")
        )
        distance: Array = np.concatenate([one.distance[::step] for one, step in chosen])
        self._far = self._far or float(distance.max(initial=0.0)) or 1.0
        counts = np.array([len(one.distance[::step]) for one, step in chosen])
        style = Style(rr.Arrows3D, radii=[-1.0])
        self._standing.draw(
            rows.name, field, schema.drawn(rows.name, field), rows.at.pick(kept), style, counts,
            vectors=ends - origins, origins=origins, colors=schema.by_distance(distance / self._far),
        )  # fmt: skip
