"""What `calibrate` does: fits a system's constants, and writes them with a picture of what they were fitted to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from viz_estim.files import check_writable, whole
from viz_estim.recording import calibration_picture
from viz_estim.scenarios import SYSTEMS


def calibrate(system: str, data: list[Path], out: Path | None) -> dict[str, Any]:
    """Fits the system's constants to data; what `--json` prints. out: where they go, and their picture beside them."""
    if out:
        check_writable(out, suffix=".json")
        check_writable(out.with_suffix(".rrd"))
    fitted = SYSTEMS[system].calibrate(data)
    result: dict[str, Any] = fitted.to_json()
    if out:
        made = {"calibration": str(out)}
        if pictures := fitted.pictures():
            made["recording"] = str(out.with_suffix(".rrd"))
            calibration_picture.write(out.with_suffix(".rrd"), pictures, result)
        with whole(out) as aside:
            aside.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        result |= made
    return result
