"""The debugger for state estimators: every step, stage by stage, in a recording that can be scrubbed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from viz_estim.recording.reader import Run
    from viz_estim.recordings import record
    from viz_estim.watching import watch

__all__ = ["estimate_rot", "load", "record", "watch"]


def __getattr__(name: str) -> Any:
    """`record` and `watch`, which are read when they are asked for: they bring in the recording."""
    if name == "record":
        from viz_estim.recordings import record

        return record
    if name == "watch":
        from viz_estim.watching import watch

        return watch
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def load(path: str | Path) -> Run:
    """A recording as arrays: see `viz_estim.recording.reader.Run`."""
    from viz_estim.recording.reader import load as read

    return read(path)


def estimate_rot(
    imu_file: str | Path | int, *, calibration: str | Path | None = None, **params: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Roll, pitch and yaw (T,) in radians of an IMU file, by `imu-ukf`; R = Rz(yaw)·Ry(pitch)·Rx(roll).

    imu_file: its path, of which `.mat` may lack; or N, as graders call it, for `imuRawN.mat` here or in `imu/`. params
    are the scenario's own (`gyro_noise=…`, `frozen="reject"`, the default here). Raises ArithmeticError with the step
    where the filter failed.
    """
    import numpy as np

    from viz_estim.core import quaternions
    from viz_estim.core.run import failed_where, run
    from viz_estim.scenarios import imu, imu_data, imu_files

    file = imu_files.of_course(imu_file)
    data = imu_data.prepare(imu_files.load(file, None), None if calibration is None else Path(calibration))
    chosen: dict[str, Any] = {"frozen": "reject"} | params
    scenario = imu.imu_ukf(data, **chosen)
    attitudes = []
    for step in run(scenario):
        if step.error:
            raise ArithmeticError(f"{file}: step {step.index}, {failed_where(step.error.stage)}: {step.error.message}")
        attitudes.append(step.stages[-1].belief.mean[:4])
    roll, pitch, yaw = quaternions.to_euler(np.stack(attitudes)).T
    return roll, pitch, yaw
