"""Files of a quadrotor's flight, in the formats of NYU's ROB-GY 6213: which file is what, reading, writing.

The flight, `studentdata*.mat`: `data`, a struct array with `t` [s], `omg` [rad/s] and `acc` [m/s², specific force]
(other fields such as `img` and `id`, and rows without a reading, are left), or one struct of arrays; and motion
capture, `vicon` 12×N (x, y, z, roll, pitch, yaw, then velocities of both, which may lack) at `time` 1×N, NaN where it
lost the body. What we write has the IMU's true biases too: `bias` 6×N (gyro, accelerometer). Beside a camera's file the
motion capture may lack.

The camera, `proj2_dataset*.mat`: `time`, `position`, `angle` (both of the body) and `linearVel` (of the camera, in its
own frame), N×3. All angles are roll, pitch, yaw with R = Rz(yaw)·Ry(pitch)·Rx(roll), body → world.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios.reading import expand, field, finite, mat_shapes, not_read, read_mat, shape_text, spelled

_FLIGHT, _CAMERA = {"data", "vicon"}, {"position", "angle", "linearvel", "angvel"}
_IMU = {"t": ("t", "time"), "omg": ("omg", "drpy", "gyro"), "acc": ("acc", "accel")}


@dataclass(frozen=True)
class Flight:
    """An IMU's readings at stamps (T,) s, gyro and accel (T, 3); states (N, 16) as motion capture knows them, NaN
    where it does not, at vicon_stamps (N,)."""

    stamps: Array
    gyro: Array
    accel: Array
    vicon_stamps: Array
    states: Array


@dataclass(frozen=True)
class Camera:
    """What the camera measured at stamps (N,) s: pose (N, 7), position and quaternion; its own velocity (N, 3).

    Where there is no velocity yet its row is NaN.
    """

    stamps: Array
    pose: Array
    velocity: Array


def find(paths: list[Path]) -> tuple[Path | None, Path | None]:
    """The flight's file and the camera's among files and folders, each known by its fields; one of them may lack."""
    roles: dict[str, list[Path]] = {"flight": [], "camera": []}
    for path in paths:
        for file in expand(path, (".mat",)):
            role = _role(file, strict=file == path)
            if role and file not in roles[role]:
                roles[role].append(file)
    for role, files in roles.items():
        if len(files) > 1:
            names = ", ".join(str(file) for file in files)
            raise BadInput(f"{len(files)} {role} files found, a run takes one: name one of {names}")
    if not any(roles.values()):
        where = ", ".join(map(str, paths))
        what = "a .mat with data, vicon and time, or with position and linearVel"
        raise BadInput(f"{where}: no flight there ({what}){not_read(paths)}")
    return next(iter(roles["flight"]), None), next(iter(roles["camera"]), None)


def _role(path: Path, *, strict: bool) -> str | None:
    """flight, camera or None by the file's fields; None is an error for a file that was named itself."""
    if path.suffix.lower() != ".mat":
        raise BadInput(f"{path}: expected a MATLAB file that ends in .mat")
    try:
        held = mat_shapes(path)
    except BadInput:
        if strict:
            raise
        return None
    names = {name.lower() for name in held}
    role = "flight" if names & _FLIGHT else "camera" if len(names & _CAMERA) > 1 else None
    if role is None and strict:
        raise BadInput(
            f"{path}: neither a flight (`data`, `vicon`, `time`) nor a camera's measurements (`time`, `position`, "
            f"`angle`, `linearVel`): it holds {', '.join(held) or 'nothing'}"
        )
    return role


def load_camera(path: Path) -> Camera:
    """The camera's file read and checked."""
    fields = read_mat(path)
    stamps = _stamps(field(fields, "time", path), path, "time")
    columns = {}
    for name in ("position", "angle", "linearVel"):
        values = field(fields, name, path).astype(float)
        if values.shape != (len(stamps), 3):
            raise _misshapen(values, name, (len(stamps), 3), path)
        columns[name] = finite(values.T, path, name).T
    position, angle, velocity = columns.values()
    # A velocity takes two images: at the first there is none yet, and the file says 0.
    if not velocity[0].any():
        velocity[0] = np.nan
    return Camera(stamps, np.concatenate([position, quaternions.from_euler(angle)], axis=1), velocity)


def load_flight(path: Path) -> Flight:
    """The flight's file read and checked."""
    fields = read_mat(path)
    stamps, gyro, accel = _imu(fields, path)
    if not spelled(fields, "vicon"):
        return Flight(stamps, gyro, accel, np.empty(0), np.empty((0, 16)))
    vicon_stamps = _stamps(field(fields, "time", path), path, "time")
    vicon = field(fields, "vicon", path).astype(float)
    if vicon.shape not in [(rows, len(vicon_stamps)) for rows in (6, 9, 12)]:
        raise _misshapen(vicon, "vicon", (12, len(vicon_stamps)), path)
    velocity = vicon[6:9] if len(vicon) > 6 else np.full((3, len(vicon_stamps)), np.nan)
    bias = np.full((6, len(vicon_stamps)), np.nan)
    if any(name.lower() == "bias" for name in fields):
        bias = field(fields, "bias", path).astype(float)
        if bias.shape != (6, len(vicon_stamps)):
            raise BadInput(f"{path}: expected `bias` of shape 6×{len(vicon_stamps)}, got {shape_text(bias)}")
    parts = [vicon[:3].T, quaternions.from_euler(vicon[3:6].T), velocity.T, bias.T]
    return Flight(stamps, gyro, accel, vicon_stamps, np.concatenate(parts, axis=1))


def _imu(fields: dict[str, Any], path: Path) -> tuple[Array, Array, Array]:
    """Stamps (T,), gyro and accel (T, 3) of the rows of `data` that have both."""
    name = next((name for name in fields if name.lower() == "data"), None)
    rows: np.ndarray = fields[name].ravel() if name else np.empty(0)
    held = rows.dtype.names or ()
    found = [next((k for k in held if k.lower() in spellings), None) for spellings in _IMU.values()]
    missing = [key for key, spelled in zip(_IMU, found, strict=True) if spelled is None]
    if missing:
        what = f"`data` has no {', '.join(missing)} (it has {', '.join(held) or 'no fields'})" if name else "no `data`"
        raise BadInput(f"{path}: {what}; expected a struct array with t, omg and acc")
    if len(rows) == 1 and np.size(rows[0][found[0]]) > 1:
        rows = _split(rows[0], found, path)
    columns: list[list[Array]] = [[], [], []]
    for k, row in enumerate(rows):
        try:
            values = [np.asarray(row[spelled], float).ravel() for spelled in found]
        except (TypeError, ValueError):
            raise BadInput(f"{path}: row {k} of `data` must hold numbers in t, omg and acc") from None
        if not values[1].size and not values[2].size:
            continue
        if [value.size for value in values] != [1, 3, 3]:
            raise BadInput(f"{path}: row {k} of `data` needs one t, three omg and three acc")
        for column, value in zip(columns, values, strict=True):
            column.append(value)
    t, gyro, accel = (np.array(column) for column in columns)
    stamps = _stamps(t, path, "data.t")
    return stamps, finite(gyro.T, path, "data.omg").T, finite(accel.T, path, "data.acc").T


def _split(one: Any, found: list[str | None], path: Path) -> np.ndarray:
    """The rows (T,) of one struct of arrays: t of T, omg and acc 3×T or T×3."""
    T = np.size(one[found[0]])
    rows = np.empty(T, dtype=[(name, object) for name in found])
    for name, size in zip(found, (1, 3, 3), strict=True):
        values = np.asarray(one[name])
        if values.shape not in [(size, T), (T, size)]:
            raise BadInput(
                f"{path}: expected `data.{name}` of shape {size}×{T} as its stamps, got {shape_text(values)}"
            )
        rows[name] = list(values.reshape(T, size) if values.shape == (T, size) else values.T)
    return rows


def _misshapen(values: np.ndarray, name: str, shape: tuple[int, int], path: Path) -> BadInput:
    """What to say of a field that is not of this shape; that of `time` is one of the two."""
    remedy = "; transpose it" if values.shape == shape[::-1] else ""
    expected = "×".join(map(str, shape))
    return BadInput(f"{path}: expected `{name}` of shape {expected} as `time`, got {shape_text(values)}{remedy}")


def _stamps(values: np.ndarray, path: Path, name: str) -> Array:
    stamps = finite(values.astype(float).ravel(), path, name)
    if len(stamps) < 2:
        raise BadInput(f"{path}: {name} has {len(stamps)} samples; at least 2 are needed")
    back = np.flatnonzero(np.diff(stamps) < 0)
    if len(back):
        raise BadInput(f"{path}: {name} goes back at sample {back[0] + 1}; sort the samples by time")
    return stamps


def save(folder: Path, number: int, flight: Flight, camera: Camera) -> list[Path]:
    """Writes `studentdata<number>.mat` and `proj2_dataset<number>.mat`; states without gaps, velocity from row 1."""
    paths = [folder / f"studentdata{number}.mat", folder / f"proj2_dataset{number}.mat"]
    for path in paths:
        if path.exists():
            raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
    rows = np.empty((1, len(flight.stamps)), dtype=[(name, object) for name in _IMU])
    for k, values in enumerate(zip(flight.stamps, flight.gyro, flight.accel, strict=True)):
        rows[0, k] = tuple(_packed(np.atleast_2d(value).T) for value in values)
    x = flight.states
    turn = quaternions.log(quaternions.multiply(quaternions.conjugate(x[:-1, 3:7]), x[1:, 3:7]))
    rate = np.concatenate([turn[:1], turn]) / np.diff(flight.vicon_stamps, prepend=np.nan)[:, None]
    rate[0] = rate[1]
    vicon = np.concatenate([x[:, :3], quaternions.to_euler(x[:, 3:7]), x[:, 7:10], rate], axis=1).T
    fields = {"data": rows, "time": flight.vicon_stamps[None], "vicon": _packed(vicon), "bias": _packed(x[:, 10:].T)}
    scipy.io.savemat(paths[0], fields, do_compression=True)
    columns = {"position": camera.pose[:, :3], "angle": quaternions.to_euler(camera.pose[:, 3:])}
    columns["linearVel"] = np.nan_to_num(camera.velocity)
    fields = {name: _packed(values) for name, values in columns.items()} | {"time": camera.stamps[:, None]}
    scipy.io.savemat(paths[1], fields, do_compression=True)
    return paths


def _packed(values: Array) -> Array:
    """A micrometre, a microradian: far below what any sensor resolves, and half the size."""
    return values.round(6)
