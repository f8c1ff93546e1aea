"""Readings that are fed to a healthy filter in a wrong way, each by one mistake that people or sensors make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick
from viz_estim.scenarios.imu_data import ImuData, resting_gyro
from viz_estim.scenarios.quadrotor_data import QuadrotorData

Readings = dict[str, Array]


def fed(scenario: Scenario, change: Callable[[int, Readings], Readings]) -> Scenario:
    """The scenario with the readings of each tick changed, by its number."""
    ticks = [replace(t, measurements=change(k, dict(t.measurements))) for k, t in enumerate(scenario.ticks)]
    return replace(scenario, ticks=ticks)


def held(scenario: Scenario) -> Scenario:
    """Every second reading is the one before, given again."""
    ticks = scenario.ticks
    return fed(scenario, lambda k, z: dict(ticks[k - 1].measurements) if k > 1 and k % 2 == 0 else z)


def shifted(scenario: Scenario, by: int) -> Scenario:
    """Each reading is that which came `by` readings before."""
    at = [k for k, tick in enumerate(scenario.ticks) if tick.measurements]
    old = {k: dict(scenario.ticks[at[i - by]].measurements) for i, k in enumerate(at) if i >= by}
    return fed(scenario, lambda k, z: old.get(k, {}))


def silenced(scenario: Scenario, first: float, last: float) -> Scenario:
    """No reading between two shares of the run."""
    n = len(scenario.ticks)
    return fed(scenario, lambda k, z: {} if first * n <= k < last * n else z)


def with_glitches(scenario: Scenario, share: float, size: float) -> Scenario:
    """A share of the readings is off by up to `size`; which ones, the readings' own digits decide."""

    def glitch(k: int, z: Readings) -> Readings:
        rng = np.random.default_rng(int(1e6 * abs(sum(float(v.sum()) for v in z.values()))) if z else 0)
        return {name: v + rng.uniform(0.5, 1.0) * size * (rng.random() < share) for name, v in z.items()}

    return fed(scenario, glitch)


def clipped(scenario: Scenario, share: float) -> Scenario:
    """Readings above the quantile of 1 − share are clipped to it."""
    values = np.concatenate([v for tick in scenario.ticks for v in tick.measurements.values()])
    end = float(np.quantile(values, 1 - share))
    return fed(scenario, lambda k, z: {name: np.minimum(v, end) for name, v in z.items()})


def with_fixed_dt(scenario: Scenario) -> Scenario:
    """Every fourth sample is lost, and the filter takes the usual interval for each."""
    usual = float(np.median([tick.dt for tick in scenario.ticks]))
    kept = [k for k in range(len(scenario.ticks)) if k % 4 != 2]
    ticks: list[Tick] = [replace(scenario.ticks[k], dt=usual if k else 0.0) for k in kept]
    return replace(scenario, ticks=ticks, truth=None if scenario.truth is None else scenario.truth[kept])


def by_median(data: ImuData) -> ImuData:
    """The gyro's bias taken as the median of whole counts at rest, not their mean."""
    if not data.still:
        return data
    per_count = np.ptp(data.gyro, axis=0) / np.ptp(data.log.gyro, axis=0)
    median = np.median(data.log.gyro[: data.still], axis=0)
    return replace(data, gyro=data.gyro + per_count * (resting_gyro(data.log, data.still, data.stuck) - median))


def frozen(data: ImuData) -> ImuData:
    """The gyro stuck for 1.5 s while it turns, unless it sticks already; the health check is not asked."""
    nowhere = np.zeros(len(data.time), bool)
    if data.frozen.any():
        return replace(data, frozen=nowhere)
    begin = data.time[data.still] + 2.0
    stuck = (data.time >= begin) & (data.time < begin + 1.5)
    gyro = np.where(stuck[:, None], data.gyro[np.argmax(stuck)], data.gyro)
    return replace(data, gyro=gyro, frozen=nowhere)


def turned_about(data: QuadrotorData, angle: float) -> QuadrotorData:
    """The same flight in a world that is turned about the vertical (rad)."""
    turn = quaternions.exp(np.array([0.0, 0.0, angle]))

    def turned(x: Array) -> Array:
        pieces = [quaternions.rotate(turn, x[:, :3]), quaternions.multiply(turn, x[:, 3:7])]
        if x.shape[1] > 7:
            pieces += [quaternions.rotate(turn, x[:, 7:10]), x[:, 10:]]
        return np.concatenate(pieces, axis=1)

    return replace(data, pose=turned(data.pose), truth=turned(data.truth))
