"""What `simulate` does: writes a system's simulated data in the formats that its scenarios read."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from viz_estim.errors import BadInput
from viz_estim.parameters import assign, check_seed, nearest, parameters
from viz_estim.scenarios import SYSTEMS


def simulate(system: str, settings: list[str], seed: int, folder: Path) -> list[Path]:
    """Simulates a system with `K=V` settings; the files that were written."""
    if system not in SYSTEMS:
        raise BadInput(f"no system {system}{nearest(system, SYSTEMS)}")
    check_seed(seed)
    module = SYSTEMS[system]
    make = getattr(module, system)
    # Here every parameter is the data's: `freeze=0` and `data.freeze=0` mean the same.
    own = [text.removeprefix("data.") for text in settings]
    params, _ = assign(own, parameters(make), {}, f"simulate {system}")
    data = make(None, np.random.default_rng(seed), **params)
    if folder.exists() and not folder.is_dir():
        raise BadInput(f"{folder}: is a file, expected a folder")
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise BadInput(f"{folder}: nothing can be written there (permission denied); choose another folder")
    written: list[Path] = module.save(data, folder)
    return written
