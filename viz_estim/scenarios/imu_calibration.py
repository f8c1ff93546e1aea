"""Sensor constants of the IMU: value = sign·(raw − bias)·3300/1023/sensitivity, and their fit to motion capture."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.files import sha256

MV_PER_COUNT = 3300.0 / 1023.0  # a 10-bit converter at 3.3 V
ACCEL_SIGNS = np.array([-1.0, -1.0, 1.0])  # the chip's x and y are mounted against the body's


@dataclass(frozen=True)
class Calibration:
    """Constants (3,) in body order x, y, z: biases in counts, sensitivities in mV/(m/s²) and mV/(rad/s).

    truth_offsets: by how much (s) the motion capture's stamps are late in the sets that were fitted, by the SHA-256 of
    the IMU's file.
    """

    accel_bias: Array
    accel_sensitivity: Array
    gyro_sensitivity: Array
    gyro_bias: Array
    truth_offsets: Mapping[str, float] = field(default_factory=dict)

    def accel(self, counts: Array) -> Array:
        """Specific force (*, 3) in m/s² of counts (*, 3)."""
        return ACCEL_SIGNS * (counts - self.accel_bias) * (MV_PER_COUNT / self.accel_sensitivity)

    def gyro(self, counts: Array) -> Array:
        """Angular rate (*, 3) in rad/s of counts (*, 3)."""
        return (counts - self.gyro_bias) * (MV_PER_COUNT / self.gyro_sensitivity)

    def by_sensor(self) -> dict[str, dict[str, Any]]:
        """The constants as `load` reads them."""
        gyro = {"bias_counts": self.gyro_bias, "sensitivity_mv_per_radps": self.gyro_sensitivity}
        accel = {"bias_counts": self.accel_bias, "sensitivity_mv_per_mps2": self.accel_sensitivity}
        return {
            sensor: {name: values.tolist() for name, values in constants.items()}
            for sensor, constants in (("accel", accel), ("gyro", gyro))
        }

    def with_gyro_bias(self, bias: Array) -> Calibration:
        return replace(self, gyro_bias=bias)

    def truth_offset(self, files: Sequence[Path]) -> float:
        """How late (s) the truth of this IMU file is stamped, where the fit saw the file; else 0."""
        return self.truth_offsets.get(sha256(files[0]), 0.0) if files and self.truth_offsets else 0.0


DOCUMENTED = Calibration(
    accel_bias=np.array([511.5, 500.5, 502.5]),
    accel_sensitivity=np.array([34.3, 34.2, 33.8]),
    gyro_sensitivity=np.array([208.0, 201.0, 184.0]),
    gyro_bias=np.array([373.5, 375.4, 369.6]),
)


def load(path: Path) -> Calibration:
    """The constants that `calibrate imu` wrote."""
    if not path.is_file():
        raise BadInput(f"{path}: no such calibration; make one with `calibrate imu --data … --out FILE`")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise BadInput(f"{path}: not a JSON file that `calibrate imu` wrote ({error})") from error
    if not isinstance(values, dict) or values.get("system") != "imu":
        raise BadInput(
            f"{path}: not a calibration of the system imu; make one with `calibrate imu --data … --out FILE`"
        )
    return Calibration(
        accel_bias=_numbers(values, "accel", "bias_counts", path),
        accel_sensitivity=_numbers(values, "accel", "sensitivity_mv_per_mps2", path, positive=True),
        gyro_bias=_numbers(values, "gyro", "bias_counts", path),
        gyro_sensitivity=_numbers(values, "gyro", "sensitivity_mv_per_radps", path, positive=True),
        truth_offsets=_offsets(values, path),
    )


def _offsets(values: dict[str, Any], path: Path) -> dict[str, float]:
    try:
        return {one["files"][0]["sha256"]: float(one["time_offset_s"]) for one in values.get("sets", [])}
    except (KeyError, IndexError, TypeError, ValueError):
        raise BadInput(f"{path}: each of `sets` needs files[0].sha256 and time_offset_s; fit it anew") from None


def _numbers(values: dict[str, Any], sensor: str, key: str, path: Path, *, positive: bool = False) -> Array:
    try:
        numbers = np.array(values[sensor][key], float)
    except (KeyError, TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all() or (positive and (numbers <= 0).any()):
        raise BadInput(f"{path}: {sensor}.{key} must be three {'positive ' if positive else ''}numbers (x, y, z)")
    return numbers
