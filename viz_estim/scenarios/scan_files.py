"""Files of two clouds and of the true pose between them: which file is what, reading, writing.

A cloud is a PLY file, or text, separated by blanks, commas or semicolons, one point a line: x, y[, z] first, or where a
header names them. Poses are a CSV list with `reading`, a cloud's file name, and `gT00` … `gT33` (in the plane `gT00` …
`gT22`), the matrix that takes its points into the common frame, as libpointmatcher's lists have them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.registration import to_pose, to_state
from viz_estim.errors import BadInput
from viz_estim.files import check_writable, whole
from viz_estim.scenarios import scan_ply
from viz_estim.scenarios.reading import expand, unreadable
from viz_estim.scenarios.tables import is_number

_SUFFIXES = (".txt", ".csv", ".xyz", ".ply")  # of what a folder is searched for
_SAVED = ("cloudX.csv", "cloudY.csv", "cloudList.csv")
_AXES = ("x", "y", "z")
_METRES = re.compile(r"\s*[\[(]\s*m\s*[\])]")  # beside a name in a header
_WIDE = 20  # columns of two or three lines: no points with so many properties, but one coordinate a line
_NOT_RIGID = 1e-3  # of a rotation matrix from the one nearest to it, whose file may hold few digits


@dataclass(frozen=True)
class ScanData:
    """Two clouds in m: X (N, d) is to be moved on to Y (M, d). truth: the pose that does so, as a state, or None."""

    X: Array
    Y: Array
    truth: Array | None
    files: tuple[Path, ...] = ()


def load(paths: list[Path]) -> ScanData:
    """The two clouds among files and folders, in the order given (a folder's by name), and the pose between them."""
    files = [file for path in paths for file in expand(path, _SUFFIXES)]
    roles = [_role(file, strict=file in paths) for file in files]
    clouds = [file for file, role in zip(files, roles, strict=True) if role == "cloud"]
    if len(clouds) != 2:
        names = ", ".join(str(path) for path in clouds or paths)
        raise BadInput(
            f"{names[:300]}: {len(clouds)} clouds found, a registration takes two: name first the moved one, then the "
            "fixed one (--data X --data Y)"
        )
    X, Y = (_read_cloud(file) for file in clouds)
    if X.shape[1] != Y.shape[1]:
        raise BadInput(f"{clouds[0]} has {X.shape[1]} coordinates a point, {clouds[1]} {Y.shape[1]}; they must agree")
    named = [file for file, role in zip(files, roles, strict=True) if role == "poses"]
    beside = [file for path in clouds for file in expand(path.parent, (".csv",)) if _is_list(file)]
    for file in dict.fromkeys([*named, *beside]):
        truth = _read_truth(file, clouds, X.shape[1], strict=file in paths)
        if truth is not None:
            return ScanData(X, Y, truth, (*clouds, file))
    return ScanData(X, Y, None, tuple(clouds))


def save(folder: Path, data: ScanData) -> list[Path]:
    """Writes both clouds and the list of their poses, for simulated data; Y's frame is the common one."""
    assert data.truth is not None
    paths = [folder / name for name in _SAVED]
    for path in paths:
        if path.exists():
            raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
        check_writable(path)
    d = data.X.shape[1]
    for path, cloud in zip(paths, (data.X, data.Y), strict=False):
        with whole(path) as aside:
            np.savetxt(aside, cloud, "%.4f", ",", header=",".join(_AXES[:d]), comments="")
    pose = np.eye(d + 1)
    pose[:d, :d], pose[:d, d] = to_pose(data.truth)
    lines = [",".join(["reading", *_matrix_names(d)])]
    for path, matrix in zip(paths, (pose, np.eye(d + 1)), strict=False):
        lines.append(",".join([path.name, *(f"{value:.17g}" for value in matrix.ravel())]))
    with whole(paths[2]) as aside:
        aside.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return paths


def _role(path: Path, *, strict: bool) -> str | None:
    """cloud, poses or None by the file's fields; None is an error for a file that was named itself."""
    try:
        if scan_ply.is_ply(path):
            return "cloud"
        if _is_list(path):
            return "poses"
        _columns(path, *_read_text(path))
        return "cloud"
    except BadInput:
        if strict:
            raise
        return None


def _is_list(path: Path) -> bool:
    """Whether the file's first line names the columns of a list of poses."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return {"reading", "gt00"} <= set(_cells(file.readline().lower()))


def _read_cloud(path: Path) -> Array:
    cloud = scan_ply.read(path) if scan_ply.is_ply(path) else _read_points(path)
    bad = np.argwhere(~np.isfinite(cloud))
    if len(bad):
        point, axis = bad[0]
        raise BadInput(f"{path}: {_AXES[axis]} of point {point} is {cloud[point, axis]}; leave such points out")
    if len(cloud) < 3:
        raise BadInput(f"{path}: holds {len(cloud)} points; a registration takes at least 3")
    return cloud


def _read_points(path: Path) -> Array:
    names, lines = _read_text(path)
    columns = _columns(path, names, lines)
    width = len(names or _cells(lines[0][1]))
    points = []
    for number, line in lines:
        cells = _cells(line)
        if len(cells) != width:
            raise BadInput(f"{path}: line {number} has {len(cells)} cells, the first line {width}")
        try:
            points.append([float(cells[i]) for i in columns])
        except ValueError:
            raise BadInput(f"{path}: line {number} is no point: {line.strip()[:60]!r}") from None
    return np.array(points)


def _columns(path: Path, names: list[str], lines: list[tuple[int, str]]) -> list[int]:
    """Which cells are x, y and, if there is one, z: by the header, or the first."""
    if names:
        if not {"x", "y"} <= set(names):
            raise BadInput(f"{path}: neither a cloud (x, y[, z]) nor poses (reading, gT00 …): {', '.join(names)[:200]}")
        return [names.index(axis) for axis in _AXES if axis in names]
    cells = _cells(lines[0][1])
    if len(lines) <= len(_AXES) and len(cells) > _WIDE:
        raise BadInput(f"{path}: {len(lines)} lines of {len(cells)} numbers, expected one point a line; transpose it")
    if len(cells) < 2:
        raise BadInput(f"{path}: neither a cloud (x, y[, z]) nor poses: its first line is {lines[0][1][:60]!r}")
    return list(range(min(3, len(cells))))


def _read_text(path: Path) -> tuple[list[str], list[tuple[int, str]]]:
    """The header's names in lower case, none where there is no header, and the other lines with their numbers."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: cannot be read, it is neither text in UTF-8 nor PLY; save it as CSV or PLY") from error
    except OSError as error:
        raise unreadable(path, error) from error
    lines = []
    for number, line in enumerate(text.splitlines(), 1):
        said = line.lstrip("#/% \t")  # a comment, unless it is where a program puts the names: `//X Y Z`
        if said and (said == line.lstrip() or {"x", "y"} <= set(_cells(said.lower()))):
            lines.append((number, said))
    if lines and lines[0][1].strip() == str(len(lines) - 1):  # how many points there are, as .xyz files begin
        lines.pop(0)
    names: list[str] = []
    if lines and not is_number(_cells(lines[0][1])[0]):
        names = [cell.strip('"').lower() for cell in _cells(_METRES.sub("", lines.pop(0)[1]))]
    if not lines:
        raise BadInput(f"{path}: {'holds column names alone' if names else 'is empty'}")
    return names, lines


def _cells(line: str) -> list[str]:
    separator = next((mark for mark in ";," if mark in line), None)
    if separator == ";":  # a comma beside semicolons is a decimal one
        line = line.replace(",", ".")
    return [cell.strip() for cell in line.split(separator)]


def _matrix_names(d: int) -> list[str]:
    return [f"gT{i}{j}" for i in range(d + 1) for j in range(d + 1)]


def _read_truth(path: Path, clouds: list[Path], d: int, *, strict: bool) -> Array | None:
    """The pose of the first cloud in the second's frame, as a state; None where the list has not both, unless `strict`
    refuses that."""
    names, lines = _read_text(path)
    rows = [_cells(line) for _, line in lines]
    at = names.index("reading")
    by_name = {Path(row[at]).name: row for row in rows if len(row) == len(names)}
    missing = [cloud.name for cloud in clouds if cloud.name not in by_name]
    if missing or clouds[0].name == clouds[1].name:
        if strict:
            what = missing[0] if missing else f"two clouds of one name, {clouds[0].name}"
            raise BadInput(f"{path}: has no pose of {what} (readings: {', '.join(by_name)[:200]})")
        return None
    lacking = [name for name in _matrix_names(d) if name.lower() not in names]
    if lacking or (d == 2 and "gt33" in names):
        raise BadInput(
            f"{path}: expected poses {d + 1}×{d + 1} for clouds of {d} coordinates, {_matrix_names(d)[-1]} last"
        )
    X, Y = (_pose(path, names, by_name[cloud.name], cloud.name, d) for cloud in clouds)
    return to_state(Y[0].T @ X[0], Y[0].T @ (X[1] - Y[1]))


def _pose(path: Path, names: list[str], row: list[str], cloud: str, d: int) -> tuple[Array, Array]:
    """R (d, d) and t (d,) of a row; the rotation nearest to the one it holds, for that may be rounded."""
    try:
        matrix = np.array([float(row[names.index(name.lower())]) for name in _matrix_names(d)]).reshape(d + 1, d + 1)
    except ValueError:
        raise BadInput(f"{path}: the pose of {cloud} is not made of numbers") from None
    sound = np.isfinite(matrix).all()
    U, _, Vt = np.linalg.svd(matrix[:d, :d] if sound else np.eye(d))
    R = U @ Vt
    if not sound or np.abs(R - matrix[:d, :d]).max() > _NOT_RIGID or np.linalg.det(R) < 0:
        raise BadInput(f"{path}: the pose of {cloud} is no rotation with a translation")
    return R, matrix[:d, d]
