"""A recording of code that is no scenario: a person's own loop says what each stage left, step by step.

with viz_estim.record("run.rrd", {"x": "m", "vx": "m/s"}) as rec:
    for t, z in readings:
        …
        rec.stage("predict", mean=x, cov=P)
        …
        rec.stage("update", mean=x, cov=P, residual=y, residual_cov=S, gain=K)
        rec.step(time=t)
"""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.consistency import Tally
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Failure, Scenario, Step, Tick
from viz_estim.core.spaces import Euclidean, Product, Space
from viz_estim.core.stages import Innovation, Stage
from viz_estim.files import check_writable
from viz_estim.recording.recorder import Recorder

Names = Space | Mapping[str, str] | Sequence[str]


@dataclass(frozen=True, slots=True)
class Corrected(Stage):
    """An update as a person's own code tells it."""

    innovation: Innovation


@dataclass(frozen=True, slots=True)
class CorrectedByGain(Corrected):
    """The same with its gain, so that what moved the estimate is known."""

    gain: Array


def record(path: str | Path, space: Names | None = None, *, sensors: Mapping[str, Names] | None = None) -> Recording:
    """A recording to be told of stages and steps; a context manager, which ends it.

    space: the state's geometry; or its components' names, with their units as a dict; without it they are x0, x1, ….
    sensors: the same of each sensor's reading, by the name that `stage` calls it.
    """
    return Recording(Path(path), space, sensors or {})


class Recording:
    """What a person's own code tells of its steps; arrays are copied, for such code often goes on in place.

    Leaving the context by an exception records it as the run's failure, in the step that was not ended.
    """

    made_by = "viz_estim.record"

    def __init__(self, path: Path, space: Names | None, sensors: Mapping[str, Names]) -> None:
        check_writable(path, suffix=".rrd")
        self.path = path
        self._space = None if space is None else _space(space)
        self._sensors = {name: _space(names) for name, names in sensors.items()}
        self._measured: dict[str, Product] = {}  # by stage
        self._stages: list[Stage] = []
        self._readings: dict[str, Array] = {}
        self._times: list[float] = []
        self._count = 0
        self._recorder: Recorder | None = None
        self._failure: Failure | None = None
        self._told = 0
        self._tally: Tally

    def stage(
        self,
        name: str,
        *,
        mean: ArrayLike,
        cov: ArrayLike,
        residual: ArrayLike | None = None,
        residual_cov: ArrayLike | None = None,
        gain: ArrayLike | None = None,
        sensor: str = "z",
        z: ArrayLike | None = None,
        noise: ArrayLike | None = None,
    ) -> None:
        """The belief after a stage: mean (n,), cov (d, d). Of an update also the residual (m,), its covariance S (m, m)
        and the gain (d, m); if known, the reading z and its noise R (m, m).

        Without z the reading is recorded as the residual, as if zero had been expected; without the noise R is zero.
        ValueError where a shape does not fit.
        """
        if not re.fullmatch(r"[\w-]+", name):
            raise ValueError(f"stage {name!r}: a stage's name is of letters, digits, _ and -")
        x, P = _vector(mean), _matrix(cov)
        if self._space is None:
            self._space = Euclidean([f"x{i}" for i in range(len(x))])
        n, d = len(self._space.names), len(self._space.axes)
        _fits(f"stage {name}: mean", x, (n,))
        _fits(f"stage {name}: cov", P, (d, d))
        belief = Gaussian(self._space, x, P)
        if residual is None or residual_cov is None:
            if residual is not None or residual_cov is not None or gain is not None:
                raise ValueError(f"stage {name}: give residual and residual_cov together, or neither")
            self._stages.append(Stage(name, belief))
            return
        innovation, K = self._innovation(name, sensor, _vector(residual), _matrix(residual_cov), gain, z, noise, d)
        self._readings[sensor] = innovation.z
        self._stages.append(
            Corrected(name, belief, innovation) if K is None else CorrectedByGain(name, belief, innovation, K)
        )

    def step(self, *, time: float, truth: ArrayLike | None = None, control: ArrayLike | None = None) -> None:
        """Ends a step at a time (s, not before the last one's), with the true state (n,) where it is known.

        Whether a truth is drawn is settled by the first step: give one there, of NaN if it is not known yet.
        """
        if not np.isfinite(time) or (self._times and time < self._times[-1]):
            raise ValueError(f"step {self._count}: its time {time} is not after the last one's")
        if not self._stages:
            raise ValueError(f"step {self._count}: tell of a stage before the step ends")
        assert self._space is not None
        true = None if truth is None else _vector(truth)
        if true is not None:
            _fits(f"step {self._count}: truth", true, (len(self._space.names),))
        dt = time - self._times[-1] if self._times else 0.0
        tick = Tick(float(time), dt, None if control is None else _vector(control), dict(self._readings))
        self._times.append(float(time))
        self._add(Step(self._count, tick, tuple(self._stages), true, self._failure))
        self._stages, self._readings = [], {}
        self._count += 1

    def fail(self, error: BaseException) -> None:
        """Ends the run with what was raised, in the step that is not ended."""
        last = self._stages[-1].name if self._stages else ""
        text = f"{type(error).__name__}: {error}"
        self._failure = Failure(self._count, f"after {last}" if last else "first", text)

    def close(self) -> None:
        """Ends the recording; stages that no step ended are one at the time that would have come next."""
        if self._stages or (self._failure and self._recorder):
            gap = self._times[-1] - self._times[-2] if len(self._times) > 1 else 0.0
            time = self._times[-1] + gap if self._times else 0.0
            if not self._stages:
                self._add(Step(self._count, Tick(time, gap), (), None, self._failure))
                self._times.append(time)
                self._count += 1
            else:
                self.step(time=time)
        if self._recorder is None:
            return
        failure = self._failure
        result = {
            "steps": self._count,
            "stages": self._told,
            "duration_s": self._times[-1] - self._times[0],
            "error": {"step": failure.step, "stage": failure.stage, "message": failure.message} if failure else None,
            **self._tally.summary(),
        }
        self._recorder.close(result)
        self._recorder = None

    def __enter__(self) -> Recording:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, Exception):
            self.fail(error)
        self.close()

    def _add(self, step: Step) -> None:
        if self._recorder is None:
            self._begin(step)
        assert self._recorder
        self._recorder.add(step)
        self._tally.add(step)
        self._told += len(step.stages)

    def _begin(self, step: Step) -> None:
        """Opens the file, with all that must be known beforehand taken from the first step."""
        belief = step.stages[0].belief
        truth = None
        if step.truth is not None:
            # Two rows, of which one is unknown: a truth that may have gaps, of the parts that this step knows, or of
            # all where it knows none yet.
            known = step.truth if np.isfinite(step.truth).any() else belief.mean
            truth = np.stack([known, np.full(len(known), np.nan)])
        scenario = Scenario(None, {0: belief}, [step.tick], truth)  # type: ignore[arg-type]
        self._tally = Tally(belief.space)
        properties: dict[str, Any] = {
            "title": self.path.stem,
            "scenario": self.path.stem,
            "recorded_by": self.made_by,
            "params": {},
            "seed": None,
            "data": [],
            "calibration": None,
            "versions": {name: version(name) for name in ("viz-estim", "rerun-sdk", "numpy")}
            | {"python": platform.python_version()},
            "first": 0,
        }
        self._recorder = Recorder(self.path, scenario, properties)

    def _innovation(
        self, stage: str, sensor: str, residual: Array, S: Array, gain: ArrayLike | None, z: ArrayLike | None,
        noise: ArrayLike | None, d: int,
    ) -> tuple[Innovation, Array | None]:  # fmt: skip
        m = len(residual)
        if stage not in self._measured:
            names = self._sensors.get(sensor) or Euclidean([f"{sensor}{i}" for i in range(m)] if m > 1 else [sensor])
            self._measured[stage] = Product(**{sensor: names})
        space = self._measured[stage]
        if sensor not in space.parts:
            raise ValueError(
                f"stage {stage}: its reading was {next(iter(space.parts))}; name a {sensor}'s update otherwise"
            )
        size = len(space.axes)
        _fits(f"stage {stage}: residual", residual, (size,))
        _fits(f"stage {stage}: residual_cov", S, (size, size))
        K = None if gain is None else _matrix(gain, (d, size))
        if K is not None:
            _fits(f"stage {stage}: gain", K, (d, size))
        R = np.zeros((size, size)) if noise is None else _matrix(noise)
        _fits(f"stage {stage}: noise", R, (size, size))
        reading = residual if z is None else _vector(z)
        flat = len(reading) == size
        predicted = reading - residual if flat else reading
        yes = np.ones(1, bool)
        C = np.zeros((d, size)) if K is None else K @ S
        return Innovation(space, reading, predicted, residual, S, R, C, yes, yes, np.zeros((d, 1))), K


def _space(names: Names) -> Space:
    if isinstance(names, Mapping):
        return Euclidean(list(names), list(names.values()))
    if isinstance(names, Sequence):
        return Euclidean(names)
    return names


def _vector(values: ArrayLike) -> Array:
    """A copy (n,) of a vector, a column, or one number."""
    return np.array(values, float).reshape(-1)


def _matrix(values: ArrayLike, shape: tuple[int, int] | None = None) -> Array:
    """A copy as a matrix; one number is 1 × 1, and a vector a row or column where the shape asks for it."""
    found = np.array(values, float)
    if shape and found.size == shape[0] * shape[1] and found.ndim < 2:
        return found.reshape(shape)
    return np.atleast_2d(found)


def _fits(what: str, values: Array, shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        raise ValueError(f"{what}: expected the shape {shape}, got {values.shape}")
