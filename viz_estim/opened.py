"""The recordings of a person's own code that are not ended: one a file, each ended with its program at the latest."""

from __future__ import annotations

import atexit
import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from viz_estim.recordings import Recording

_OPEN: dict[Path, Recording] = {}


def begin(recording: Recording, file: Path) -> None:
    """Keeps it; an earlier one of the same file, as of a notebook's cell that is run again, is ended before."""
    if earlier := _OPEN.get(file):
        earlier.close()
    _OPEN[file] = recording
    atexit.unregister(_end_all)
    atexit.register(_end_all)  # anew: it must come before what was registered so far, such as the SDK's own end


def end(recording: Recording, file: Path) -> None:
    """Forgets it."""
    if _OPEN.get(file) is recording:
        del _OPEN[file]


def _end_all() -> None:
    for recording in list(_OPEN.values()):
        recording.close()


if hasattr(os, "register_at_fork"):  # the files of a process are none of its children's
    os.register_at_fork(after_in_child=_OPEN.clear)
