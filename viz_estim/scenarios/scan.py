"""Two scans of one place, and their registration: iterated closest points from the identity.

Y's frame is the world; the estimated body is X's frame in it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.registration import SPACES, ClosestPoints, start, to_state
from viz_estim.core.run import Scenario, Step, Tick
from viz_estim.core.scenery import Cloud
from viz_estim.core.stages import Align
from viz_estim.errors import BadInput
from viz_estim.scenarios import scan_files
from viz_estim.scenarios.checks import at_most, positive
from viz_estim.scenarios.scan_files import ScanData

_MOST = 200  # iterations, where none are prescribed

# The simulated room, in m: faces as a corner and two edges. A planar scanner sees the upright ones, as lines.
_UP, _BOX_UP = (0, 0, 1.5), (0, 0, 0.7)
_FACES = np.array(
    [
        [(0, 0, 0), (3, 0, 0), (0, 2.4, 0)],  # the floor
        [(0, 0, 0), (3, 0, 0), _UP],
        [(0, 0, 0), (0, 2.4, 0), _UP],
        [(3, 0, 0), (0, 2.4, 0), _UP],
        [(0, 2.4, 0), (3, 0, 0), _UP],
        [(0.9, 1.3, 0.7), (0.8, 0.3, 0), (-0.2, 0.5, 0)],  # a box that stands askew
        [(0.9, 1.3, 0), (0.8, 0.3, 0), _BOX_UP],
        [(0.9, 1.3, 0), (-0.2, 0.5, 0), _BOX_UP],
        [(1.7, 1.6, 0), (-0.2, 0.5, 0), _BOX_UP],
        [(0.7, 1.8, 0), (0.8, 0.3, 0), _BOX_UP],
    ]
)
_SCANNER = np.array([1.5, 1.2, 0.8])  # the frame of Y in the room
_HIDDEN, _HIDDEN_FROM_X, _HIDDEN_FROM_Y = 0.8, (0.0, 0.0), (3.0, 2.4)  # m around a corner: each scan misses another
_SHIFT, _TURN = 0.1, 0.06  # m, rad: standard deviations of the true pose along and about each axis


def scan(
    source: list[Path] | None,
    rng: np.random.Generator,
    *,
    points: int = 1500,
    noise: float = 0.004,
    planar: bool = False,
) -> ScanData:
    """Two clouds from files, the moved one first, or two simulated scans of a room, of `points` each.

    noise: the standard deviation in m of each coordinate. The two scans hit different points, and each misses a corner
    of the room that the other sees.
    """
    if source is not None:
        return scan_files.load(source)
    if points < 3 or noise < 0:
        raise BadInput(f"a simulation needs points ≥ 3 and noise ≥ 0: got points={points}, noise={noise:g}")
    at_most(1e6, points=points)
    d = 2 if planar else 3
    turn = _TURN * rng.standard_normal(3)
    R = quaternions.to_matrix(quaternions.exp(turn * (0, 0, 1) if planar else turn))[:d, :d]
    t = _SHIFT * rng.standard_normal(3)[:d]
    X, Y = (_draw(rng, points, corner, planar) for corner in (_HIDDEN_FROM_X, _HIDDEN_FROM_Y))
    X, Y = (cloud + noise * rng.standard_normal(cloud.shape) for cloud in (X, Y))
    # A tenth of a millimetre is what a scanner's files hold.
    return ScanData(((X - t) @ R).round(4), Y.round(4), to_state(R, t))


def _draw(rng: np.random.Generator, points: int, hidden: tuple[float, float], planar: bool) -> Array:
    """Points (N, 2 or 3) drawn evenly from the faces, but for those near a hidden corner (x, y); in Y's frame."""
    faces = _FACES[_FACES[:, 2, 2] > 0] if planar else _FACES
    size = np.linalg.norm(faces[:, 1] if planar else np.cross(faces[:, 1], faces[:, 2]), axis=1)
    found = np.empty((0, 3))
    while len(found) < points:
        corner, u, v = np.moveaxis(faces[rng.choice(len(faces), points, p=size / size.sum())], 1, 0)
        drawn = corner + rng.random((points, 1)) * u + rng.random((points, 1)) * v
        found = np.concatenate([found, drawn[np.linalg.norm(drawn[:, :2] - hidden, axis=1) > _HIDDEN]])
    return (found[:points] - _SCANNER)[:, : 2 if planar else 3]


def save(data: ScanData, folder: Path) -> list[Path]:
    """Writes simulated data as `cloudX.csv`, `cloudY.csv` and `cloudList.csv`, the true poses."""
    return scan_files.save(folder, data)


def scan_icp(data: ScanData, *, max_distance: float = 0.25, iterations: int = 0) -> Scenario:
    """Iterated closest points: a scan moved on to another, each point to its nearest within max_distance (m).

    iterations: so many, whether or not the matches repeat; 0: until they do, at most 200.
    """
    positive(max_distance=max_distance)
    if iterations < 0:
        raise BadInput(f"iterations must be a whole number from 0 on (0: until the matches repeat), got {iterations}")
    count = iterations or _MOST
    # Step k is iteration k: step 0 holds the start alone. A second an iteration, for want of another time.
    ticks = [Tick(float(k), float(k > 0)) for k in range(count + 1)]
    truth = data.truth

    def figures(last: Step) -> dict[str, float]:
        stage = last.stages[-1] if last.stages else None
        if not isinstance(stage, Align):  # it failed
            return {"iterations": max(last.index - 1, 0), "converged": 0}
        found = {"registration_rmse": stage.rmse, "matches": stage.count}
        found |= {"iterations": last.index, "converged": int(stage.converged)}
        return found if truth is None else found | _final_error(stage.belief.mean, truth)

    return Scenario(
        ClosestPoints(data.X, data.Y, max_distance),
        {0: start(data.X, max_distance)},
        ticks,
        None if truth is None else np.broadcast_to(truth, (len(ticks), len(truth))),
        {"Y": Cloud(data.Y), "X": Cloud(data.X, moves=True)},
        _notes(data, max_distance, iterations),
        until=None if iterations else _repeats,
        figures=figures,
    )


def _repeats(step: Step) -> bool:
    return isinstance(step.stages[-1], Align) and step.stages[-1].converged


def _final_error(state: Array, truth: Array) -> dict[str, float]:
    """The angle between the last rotation and the true one; that of the position is among every run's metrics."""
    d = 2 if len(state) == 3 else 3
    angle = float(np.linalg.norm(SPACES[d].minus(state, truth)[d:]))
    return {"final_heading_error_rad": angle} if d == 2 else {"final_attitude_error_deg": float(np.degrees(angle))}


def _notes(data: ScanData, max_distance: float, iterations: int) -> str:
    end = (
        f"{iterations} iterations were prescribed: **converged** says whether the matches repeat by then. "
        if iterations
        else f"It ends when the matches repeat, for then nothing moves any more, or after {_MOST} iterations. "
    )
    return (
        f"X ({len(data.X)} points) is moved on to Y ({len(data.Y)}), one iteration a step. **match** draws a line from "
        f"each point of X to its nearest in Y within {max_distance:g} m; **align** fits the pose to these pairs. Long "
        "lines that lean one way are what is left to move; at a rim they are points that the other scan never saw.\n\n"
        "While **K**, the count of matches, rises, RMSE may rise with it: the new pairs are the long ones. "
        f"{end}Repeating is no proof of being right: from a start too far off, the matches can repeat at a wrong pose. "
        "The covariance takes every match as right, so that it is far too small (**NEES**)."
    )
