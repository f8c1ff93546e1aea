"""Files of a camera beside an IMU: which file is what, reading, writing.

The ESE 650 course's format: `cam*.mat` (`cam` M×N×3×K, bytes, RGB; `ts` 1×K, Unix s, the IMU's clock). What we draw has
the world it shows beside it: `panorama*.mat` (`panorama` H×2H×3, bytes).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from viz_estim.core.panoramas import Picture
from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios.imu_files import find_sets
from viz_estim.scenarios.reading import expand, field, finite, mat_shapes, not_read, read_mat, shape_text, spelled

_SUFFIXES = (".mat", ".csv", ".txt", ".npz")
_ROLES = ("cam", "panorama")  # named as the field that tells it


@dataclass(frozen=True)
class Found:
    """The files of one set; truth and panorama may lack."""

    imu: Path
    truth: Path | None
    camera: Path
    panorama: Path | None


def find(paths: list[Path]) -> Found:
    """The one set among files and folders: what is not given is found beside the IMU's file, by its number."""
    given: dict[str, list[Path]] = {role: [] for role in _ROLES}
    others: list[Path] = []
    for file in dict.fromkeys(file for path in paths for file in expand(path, _SUFFIXES)):
        given.get(_role(file) or "", others).append(file)
    where = ", ".join(map(str, paths))
    # A folder stays one: what in it is no IMU file of any kind is passed over there.
    rest = [path for path in paths if path.is_dir() or path in others]
    if not rest:
        raise BadInput(f"{where}: no IMU file there; give the IMU's file beside the camera's")
    sets = find_sets(rest)
    if len(sets) > 1:
        names = ", ".join(str(file.name) for file, _ in sets)
        raise BadInput(f"{len(sets)} IMU files found, a run takes one: name one of {names}")
    imu, truth = sets[0]
    camera, panorama = (_of_set(imu, role, given[role]) for role in _ROLES)
    if camera is None:
        raise BadInput(f"{where}: no camera file there (a .mat with `cam`, M×N×3×K, and `ts`){not_read(paths)}")
    return Found(imu, truth, camera, panorama)


def load_pictures(path: Path) -> tuple[Array, Picture]:
    """Stamps (K,) s and pictures (K, M, N, 3)."""
    fields = read_mat(path)
    cam = field(fields, "cam", path)
    if cam.ndim == 3:  # MATLAB drops a last axis of one
        cam = cam[..., None]
    if cam.ndim != 4 or cam.shape[2] != 3 or 0 in cam.shape:
        raise BadInput(f"{path}: expected `cam` of shape M×N×3×K (RGB pictures), got {shape_text(cam)}")
    stamps = finite(field(fields, "ts", path).astype(float).ravel(), path, "ts")
    if len(stamps) != cam.shape[3]:
        raise BadInput(f"{path}: `ts` has {len(stamps)} stamps and `cam` {cam.shape[3]} pictures; they must agree")
    back = np.flatnonzero(np.diff(stamps) < 0)
    if len(back):
        raise BadInput(f"{path}: ts goes back at picture {back[0] + 1}; sort the pictures by time")
    return stamps, np.moveaxis(_bytes(cam, path, "cam"), -1, 0)


def load_panorama(path: Path) -> Picture:
    """The true panorama (H, 2H, 3)."""
    panorama = field(read_mat(path), "panorama", path)
    if panorama.ndim != 3 or panorama.shape[1:] != (2 * panorama.shape[0], 3):
        raise BadInput(f"{path}: expected `panorama` of shape H×2H×3, got {shape_text(panorama)}")
    return _bytes(panorama, path, "panorama")


def save(folder: Path, number: str, stamps: Array, pictures: Picture, panorama: Picture) -> list[Path]:
    """Writes `cam<number>.mat` and `panorama<number>.mat`; a file that exists is never written over."""
    files = [folder / f"{role}{number}.mat" for role in _ROLES]
    for path in files:
        if path.exists():
            raise BadInput(f"{path}: is there already, and may be real data; choose another folder or remove it")
    scipy.io.savemat(files[0], {"cam": np.moveaxis(pictures, 0, -1), "ts": stamps[None]}, do_compression=True)
    scipy.io.savemat(files[1], {"panorama": panorama}, do_compression=True)
    return files


def number_of(path: Path) -> str | None:
    """The digits at the end of a file's name, which its companions share."""
    match = re.search(r"(\d+)$", path.stem)
    return match.group(1) if match else None


def _role(path: Path) -> str | None:
    """cam or panorama, by the file's fields; None for any other, which the IMU's files are looked for among."""
    if path.suffix.lower() != ".mat":
        return None
    try:
        held = mat_shapes(path)
    except BadInput:  # who needs the file will say so
        return None
    return next((role for role in _ROLES if spelled(held, role)), None)


def _of_set(imu: Path, role: str, given: list[Path]) -> Path | None:
    """The file of that role among those given: the only one, or the one of the IMU's number; else one beside it."""
    number = number_of(imu)
    same = [file for file in given if number is not None and number_of(file) == number]
    if len(given) == 1 or len(same) == 1:
        return (same or given)[0]
    if given:
        names = ", ".join(str(file) for file in given)
        raise BadInput(f"{len(given)} {role} files found, a run takes one: name one of {names}")
    folders = [folder for folder in (imu.parent, imu.parent.parent / role) if folder.is_dir()]
    beside = (file for folder in folders for file in sorted(folder.iterdir()))
    return next((file for file in beside if number and file.name.lower() == f"{role}{number}.mat"), None)


def _bytes(values: np.ndarray, path: Path, name: str) -> Picture:
    """Colours as bytes: so they come, or as other whole numbers from 0 to 255."""
    if values.dtype == np.uint8:
        return values
    finite(values, path, name)
    if (values != np.clip(np.round(values), 0, 255)).any():
        raise BadInput(f"{path}: `{name}` must hold bytes, whole numbers from 0 to 255; convert it (im2uint8)")
    return values.astype(np.uint8)
