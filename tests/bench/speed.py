"""Speed as ratios within one process: `python tests/bench/speed.py` prints a table. Never a test: machines differ.

Needs `pip install -e .[bench]` (FilterPy is the yardstick for the unscented filter).
"""

from __future__ import annotations

import itertools
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.measurement import Measurement, Sensor
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Step, Tick, run
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.core.stages import SigmaPoints, Stage
from viz_estim.core.unscented import UnscentedFilter, scaled
from viz_estim.recording.recorder import Recorder
from viz_estim.scenarios.imu import imu, imu_ukf

ROUNDS = 7


def timed(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def in_turn(*works: Callable[[], object]) -> list[float]:
    """The median time of each work (s), all of them once a round, so that a slow moment hits all alike."""
    rounds = [[timed(work) for work in works] for _ in range(ROUNDS)]
    return [statistics.median(times) for times in zip(*rounds, strict=True)]


_count = itertools.count()


def fresh(folder: Path) -> Path:
    """A file that is not there yet: taking the place of another costs what freeing that takes."""
    return folder / f"{next(_count)}.rrd"


def recording_overhead(folder: Path) -> list[tuple[str, str, str]]:
    scenario = imu_ukf(imu(None, np.random.default_rng(1), duration=60.0))

    def bare() -> None:
        for _ in run(scenario):
            pass

    def recorded() -> None:
        with Recorder(fresh(folder), scenario, {"scenario": "bench"}) as recorder:
            for step in run(scenario):
                recorder.add(step)

    alone, both = in_turn(bare, recorded)
    count = len(scenario.ticks)
    figures = f"{1e6 * alone / count:.0f} µs a step alone, {1e6 * both / count:.0f} recorded in full"
    return [("imu-ukf recorded in full / itself", f"{both / alone:.3f} (≤ 1.15)", figures)]


@dataclass(frozen=True, slots=True)
class SixSignals(Stage):
    """design.md's set: a transform (the belief's mean), four arrays, twelve sigma points."""

    rate: Array
    bias: Array
    force: Array
    sigma: SigmaPoints


def six_signals(folder: Path) -> list[tuple[str, str, str]]:
    count, rng = 40_000, np.random.default_rng(2)
    names = ("tx", "ty", "tz", "qw", "qx", "qy", "qz")
    space, cube = Euclidean(names), Euclidean(("x", "y", "z"))
    data = {k: rng.standard_normal((count, n)) for k, n in (("mean", 7), ("rate", 3), ("bias", 3), ("force", 3))}
    cov = np.array([a @ a.T for a in rng.standard_normal((count, 7, 7))])
    points = rng.standard_normal((count, 12, 3))
    weights = np.full(12, 1 / 12)
    steps = [
        Step(
            k,
            Tick(0.01 * k, 0.01),
            (
                SixSignals(
                    "signals",
                    Gaussian(space, data["mean"][k], cov[k]),
                    *(data[name][k] for name in ("rate", "bias", "force")),
                    SigmaPoints(cube, points[k], weights, weights),
                ),
            ),
        )
        for k in range(count)
    ]
    raw = 8 * count * (7 + 49 + 3 * 3 + 36)
    scenario = Scenario(None, {0: Gaussian(space, data["mean"][0], cov[0])}, [step.tick for step in steps])  # type: ignore[arg-type]
    path, plain = folder / "six.rrd", folder / "log.rrd"

    def ours() -> None:
        with Recorder(fresh(folder), scenario, {"scenario": "six"}) as recorder:
            for step in steps:
                recorder.add(step)

    fewer = count // 10

    def row_by_row() -> None:
        stream = rr.RecordingStream("bench rr.log")
        stream.save(plain)
        for k in range(fewer):
            stream.set_time("step", sequence=k)
            stream.set_time("time", duration=0.01 * k)
            stream.set_time("stage", sequence=k)
            mean = data["mean"][k]
            stream.log("transform", rr.Transform3D(translation=mean[:3], quaternion=mean[[4, 5, 6, 3]]))
            for name in ("rate", "bias", "force"):
                stream.log(name, rr.Scalars(data[name][k]))
            stream.log("cov", rr.Scalars(cov[k].ravel()))
            stream.log("sigma", rr.Points3D(points[k]))
        stream.disconnect()

    mine, theirs = in_turn(ours, row_by_row)
    max(folder.glob("[0-9]*.rrd"), key=lambda file: int(file.stem)).rename(path)
    log = theirs / fewer
    # design.md's machine takes 301 µs for a step of rr.log, and 8 µs are the bound there.
    figures = f"rr.log: {1e6 * log:.0f} µs, {log * count / mine:.0f} times as long (≥ {301 / 8:.0f})"
    return [
        ("the recorder on six signals, a step", f"{1e6 * mine / count:.1f} µs (≤ 8)", figures),
        (
            "its file / the raw float bytes",
            f"{path.stat().st_size / raw:.2f} (≤ 1.5)",
            f"{raw / count:.0f} bytes a step",
        ),
    ]


def against_filterpy() -> list[tuple[str, str, str]]:
    n, count, rng = 6, 500, np.random.default_rng(3)
    F = np.eye(n) + 0.01 * rng.standard_normal((n, n))
    H, Q, R = rng.standard_normal((n, n)), 0.1 * np.eye(n), np.eye(n)
    space = Euclidean([f"x{i}" for i in range(n)])
    sensor = Sensor(space, lambda x: x @ H.T, R)
    filter_ = UnscentedFilter(
        lambda x, tick: x @ F.T, lambda tick: Q, Measurement({"z": sensor}), scaled(n, 0.5, 2.0, 0.0)
    )
    readings = rng.standard_normal((count, n))
    ticks = [Tick(0.01 * k, 0.01, measurements={"z": z}) for k, z in enumerate(readings)]
    scenario = Scenario(filter_, {0: Gaussian(Product(state=space), np.zeros(n), np.eye(n))}, ticks)

    def ours() -> None:
        for _ in run(scenario):
            pass

    def filterpys() -> None:
        points = MerweScaledSigmaPoints(n, 0.5, 2.0, 0.0)
        kf = UnscentedKalmanFilter(n, n, 0.01, lambda x: H @ x, lambda x, dt: F @ x, points)
        kf.Q, kf.R = Q, R
        for z in readings:
            kf.predict()
            kf.update(z)

    mine, theirs = in_turn(ours, filterpys)
    figures = f"{1e6 * mine / count:.0f} and {1e6 * theirs / count:.0f} µs a step"
    return [("our UKF / FilterPy's, six Euclidean states", f"{mine / theirs:.2f} (≤ 1)", figures)]


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = [*recording_overhead(folder), *six_signals(folder), *against_filterpy()]
    print(f"median of {ROUNDS} rounds in turn")
    for what, figure, detail in rows:
        print(f"  {what:45} {figure:18} {detail}")


if __name__ == "__main__":
    main()
