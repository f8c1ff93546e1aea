"""A point that moves freely in the plane, and its ranges to two landmarks whose places are known.

Files are CSV or NPZ with the columns `time` [s], `range_1, range_2` [m], the landmarks' places `landmark_1_x, …_y,
landmark_2_x, …_y` [m], the same in every row, and optionally the truth `x, y` [m] and `vx, vy` [m/s] (empty or NaN
where it is not known).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from viz_estim.core.beliefs import Gaussian, normal
from viz_estim.core.kalman import KalmanFilter
from viz_estim.core.measurement import Sensor
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.scenery import Landmarks
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.errors import BadInput
from viz_estim.files import check_writable, whole
from viz_estim.scenarios.checks import at_most, positive, probability
from viz_estim.scenarios.ranges import directions, distances
from viz_estim.scenarios.reading import expand, finite
from viz_estim.scenarios.tables import read_table

_SUFFIXES = (".csv", ".npz")
_RANGES = ("range_1", "range_2")
_PLACES = ("landmark_1_x", "landmark_1_y", "landmark_2_x", "landmark_2_y")
_TRUTH = ("x", "y", "vx", "vy")
_NEEDED = ("time", *_RANGES, *_PLACES)
_NAME = "landmarks.csv"
_SPACE = Product(position=Euclidean(("x", "y"), "m"), velocity=Euclidean(("x", "y"), "m/s"))

# The simulated world: the point starts 40 m from the landmarks' line, which one drive of 200 reaches in a minute.
_WORLD = np.array([[0.0, 0.0], [40.0, 0.0]])
_START = np.array([0.0, 40.0, 0.7, 0.0])


@dataclass(frozen=True)
class LandmarksData:
    """time (T,) s from the first; ranges (T, 2) m to the landmarks (2, 2) m; truth (T, 4): x, y, vx, vy, or NaN."""

    time: Array
    ranges: Array
    landmarks: Array
    truth: Array
    files: tuple[Path, ...] = ()


def landmarks(
    source: list[Path] | None,
    rng: np.random.Generator,
    *,
    duration: float = 60.0,
    rate: float = 10.0,
    accel_noise: float = 0.05,
    range_noise: float = 0.3,
) -> LandmarksData:
    """Ranges from a file, or a simulation of the filter's own model, `duration` s long at `rate` readings a second."""
    if source is not None:
        return _load(source)
    positive(duration=duration, rate=rate, accel_noise=accel_noise, range_noise=range_noise)
    at_most(1e6, readings=duration * rate)
    time = np.arange(int(duration * rate) + 1) / rate
    if len(time) < 2:
        raise BadInput(f"duration={duration:g} s at rate={rate:g} has fewer than two readings; make one of them larger")
    truth = np.empty((len(time), 4))
    truth[0] = _START
    F, Q = _transition(1 / rate), _process_noise(1 / rate, accel_noise)
    for k in range(1, len(time)):
        truth[k] = normal(_SPACE, F @ truth[k - 1], Q, rng)
    exact = distances(truth[:, :2], _WORLD)
    return LandmarksData(time, exact + range_noise * rng.standard_normal(exact.shape), _WORLD, truth)


def save(data: LandmarksData, folder: Path) -> list[Path]:
    """Writes simulated data as a CSV in the folder."""
    path = folder / _NAME
    if path.exists():
        raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
    check_writable(path)
    places = np.broadcast_to(data.landmarks.ravel(), (len(data.time), 4))
    table = np.column_stack([data.time, data.ranges, places, data.truth])
    with whole(path) as aside:
        np.savetxt(aside, table, "%.7g", ",", header=",".join((*_NEEDED, *_TRUTH)), comments="")
    return [path]


def landmarks_ekf(
    data: LandmarksData,
    *,
    initial: Literal["ranges", "truth"] = "ranges",
    side: Literal["left", "right"] = "left",
    accel_noise: float = 0.05,
    range_noise: float = 0.3,
    gate: float | None = None,
    initial_velocity_std: float = 1.0,
) -> Scenario:
    """An EKF on position and velocity from ranges to two landmarks, which cannot tell a place from its mirror image.

    initial: where the first two ranges cross, on the `side` of the line from landmark 1 to landmark 2; or the truth,
    where it begins. accel_noise is
    white acceleration in m/s²/√Hz, range_noise in m; a gate is the probability with which a good reading passes.
    """
    positive(accel_noise=accel_noise, range_noise=range_noise, initial_velocity_std=initial_velocity_std)
    beliefs = _starts(data, initial, side, range_noise, initial_velocity_std)
    # The first reading is no news to a belief that was made of it.
    ticks = [
        Tick(float(time), 0.0)
        if k in beliefs
        else Tick(float(time), float(time - data.time[k - 1]), measurements={"range": data.ranges[k]})
        for k, time in enumerate(data.time)
    ]
    notes = (
        "Two ranges fit two places: one on each side of the line between the landmarks. The filter keeps to the side "
        "where it starts, and **nothing in the ranges says that it is the wrong one**: run it with `side=right` and "
        "compare: NIS stays in its band while the **position error** is the distance to the mirror image. Near the "
        "line the ranges no longer tell sideways motion (the **ellipse** grows across it), and a path that crosses it "
        "may be followed on either side."
    )
    scenery = Landmarks(data.landmarks, ("1", "2"))
    return Scenario(
        estimator(data.landmarks, accel_noise, range_noise, probability("gate", gate)),
        beliefs,
        ticks,
        data.truth if np.isfinite(data.truth).any() else None,
        {"landmarks": scenery},
        notes,
    )


def estimator(places: Array, accel_noise: float, range_noise: float, gate: float | None = None) -> KalmanFilter:
    """Constant velocity driven by white acceleration; one sensor `range` reads the distances from all places (N, 2)."""

    def by_state(x: Array) -> Array:
        d_position = directions(x[..., :2], places)
        return np.concatenate([d_position, np.zeros_like(d_position)], axis=-1)

    sensor = Sensor(
        Euclidean([str(i + 1) for i in range(len(places))], "m"),
        lambda x: distances(x[..., :2], places),
        range_noise**2 * np.eye(len(places)),
        gate,
        jacobian=by_state,
    )
    return KalmanFilter(
        lambda x, tick: (_transition(tick.dt) @ x[..., None])[..., 0],
        lambda x, tick: _transition(tick.dt),
        lambda x, tick: _process_noise(tick.dt, accel_noise),
        {"range": sensor},
    )


def _transition(dt: float) -> Array:
    """F (4, 4): position moves by velocity·dt."""
    return np.eye(4) + dt * np.eye(4, k=2)


def _process_noise(dt: float, accel_noise: float) -> Array:
    """Q (4, 4) of white acceleration (Bar-Shalom et al. 2001, eq. 6.2.2-4)."""
    along: Array = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return np.asarray(accel_noise**2 * np.kron(along, np.eye(2)), float)


def _starts(
    data: LandmarksData, initial: str, side: str, range_noise: float, velocity_std: float
) -> dict[int, Gaussian]:
    """The start by step: where the first ranges cross, or the truth, which sets the belief where it begins."""
    seen = np.concatenate([_crossing(data, 1.0 if side == "left" else -1.0, range_noise), np.zeros(2)])
    means = {0: seen}
    if initial == "truth":
        known = np.isfinite(data.truth[:, :2]).all(1)
        if not known.any():
            raise BadInput("initial=truth needs x and y, and this data has none: use initial=ranges")
        means[int(np.argmax(known))] = np.nan_to_num(data.truth[np.argmax(known)])
    return {k: _belief(data, mean, range_noise, velocity_std) for k, mean in means.items()}


def _belief(data: LandmarksData, mean: Array, range_noise: float, velocity_std: float) -> Gaussian:
    """The belief with this mean, as sure of the place as one pair of ranges is."""
    H = directions(mean[:2], data.landmarks)
    cov = np.diag([0.0, 0.0, velocity_std**2, velocity_std**2])
    # On the line itself the ranges say nothing across it: there the belief is as wide as the landmarks are apart.
    apart = float(np.hypot(*(data.landmarks[1] - data.landmarks[0])))
    cov[:2, :2] = np.linalg.solve(H.T @ H / range_noise**2 + np.eye(2) / apart**2, np.eye(2))
    return Gaussian(_SPACE, mean, cov)


def _crossing(data: LandmarksData, sign: float, range_noise: float) -> Array:
    """Where the circles of the first two ranges cross, left (+) or right (−) of the line from landmark 1 to 2.

    Circles that noise keeps from meeting are taken to touch, one standard deviation beside the line.
    """
    line = data.landmarks[1] - data.landmarks[0]
    apart = np.hypot(*line)
    first, second = data.ranges[0]
    along = (apart**2 + first**2 - second**2) / (2 * apart)
    across = np.sqrt(max(first**2 - along**2, range_noise**2))
    unit = line / apart
    return data.landmarks[0] + along * unit + sign * across * np.array([-unit[1], unit[0]])


def _load(source: list[Path]) -> LandmarksData:
    files = [file for path in source for file in expand(path, _SUFFIXES)]
    found = [file for file in dict.fromkeys(files) if file in source or _is_ours(file)]
    if len(found) != 1:
        names = ", ".join(map(str, found or source))
        raise BadInput(f"{names}: expected one .csv or .npz with {', '.join(_NEEDED)}, found {len(found)}")
    path = found[0]
    if path.suffix.lower() not in _SUFFIXES:
        raise BadInput(f"{path}: expected a data file that ends in {' or '.join(_SUFFIXES)}")
    table = read_table(path)
    table.require(_NEEDED)
    columns = table.columns((*_NEEDED, *_TRUTH))
    for name in _NEEDED:
        finite(columns[name], path, name)
    time = columns["time"]
    if len(time) < 2:
        raise BadInput(f"{path}: time has {len(time)} samples; at least 2 are needed")
    back = np.flatnonzero(np.diff(time) < 0)
    if len(back):
        raise BadInput(f"{path}: time goes back at sample {back[0] + 1}; sort the samples by time")
    places = np.stack([columns[name] for name in _PLACES], axis=1)
    moved = np.flatnonzero((places != places[0]).any(1))
    if len(moved):
        raise BadInput(f"{path}: the landmarks move at sample {moved[0]}; their places must be the same in every row")
    if (places[0, :2] == places[0, 2:]).all():
        raise BadInput(f"{path}: both landmarks stand at one place; ranges to it leave the direction open")
    truth = np.stack([columns.get(name, np.full(len(time), np.nan)) for name in _TRUTH], axis=1)
    ranges = np.stack([columns[name] for name in _RANGES], axis=1)
    return LandmarksData(time - time[0], ranges, places[0].reshape(2, 2), truth, (path,))


def _is_ours(path: Path) -> bool:
    try:
        return set(_NEEDED) <= set(read_table(path).names)
    except BadInput:
        return False
