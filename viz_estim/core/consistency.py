"""How good an estimate is, and whether it knows: errors, NEES, NIS, and their bands.

Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001), section 5.4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.discrete import categorical_metrics
from viz_estim.core.distributions import chi2
from viz_estim.core.euler import EulerAngles
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SE2, SO3, Product, Space, wrap

_LEVEL = 0.95
# The numbers of a stage that is one iteration towards one estimate, as a registration's fits are: the poses on the way
# are nobody's estimate, and a run of them is judged where it ends.
FIT = frozenset({"rmse", "converged"})


def squared_distance(error: Array, cov: Array) -> Array:
    """eᵀ·P⁻¹·e (*,) of e (*, d) and P (*, d, d): NIS of a residual under S, NEES of an error under P.

    NaN where P is singular.
    """
    try:
        return (error * np.linalg.solve(cov, error[..., None])[..., 0]).sum(-1)
    except np.linalg.LinAlgError:
        sound = np.linalg.matrix_rank(cov) == cov.shape[-1]
        cov = np.where(sound[..., None, None], cov, np.eye(cov.shape[-1]))
        return np.where(sound, squared_distance(error, cov), np.nan)


def band(dof: int, count: int = 1, level: float = _LEVEL) -> tuple[float, float]:
    """The two-sided band of the mean of `count` independent χ²(dof): (low, high).

    For NIS, count is the number of updates in time (innovations are white); for NEES, the number of runs at one
    step (errors are not white, so that their mean over time has no such band).
    """
    tail = 0.5 * (1 - level)
    low, high = chi2.ppf([tail, 1 - tail], dof * count) / count
    return float(low), float(high)


def rms(error: Array) -> float:
    """Root of the mean squared length of errors (T, d)."""
    return float(np.sqrt((error * error).sum(-1).mean()))


def metrics(space: Space, mean: Array, truth: Array) -> dict[str, float]:
    """Errors by part of the state, over the steps whose truth is known; names carry their units.

    mean, truth (T, n). Attitudes, in whatever way they are kept: the geodesic angle, beside it roll, pitch and yaw of
    R = Rz(yaw)·Ry(pitch)·Rx(roll), and the tilt (the angle between the estimated and the true direction of gravity).
    """
    parts = space.parts if isinstance(space, Product) else {"state": space}
    at = space.at if isinstance(space, Product) else {"state": slice(0, len(space.names))}
    found: dict[str, float] = {}
    for name, part in parts.items():
        x, y = mean[:, at[name]], truth[:, at[name]]
        known = np.isfinite(y).all(1) & np.isfinite(x).all(1)
        if known.any():
            found |= _errors(name, part, x[known], y[known])
    return found


def _errors(name: str, part: Space, x: Array, y: Array) -> dict[str, float]:
    if isinstance(part, SO3):
        return _attitude(x, y)
    if isinstance(part, EulerAngles):
        return _attitude(part.to_quaternion(x), part.to_quaternion(y))
    if isinstance(part, SE2):
        turn = wrap(x[:, 2:] - y[:, 2:])
        place = x[:, :2] - y[:, :2]
        final = {"final_position_error_m": rms(place[-1:])}
        return {"position_rmse_m": rms(place), **final, "heading_rmse_rad": rms(turn)}
    error, found = part.minus(x, y), {}
    for unit in dict.fromkeys(part.axis_units):  # what is in metres and what in m/s make no sum
        along = error[:, [one == unit for one in part.axis_units]]
        word = _UNIT_NAMES.get(unit, unit)
        found[f"{name}_rmse_{word}" if word else f"{name}_rmse"] = rms(along)
    at_end = {"final_position_error_m": rms(error[-1:])}
    return found | (at_end if name == "position" and set(part.axis_units) == {"m"} else {})


def _attitude(x: Array, y: Array) -> dict[str, float]:
    relative = quaternions.multiply(quaternions.conjugate(y), x)
    angle = rms(quaternions.log(relative))
    turns = quaternions.to_euler(x) - quaternions.to_euler(y)
    roll, pitch, yaw = np.sqrt((wrap(turns) ** 2).mean(0))
    up = np.array([0.0, 0.0, 1.0])
    up_x, up_y = (quaternions.rotate(quaternions.conjugate(q), up) for q in (x, y))
    tilt = np.arctan2(np.linalg.norm(np.cross(up_x, up_y), axis=-1), (up_x * up_y).sum(-1))
    values = {"attitude": angle, "roll": roll, "pitch": pitch, "yaw": yaw, "tilt": float(np.sqrt((tilt**2).mean()))}
    return {f"{name}_rmse_deg": float(np.degrees(value)) for name, value in values.items()}


_UNIT_NAMES = {"m": "m", "rad": "rad", "m/s": "mps", "rad/s": "radps", "m/s²": "mps2"}


@dataclass(frozen=True)
class Nis:
    """Normalised innovation squared of one sensor: values (T,), NaN where it was not offered."""

    values: Array
    dof: int

    def summary(self) -> dict[str, float] | None:
        """The mean, and the 95 % band of that mean over time; None where nothing was offered."""
        offered = self.values[np.isfinite(self.values)]
        if not len(offered):
            return None
        low, high = band(self.dof, len(offered))
        return {"mean": float(offered.mean()), "dof": self.dof, "low": low, "high": high}


def nis(space: Product, residual: Array, cov: Array, offered: np.ndarray) -> dict[str, Nis]:
    """NIS by sensor, each by its own block of S: residual (T, m), cov (T, m, m), offered (T, s)."""
    found = {}
    for i, name in enumerate(space.parts):
        at = space.axes_at[name]
        values = squared_distance(residual[:, at], cov[:, at, at])
        found[name] = Nis(np.where(offered[:, i], values, np.nan), at.stop - at.start)
    return found


def nees(space: Space, mean: Array, cov: Array, truth: Array) -> tuple[Array, int]:
    """Normalised estimation error squared (T,) over the parts of the state that have a truth, and its χ² dof.

    NaN at steps without truth, or where the covariance of those parts is singular or no number.
    """
    error = space.minus(mean, truth)
    known = np.isfinite(error)
    directions = np.flatnonzero(known.any(0))
    values = np.full(len(mean), np.nan)
    rows = known[:, directions].all(1)
    if len(directions) == 0 or not rows.any():
        return values, len(directions)
    P = cov[np.ix_(np.flatnonzero(rows), directions, directions)]
    sound: np.ndarray = np.asarray(np.isfinite(P).all((1, 2)))
    sound[sound] = np.linalg.cond(P[sound]) < 1e15
    at = np.flatnonzero(rows)[sound]
    with np.errstate(over="ignore", invalid="ignore"):  # of particles that are all but copies
        values[at] = squared_distance(error[at][:, directions], P[sound])
    return values, len(directions)


def nees_summary(values: Array, dof: int) -> dict[str, float] | None:
    """The mean NEES, and the share of steps inside χ²(dof)'s two-sided 95 % interval; None without truth."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    low, high = band(dof)
    return {"mean": float(known.mean()), "dof": dof, "inside": float(((known >= low) & (known <= high)).mean())}


def nees_by_part(space: Space, mean: Array, cov: Array, truth: Array) -> dict[str, float]:
    """The mean NEES of each part of the state by its own block of the covariance, as `nees_<part>`: which part carries
    an inconsistency. Nothing where only one part has a truth."""
    parts = space if isinstance(space, Product) else Product(state=space)
    found = {}
    for name, part in parts.parts.items():
        at, axes = parts.at[name], parts.axes_at[name]
        one = nees_summary(*nees(part, mean[:, at], cov[:, axes, axes], truth[:, at]))
        if one:
            found[f"nees_{name}"] = one["mean"]
    return found if len(found) > 1 else {}


def summary(
    space: Space | None,
    ends: Mapping[str, Array],
    truth: Array,
    innovations: list[tuple[Product, Array, Array, np.ndarray]],
    facts: Mapping[str, float],
) -> dict[str, Any]:
    """`metrics`, `nis` by sensor, and `nees` of a run, as the command line prints them.

    ends: the belief's arrays at the end of each step that counts, mean (T, n) and cov (T, d, d) or log_probabilities
    (T, K); truth (T, n) or (T, 1). innovations: of each update stage its measurement's space, residuals (M, m), S
    (M, m, m) and which were offered (M, s). facts: figures known beforehand, printed among the metrics.
    """
    by_sensor: dict[str, Any] = {}
    for name, values in _pooled([nis(*rows) for rows in innovations]).items():
        if found := values.summary():
            by_sensor[name] = found
    plain = {"metrics": dict(facts), "nis": by_sensor, "nees": None}
    if not len(truth):
        return plain
    if "log_probabilities" in ends:
        return plain | {"metrics": categorical_metrics(ends["log_probabilities"], truth) | dict(facts)}
    assert space is not None
    mean, cov = ends["mean"], ends["cov"]
    figures = metrics(space, mean, truth) | nees_by_part(space, mean, cov, truth) | dict(facts)
    return plain | {"metrics": figures, "nees": nees_summary(*nees(space, mean, cov, truth))}


def _pooled(found: list[dict[str, Nis]]) -> dict[str, Nis]:
    """By sensor: the readings of its several targets (`range/1`, `range/2`) are one sensor's."""
    pooled: dict[str, list[Nis]] = {}
    for one in found:
        for name, values in one.items():
            pooled.setdefault(name.partition("/")[0], []).append(values)
    return {name: Nis(np.concatenate([n.values for n in all_]), all_[0].dof) for name, all_ in pooled.items()}


class _Rows:
    """Arrays of one shape, one after the other, kept a thousand to an array: a small one's head is larger than its
    numbers, and a robot runs for hours."""

    def __init__(self) -> None:
        self._new: list[Any] = []
        self._blocks: list[Array] = []

    def append(self, row: Any) -> None:
        self._new.append(row)
        if len(self._new) == 1000:
            self._blocks.append(np.stack(self._new))
            self._new = []

    def stacked(self) -> Array:
        """All of them (N, …), of which there is at least one."""
        return np.concatenate([*self._blocks, np.stack(self._new)] if self._new else self._blocks)


class Tally:
    """Gathers of each step what a run's summary needs, and nothing large: clouds and sigma points are let go.

    first: the step from which on steps count.
    """

    def __init__(self, space: Space | None, first: int = 0, facts: Mapping[str, float] | None = None) -> None:
        self.space, self.first, self.facts = space, first, facts or {}
        self.ends: dict[str, _Rows] = {}
        self.innovations: dict[str, tuple[Any, dict[str, _Rows]]] = {}  # by stage: the reading's space, and its numbers

    def add(self, step: Any) -> None:
        """Takes in a `Step`, unless it lies before the first that counts or never came to its end."""
        if step.index < self.first or not step.stages or step.error:
            return
        belief = step.stages[-1].belief
        if all(hasattr(step.stages[-1], name) for name in FIT):
            self.ends = {}
        size = 1 if self.space is None else len(self.space.names)
        ended = {"truth": np.full(size, np.nan) if step.truth is None else step.truth}
        for name in ("log_probabilities",) if self.space is None else ("mean", "cov"):
            ended[name] = getattr(belief, name)
        for name, value in ended.items():
            self.ends.setdefault(name, _Rows()).append(value)
        for stage in step.stages:
            if hasattr(stage, "innovation"):
                told = stage.innovation
                _, rows = self.innovations.setdefault(stage.name, (told.space, {k: _Rows() for k in _TOLD}))
                for name, column in rows.items():
                    column.append(getattr(told, name))

    def summary(self) -> dict[str, Any]:
        """The run's `summary`."""
        innovations: list[Any] = [
            (space, *(rows[name].stacked() for name in _TOLD)) for space, rows in self.innovations.values()
        ]
        ends = {name: rows.stacked() for name, rows in self.ends.items()}
        truth = ends.pop("truth", np.empty(0))
        return summary(self.space, ends, truth, innovations, self.facts)


_TOLD = ("residual", "cov", "offered")
