"""The systems and the scenarios over them: plain functions, whose keyword arguments are their parameters."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

from viz_estim.scenarios import (
    beacons,
    camera,
    diffdrive,
    imu,
    landmarks,
    parameter,
    plaza,
    quadrotor,
    scan,
    se2,
    underwater,
)

SYSTEMS: dict[str, ModuleType] = {
    "imu": imu,
    "beacons": beacons,
    "camera": camera,
    "diffdrive": diffdrive,
    "parameter": parameter,
    "landmarks": landmarks,
    "plaza": plaza,
    "quadrotor": quadrotor,
    "scan": scan,
    "se2": se2,
    "underwater": underwater,
}
SCENARIOS: dict[str, Callable[..., Any]] = {
    "imu-gyro": imu.imu_gyro,
    "imu-ukf": imu.imu_ukf,
    "imu-ukf-gyro": imu.imu_ukf_gyro,
    "mosaic": camera.mosaic,
    "diffdrive-ekf": diffdrive.diffdrive_ekf,
    "parameter-ekf": parameter.parameter_ekf,
    "landmarks-ekf": landmarks.landmarks_ekf,
    "range-ekf": plaza.range_ekf,
    "quadrotor-ukf-pose": quadrotor.quadrotor_ukf_pose,
    "quadrotor-ukf-velocity": quadrotor.quadrotor_ukf_velocity,
    "beacons-pf": beacons.beacons_pf,
    "se2-pf": se2.se2_pf,
    "scan-icp": scan.scan_icp,
    "underwater-bayes": underwater.underwater_bayes,
}
