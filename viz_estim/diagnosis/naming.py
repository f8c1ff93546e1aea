"""What a factor may come from: the known mistakes that it is near to, as far as it is known."""

from __future__ import annotations

import numpy as np

from viz_estim.diagnosis.axes import units
from viz_estim.diagnosis.finding import GROSS, ODDS, SHEET, TINY

FAR = 3.0  # standard deviations: one of 370 right names is lost by it
_CALIBRATED = 0.5 * SHEET  # of a factor, one standard deviation


SIGNS = [["a wrong sign"], ["its sign is wrong"]]  # of a reading, of a motion: names that a sign alone has


def named(factor: float, known: dict[str, float], error: float = 0.0) -> str:
    """In words, of a factor with this standard error: one of the known ones, or several that are as likely."""
    found = likeliest(factor, known, error)
    if not found:
        return "a scale factor that is not 1" if factor > 0 else "a wrong sign and size"
    return ", or ".join(found)


def likeliest(factor: float, known: dict[str, float], error: float = 0.0) -> list[str]:
    """The names whose factor it may be, the nearest first: those within three standard deviations, of which none is
    less likely than the first by ODDS. By its logarithm, with the error of a calibration besides."""
    scale = np.hypot(error / max(abs(factor), TINY), _CALIBRATED)
    off = {name: (np.log(factor / value) / scale) ** 2 for name, value in known.items() if factor / value > 0}
    near = sorted((value, name) for name, value in off.items() if value < FAR**2)
    return [name for value, name in near if 0.5 * (value - near[0][0]) < np.log(ODDS)]


def of_reading(unit: str) -> dict[str, float]:
    """The factors of a reading that is mistaken."""
    known = {name: 1 / value for name, value in units(unit).items()}
    return known | {"a wrong sign": -1.0, "twice, as a round trip taken for the way there": 2.0}


def of_motion(unit: str, dt: float, times: int = 1) -> dict[str, float]:
    """The factors of a motion that is predicted over dt s, in `times` parts: of its rate, or of time."""
    known = {name: 1 / value for name, value in units({"m": "m/s", "rad": "rad/s"}.get(unit, unit)).items()}
    known |= {"its sign is wrong": -1.0, "stamps in ms taken for s": 1e3, "stamps in s taken for ms": 1e-3}
    if times > 1:
        known[f"the prediction is done {times} times a step, each over the whole of it"] = float(times)
    else:
        known["as if the prediction were done twice a step"] = 2.0
    # A dt of about 1 s is no factor.
    return known | ({"a dt that is multiplied once too often": dt} if 0 < dt < 1 / GROSS else {})
