"""Files of an IMU with motion capture: which file is what, reading, writing.

The ESE 650 course's format: `imuRaw*.mat` (`vals` 6×T 10-bit counts in the order ax, ay, az, wz, wx, wy; `ts` 1×T,
Unix s) and `viconRot*.mat` (`rots` 3×3×N body → world; `ts` 1×N). Any other log: CSV, as `.txt` too, or NPZ with
`time` [s], `gyro_x…z` [rad/s], `accel_x…z` [m/s²] and optionally `qw, qx, qy, qz` (body → world; NaN where there is no
truth). Names in any case.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios.reading import expand, field, finite, mat_shapes, not_read, read_mat, shape_text, spelled
from viz_estim.scenarios.tables import Table, read_table

_CHANNELS = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")
_QUATERNION = ("qw", "qx", "qy", "qz")
_GYRO_ROWS = [4, 5, 3]  # of `vals`: x, y, z
_SUFFIXES = (".mat", ".csv", ".txt", ".npz")
_STAMPS = ("ts", "time", "t", "timestamp", "timestamps")  # other people's names for them
_SLOWEST = 1.0  # s between samples: no IMU is slower, so such stamps are in another unit


@dataclass(frozen=True)
class ImuLog:
    """One IMU file: stamps (T,) s; accel, gyro (T, 3), body x, y, z, in 10-bit counts or in m/s² and rad/s.

    truth_stamps (N,) s and truth (N, 4), quaternions body → world, are the reference's own samples, bad ones left out;
    files are those it was read from.
    """

    stamps: Array
    accel: Array
    gyro: Array
    in_counts: bool
    truth_stamps: Array
    truth: Array
    files: tuple[Path, ...] = ()


def find_sets(paths: list[Path]) -> list[tuple[Path, Path | None]]:
    """The IMU files among files and folders, each with its motion capture: given, or found beside it by its number."""
    files = [file for path in paths for file in expand(path, _SUFFIXES)]
    roles = {file: _role(file, strict=file in paths) for file in dict.fromkeys(files)}
    imus = [file for file, role in roles.items() if role == "imu"]
    truths = [file for file, role in roles.items() if role == "truth"]
    where = ", ".join(map(str, paths))
    if not imus:
        what = "a .mat with `vals` and `ts`, or a .csv/.txt/.npz log with `time`"
        raise BadInput(f"{where}: no IMU file there ({what}){not_read(paths)}")
    if len(imus) == 1 and len(truths) == 1:
        return [(imus[0], truths[0])]
    return [(imu, _truth_of(imu, truths)) for imu in imus]


def of_course(name: str | Path | int) -> Path:
    """The IMU file that is meant: by its path, with or without `.mat`, or by its number, here or in `imu/`."""
    given = f"imuRaw{name}" if isinstance(name, (int, np.integer)) else str(name)
    wanted = [Path(given), Path(f"{given}.mat"), Path("imu", f"{given}.mat")]
    found = next((path for path in wanted if path.is_file()), None)
    if found is None:
        raise BadInput(f"{given}: no such file; looked for {', '.join(map(str, wanted))} in {Path.cwd()}")
    return found


def load(imu: Path, truth: Path | None) -> ImuLog:
    """The IMU file read and checked, with its reference."""
    if imu.suffix.lower() == ".mat":
        return _load_course(imu, truth)
    table = _table(imu)
    table.require(("time", *_CHANNELS))
    columns = table.columns(("time", *_CHANNELS, *_QUATERNION))
    stamps = _imu_stamps(columns["time"], imu, "time")
    values = {c: finite(columns[c], imu, c) for c in _CHANNELS}
    gyro, accel = (np.stack([values[f"{kind}_{axis}"] for axis in "xyz"], axis=1) for kind in ("gyro", "accel"))
    files: tuple[Path, ...] = (imu,)
    reference = np.empty(0), np.empty((0, 4))
    if truth is not None:
        files, reference = (imu, truth), _load_truth(truth)
    elif any(c in columns for c in _QUATERNION):
        missing = [c for c in _QUATERNION if c not in columns]
        if missing:
            raise BadInput(f"{imu}: the truth lacks {', '.join(missing)}; give all of {', '.join(_QUATERNION)} or none")
        reference = _good_truth(stamps, np.stack([columns[c] for c in _QUATERNION], axis=1), imu)
    return ImuLog(stamps, accel, gyro, False, *reference, files)


def save_course(folder: Path, number: int, log: ImuLog) -> list[Path]:
    """Writes the log as `imuRaw<number>.mat` and `viconRot<number>.mat`, in the course's format and axis order."""
    vals = np.concatenate([log.accel, log.gyro[:, [2, 0, 1]]], axis=1).T.astype(np.uint16)
    imu, truth = folder / f"imuRaw{number}.mat", folder / f"viconRot{number}.mat"
    for path in (imu, truth):
        if path.exists():
            raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
    scipy.io.savemat(imu, {"vals": vals, "ts": log.stamps[None]}, do_compression=True)
    # Seven digits are a tenth of a microradian, far below what motion capture resolves, and pack to half the size.
    rots = np.moveaxis(quaternions.to_matrix(log.truth), 0, -1).round(7)
    scipy.io.savemat(truth, {"rots": rots, "ts": log.truth_stamps[None]}, do_compression=True)
    return [imu, truth]


def _role(path: Path, *, strict: bool) -> str | None:
    """imu, truth, camera or None by the file's fields; None is an error for a file that was named itself."""
    if path.suffix.lower() not in _SUFFIXES:
        raise BadInput(f"{path}: expected a data file that ends in {', '.join(_SUFFIXES)}")
    try:
        if path.suffix.lower() == ".mat":
            fields = {name.lower() for name in mat_shapes(path)}
            role = "truth" if "rots" in fields else "imu" if "vals" in fields else "camera" if "cam" in fields else None
        else:
            # A file that was named itself is told what it lacks; others with stamps of their own may lie beside.
            names = _table(path).names
            role = "imu" if "time" in names and (strict or set(_CHANNELS) <= set(names)) else None
    except BadInput:
        if strict:
            raise
        return None
    if role is None and strict:
        raise BadInput(
            f"{path}: neither an IMU file (`vals`, `ts`, or columns time, {', '.join(_CHANNELS)}) nor motion capture "
            "(`rots`, `ts`)"
        )
    return role


def _truth_of(imu: Path, truths: list[Path]) -> Path | None:
    number = _number(imu)
    if number is None:
        return None
    folders = [folder for folder in (imu.parent, imu.parent.parent / "vicon") if folder.is_dir()]
    beside = [file for folder in folders for file in sorted(folder.iterdir())]
    named = (file for file in beside if file.name.lower() == f"viconrot{number}.mat")
    return next((t for t in truths if _number(t) == number), next(named, None))


def _number(path: Path) -> str | None:
    match = re.search(r"(\d+)$", path.stem)
    return match.group(1).lstrip("0") or "0" if match else None


def _table(path: Path) -> Table:
    return read_table(path, dict.fromkeys(_STAMPS, "time"))


def _load_course(imu: Path, truth: Path | None) -> ImuLog:
    fields = read_mat(imu)
    vals = field(fields, "vals", imu)
    if vals.ndim != 2 or vals.shape[0] != 6:
        remedy = "; transpose it" if vals.ndim == 2 and vals.shape[1] == 6 else ""
        what = "`vals` of shape 6×T (ax, ay, az, wz, wx, wy)"
        raise BadInput(f"{imu}: expected {what}, got {shape_text(vals)}{remedy}")
    # Unsigned counts wrap around when a bias is subtracted: floats from here on.
    vals = finite(vals.astype(float), imu, "vals")
    stamps = _imu_stamps(_stamps_field(fields, imu), imu, "ts")
    if len(stamps) != vals.shape[1]:
        raise BadInput(f"{imu}: `ts` has {len(stamps)} stamps and `vals` {vals.shape[1]} columns; they must agree")
    reference = (np.empty(0), np.empty((0, 4))) if truth is None else _load_truth(truth)
    files = (imu,) if truth is None else (imu, truth)
    return ImuLog(stamps, vals[:3].T.copy(), vals[_GYRO_ROWS].T.copy(), True, *reference, files)


def _load_truth(path: Path) -> tuple[Array, Array]:
    fields = read_mat(path)
    rots = field(fields, "rots", path).astype(float)
    if rots.ndim != 3 or rots.shape[:2] != (3, 3):
        remedy = "; move its first axis to the end" if rots.ndim == 3 and rots.shape[1:] == (3, 3) else ""
        raise BadInput(f"{path}: expected `rots` of shape 3×3×N, got {shape_text(rots)}{remedy}")
    stamps = _stamps_field(fields, path)
    if len(stamps) != rots.shape[2]:
        raise BadInput(f"{path}: `ts` has {len(stamps)} stamps and `rots` {rots.shape[2]} frames; they must agree")
    matrices = np.moveaxis(rots, -1, 0)
    # Lost frames come as NaN or as anything that is no rotation.
    good = np.asarray(np.isfinite(matrices).all((1, 2)))
    good[good] = np.abs(matrices[good] @ np.swapaxes(matrices[good], 1, 2) - np.eye(3)).max((1, 2)) < 0.05
    good[good] = np.linalg.det(matrices[good]) > 0
    q = np.full((len(stamps), 4), np.nan)
    q[good] = quaternions.from_matrix(matrices[good])
    return _good_truth(_in_order(stamps, path, "ts"), q, path)


def _good_truth(stamps: Array, q: Array, path: Path) -> tuple[Array, Array]:
    """The samples that are there: a lost one is NaN, or zero."""
    good = np.isfinite(q).all(1) & q.any(1)
    if np.any(np.abs(np.linalg.norm(q[good], axis=1) - 1) > 0.01):
        raise BadInput(f"{path}: qw, qx, qy, qz are not unit quaternions (NaN marks a missing truth)")
    return stamps[good], quaternions.continuous(quaternions.normalise(q[good]))


def _stamps_field(fields: dict[str, Any], path: Path) -> Array:
    """The stamps (N,), in s, under whichever of their names the file has."""
    name = next((name for name in _STAMPS if spelled(fields, name)), _STAMPS[0])
    return field(fields, name, path).astype(float).ravel()


def _imu_stamps(stamps: Array, path: Path, name: str) -> Array:
    _in_order(stamps, path, name)
    if (spacing := float(np.median(np.diff(stamps)))) > _SLOWEST:
        raise BadInput(f"{path}: {name} has {spacing:g} s between samples, which is no IMU's; give seconds")
    if spacing == 0:  # single precision resolves Unix seconds to 128 s
        raise BadInput(f"{path}: {name} stands still at most samples; save it in double precision, in seconds")
    return stamps


def _in_order(stamps: Array, path: Path, name: str) -> Array:
    if len(stamps) < 2:
        raise BadInput(f"{path}: {name} has {len(stamps)} samples; at least 2 are needed")
    finite(stamps, path, name)
    back = np.flatnonzero(np.diff(stamps) < 0)
    if len(back):
        raise BadInput(f"{path}: {name} goes back at sample {back[0] + 1}; sort the samples by time")
    return stamps
