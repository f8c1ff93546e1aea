"""Files of any kind: what they hold in one number, whether one can be written, and writing it whole or not at all."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from viz_estim.errors import BadInput


def sha256(path: Path) -> str:
    """The file's SHA-256 in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def check_writable(path: Path, *, suffix: str | None = None) -> None:
    """BadInput where the file cannot be written, before any work is done; what exists is left as it is."""
    if suffix and path.suffix != suffix:
        raise BadInput(f"{path}: the output's name must end in {suffix}")
    if not path.parent.is_dir():
        raise BadInput(f"{path}: the folder {path.parent} does not exist; make it first")
    if path.is_dir():
        raise BadInput(f"{path}: is a folder, expected a file's name")
    aside = _aside(path)
    try:
        aside.touch()
        aside.unlink()
    except OSError as error:
        raise BadInput(f"{path}: cannot be written ({error.strerror}); choose another place") from error


def make_folder(folder: Path) -> None:
    """Makes the folder for outputs that nobody named; BadInput where that cannot be."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise BadInput(f"{folder}: cannot be made here ({error.strerror}); name another place with --out") from error


@contextmanager
def claimed(path: Path) -> Generator[None]:
    """Keeps the file for one run while the context lasts; BadInput where another one is writing it."""
    try:
        import fcntl
    except ImportError:  # not on this system: there, two runs must be told apart by the person who starts them
        yield
        return
    with path.open("ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BadInput(f"{path}: another run is recording there; wait for it, or choose another name") from None
        yield


@contextmanager
def whole(path: Path) -> Generator[Path]:
    """A name to write to, which becomes `path` when the context ends well and vanishes when it does not."""
    aside = _aside(path)
    try:
        yield aside
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def _aside(path: Path) -> Path:
    return path.with_name(f".{path.name}.part")
