"""What a person sees on the terminal while something takes long: nothing where stderr is no terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable


def working(what: str) -> None:
    """Says on stderr, where that is a terminal, what takes a while and cannot tell how far it is."""
    if sys.stderr.isatty():
        print(f"{what} …", file=sys.stderr, flush=True)


def counter() -> Callable[[int, int], None]:
    """Shows a count on stderr, where that is a terminal, five times a second."""
    if not sys.stderr.isatty():
        return lambda done, total: None
    last = time.monotonic()

    def show(done: int, total: int) -> None:
        nonlocal last
        if done == total or time.monotonic() - last > 0.2:
            last = time.monotonic()
            print(f"\r{done}/{total} steps", end="\n" if done == total else "", file=sys.stderr, flush=True)

    return show
