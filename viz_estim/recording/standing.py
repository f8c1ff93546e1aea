"""Geometry that stands while its stage does, and is taken away after it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import rerun as rr

from viz_estim.core.quaternions import Array
from viz_estim.recording.batch import Batch
from viz_estim.recording.columns import Column, Style, Times, drawn, place, send, send_static

_SHAPE: dict[Any, str] = {rr.Points3D: "positions", rr.Arrows3D: "vectors", rr.Ellipsoids3D: "half_sizes"}


@dataclass
class _Drawn:
    """What one field of a stage draws on one path, and the stages during which it stands."""

    stage: str
    field: str
    kind: Any
    shape: str
    during: set[str]


class Standing:
    """Draws what stages show in space, and clears it: after its stage on the stage timeline alone, so that on `step`
    and `time` all stages of a step stand together; and on all three where a step lacks the stage."""

    def __init__(self, stream: rr.RecordingStream, every: int) -> None:
        self._stream, self._every = stream, every
        self._paths: dict[str, _Drawn] = {}
        self._more: dict[tuple[str, str], set[str]] = {}  # by stage and field: the other stages during which it stands
        self._last: tuple[str, ...] = ()  # the stages whose geometry the last step drew

    def draw(
        self, stage: str, field: str, path: str, at: Times, style: Style, count: int | np.ndarray, **values: Array
    ) -> None:
        """`count` points or arrows a row, in a style of their own."""
        if path not in self._paths:
            send_static(self._stream, path, style.made())
        self.add(stage, field, path, style.kind, _SHAPE[style.kind])
        send(self._stream, path, at, drawn(style.kind, count, len(at), **values))

    def add(self, stage: str, field: str, path: str, kind: Any, shape: str) -> None:
        """Takes in a path that another draws."""
        self._paths.setdefault(path, _Drawn(stage, field, kind, shape, {stage, *self._more.get((stage, field), ())}))

    def also(self, stage: str, of: str, field: str) -> None:
        """What a field of the stage `of` drew stands during `stage` too."""
        self._more.setdefault((of, field), set()).add(stage)
        for one in self._paths.values():
            if (one.stage, one.field) == (of, field):
                one.during.add(stage)

    def take_away(self, stage: str, field: str, at: Times) -> None:
        """Takes away what a field of a stage drew, on all timelines."""
        for path, one in self._paths.items():
            if (one.stage, one.field) == (stage, field):
                send(self._stream, path, at, self._nothing(one, len(at)))

    def clear(self, batch: Batch) -> None:
        """Takes away what the batch's stages left."""
        if not self._paths:
            return
        # Steps with the same stages, after a step with the same, are treated alike. Of a step that is not kept, none
        # has drawn.
        drew: list[tuple[str, ...]] = [self._last, (), *batch.kinds]
        now_of = np.where(batch.times.step % self._every == 0, batch.kind + 2, 1)
        before_of = np.concatenate([[0], now_of[:-1]])
        pairs = dict.fromkeys(zip(before_of.tolist(), now_of.tolist(), strict=True))
        alike = [(drew[a], drew[b], np.flatnonzero((before_of == a) & (now_of == b))) for a, b in pairs]
        self._last = drew[now_of[-1]]
        for path, one in self._paths.items():
            within, absent = [], []
            for before, now, rows in alike:
                if one.stage in before and one.stage not in now:
                    absent.append(rows)
                follows = [(before[-1], now[0], 0)] if before and one.stage in now else []
                follows += [(name, after, i + 1) for i, (name, after) in enumerate(pairwise(now))]
                for name, after, offset in follows:
                    if name in one.during and after not in one.during:
                        within.append(batch.times.stage[rows] + offset)
            if within:
                places = np.sort(np.concatenate(within))
                nothing: list[Any] = self._nothing(one, len(places))
                rr.send_columns(path, [place(places)], nothing, recording=self._stream, strict=True)
            if absent:
                at = batch.times.pick(np.sort(np.concatenate(absent)))
                send(self._stream, path, at, self._nothing(one, len(at)))

    def _nothing(self, one: _Drawn, rows: int) -> list[Column]:
        return drawn(one.kind, 0, rows, **{one.shape: np.empty((0, 3))})
