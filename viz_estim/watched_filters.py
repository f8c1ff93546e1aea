"""What is told of other libraries' filters at each of their calls: FilterPy's objects, Stone Soup's components."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.watching import Watched

Watcher = Callable[[Any, Watched, float | None], object]


def of_filterpy(one: Any) -> Watcher | None:
    """For an object with x, P, predict and update."""
    return FilterPy if all(hasattr(one, name) for name in ("x", "P", "predict", "update")) else None


def of_stonesoup(one: Any) -> Watcher | None:
    """For a predictor or an updater."""
    if hasattr(one, "predict") and hasattr(one, "transition_model"):
        return Predictor
    return Updater if hasattr(one, "update") and hasattr(one, "measurement_model") else None


_METHODS = {
    "predict": "predict", "predict_steadystate": "predict", "update": "update", "update_correlated": "update",
    "update_steadystate": "plain", "predict_update": "both",
}  # fmt: skip


class FilterPy:
    """A filter with x and P, and mostly, after an update, y, S, K, R (Labbe, FilterPy)."""

    def __init__(self, kf: Any, recording: Watched, dt: float | None) -> None:
        self.kf, self.recording = kf, recording
        self._dt = dt if dt is not None else getattr(kf, "dt", getattr(kf, "_dt", None))
        self._begun = False
        known = [name for name in _METHODS if hasattr(kf, name)]
        self._signatures = {name: inspect.signature(getattr(kf, name)) for name in known}
        for name in known:
            told = {"predict": self._predicted, "update": self._updated, "plain": self._moved, "both": self._both}
            recording.wrap(kf, name, self._start, self._of(name, told[_METHODS[name]]), self._of(name, self._failed))
        if not self._tells:
            recording.say(
                f"{type(kf).__name__} keeps no residual: its updates are recorded without their readings' NIS"
            )

    @property
    def _tells(self) -> bool:
        """Whether an update leaves what it was made of."""
        return all(hasattr(self.kf, name) for name in ("y", "S", "K", "R"))

    def _of(self, method: str, told: Callable[..., None]) -> Callable[..., None]:
        """told(method, its arguments by name), of what was called with them; a result before them is left out."""
        signature, skip = self._signatures[method], told != self._failed

        def called(*args: Any, **kwargs: Any) -> None:
            bound = signature.bind(*(args[1:] if skip else args), **kwargs)
            told(method, dict(bound.arguments))

        return called

    def _start(self, *args: Any, **kwargs: Any) -> None:
        """Before the very first call, the belief is a start."""
        if not self._begun:
            self._begun = True
            self.recording.begin(0.0)
            self.recording.stage("start", mean=self.kf.x, cov=self.kf.P)

    def _move_on(self, dt: float | None) -> None:
        now = self.recording.now or 0.0
        dt = self._dt if dt is None else dt
        self.recording.begin(now + (1.0 if dt is None else float(dt)))

    def _predicted(self, method: str, given: dict[str, Any]) -> None:
        self._move_on(given.get("dt"))
        self.recording.control = given.get("u")
        self.recording.stage("predict", mean=self.kf.x, cov=self.kf.P, **self._figures(), **self._model(method, given))

    def _updated(self, method: str, given: dict[str, Any]) -> None:
        if given.get("z") is None:
            return
        kf = self.kf
        if not self._tells:
            self.recording.stage("update", mean=kf.x, cov=kf.P, z=given["z"], **self._figures(), **self._points())
            return
        residual = np.array(kf.y, float).reshape(-1)
        stage, sensor = self.recording.sensor(self._key(len(residual), given))
        self.recording.stage(
            stage, mean=kf.x, cov=kf.P, residual=residual, residual_cov=kf.S, gain=kf.K, sensor=sensor, z=given["z"],
            noise=self._noise(len(residual), given), **self._figures(), **self._points(),
        )  # fmt: skip

    def _moved(self, method: str, given: dict[str, Any]) -> None:
        self.recording.stage(method, mean=self.kf.x, cov=self.kf.P, z=given.get("z"))

    def _both(self, method: str, given: dict[str, Any]) -> None:
        self._move_on(None)
        self._updated(method, given)

    def _failed(self, method: str, given: dict[str, Any]) -> None:
        """What raised is recorded in the step that it was to make, with its reading."""
        if _METHODS[method] in ("predict", "both"):
            self._move_on(given.get("dt"))
        if given.get("z") is not None:
            self.recording.reading("z", given["z"])

    def _noise(self, m: int, given: dict[str, Any]) -> Array:
        if given.get("R2") is not None:  # a square root
            root = np.eye(m) * given["R2"]
            return np.asarray(root @ root.T)
        noise = self.kf.R if given.get("R") is None else given["R"]
        return np.asarray(np.eye(m) * noise if np.ndim(noise) == 0 else noise)

    def _key(self, m: int, given: dict[str, Any]) -> Hashable:
        """What tells one sensor from another: the size of its reading, and what it reads."""
        function = given.get("hx") or given.get("Hx")
        if function is not None:
            return m, getattr(function, "__code__", function)
        H = given.get("H")
        H = getattr(self.kf, "H", None) if H is None else H
        pattern = np.zeros(0) if H is None or np.ndim(H) == 0 else np.asarray(H)
        return m, (pattern != 0).tobytes()

    def _model(self, method: str, given: dict[str, Any]) -> dict[str, Any]:
        """F and Q of a linear prediction; NaN of one that leaves the covariance alone."""
        F, Q = (getattr(self.kf, k, None) if given.get(k) is None else given[k] for k in ("F", "Q"))
        n = np.size(self.kf.x)
        if F is None or Q is None or np.shape(F) != (n, n) or np.shape(Q) not in ((), (n, n)):
            return {}
        share = 1.0 if method == "predict" else np.nan
        return {
            "transition": share * np.asarray(F, float),
            "noise": share * np.eye(n) * Q if np.ndim(Q) == 0 else share * np.asarray(Q, float),
        }

    def _figures(self) -> dict[str, Any]:
        """Probabilities of the models among which it chooses, where it does."""
        names = [name for name in ("mu", "p") if hasattr(self.kf, "filters") and hasattr(self.kf, name)]
        return {name: getattr(self.kf, name) for name in names}

    def _points(self) -> dict[str, Any]:
        """Sigma points, or an ensemble."""
        kf, found = self.kf, {}
        n = np.size(kf.x)
        for name, field in (("sigma", "sigmas_f"), ("mapped", "sigmas_h"), ("sigma", "sigmas")):
            points = getattr(kf, field, None)
            if points is not None and np.ndim(points) == 2 and (name == "mapped" or np.shape(points)[1] == n):
                found[name] = points
        return found


class Predictor:
    """Stone Soup's: the state that it returns, at its time stamp."""

    def __init__(self, predictor: Any, recording: Watched, dt: float | None) -> None:
        self.recording = recording
        recording.wrap(predictor, "predict", _nothing, self._predicted, self._failed)

    def _predicted(self, prediction: Any, *args: Any, **kwargs: Any) -> None:
        self.recording.begin(_seconds(self.recording, prediction.timestamp))
        self.recording.stage("predict", **_belief(prediction))

    def _failed(self, *args: Any, timestamp: Any = None, **kwargs: Any) -> None:
        if timestamp is not None:
            self.recording.begin(_seconds(self.recording, timestamp))


class Updater:
    """Stone Soup's: the posterior, and the hypothesis that it came from."""

    def __init__(self, updater: Any, recording: Watched, dt: float | None) -> None:
        self.recording = recording
        recording.wrap(updater, "update", _nothing, self._updated, self._failed)

    def _updated(self, posterior: Any, hypothesis: Any, *args: Any, **kwargs: Any) -> None:
        recording = self.recording
        if recording.now is None:
            recording.begin(_seconds(recording, posterior.timestamp))
        measurement = getattr(hypothesis, "measurement", None)
        expected = getattr(hypothesis, "measurement_prediction", None)
        expected = expected or getattr(getattr(posterior, "hypothesis", None), "measurement_prediction", None)
        belief = _belief(posterior)
        if measurement is None or expected is None or "states" in belief or getattr(expected, "covar", None) is None:
            z = None if measurement is None else np.array(measurement.state_vector, float)
            recording.stage("update" if measurement is None or "states" in belief else "update_plain", **belief, z=z)
            return
        residual = np.array(measurement.state_vector - expected.state_vector, float).reshape(-1)
        S, model = np.array(expected.covar, float), measurement.measurement_model
        cross = getattr(expected, "cross_covar", None)
        gain = None if cross is None else np.linalg.solve(S.T, np.array(cross, float).T).T
        mapping = getattr(model, "mapping", None)
        stage, sensor = recording.sensor((len(residual), type(model).__name__, str(mapping)))
        recording.stage(
            stage, **belief, residual=residual, residual_cov=S, gain=gain, sensor=sensor, z=measurement.state_vector,
            noise=None if model is None else model.covar(),
        )  # fmt: skip

    def _failed(self, hypothesis: Any, *args: Any, **kwargs: Any) -> None:
        measurement = getattr(hypothesis, "measurement", None)
        if measurement is not None:
            self.recording.reading("z", np.array(measurement.state_vector, float))


def _belief(state: Any) -> dict[str, Any]:
    """A Stone Soup state's mean and covariance, or particles and weights, as `stage` takes them."""
    if getattr(state, "log_weight", None) is not None:
        return {"states": np.array(state.state_vector, float).T, "log_weights": np.array(state.log_weight, float)}
    return {"mean": np.array(state.state_vector, float), "cov": np.array(state.covar, float)}


def _nothing(*args: Any, **kwargs: Any) -> None:
    pass


def _seconds(recording: Watched, stamp: Any) -> float:
    """A time stamp in seconds from the first one."""
    if recording.origin is None:
        recording.origin = stamp
    return float((stamp - recording.origin).total_seconds())
