"""Noise covariances of a differential drive: the documented ones, their fit to ground truth, and its file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from viz_estim.core.identification import Noise, identify, input_noise
from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.files import sha256
from viz_estim.scenarios.diffdrive_files import DriveLog
from viz_estim.scenarios.diffdrive_model import SPACE, effect, moved

_FEWEST = 10  # readings: with fewer a variance is not known to a half


@dataclass(frozen=True)
class Calibration:
    """Covariances (2, 2): of the inputs (speed in m/s, turn rate in rad/s) at each step; of a GPS reading (m)."""

    input_cov: Array
    gps_cov: Array


# The course's V and W, identified from its calibration.mat.
DOCUMENTED = Calibration(
    input_cov=np.array([[0.2590, 0.0010], [0.0010, 0.0625]]), gps_cov=np.array([[1.8817, 0.0632], [0.0632, 2.1384]])
)


@dataclass(frozen=True)
class Fit:
    """The noises of the inputs and of the GPS, as the truth of some files shows them."""

    inputs: Noise
    gps: Noise
    files: tuple[Path, ...]

    def to_json(self) -> dict[str, Any]:
        """What `load` reads, how sure it is, and what it was made from."""
        found = {
            f"{name}_{key}": value
            for name, noise in (("input", self.inputs), ("gps", self.gps))
            for key, value in vars(noise).items()
        }
        return {
            "system": "diffdrive",
            "model": "x' = x + T (v cos h, v sin h, w), noise of input_cov on (v, w); y = (x, y) + noise of gps_cov",
            **{key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in found.items()},
            "V": self.inputs.cov.tolist(),  # as the course names them
            "W": self.gps.cov.tolist(),
            "documented": {name: value.tolist() for name, value in vars(DOCUMENTED).items()},
            "files": [{"name": path.name, "sha256": sha256(path)} for path in self.files],
        }

    def pictures(self) -> list[Any]:
        """None: two small matrices are read, not looked at."""
        return []


def fit(logs: list[DriveLog]) -> Fit:
    """The covariances of all files' noises together; steps without truth are left out.

    The GPS's divides by N − 1. The inputs' divides by N: so the documented one was made, and with thousands of steps
    the two differ by less than a tenth of their standard error.
    """
    inputs, gps = (np.concatenate(parts) for parts in zip(*map(_samples, logs), strict=True))
    files = tuple(path for log in logs for path in log.files)
    if min(len(inputs), len(gps)) < _FEWEST:
        where = ", ".join(str(path) for path in files)
        raise BadInput(
            f"{where}: the truth (`q_groundTruth`) is there for {len(inputs)} steps and {len(gps)} GPS readings; "
            f"at least {_FEWEST} of each are needed"
        )
    found = Fit(identify(inputs, unbiased=False), identify(gps), files)
    for name, noise in (("the inputs", found.inputs), ("the GPS", found.gps)):
        if not _positive_definite(noise.cov):
            raise BadInput(f"{files[0]}: {name} have no noise beside the truth, so there is no covariance to find")
    return found


def _samples(log: DriveLog) -> tuple[Array, Array]:
    """What inputs (N, 2) and readings (M, 2) were off by, where the truth is known."""
    dt = np.diff(log.time)
    before, after = log.truth[:-1], log.truth[1:]
    change = SPACE.minus(after, moved(before, log.inputs, dt))
    inputs = input_noise(change, effect(before, dt))
    gps = log.gps - log.truth[log.gps_step, :2]
    return inputs[np.isfinite(inputs).all(1)], gps[np.isfinite(gps).all(1)]


def load(path: Path) -> Calibration:
    """The covariances that `calibrate diffdrive` wrote."""
    remedy = "make one with `calibrate diffdrive --data … --out FILE`"
    if not path.is_file():
        raise BadInput(f"{path}: no such calibration; {remedy}")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise BadInput(f"{path}: not a JSON file that `calibrate diffdrive` wrote ({error})") from error
    if not isinstance(values, dict) or values.get("system") != "diffdrive":
        raise BadInput(f"{path}: not a calibration of the system diffdrive; {remedy}")
    return Calibration(_covariance(values, "input_cov", path), _covariance(values, "gps_cov", path))


def _covariance(values: dict[str, Any], key: str, path: Path) -> Array:
    try:
        cov = np.array(values[key], float)
    except (KeyError, TypeError, ValueError):
        cov = np.empty(0)
    if cov.shape != (2, 2) or not np.isfinite(cov).all() or (cov != cov.T).any() or not _positive_definite(cov):
        raise BadInput(f"{path}: {key} must be a symmetric positive definite 2×2 matrix")
    return cov


def _positive_definite(cov: Array) -> bool:
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        return False
    return True
