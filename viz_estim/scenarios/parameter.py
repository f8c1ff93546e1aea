"""An unknown parameter learnt beside the state: x' = a·x + ε, y = √(x² + 1) + ν.

ε ~ N(0, 1), ν ~ N(0, 1/2), x₀ ~ N(1, 2), a = −1. y is even in x, so that a and −a explain the data equally well: every
solution x_k with a has its mirror (−1)^k·x_k with −a.

A log is a .csv or .npz with the column `y`, one row an observation, and optionally the truth `x` and `a`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.kalman import KalmanFilter
from viz_estim.core.measurement import Sensor
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.errors import BadInput
from viz_estim.scenarios.checks import positive
from viz_estim.scenarios.reading import expand, finite
from viz_estim.scenarios.tables import read_table

_SUFFIXES = (".csv", ".npz")
_COLUMNS = {"y", "x", "a"}
_SPACE = Product(x=Euclidean(("x",)), a=Euclidean(("a",)))
_READING = Euclidean(("y",))
_START_MEAN, _START_VARIANCE = 1.0, 2.0  # of x₀
_PROCESS_STD, _READING_STD = 1.0, math.sqrt(0.5)
_TRUE_A = -1.0
_SEEDS = 200
_NOTES = """The EKF learns **a** from readings that tell only |x|. The tab *State* has **a** ±σ beside the truth, −1.

- From `prior_a=-0.5` it settles near −1, from `prior_a=0.5` near +1, and fits the readings exactly as well: a and −a,
  with every other x turned round, give the same y. **The sign is the prior's, not the data's**; from 0 it never moves.
- The metrics say how often ±σ at the end covers |a| over 200 seeds (an honest ±σ: 68 %), and how often a itself. So
  ±σ is right about the size and knows nothing of the second solution: where the sign is wrong, a lies a hundred σ off.
- x has two signs as well. Where the filter takes the other one, its error is 2|x| and NEES is huge, while NIS, which
  sees |x| alone, is not. Near x = 0 the slope of y vanishes: a reading there moves nothing."""


@dataclass(frozen=True)
class ParameterData:
    """Observations y (T,), and the truth (T, 2) of x and a, NaN where it is absent; files it was read from."""

    y: Array
    truth: Array
    files: tuple[Path, ...] = ()


def parameter(
    source: list[Path] | None, rng: np.random.Generator, *, observations: int = 100, a: float = _TRUE_A
) -> ParameterData:
    """Observations from a file, or simulated ones of a system with the parameter `a`."""
    if source is not None:
        return _load(_find(source))
    if not 2 <= observations <= 100_000 or abs(a) > 1:
        raise BadInput(
            f"a simulation needs 2 to 100000 observations and a in [−1, 1] (beyond, x grows without bound), got "
            f"observations={observations}, a={a:g}"
        )
    return simulate(rng, observations, a)


def save(data: ParameterData, folder: Path) -> list[Path]:
    """Writes simulated data as `parameter.csv`."""
    path = folder / "parameter.csv"
    if path.exists():
        raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
    table = np.column_stack([data.y, data.truth])
    np.savetxt(path, table, "%.17g", ",", header="y,x,a", comments="")
    return [path]


def simulate(rng: np.random.Generator, observations: int, a: float = _TRUE_A) -> ParameterData:
    """Observations y₀, y₁, … of the model, from an x₀ of its own."""
    steps = _PROCESS_STD * rng.standard_normal(observations)
    steps[0] = _START_MEAN + math.sqrt(_START_VARIANCE) * rng.standard_normal()
    x = scipy.signal.lfilter([1.0], [1.0, -a], steps)
    y = np.sqrt(x**2 + 1) + _READING_STD * rng.standard_normal(observations)
    return ParameterData(y, np.stack([x, np.full(observations, a)], axis=-1))


def parameter_ekf(
    data: ParameterData,
    *,
    prior_a: float = -0.5,
    prior_a_std: float = 0.5,
    process_noise: float = _PROCESS_STD,
    measurement_noise: float = _READING_STD,
) -> Scenario:
    """An EKF on (x, a) that learns a: which sign it settles on, the data don't say and the prior decides.

    Noises are standard deviations of ε and ν.
    """
    positive(prior_a_std=prior_a_std, process_noise=process_noise, measurement_noise=measurement_noise)
    Q, R = np.diag([process_noise**2, 0.0]), np.array([[measurement_noise**2]])
    estimator = KalmanFilter(
        _moved, _transition, lambda x, tick: Q, {"y": Sensor(_READING, _read, R, jacobian=_reading_slope)}
    )
    start = Gaussian(_SPACE, np.array([_START_MEAN, prior_a]), np.diag([_START_VARIANCE, prior_a_std**2]))
    ticks = [Tick(float(k), float(k > 0), measurements={"y": y}) for k, y in enumerate(data.y[:, None])]
    return Scenario(estimator, {0: start}, ticks, data.truth, {}, _NOTES, _over_seeds(estimator, start))


def _over_seeds(estimator: KalmanFilter, start: Gaussian) -> dict[str, float]:
    """How the filter ends on 100 observations of a = −1, simulated with the seeds 0, 1, … and run as one batch."""
    y = np.stack([simulate(np.random.default_rng(seed), 100).y for seed in range(_SEEDS)])
    belief = Gaussian(_SPACE, np.tile(start.mean, (_SEEDS, 1)), np.tile(start.cov, (_SEEDS, 1, 1)))
    rng = np.random.default_rng()  # an EKF draws nothing
    for k in range(y.shape[1]):
        *_, last = estimator.step(belief, Tick(float(k), float(k > 0), measurements={"y": y[:, k, None]}), rng)
        belief = last.belief
    a, sigma = belief.mean[:, 1], np.sqrt(belief.cov[:, 1, 1])
    return {
        f"coverage_of_abs_a_{_SEEDS}_seeds": float((np.abs(np.abs(a) - abs(_TRUE_A)) <= sigma).mean()),
        f"coverage_of_a_{_SEEDS}_seeds": float((np.abs(a - _TRUE_A) <= sigma).mean()),
        f"negative_a_{_SEEDS}_seeds": float((a < 0).mean()),
    }


def _moved(x: Array, tick: Tick) -> Array:
    return np.stack([x[..., 1] * x[..., 0], x[..., 1]], axis=-1)


def _transition(x: Array, tick: Tick) -> Array:
    F = np.zeros((*x.shape, 2))
    F[..., 0, 0], F[..., 0, 1], F[..., 1, 1] = x[..., 1], x[..., 0], 1.0
    return F


def _read(x: Array) -> Array:
    return np.sqrt(x[..., :1] ** 2 + 1)


def _reading_slope(x: Array) -> Array:
    H = np.zeros((*x.shape[:-1], 1, 2))
    H[..., 0, 0] = x[..., 0] / np.sqrt(x[..., 0] ** 2 + 1)
    return H


def _find(paths: list[Path]) -> Path:
    """The one log among files and folders: in a folder a file with no other columns, else the file that was named."""
    found = []
    for path in paths:
        files = expand(path, _SUFFIXES)
        found += files if not path.is_dir() else [file for file in files if _fits(file)]
    where = ", ".join(map(str, paths))
    if not found:
        raise BadInput(f"{where}: no log of the system parameter there (a .csv or .npz with the column `y`)")
    if len(found) > 1:
        raise BadInput(f"{len(found)} logs found, a run takes one: name one of {', '.join(f.name for f in found)}")
    return found[0]


def _fits(path: Path) -> bool:
    try:
        held = set(read_table(path).names)
    except BadInput:  # nobody named this one
        return False
    return {"y"} <= held <= _COLUMNS


def _load(path: Path) -> ParameterData:
    if path.suffix.lower() not in _SUFFIXES:
        raise BadInput(f"{path}: expected a .csv or .npz with the column `y`")
    table = read_table(path)
    table.require(("y",))
    columns = table.columns(("y", "x", "a"))
    y = finite(columns["y"], path, "y")
    nothing = np.full(len(y), np.nan)
    return ParameterData(y, np.stack([columns.get(name, nothing) for name in ("x", "a")], axis=-1), (path,))
