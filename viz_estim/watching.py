"""Other libraries' filters recorded as they run, by one line: `viz_estim.watch(kf)`.

Their `predict` and `update` are wrapped on the very objects that are given; what they return and hold stays as it is.
"""

from __future__ import annotations

import atexit
import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from viz_estim.recordings import Recording
from viz_estim.told import Names


def watch(
    *filters: Any, path: str | Path | None = None, space: Names | None = None, dt: float | None = None
) -> Recording:
    """Records a filter of FilterPy's kind (an object with x, P, predict and update), or Stone Soup's predictor and
    updater, from here on; `close` ends the recording, or the end of the program.

    A step is a prediction with the updates after it. path: recordings/TYPE.rrd unless given; space: names, units and
    geometry of the state as in `record`; dt: seconds from one prediction to the next, of a filter that does not say.
    ValueError where an object is neither.
    """
    path = Path(path) if path else Path("recordings") / f"{type(filters[0]).__name__ if filters else ''}.rrd"
    path.parent.mkdir(parents=True, exist_ok=True)
    recording = Watched(path, space, {})
    for one in filters:
        if all(hasattr(one, name) for name in ("x", "P", "predict", "update")):
            _FilterPy(one, recording, dt)
        elif hasattr(one, "predict") and hasattr(one, "transition_model"):
            recording.wrap(one, "predict", functools.partial(_predicted, recording))
        elif hasattr(one, "update") and hasattr(one, "measurement_model"):
            recording.wrap(one, "update", functools.partial(_updated, recording))
        else:
            raise ValueError(
                f"{type(one).__name__}: expected a filter with x, P, predict and update, or Stone Soup's predictor or "
                "updater; record others by viz_estim.record"
            )
    atexit.register(recording.close)
    return recording


class Watched(Recording):
    """A recording that other objects' calls fill. A step ends when the next one begins."""

    made_by = "viz_estim.watch"

    def __init__(self, path: Path, space: Names | None, sensors: Mapping[str, Names]) -> None:
        super().__init__(path, space, sensors)
        self.now: float | None = None  # the time of the step that is not ended
        self.origin: Any = None  # the first time stamp, of a library that has them
        self._undo: list[Callable[[], None]] = []
        self._sizes: list[int] = []

    def wrap(self, owner: Any, name: str, told: Callable[..., None]) -> None:
        """Has told(result, *arguments) called after each call of a method."""
        method = getattr(owner, name)

        @functools.wraps(method)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            self._failure = None  # what was raised before was caught, or it would not come here
            try:
                result = method(*args, **kwargs)
            except Exception as error:
                self.fail(error)
                raise
            told(result, *args, **kwargs)
            return result

        setattr(owner, name, wrapped)
        self._undo.append(functools.partial(delattr, owner, name))

    def begin(self, time: float) -> None:
        """A step begins: the one before, if any, has ended."""
        if self._stages and self.now is not None:
            self.step(time=self.now)
        self.now = time

    def update(self, size: int, **told: Any) -> None:
        """An update; readings of another size than the first's are another sensor's."""
        if size not in self._sizes:
            self._sizes.append(size)
        other = self._sizes[0] != size
        self.stage(f"update_{size}" if other else "update", sensor=f"z{size}" if other else "z", **told)

    def close(self) -> None:
        """Ends the recording and leaves the objects as they were."""
        for undo in self._undo:
            undo()
        self._undo = []
        atexit.unregister(self.close)
        if self._stages and self.now is not None:
            self.step(time=max(self.now, self._times[-1] if self._times else self.now))
        super().close()


class _FilterPy:
    """A filter with x, P and, after an update, y, S, K, R (Labbe, FilterPy)."""

    def __init__(self, kf: Any, recording: Watched, dt: float | None) -> None:
        self.kf, self.recording = kf, recording
        self._dt = dt if dt is not None else getattr(kf, "dt", getattr(kf, "_dt", None))
        self._signatures = {name: inspect.signature(getattr(kf, name)) for name in ("predict", "update")}
        self._begun = False
        for name in ("predict", "update", "predict_update"):
            if hasattr(kf, name):
                self._first(name)
                recording.wrap(kf, name, getattr(self, f"_after_{name}"))

    def _first(self, name: str) -> None:
        """Before the very first call, the belief is a start."""
        method = getattr(self.kf, name)

        @functools.wraps(method)
        def started(*args: Any, **kwargs: Any) -> Any:
            if not self._begun:
                self._begun = True
                self.recording.begin(0.0)
                self.recording.stage("start", mean=self.kf.x, cov=self.kf.P)
            return method(*args, **kwargs)

        setattr(self.kf, name, started)

    def _given(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
        return dict(self._signatures[name].bind(*args, **kwargs).arguments)

    def _after_predict(self, result: Any, *args: Any, **kwargs: Any) -> None:
        given = self._given("predict", args, kwargs).get("dt")
        self._move_on(given if given is not None else self._dt)
        self.recording.stage("predict", mean=self.kf.x, cov=self.kf.P)

    def _after_update(self, result: Any, *args: Any, **kwargs: Any) -> None:
        given = self._given("update", args, kwargs)
        if given.get("z") is not None:
            self._updated(given["z"], given.get("R"))

    def _after_predict_update(self, result: Any, z: Any, *args: Any, **kwargs: Any) -> None:
        self._move_on(self._dt)
        self._updated(z, None)

    def _move_on(self, dt: float | None) -> None:
        now = self.recording.now or 0.0
        self.recording.begin(now + (1.0 if dt is None else float(dt)))

    def _updated(self, z: Any, R: Any) -> None:
        kf = self.kf
        residual = np.array(kf.y, float).reshape(-1)
        m = len(residual)
        noise = kf.R if R is None else R
        self.recording.update(
            m, mean=kf.x, cov=kf.P, residual=residual, residual_cov=kf.S, gain=kf.K, z=z,
            noise=np.eye(m) * noise if np.ndim(noise) == 0 else noise,
        )  # fmt: skip


def _predicted(recording: Watched, prediction: Any, *args: Any, **kwargs: Any) -> None:
    """Of Stone Soup's predictor: the state that it returned, at its time stamp."""
    recording.begin(_seconds(recording, prediction.timestamp))
    recording.stage("predict", mean=prediction.state_vector, cov=prediction.covar)


def _updated(recording: Watched, posterior: Any, hypothesis: Any, **kwargs: Any) -> None:
    """Of Stone Soup's updater: the posterior, and the hypothesis that it came from."""
    expected, measurement = hypothesis.measurement_prediction, hypothesis.measurement
    if recording.now is None:
        recording.begin(_seconds(recording, posterior.timestamp))
    residual = np.array(measurement.state_vector - expected.state_vector, float).reshape(-1)
    S = np.array(expected.covar, float)
    model = getattr(measurement, "measurement_model", None)
    gain = np.linalg.solve(S.T, np.array(expected.cross_covar, float).T).T
    recording.update(
        len(residual), mean=posterior.state_vector, cov=posterior.covar, residual=residual, residual_cov=S, gain=gain,
        z=measurement.state_vector, noise=model.covar() if model is not None else None,
    )  # fmt: skip


def _seconds(recording: Watched, stamp: Any) -> float:
    """A time stamp in seconds from the first one."""
    if recording.origin is None:
        recording.origin = stamp
    return float((stamp - recording.origin).total_seconds())
