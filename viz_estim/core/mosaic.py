"""A mosaic of pictures beside an attitude filter: the filter as it is, and each picture painted where it looked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.panoramas import Tiles, paint
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Estimator, Tick
from viz_estim.core.scenery import Camera
from viz_estim.core.spaces import Product
from viz_estim.core.stages import Stage


@dataclass(frozen=True, slots=True)
class Mosaic:
    """N(mean, cov) on a space with a part `attitude`, mean (n,), cov (d, d); and the canvas that it led to.

    A later canvas shares the tiles that no picture reached: many beliefs may be kept.
    """

    space: Product
    mean: Array
    cov: Array
    tiles: Tiles

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of what is numbers: the canvas is recorded as a picture."""
        return {"mean": (len(self.space.names),), "cov": (len(self.space.axes),) * 2}


@dataclass(frozen=True, slots=True)
class Paint(Stage):
    """A picture painted on the canvas where it lay.

    picture (2,): its number, and its stamp in s; angles (3,): its roll, pitch and yaw in rad, where
    R = Rz(yaw)·Ry(pitch)·Rx(roll).
    mismatch: its root mean squared difference, in colours from 0 to 255, from what earlier pictures left there; 0 where
    there were none. It tells of a wrong attitude without any truth.
    """

    picture: Array
    angles: Array
    mismatch: float


@dataclass(frozen=True)
class Painter:
    """An attitude filter whose tick may bring a picture: the reading `picture` (2,) is its number and its stamp in s.

    A picture is taken between two ticks; it lies where the attitude was then, on the way from the belief before the
    step to the one after it.
    """

    pure = True
    filter: Estimator
    camera: Camera

    def step(self, belief: Mosaic, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        before = belief
        for stage in self.filter.step(Gaussian(belief.space, belief.mean, belief.cov), tick, rng):
            belief = Mosaic(belief.space, stage.belief.mean, stage.belief.cov, belief.tiles)
            yield replace(stage, belief=belief)
        if "picture" in tick.measurements:
            number, stamp = tick.measurements["picture"]
            late = 0.0 if tick.dt == 0 else min(1.0, (tick.time - stamp) / tick.dt)
            back = late * belief.space.minus(before.mean, belief.mean)
            q = belief.space.plus(belief.mean, back)[belief.space.at["attitude"]]
            tiles, mismatch = paint(belief.tiles, self.camera.pictures[int(number)], q, self.camera.field_of_view)
            painted = Mosaic(belief.space, belief.mean, belief.cov, tiles)
            yield Paint("paint", painted, tick.measurements["picture"], quaternions.to_euler(q), mismatch)
