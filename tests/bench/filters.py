"""The Gaussian filters against hand-written loops and FilterPy: `python tests/bench/filters.py` prints a table.

Needs `pip install -e .[bench]`.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from filterpy.common import Saver
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from speed import fresh, in_turn

from viz_estim.core.run import Scenario, run
from viz_estim.recording.recorder import Recorder
from viz_estim.running import plan

Rows = list[tuple[str, str, str]]


def built(name: str, *settings: str) -> Scenario:
    return plan(name, data=None, calibration=None, settings=list(settings), seed=1).build()


def recorded(scenario: Scenario, folder: Path | None) -> None:
    """A run; without a folder it is not recorded."""
    if folder is None:
        for _ in run(scenario):
            pass
        return
    with Recorder(fresh(folder), scenario, {"scenario": "bench"}) as recorder:
        for step in run(scenario):
            recorder.add(step)


def ekf(folder: Path) -> Rows:
    """diffdrive-ekf beside the same algebra (Joseph, Cholesky) in a plain loop, and beside FilterPy with its Saver."""
    scenario = built("diffdrive-ekf", "data.duration=60")
    kf: Any = scenario.estimator
    start, ticks = scenario.beliefs[0], scenario.ticks
    (sensor,) = kf.sensors.values()
    (name,) = kf.sensors
    R, eye = sensor.noise, np.eye(3)

    def by_hand() -> None:
        x, P = start.mean, start.cov
        for tick in ticks:
            if tick.dt > 0:
                F, Q = kf.jacobian(x, tick), kf.process_noise(x, tick)
                x = kf.process(x, tick)
                P = F @ P @ F.T + Q
                P = 0.5 * (P + P.T)
            if name in tick.measurements:
                H = sensor.jacobian(x)
                nu = tick.measurements[name] - sensor.measure(x)
                S = H @ P @ H.T + R
                L = np.linalg.cholesky(S)
                K = np.linalg.solve(L.T, np.linalg.solve(L, H @ P)).T
                x = x + K @ nu
                A = eye - K @ H
                P = A @ P @ A.T + K @ R @ K.T
                P = 0.5 * (P + P.T)

    def filterpys() -> None:
        other = ExtendedKalmanFilter(3, 2)
        other.x, other.P, other.R = start.mean.copy(), start.cov.copy(), R
        saver = Saver(other)
        for tick in ticks:
            if tick.dt > 0:
                other.F, other.Q = kf.jacobian(other.x, tick), kf.process_noise(other.x, tick)
                other.x = kf.process(other.x, tick)
                other.P = other.F @ other.P @ other.F.T + other.Q
            if name in tick.measurements:
                other.update(tick.measurements[name], sensor.jacobian, sensor.measure)
            saver.save()

    def ours() -> None:
        for _ in run(scenario):
            pass

    hand, mine, kept, theirs = in_turn(by_hand, ours, lambda: recorded(scenario, folder), filterpys)
    count = len(ticks)
    return [
        ("EKF / a hand-written loop", f"{mine / hand:.2f} (≤ 2.5)", f"{1e6 * mine / count:.0f} µs a step"),
        ("EKF recorded in full / itself", f"{kept / mine:.2f} (≤ 2)", f"{1e6 * kept / count:.0f} µs a step"),
        ("EKF recorded / FilterPy with its Saver", f"{kept / theirs:.2f} (< 1)", f"{1e6 * theirs / count:.0f} µs"),
    ]


def ukf(folder: Path) -> Rows:
    """The 15-state UKF, 55 points, beside FilterPy's with 31 points on the same motion; and recorded."""
    scenario = built("quadrotor-ukf-pose", "data.duration=20")
    kf: Any = scenario.estimator
    start, ticks = scenario.beliefs[0], scenario.ticks
    n = len(start.mean) - 1  # FilterPy's state is flat: the attitude as a rotation vector from the start

    def filterpys() -> None:
        points = MerweScaledSigmaPoints(n, 0.5, 2.0, 0.0)
        space = start.space

        def move(x: np.ndarray, dt: float) -> np.ndarray:
            moved = kf.process(space.plus(start.mean, x)[None], np.zeros((1, 12)), tick)
            return space.minus(moved, start.mean)[0]

        other = UnscentedKalmanFilter(n, 6, 0.01, lambda x: x[:6], move, points)
        other.P, other.Q, other.R = start.cov.copy(), 1e-6 * np.eye(n), 1e-3 * np.eye(6)
        for tick in ticks:
            if tick.dt > 0:
                other.predict(dt=tick.dt)
            if "pose" in tick.measurements:
                other.update(np.zeros(6))

    def ours() -> None:
        for _ in run(scenario):
            pass

    mine, theirs = in_turn(ours, filterpys)
    count = len(ticks)
    longer = built("quadrotor-ukf-pose", "data.duration=60")  # what a recording takes once is little of a minute
    alone, kept = in_turn(lambda: recorded(longer, None), lambda: recorded(longer, folder))
    return [
        ("15-state UKF / FilterPy's", f"{mine / theirs:.2f} (< 1)", f"{1e6 * mine / count:.0f} µs a step"),
        (
            "15-state UKF recorded in full / itself",
            f"{kept / alone:.2f} (≤ 1.15)",
            f"{1e6 * kept / len(longer.ticks):.0f} µs a step",
        ),
    ]


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        for what, figure, detail in [*ekf(Path(name)), *ukf(Path(name))]:
            print(f"  {what:45} {figure:18} {detail}")


if __name__ == "__main__":
    main()
