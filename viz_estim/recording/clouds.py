"""Particle clouds: what is kept of them, and how they are drawn: by weight, with headings, ancestry and modes."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import rerun as rr

from viz_estim.core.beliefs import Particles
from viz_estim.core.modes import several
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Step
from viz_estim.core.spaces import SE2, SO2, SO3
from viz_estim.core.stages import Resample, Stage
from viz_estim.recording import schema
from viz_estim.recording.batch import Batch, StageRows
from viz_estim.recording.bodies import axes_of, tips, xyzw
from viz_estim.recording.columns import Style, drawn, send, send_static
from viz_estim.recording.layout import KEPT, Layout, place_of
from viz_estim.recording.standing import Standing

_LINES = 250  # of ancestry, at most
_LOOKS = 50  # how often in a run its modes are looked for: that takes longer than a step of a small filter


class Clouds:
    """Draws particle beliefs into the world. A cloud of more than `KEPT` is thinned, by weight, as it comes in."""

    def __init__(self, stream: rr.RecordingStream, layout: Layout, standing: Standing, every: int, steps: int) -> None:
        self._stream, self._layout, self._standing, self._every = stream, layout, standing, every
        self._look = max(every, -(-steps // _LOOKS))
        self._before: Particles | None = None  # the whole cloud at the end of the step before
        self._descent: dict[int, tuple[Array, Array]] = {}  # by step: parents and children (L, 3)
        self._path = f"{schema.WORLD}/particles"
        modes = rr.Ellipsoids3D.from_fields(colors=[schema.MODE], line_radii=[-1.5], fill_mode="MajorWireframe")
        send_static(stream, f"{schema.WORLD}/modes", modes)

    @property
    def _turned(self) -> bool:
        return bool(self._layout.heading or self._layout.attitude)

    def take(self, step: Step) -> Step:
        """The step as it is kept: with thinned clouds; notes who descends from whom while the whole ones are there."""
        if not any(len(stage.belief.log_weights) > KEPT for stage in step.stages):
            return step
        for stage in step.stages:
            drawn_then = self._layout.position and step.index % self._every == 0
            if isinstance(stage, Resample) and self._before is not None and drawn_then:
                self._descent[step.index] = _descent_of(stage, self._before.states)
        self._before = step.stages[-1].belief
        return dataclasses.replace(step, stages=_thinned(step.stages))

    def add(self, batch: Batch) -> None:
        if not self._layout.position:  # of something that is nowhere: its numbers and plots are kept alone
            return
        for rows in batch.stages:
            self._draw(rows)
            if "ancestors" in self._layout.stages[rows.name]:
                self._draw_descent(batch, rows)
        if self._every > 1:
            late = np.flatnonzero(batch.times.step % self._every == 1)
            if len(late):
                at = batch.times.pick(late)
                kind, shape = (rr.Arrows3D, "vectors") if self._turned else (rr.Points3D, "positions")
                nothing = drawn(kind, 0, len(at), **{shape: np.empty((0, 3))})
                send(self._stream, self._path, at, nothing)
        self._draw_modes(batch)

    def _draw(self, rows: StageRows) -> None:
        """The cloud after a stage. Where it is the one before, only weighed anew, its colours change; where it is made
        of copies of that, those that left none vanish: nothing moves, and a cloud is most of a recording's bytes."""
        kept = np.flatnonzero(rows.at.step % self._every == 0)
        if not len(kept):
            return
        at = rows.at.pick(kept)
        kind = rr.Arrows3D if self._turned else rr.Points3D
        N = len(rows.stages[0].belief.log_weights)
        what = self._layout.stages[rows.name].get("belief.states", {})
        same, own = what.get("same_as"), _own(rows, what)[kept]
        if same and "by" in self._layout.stages[same[0]].get("belief.states", {}):
            own[:] = True  # those before stand, as drawn, in their parents' order
        columns = []
        if own.any():
            states = rows.some("belief.states", kept)
            places = self._places(states)
            shown = {"origins": places, "vectors": self._ahead(states)} if self._turned else {"positions": places}
            columns += drawn(kind, N, len(at), **shown)
        if own.any() or (same and "by" in what):
            radius = np.full((len(at), 1), -1.0 if self._turned else -1.5, np.float32)
            if not own.any():
                named = np.zeros((len(at), N), bool)
                for row, i in enumerate(kept.tolist()):
                    named[row, getattr(rows.stages[i], what["by"])] = True
                radius = np.where(named, radius, np.float32(0))
            columns += drawn(kind, radius.shape[1], len(at), radii=radius)
        if rows.equal_weights.all():
            columns += drawn(kind, 1, len(at), colors=np.full(len(at), schema.by_weight(np.ones(1))))
        else:
            share = rows.some("belief.log_weights", kept).astype(np.float32)
            share -= share.max(axis=1, keepdims=True)
            columns += drawn(kind, N, len(at), colors=schema.by_weight(np.exp(share)))
        send(self._stream, self._path, at, columns)

    def _draw_descent(self, batch: Batch, rows: StageRows) -> None:
        """Lines from parents, a step before, to a child of each."""
        lines, drawn_rows = [], []
        for i, step in enumerate(rows.at.step.tolist()):
            before: Any = batch.ended(int(rows.rows[i]))
            if step in self._descent:
                lines.append(self._descent.pop(step))
            elif before is None or step % self._every or self._layout.particles > KEPT:
                continue
            else:
                lines.append(_descent_of(rows.stages[i], before.belief.states))
            drawn_rows.append(i)
        if not lines:
            return
        counts = np.array([len(children) for _, children in lines])
        origins, ends = (self._places(np.concatenate(some)) for some in zip(*lines, strict=True))
        style = Style(rr.Arrows3D, colors=[schema.BAND], radii=[-0.5])
        path, at = schema.drawn(rows.name, "ancestry"), rows.at.pick(np.array(drawn_rows))
        self._standing.draw(rows.name, "ancestors", path, at, style, counts, vectors=ends - origins, origins=origins)

    def _draw_modes(self, batch: Batch) -> None:
        """Where the cloud stands in several places: each with its 3σ; nothing where it is one."""
        chosen = [i for i, row in enumerate(batch.end_rows) if batch.times.step[row] % self._look == 0]
        if not chosen:
            return
        layout, found = self._layout, []
        assert layout.position
        for i in chosen:
            belief: Any = batch.steps[batch.end_rows[i]].stages[-1].belief
            found.append(several(belief.space, belief.states, belief.log_weights))
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
        send(self._stream, f"{schema.WORLD}/modes", at, columns)

    def _places(self, states: Array) -> Array:
        layout = self._layout
        assert layout.position
        part = layout.space.parts[layout.position]
        place = place_of(part, states[..., layout.space.at[layout.position]])
        places = np.zeros((*place.shape[:-1], 3), np.float32)
        places[..., : place.shape[-1]] = place
        return places

    def _ahead(self, states: Array) -> Array:
        """A short arrow the way each particle looks."""
        layout = self._layout
        assert layout.extent
        reach = 0.03 * layout.extent[1]
        if layout.heading and isinstance(layout.space.parts[layout.heading], (SO2, SE2)):
            turn = states[..., layout.space.at[layout.heading]][..., -1].astype(np.float32)
            ahead = np.zeros((*turn.shape, 3), np.float32)
            ahead[..., 0], ahead[..., 1] = reach * np.cos(turn), reach * np.sin(turn)
            return ahead
        assert layout.attitude
        assert isinstance(layout.space.parts[layout.attitude], SO3)
        return reach * tips(states[..., layout.space.at[layout.attitude]])[..., 0, :]


def _descent_of(stage: Any, before: Array) -> tuple[Array, Array]:
    """Of a resampling, the states (L, n) of parents, a step before, and of a child of each: of `_LINES` children at
    most, as far apart in the cloud, so that a parent of many is hardly left out."""
    children = _evenly(len(before), min(_LINES, len(before)))
    parents = stage.ancestors[children]
    first = np.ones(len(parents), bool)
    np.not_equal(parents[1:], parents[:-1], out=first[1:])  # copies stand together
    return before.take(parents[first], axis=0), stage.belief.states.take(children[first], axis=0)


def _thinned(stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """The stages with `KEPT` equal particles in place of their clouds, taken evenly along the weights added up. Before
    a resampling they are the ancestors of those that are kept after it: chosen by their weight too."""
    thin: list[Stage] = []
    for stage, after in zip(stages, [*stages[1:], None], strict=True):
        weights = stage.belief.log_weights
        states: Array | None = None
        if isinstance(after, Resample) and _equal(after.belief.log_weights):
            chosen = after.ancestors[_evenly(len(weights))]
        elif _equal(weights):
            chosen = _evenly(len(weights))
            if isinstance(stage, Resample) and thin:
                same: Array = thin[-1].belief.states
                states = same if np.array_equal(same, stage.belief.states[chosen]) else None
        else:
            total = np.cumsum(np.exp(weights.astype(np.float32)), dtype=float)  # as near as a choice needs it
            chosen = np.searchsorted(total, (np.arange(KEPT) + 0.5) / KEPT * total[-1])
        if states is None:
            states = stage.belief.states.take(chosen, axis=0)
        changed: dict[str, Any] = {"belief": Particles(stage.belief.space, states, _EQUAL)}
        for field in dataclasses.fields(stage)[2:]:
            value = getattr(stage, field.name)
            if isinstance(value, np.ndarray) and value.shape[:1] == weights.shape:
                changed[field.name] = value.take(chosen, axis=0)
        thin.append(dataclasses.replace(stage, **changed))
    return tuple(thin)


_EQUAL = np.full(KEPT, -np.log(KEPT))


@cache
def _evenly(count: int, few: int = KEPT) -> np.ndarray:
    """A few of so many places, all as far apart."""
    return np.arange(few) * count // few


def _equal(log_weights: Array) -> bool:
    return bool(log_weights[0] == log_weights[-1] and log_weights.min() == log_weights.max())


def _own(rows: StageRows, what: dict[str, Any]) -> np.ndarray:
    """Which rows hold a cloud that is neither the one before nor made of copies of it; all, where any does."""
    if "same_as" not in what:
        return np.ones(len(rows.at), bool)
    held = rows.copied(what["same_as"][0]) if "by" in what else rows.shared("belief.states", *what["same_as"])
    return np.full(len(held), not held.all())
