"""A recording that was cut off inside a message, as a kill leaves it: everything before that message is sound."""

from __future__ import annotations

import contextlib
import os
import shutil
import struct
import tempfile
import warnings
from collections.abc import Collection, Generator
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from viz_estim.recording.tables import StageTable

# An .rrd stream is a header of 12 bytes and messages of two little-endian uint64, kind and length, and a payload; where
# it was ended well, a footer follows, whose last 12 bytes are its mark and the number of its entries.
_MAGIC, _HEADER, _MESSAGE, _MARK, _MARKED = b"RRF2", 12, struct.Struct("<QQ"), b"RRF2FOOT", 12


@contextlib.contextmanager
def whole(path: Path) -> Generator[Path]:
    """The recording itself, or for the time of the context a copy of it up to its last whole message."""
    end = _sound_end(path)
    if end == path.stat().st_size:
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="viz_estim_") as folder:
        copy = Path(folder) / path.name
        shutil.copyfile(path, copy)
        with copy.open("r+b") as file:
            file.truncate(end)
        yield copy


def has_rows(path: Path) -> bool:
    """Whether there is any row on a timeline. True where it is no stream that we know, or a damaged one (others judge
    it)."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RerunWarning)  # of a run that was killed
            return any(not chunk.is_static for chunk in RrdReader(path).stream())
    except (ValueError, OSError, RuntimeError) as error:
        return path.stat().st_size > 0 and "No recording store" not in str(error)


def last_whole(batches: list[np.ndarray], tables: Collection[StageTable]) -> int:
    """The number of the last step whose stages all reached the file; −1 where there is none. batches: the steps (M,) of
    each batch, in order.

    A batch is written table by table, its steps first, so that a kill may leave some of the last one's stages alone:
    then the places on the stage timeline, which are counted without a gap, have one, or end before the steps do.
    """
    place, step = (np.concatenate([[], *(getattr(table, name) for table in tables)]) for name in ("place", "step"))
    if len(place) and int(step.max()) == batches[-1][-1] and int(place.max()) == len(place) - 1:
        return int(batches[-1][-1])
    return int(batches[-2][-1]) if len(batches) > 1 else -1


def _sound_end(path: Path) -> int:
    """Where the last whole message ends; the file's size where it is no stream that we know (others judge it)."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if size < _HEADER or file.read(len(_MAGIC)) != _MAGIC:
            return size
        file.seek(-_MARKED, os.SEEK_END)
        if file.read(len(_MARK)) == _MARK:
            return size
        end = _HEADER
        while end + _MESSAGE.size <= size:
            file.seek(end)
            _, length = _MESSAGE.unpack(file.read(_MESSAGE.size))
            if end + _MESSAGE.size + length > size:
                break
            end += _MESSAGE.size + length
    return end
