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
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from viz_estim import opened, told
from viz_estim.core.beliefs import Belief, Categorical, Particles
from viz_estim.core.consistency import Tally
from viz_estim.core.quaternions import Array
from viz_estim.core.run import FIRST, Failure, Scenario, Step, Tick
from viz_estim.core.spaces import Euclidean, Product, Space
from viz_estim.core.stages import Stage
from viz_estim.files import check_writable
from viz_estim.recording.recorder import Recorder


def record(
    path: str | Path, space: told.Names | None = None, *, sensors: Mapping[str, told.Names] | None = None
) -> Recording:
    """A recording to be told of stages and steps; a context manager, which ends it.

    space: the state's geometry; or its components' names, with their units as a dict; without it they are x0, x1, …. A
    place that comes first (x, y, and z, in m) is drawn in a plan, and a heading right after it (theta, in rad) too.
    Of a filter over labels it is the labels.
    sensors: the same of each sensor's reading, by the name that `stage` calls it; a `Product` is a reading of several.
    """
    return Recording(Path(path), space, sensors or {})


class Recording:
    """What a person's own code tells of its steps; arrays are copied, for such code often goes on in place.

    Leaving the context by an exception records it as the run's failure, in the step that was not ended.
    """

    made_by = "viz_estim.record"

    def __init__(self, path: Path, space: told.Names | None, sensors: Mapping[str, told.Names]) -> None:
        check_writable(path, suffix=".rrd")
        self.path, self._file = path, path.resolve()  # also where the program goes to another folder
        self._space: Space | None = None if space is None else told.state_of(space)
        self._labels: tuple[str, ...] = ()
        self._sensors = {name: told.space_of(names) for name, names in sensors.items()}
        self._measured: dict[str, tuple[str, Product]] = {}  # by stage: the sensor's name, and its reading
        self._shapes: dict[str, dict[str, tuple[int, ...]]] = {}  # of a stage's numbers, by stage
        self._belief: Belief | None = None  # the last
        self._stages: list[Stage] = []
        self._readings: dict[str, Array] = {}
        self._times: list[float] = []
        self._count = 0
        self._recorder: Recorder | None = None
        self._failure: Failure | None = None
        self._closed, self._told, self._has_truth = False, 0, False
        self._with_cov = True  # a covariance is told of
        self._tally: Tally
        opened.begin(self, self._file)

    def stage(
        self,
        name: str,
        *,
        mean: ArrayLike | None = None,
        cov: ArrayLike | None = None,
        states: ArrayLike | None = None,
        weights: ArrayLike | None = None,
        log_weights: ArrayLike | None = None,
        probabilities: ArrayLike | Mapping[str, float] | None = None,
        residual: ArrayLike | None = None,
        residual_cov: ArrayLike | None = None,
        gain: ArrayLike | None = None,
        sensor: str = "z",
        z: ArrayLike | None = None,
        predicted: ArrayLike | None = None,
        noise: ArrayLike | None = None,
        used: ArrayLike = True,
        blind: ArrayLike | None = None,
        **numbers: ArrayLike,
    ) -> None:
        """The belief after a stage: mean (n,) and cov (d, d), the mean alone of a filter that has no covariance; or
        particles' states (N, n) with weights or log_weights (N,); or probabilities (K,) of the labels. Call a
        prediction `predict`, or `predict_…`: by that name its motion is held against the truth's; and the first belief
        `start`.

        Of an update also the residual (m,), its covariance S (m, m) and the gain (d, m); if known, the reading z, what
        was predicted, the noise R (m, m), whether it was used or gated, and the direction (d,) that it is blind to.
        Without z and predicted the reading is recorded as the residual, as if zero had been expected; without the noise
        R is zero. Of a prediction, `noise` is Q (d, d).

        numbers: whatever else the stage has, by name: `transition` F (d, d); `sigma`, `drawn`, `propagated` points
        (N, n), and `mapped` ones of the reading; `log_likelihoods` (N,) of particles, or (K,) of labels; `ancestors`
        (N,) of a resampling; a figure of one's own, which is plotted. ValueError where a shape does not fit, or where a
        stage has other numbers than when it first came.
        """
        self._check_open()
        if not re.fullmatch(r"[\w-]+", name):
            raise ValueError(f"stage {name!r}: a stage's name is of letters, digits, _ and -")
        where = f"stage {name}"
        belief = self._believed(where, mean, cov, states, weights, log_weights, probabilities)
        fields: dict[str, Any] = {}
        if residual is None or residual_cov is None:
            if residual is not None or residual_cov is not None or gain is not None:
                raise ValueError(f"{where}: give residual and residual_cov together, or neither")
            if noise is not None:
                numbers["noise"] = noise
        else:
            space = self._reading(name, sensor, np.size(np.asarray(residual)))
            directions = len(told.space_of(belief.space).axes) if not isinstance(belief, Categorical) else 0
            fields["innovation"], K = told.innovation(
                where, space, directions, residual, residual_cov,
                gain=gain, z=z, predicted=predicted, noise=noise, used=used, blind=blind,
            )  # fmt: skip
            fields |= {} if K is None else {"gain": K}
            self._readings |= {part: fields["innovation"].z[at] for part, at in space.at.items()}
        reading = self._measured[name][1] if name in self._measured else None
        fields |= told.others(where, belief, self._belief, reading, sensor, z, numbers)
        if z is not None and sensor not in self._readings and "innovation" not in fields:
            self._readings[sensor] = told.vector(z)
        self._check_alike(name, fields)
        self._space, self._labels = getattr(belief, "space", None), getattr(belief, "labels", ())
        self._belief = belief
        self._stages.append(told.stage_of(name, belief, fields))

    def step(self, *, time: float, truth: ArrayLike | str | None = None, control: ArrayLike | None = None) -> None:
        """Ends a step at a time (s, not before the last one's), with the true state (n,), or label, where it is known.

        Whether a truth is drawn is settled by the first step: give one there, of NaN if it is not known yet.
        """
        self._check_open()
        time = told.seconds(f"step {self._count}", time, self._times[-1] if self._times else -np.inf)
        if not self._stages:
            raise ValueError(f"step {self._count}: tell of a stage before the step ends")
        true = told.truth(f"step {self._count}: truth", self._labels, self._space, truth)
        if self._count and true is not None and not self._has_truth:
            raise ValueError(f"step {self._count}: a truth, but the first step had none; give that one of NaN")
        self._has_truth |= true is not None
        dt = time - self._times[-1] if self._times else 0.0
        tick = Tick(time, dt, None if control is None else told.vector(control), dict(self._readings))
        self._times.append(time)
        self._add(Step(self._count, tick, tuple(self._stages), true, self._failure))
        self._stages, self._readings = [], {}
        self._count += 1

    def fail(self, error: BaseException, stage: str = "") -> None:
        """Ends the run with what was raised, in the step that is not ended, and in the stage of that name."""
        last = self._stages[-1].name if self._stages else ""
        where = stage or (f"after {last}" if last else FIRST)
        self._failure = Failure(self._count, where, f"{type(error).__name__}: {error}")

    def close(self) -> None:
        """Ends the recording; stages that no step ended are one at the time that would have come next."""
        opened.end(self, self._file)
        untold = self._failure and self._failure.step == self._count
        if self._stages or (untold and self._recorder):
            gap = self._times[-1] - self._times[-2] if len(self._times) > 1 else 0.0
            time = self._times[-1] + gap if self._times else 0.0
            if not self._stages:
                self._add(Step(self._count, Tick(time, gap, None, dict(self._readings)), (), None, self._failure))
                self._times.append(time)
                self._count += 1
            else:
                self.step(time=time)
        self._closed = True
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

    def _check_open(self) -> None:
        if self._closed:  # a step more would begin the file anew, over what it holds
            raise ValueError(f"{self.path}: this recording is closed; begin another by viz_estim.record")

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
            known = step.truth if self._labels or np.isfinite(step.truth).any() else belief.mean
            truth = np.stack([known, np.full(len(known), np.nan)])
        scenario = Scenario(None, {0: belief}, [step.tick], truth)  # type: ignore[arg-type]
        self._tally = Tally(scenario.space)
        properties: dict[str, Any] = {
            "title": self.path.stem,
            "scenario": self.path.stem,
            "recorded_by": self.made_by,
            "params": {},
            "seed": None,
            "data": [],
            "calibration": None,
            "covariance": self._with_cov,
            "versions": {name: version(name) for name in ("viz-estim", "rerun-sdk", "numpy")}
            | {"python": platform.python_version()},
            "first": 0,
        }
        self._recorder = Recorder(self._file, scenario, properties)

    def _believed(
        self, where: str, mean: ArrayLike | None, cov: ArrayLike | None, states: ArrayLike | None,
        weights: ArrayLike | None, log_weights: ArrayLike | None, probabilities: ArrayLike | Mapping[str, float] | None,
    ) -> Belief:  # fmt: skip
        """The belief, of the kind that the recording began with."""
        kinds = [mean is not None or cov is not None, states is not None, probabilities is not None]
        if sum(kinds) != 1:
            raise ValueError(f"{where}: give mean and cov, or states (of particles), or probabilities (of labels)")
        belief: Belief
        if probabilities is not None:
            plain = tuple(self._space.names) if self._space is not None and self._belief is None else self._labels
            belief = told.categorical(where, plain, probabilities)
        elif states is not None:
            belief = told.particles(where, self._space, states, weights, log_weights)
        elif mean is None:
            raise ValueError(f"{where}: give the mean with cov")
        else:
            belief = told.gaussian(where, self._space, mean, cov)
            if self._belief is not None and self._with_cov != (cov is not None):
                raise ValueError(
                    f"{where}: {'no cov, but there was one' if self._with_cov else 'a cov, but there was none'} before"
                )
            self._with_cov = cov is not None
        if self._belief is not None and (type(belief), belief.shapes) != (type(self._belief), self._belief.shapes):
            if isinstance(belief, Particles) and isinstance(self._belief, Particles):
                now, then = (len(one.log_weights) for one in (belief, self._belief))
                raise ValueError(f"{where}: {now} particles, but {then} before: a recording holds one number of them")
            raise ValueError(f"{where}: the belief is of another kind than before")
        return belief

    def _reading(self, stage: str, sensor: str, m: int) -> Product:
        """The space of a stage's reading: named, or of as many components as it has."""
        if stage not in self._measured:
            names = self._sensors.get(sensor) or Euclidean([f"{sensor}{i}" for i in range(m)] if m > 1 else [sensor])
            self._measured[stage] = sensor, names if isinstance(names, Product) else Product(**{sensor: names})
        known, space = self._measured[stage]
        if known != sensor:
            raise ValueError(f"stage {stage}: its reading was {known}; name a {sensor}'s update otherwise")
        return space

    def _check_alike(self, stage: str, fields: dict[str, Any]) -> None:
        """ValueError unless a stage has the same numbers each time: they are columns of one table."""
        shapes = {name: np.shape(getattr(value, "points", value)) for name, value in fields.items()}
        known = self._shapes.setdefault(stage, shapes)
        for name in known.keys() | shapes.keys():
            if known.get(name) != shapes.get(name):
                was = "has none" if name not in known else f"was of shape {known[name]}"
                now = "none" if name not in shapes else f"one of shape {shapes[name]}"
                raise ValueError(
                    f"stage {stage}: {name} {was} when the stage first came, now {now}; give it the same each time, or "
                    "call this stage by another name"
                )
