"""The systems and the scenarios over them: plain functions, whose keyword arguments are their parameters."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

from viz_estim.scenarios import diffdrive, imu, landmarks, parameter, plaza, quadrotor, scan, underwater

SYSTEMS: dict[str, ModuleType] = {
    "imu": imu,
    "diffdrive": diffdrive,
    "parameter": parameter,
    "landmarks": landmarks,
    "plaza": plaza,
    "quadrotor": quadrotor,
    "scan": scan,
    "underwater": underwater,
}
SCENARIOS: dict[str, Callable[..., Any]] = {
    "imu-gyro": imu.imu_gyro,
    "imu-ukf": imu.imu_ukf,
    "imu-ukf-gyro": imu.imu_ukf_gyro,
    "diffdrive-ekf": diffdrive.diffdrive_ekf,
    "parameter-ekf": parameter.parameter_ekf,
    "landmarks-ekf": landmarks.landmarks_ekf,
    "range-ekf": plaza.range_ekf,
    "quadrotor-ukf-pose": quadrotor.quadrotor_ukf_pose,
    "quadrotor-ukf-velocity": quadrotor.quadrotor_ukf_velocity,
    "scan-icp": scan.scan_icp,
    "underwater-bayes": underwater.underwater_bayes,
}
