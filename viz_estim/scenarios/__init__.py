"""The systems and the scenarios over them: plain functions, whose keyword arguments are their parameters."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

from viz_estim.scenarios import imu

SYSTEMS: dict[str, ModuleType] = {"imu": imu}
SCENARIOS: dict[str, Callable[..., Any]] = {
    "imu-gyro": imu.imu_gyro,
    "imu-ukf": imu.imu_ukf,
    "imu-ukf-gyro": imu.imu_ukf_gyro,
}
