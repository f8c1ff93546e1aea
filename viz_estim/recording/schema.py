"""The contract of a recording: every entity path, what it holds, in which unit and frame; and the colours' meanings.

Three timelines are on every row: `step` (sequence), `time` (duration, s from the first stamp), `stage` (sequence over
all stages of the run). A row that only clears what a past stage drew carries `stage` alone.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import rerun as rr

Colour = tuple[int, int, int]

# One meaning a colour, in every view.
ESTIMATE: Colour = (255, 176, 0)
TRUTH: Colour = (235, 235, 235)
SENSORS: dict[str, Colour] = {
    "cyan": (0, 190, 200),
    "violet": (190, 120, 255),
    "pink": (255, 120, 170),
    "olive": (150, 190, 90),
}
BAND: Colour = (120, 120, 130)
SCENERY: Colour = (150, 150, 160)
OTHER_PATH: Colour = (120, 130, 185)  # apart from the truth's, which is drawn whole
MODE: Colour = (255, 255, 150)
AXES: tuple[Colour, ...] = ((235, 70, 70), (80, 200, 90), (80, 130, 255))  # x, y, z
HEALTH: dict[str, Colour] = {
    "used": (60, 120, 75),
    "gated": (200, 150, 60),
    "frozen, used": (220, 50, 50),
    "frozen, rejected": (150, 70, 70),
    "absent": (70, 70, 70),
}

_MORE: tuple[Colour, ...] = ((230, 200, 60), (200, 110, 220), (60, 200, 200))

STEPS = "/steps"
NOTES = "/notes"
EVENTS = "/events"
LANES = "/lanes"
ATTITUDE = "/attitude"
WORLD = "/world"
BARS = "/bars"
BAR = 0.5  # from one bar to the next, where 1 is a probability of 1
PLOTS = "/plots"


_STAGES: tuple[Colour, ...] = ((60, 75, 95), (85, 85, 130), (60, 105, 125), (110, 85, 120), (95, 105, 95))


def stage_colours(names: list[str]) -> dict[str, Colour]:
    """A quiet colour for each stage, in the order in which they came."""
    return {name: _STAGES[i % len(_STAGES)] for i, name in enumerate(names)}


def sensor_colour(place: int) -> tuple[str, Colour]:
    """The colour's name and value for the sensor that came at that place."""
    return list(SENSORS.items())[place % len(SENSORS)]


def line_colours(count: int) -> list[Colour]:
    """Colours for as many lines in one plot: the axes' three, then others that stand apart."""
    return [(*AXES, *_MORE)[i % (len(AXES) + len(_MORE))] for i in range(count)]


def shades(colour: Colour, count: int) -> list[Colour]:
    """The colour of a sensor, for each of its components: full, dark, pale, and again."""
    r, g, b = colour
    pale = (r // 2 + 125, g // 2 + 125, b // 2 + 125)
    return [((r, g, b), (r // 2, g // 2, b // 2), pale)[i % 3] for i in range(count)]


def by_weight(share: np.ndarray) -> np.ndarray:
    """Colours (*,) as 0xRRGGBBAA for weights (*,) between 0 and 1: dark blue for next to nothing (or for a weight that
    is no number), amber for all."""
    return _RAMP[(255 * np.sqrt(np.nan_to_num(np.clip(share, 0, 1)))).astype(np.intp)]


def by_distance(share: np.ndarray) -> np.ndarray:
    """Colours (*,) as 0xRRGGBBAA for distances (*,) between 0 and 1: blue for near, red for far."""
    return _DISTANCES[(255 * np.clip(share, 0, 1)).astype(np.intp)]


def _ramp(low: Colour, high: Colour) -> np.ndarray:
    share = np.linspace(0, 1, 256)[:, None]
    rgb = ((1 - share) * np.array(low) + share * np.array(high)).astype(np.uint32)
    packed: np.ndarray = (rgb[:, 0] << 24 | rgb[:, 1] << 16 | rgb[:, 2] << 8 | 255).astype(np.uint32)
    return packed


_RAMP = _ramp((40, 50, 110), ESTIMATE)
_DISTANCES = _ramp((70, 140, 255), (255, 60, 60))


def stage(name: str) -> str:
    return f"/stages/{as_part(name)}"


def drawn(name: str, field: str) -> str:
    return f"{WORLD}/{as_part(name)}/{as_part(field)}"


def sensor(name: str) -> str:
    return f"/sensors/{as_part(name)}"


def plot(group: str, component: str) -> str:
    return f"{PLOTS}/{group}/{as_part(component)}"


def lane(name: str) -> str:
    return f"{LANES}/{as_part(name)}"


@cache
def as_part(name: str) -> str:
    """A person's name as it stands in an entity's path: blanks and the like are escaped, slashes part it."""
    return "/".join(rr.escape_entity_path_part(part) for part in name.split("/") if part) or "_"


class Entry(NamedTuple):
    """One line of the contract."""

    path: str
    holds: str
    unit: str = ""
    frame: str = ""


_SENSOR_S, _PART_S, _TANGENT = "the sensor's", "the part's", "tangent at the estimate"
ENTITIES = (
    Entry(STEPS, "`viz_estim.Step`: dt, control, `truth.<part>`, `z.<sensor>`, `raw.<sensor>`", "SI, rad; counts"),
    Entry(
        "/stages/{stage}",
        "`viz_estim.Stage`: the belief (mean, cov; log_probabilities; states, log_weights) and the stage's own numbers "
        "(`gain`, `innovation.residual`, `sigma.points`, `ancestors`, `matches.source`, …), float64, row-major; what "
        "all rows share is in the first, points of the stage before are in that one, equal log_weights are one, and "
        "copies are known by their ancestors",
        "SI, rad",
        "covariances: " + _TANGENT,
    ),
    Entry(
        "/attitude/estimate, /attitude/truth", "`Boxes3D`, `Arrows3D`: the body and its axes", "not to scale", "world"
    ),
    Entry("/attitude/{stage}/{points}", "`Points3D`: sigma points, as tips of the body's axes", "1", "world"),
    Entry("/attitude/camera, …/picture", "`Pinhole`, `EncodedImage`: where the picture was taken, and it", "", "world"),
    Entry(
        "/canvas/mosaic, …/frame/…", "`EncodedImage`, `Points2D`: the mosaic so far, and where the picture lay", "½°"
    ),
    Entry("/canvas/degrees, /panorama/…", "the canvas's grid; the true panorama where it is known", "½°"),
    Entry(
        "/world/estimate, /world/truth",
        "`Arrows3D`, `Boxes3D` or `Points3D`: the body; `…/trail`, `…/path` the way so far, `…/cov` the 3σ ellipsoid",
        "m",
        "world",
    ),
    Entry("/world/{stage}/{points}", "`Points3D`: the sigma points' places", "m", "world"),
    Entry(
        "/world/{stage}/{sensor}",
        "`Points3D` or `Arrows3D`: a reading of a place; of ranges to landmarks",
        "m",
        "world",
    ),
    Entry(
        "/world/{stage}/before, …/moved", "`Ellipsoids3D`, `Arrows3D`: 3σ before an update; K[:, j]·ν_j", "m", "world"
    ),
    Entry("/world/particles", "`Arrows3D` or `Points3D`: the cloud, coloured by weight", "m", "world"),
    Entry("/world/modes", "`Ellipsoids3D`: 3σ of each mode, where there are several", "m", "world"),
    Entry("/world/{stage}/ancestry", "`Arrows3D`: from parents, a step before, to the survivors", "m", "world"),
    Entry("/world/{stage}/matches", "`Arrows3D`: pairs, coloured by distance", "m", "the fixed cloud's"),
    Entry("/world/moved, /world/scenery", "clouds that the pose moves; what stands still", "m", "world"),
    Entry("/bars/probability", "`Boxes3D`: the probability of each label", "1"),
    Entry("/sensors/{sensor}/{stage}/mapped", "`Points3D`: sigma points in the measurement", _SENSOR_S, "body"),
    Entry("/sensors/{sensor}/{stage}/measured", "`Arrows3D`: the reading", _SENSOR_S, "body"),
    Entry("/sensors/{sensor}/{stage}/predicted", "`Arrows3D`: the mean of what was expected", _SENSOR_S, "body"),
    Entry(
        "/plots/state/{part}.{component}",
        "`Measurements`: the estimate with its ±1σ band, the truth (`…/truth` where it has gaps), its sensor's reading",
        _PART_S,
        _PART_S,
    ),
    Entry(
        "/plots/error/{part}.{axis}",
        "`Measurements`: the error (`…/value` where it has gaps), ±3σ of the covariance",
        "deg, " + _PART_S,
        _TANGENT,
    ),
    Entry("/plots/sigma/{part}", "`Measurements`: √ of the covariance's diagonal", "deg, " + _PART_S, _TANGENT),
    Entry("/plots/innovation/{sensor}.{axis}", "`Measurements`: the residual, ±3σ of S", _SENSOR_S, "body"),
    Entry("/plots/nis/{sensor}", "`Measurements`: normalised innovation squared, χ²'s 95 % interval", "1"),
    Entry("/plots/moved/{part}.{axis}/{stage}", "`Measurements`: K[:, j]·ν_j by component of the reading", "σ before"),
    Entry("/plots/figure/{stage}.{field}", "`Measurements`: a stage's single numbers (ESS, evidence, RMSE, …)"),
    Entry("/plots/probability/labels", "`Measurements`: the probability of each label", "1"),
    Entry("/lanes/stage, /lanes/truth", "`StateChange`: the stage; the true label"),
    Entry("/lanes/{sensor}", "`StateChange`: its reading was used, gated, frozen or absent"),
    Entry("/findings, /findings/list, /lanes/NN_…", "`TextDocument`, `TextLog`, `StateChange`: what `diagnose` found"),
    Entry(EVENTS, "`TextLog`: what ended a run"),
    Entry(NOTES, "`TextDocument`: what to look at"),
    Entry("/runs/{run}/…", "in a comparison: a run's own entities, on the first run's steps and stages"),
    Entry(
        "/plots/{group}/{quantity}/{run}",
        "in a comparison: each run's line (`moved`: K·ν of all readings); `-truth`, `-reading` once",
        _PART_S,
    ),
    Entry(
        "/__properties/viz_estim",
        "scenario, parameters, seed, data files with their SHA-256, versions, spaces, the result (JSON texts)",
    ),
)


def table() -> str:
    """The contract as a markdown table, as the README shows it."""
    rows = [f"| `{e.path}` | {e.holds} | {e.unit} | {e.frame} |" for e in ENTITIES]
    return "\n".join(["| entity | holds | unit | frame |", "|---|---|---|---|", *rows])
