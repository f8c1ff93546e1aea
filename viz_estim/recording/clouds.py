"""Particle clouds: what is kept of them, and how they are drawn: by weight, with headings, ancestry and modes."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import rerun as rr

from viz_estim.core.beliefs import Particles
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Step
from viz_estim.core.spaces import SE2, SO2, SO3
from viz_estim.core.stages import Resample, Stage
from viz_estim.recording import schema
from viz_estim.recording.batch import Batch, StageRows
from viz_estim.recording.bodies import axes_of, tips, xyzw
from viz_estim.recording.columns import drawn, send_static
from viz_estim.recording.layout import KEPT, Layout, flat3, place_of
from viz_estim.recording.standing import Standing

_LINES = 400  # of ancestry, at most
_LOOKS = 100  # how often in a run its modes are looked for: that takes longer than a step of a small filter


class Clouds:
    """Draws particle beliefs into the world. A cloud of more than `KEPT` is thinned, by weight, as it comes in."""

    def __init__(self, stream: rr.RecordingStream, layout: Layout, standing: Standing, every: int, steps: int) -> None:
        self._stream, self._layout, self._standing, self._every = stream, layout, standing, every
        self._look = max(every, -(-steps // _LOOKS))
        self._before: Particles | None = None  # the whole cloud at the end of the step before
        self._descent: dict[int, tuple[Array, Array]] = {}  # by step: parents and children (L, 3)
        self._path = f"{schema.WORLD}/particles"
        style = rr.Arrows3D.from_fields(radii=[-1.0]) if self._turned else rr.Points3D.from_fields(radii=[-1.5])
        send_static(stream, self._path, style)
        modes = rr.Ellipsoids3D.from_fields(colors=[schema.MODE], line_radii=[-1.5], fill_mode="MajorWireframe")
        send_static(stream, f"{schema.WORLD}/modes", modes)

    @property
    def _turned(self) -> bool:
        return bool(self._layout.heading or self._layout.attitude)

    def take(self, step: Step) -> Step:
        """The step as it is kept: with thinned clouds; notes who descends from whom."""
        for stage in step.stages:
            drawable = self._layout.position and self._before is not None and step.index % self._every == 0
            if isinstance(stage, Resample) and self._before is not None and drawable:
                first = np.flatnonzero(np.diff(stage.ancestors, prepend=-1))  # copies stand together
                chosen = first[:: max(1, -(-len(first) // _LINES))]
                parents = self._before.states[stage.ancestors[chosen]]
                self._descent[step.index] = self._places(parents), self._places(stage.belief.states[chosen])
        if step.stages and isinstance(step.stages[-1].belief, Particles):
            self._before = step.stages[-1].belief
        if not any(len(stage.belief.log_weights) > KEPT for stage in step.stages):
            return step
        return dataclasses.replace(step, stages=tuple(_thinned(stage) for stage in step.stages))

    def add(self, batch: Batch) -> None:
        if not self._layout.position:  # of something that is nowhere: its numbers and plots are kept alone
            return
        for rows in batch.stages:
            self._draw(rows)
            if "ancestors" in self._layout.stages[rows.name]:
                self._draw_descent(rows)
        if self._every > 1:
            late = np.flatnonzero(batch.times.step % self._every == 1)
            if len(late):
                at = batch.times.pick(late)
                kind, shape = (rr.Arrows3D, "vectors") if self._turned else (rr.Points3D, "positions")
                nothing = drawn(kind, 0, len(at), **{shape: np.empty((0, 3))})
                rr.send_columns(self._path, at.columns, nothing, recording=self._stream, strict=True)
        self._draw_modes(batch)

    def _draw(self, rows: StageRows) -> None:
        kept = np.flatnonzero(rows.at.step % self._every == 0)
        if not len(kept):
            return
        at = rows.at.pick(kept)
        weights = np.exp(rows.array("belief.log_weights")[kept])
        colours = schema.by_weight(weights / weights.max(axis=1, keepdims=True))
        count, values = weights.shape[1], {"colors": colours}
        what = self._layout.stages[rows.name].get("belief.states", {})
        shared = rows.shared("belief.states", *what["same_as"])[kept].all() if "same_as" in what else False
        if not shared:
            states = rows.array("belief.states")[kept]
            places = self._places(states)
            values |= {"origins": places, "vectors": self._ahead(states)} if self._turned else {"positions": places}
        kind = rr.Arrows3D if self._turned else rr.Points3D
        columns = drawn(kind, count, len(at), **values)
        rr.send_columns(self._path, at.columns, columns, recording=self._stream, strict=True)

    def _draw_descent(self, rows: StageRows) -> None:
        steps = [step for step in rows.at.step.tolist() if step in self._descent]
        if steps:
            lines = [self._descent.pop(step) for step in steps]
            at = rows.at.pick(np.flatnonzero(np.isin(rows.at.step, steps)))
            counts = np.array([len(parents) for parents, _ in lines])
            origins, ends = (np.concatenate([pair[i] for pair in lines]) for i in (0, 1))
            style = rr.Arrows3D.from_fields(colors=[schema.BAND], radii=[-0.5])
            path = schema.drawn(rows.name, "ancestry")
            self._standing.draw(
                rows.name, "ancestors", path, at, style, counts, vectors=ends - origins, origins=origins
            )

    def _draw_modes(self, batch: Batch) -> None:
        """Where the cloud stands in several places: each with its 3σ; nothing where it is one."""
        chosen = [i for i, row in enumerate(batch.end_rows) if batch.times.step[row] % self._look == 0]
        if not chosen:
            return
        layout, found = self._layout, []
        assert layout.position
        for i in chosen:
            step = batch.steps[batch.end_rows[i]]
            modes = step.stages[-1].belief.modes()
            found.append(modes if len(modes) > 1 else ())
        every = [mode for modes in found for mode in modes]
        at = batch.at.pick(batch.ends[chosen])
        axes = layout.space.axes_at[layout.position]
        d = 2 if layout.planar else 3
        cov = np.array([mode.cov[axes, axes][:d, :d] for mode in every]).reshape(-1, d, d)
        sizes, turns = axes_of(cov)
        columns = drawn(
            rr.Ellipsoids3D, np.array([len(modes) for modes in found]), len(at),
            half_sizes=3 * sizes, quaternions=xyzw(turns),
            centers=self._places(np.array([mode.mean for mode in every]).reshape(-1, len(layout.space.names))),
        )  # fmt: skip
        rr.send_columns(f"{schema.WORLD}/modes", at.columns, columns, recording=self._stream, strict=True)

    def _places(self, states: Array) -> Array:
        layout = self._layout
        assert layout.position
        part = layout.space.parts[layout.position]
        return flat3(place_of(part, states[..., layout.space.at[layout.position]]))

    def _ahead(self, states: Array) -> Array:
        """A short arrow the way each particle looks."""
        layout = self._layout
        assert layout.extent
        reach = 0.03 * layout.extent[1]
        if layout.heading and isinstance(layout.space.parts[layout.heading], (SO2, SE2)):
            turn = states[..., layout.space.at[layout.heading]][..., -1].astype(np.float32)
            return reach * np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1)
        assert layout.attitude
        assert isinstance(layout.space.parts[layout.attitude], SO3)
        return reach * tips(states[..., layout.space.at[layout.attitude]])[..., 0, :]


def _thinned(stage: Stage) -> Stage:
    """The stage with `KEPT` equal particles in place of its cloud, taken evenly along the weights added up."""
    belief: Particles = stage.belief
    weights = belief.log_weights
    if weights[0] == weights[-1] and weights.min() == weights.max():
        chosen = np.arange(KEPT) * len(weights) // KEPT
    else:
        total = np.cumsum(np.exp(weights))
        chosen = np.searchsorted(total, (np.arange(KEPT) + 0.5) / KEPT * total[-1])
    thin = Particles(belief.space, belief.states[chosen], np.full(KEPT, -np.log(KEPT)))
    changed: dict[str, Any] = {"belief": thin}
    for field in dataclasses.fields(stage)[2:]:
        value = getattr(stage, field.name)
        if isinstance(value, np.ndarray) and value.shape[:1] == weights.shape:
            changed[field.name] = value[chosen]
    return dataclasses.replace(stage, **changed)
