"""States and readings drawn from a filter's own model, on which its consistency is tested; leading axes are a batch."""

from typing import Any

import numpy as np

from viz_estim.core.beliefs import normal
from viz_estim.core.kalman import KalmanFilter
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick
from viz_estim.core.spaces import Space


def next_state(filter: Any, space: Space, x: Array, tick: Tick, rng: np.random.Generator) -> Array:
    """A true next state (*, n): after the process the noise of a Kalman filter, before it that of an unscented one."""
    if tick.dt == 0:
        return x
    if isinstance(filter, KalmanFilter):
        return normal(space, filter.process(x, tick), filter.process_noise(x, tick), rng)
    moved: Array = filter.process(normal(space, x, filter.process_noise(tick), rng), tick)
    return moved


def readings(filter: Any, x: Array, rng: np.random.Generator) -> dict[str, Array]:
    """Readings of a true state x (*, n) by each of its sensors."""
    sensors = getattr(filter, "measurement", filter).sensors
    return {name: normal(sensor.space, sensor.measure(x), sensor.noise, rng) for name, sensor in sensors.items()}
