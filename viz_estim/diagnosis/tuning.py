"""Which factor on R or on Q would make the filter consistent: the same filter again, with other noises.

A linear filter's innovations under other noises follow from the recorded ones: with d the difference of the two
estimates, d' = F·d and ν_f = ν − H·d before an update, d⁺ = d + K_f·ν_f − K·ν after it, and P_f by the Riccati
recursion from the recorded F, H, R and Q = P' − F·P·Fᵀ. The factor is that of the greatest likelihood of the
innovations, −½·Σ(ν_fᵀ·S_f⁻¹·ν_f + log|S_f|) (Mehra 1970; Abbeel et al. 2005). For a linearised filter this is right
as long as d is small. Nothing of the filter is run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from viz_estim.core.distributions import chi2
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product
from viz_estim.diagnosis.evidence import Case, once, tells_gain
from viz_estim.diagnosis.finding import LARGEST
from viz_estim.diagnosis.linear import jacobians, transitions
from viz_estim.diagnosis.outlying import outlying
from viz_estim.recording.tables import StageTable

# How finely and how far is looked; a factor at the end of it is not told as one.
_GRID = np.arange(-6.0, 6.5) * np.log(10) / 2  # log factors, 10⁻³ to 10³
_PLACES = 4000  # stages at most, from the first that counts on: of a thousand readings a factor is known to 5 %


class Tuned(NamedTuple):
    """The factor on a noise that explains the innovations best, its gain in log-likelihood against 1, and the
    log-likelihoods of the log factors that were tried."""

    factor: float
    gain: float
    scores: Array
    grid: Array = _GRID

    @property
    def known(self) -> bool:
        """Whether it is a number, and not the end of those that were tried."""
        step = self.grid[1] - self.grid[0]
        return bool(self.grid[0] + 0.3 * step < np.log(self.factor) < self.grid[-1] - 0.3 * step)

    def p_beyond(self, factor: float) -> float:
        """The chance of such innovations if the noise is too small by `factor` and not by more (Wilks 1938)."""
        if self.factor <= factor:
            return 1.0
        fine, values = _spline(self.scores, self.grid)
        held = float(values[np.searchsorted(fine, np.log(factor))])
        return float(0.5 * chi2.sf(2 * max(float(values.max()) - held, 0.0), 1))

    def odds(self, factor: float) -> float:
        """By how much the best factor is likelier than this one."""
        fine, values = _spline(self.scores, self.grid)
        if not fine[0] <= np.log(factor) <= fine[-1]:
            return np.inf
        return float(np.exp(min(values.max() - values[np.searchsorted(fine, np.log(factor))], LARGEST)))


class _Turned(NamedTuple):
    """An update's readings in M rows, each sensor's m numbers turned so that their noises are independent."""

    H: Array  # (M, m, d)
    residual: Array  # (M, m)
    noise: Array  # (M, m), variances
    on: list[list[int]]  # by row those of the m whose reading was used and is no outlier, and whose model is known
    moved: Array  # (M, d, 1), K·ν
    sensors: list[str]  # m


class _Model(NamedTuple):
    """The filter's predictions, F and Q by name, its updates by name, and its sensors."""

    moves: dict[str, Array]
    noise: dict[str, Array]
    updates: dict[str, StageTable]
    turned: dict[str, _Turned]
    carried: dict[str, Array]
    sensors: list[str]


def factors(case: Case) -> dict[str, Tuned]:
    """By what is tuned: a sensor's name for its R, `Q` for the process noise. Empty where F or H is not known."""
    return once(case, "_tuned", _factors)


def _model(case: Case) -> _Model | None:
    run = case.run
    if run.labels or "cov" not in run.ends:
        return None
    moves = {name: F for name, table in run.stages.items() if (F := transitions(case, table)) is not None}
    updates = {name: table for name, table in run.stages.items() if tells_gain(table)}
    if any(name.startswith("predict") and name not in moves for name in run.stages) or not updates:
        return None
    names = list(dict.fromkeys(n.partition("/")[0] for t in updates.values() for n in _parts(t)))
    if not all(np.nan_to_num(t.values["innovation.noise"]).any() for t in updates.values()):
        return None
    before = {name: case.sequence.before(run.stages[name])[1] for name in (*moves, *updates)}
    return _Model(
        moves,
        {name: _noise(run.stages[name], F, before[name]) for name, F in moves.items()},
        updates,
        {name: _turned(case, table, before[name]) for name, table in updates.items()},
        {name: _carried(case, table) for name, table in updates.items()},
        names,
    )


def _factors(case: Case) -> dict[str, Tuned]:
    model = once(case, "_model", _model)
    if model is None:
        return {}
    kinds = [*model.sensors, "Q"] if model.moves else model.sensors
    B = len(kinds) * len(_GRID)
    scale = {kind: np.ones(B) for kind in kinds}
    for i, kind in enumerate(kinds):
        scale[kind][i * len(_GRID) : (i + 1) * len(_GRID)] = np.exp(_GRID)
    scores = _scores(case, model, scale, B)
    if scores is None:
        return {}
    found = {}
    for i, kind in enumerate(kinds):
        of = scores[i * len(_GRID) : (i + 1) * len(_GRID)]
        found[kind] = _best(of, _GRID, of[len(_GRID) // 2])
    if "Q" in found and not found["Q"].known:
        found["Q"] = _further(case, model, found["Q"])
    return found


def _best(scores: Array, grid: Array, own: float) -> Tuned:
    at, best = _peak(scores, grid)
    return Tuned(float(np.exp(at)), float(best - own), scores, grid)


def _further(case: Case, model: _Model, found: Tuned) -> Tuned:
    """Factors on Q beyond the grid's end, as those of a Q that lacks its dt: as many again on that side."""
    grid = _GRID + (_GRID[-1] if found.factor > 1 else _GRID[0])
    scale = {name: np.ones(len(grid)) for name in model.sensors} | {"Q": np.exp(grid)}
    scores = _scores(case, model, scale, len(grid))
    return found if scores is None else _best(scores, grid, float(found.scores[len(_GRID) // 2]))


def exchanged(case: Case, one: str, other: str) -> float:
    """The gain in log-likelihood where each of two sensors' R is the other's, component by component."""
    model = once(case, "_model", _model)
    if model is None or not model.moves:
        return -np.inf
    R = {name: _usual(model, name) for name in (one, other)}
    scale = {name: np.ones(2) for name in (*model.sensors, "Q")}
    scale[one][1], scale[other][1] = R[other] / R[one], R[one] / R[other]
    scores = _scores(case, model, scale, 2)
    return -np.inf if scores is None else float(scores[1] - scores[0])


def _usual(model: _Model, name: str) -> float:
    """The mean variance of a sensor's R, in the middle over its updates."""
    found = [
        np.median(np.diagonal(t.values["innovation.noise"], axis1=1, axis2=2)[:, axes].mean(1))
        for t in model.updates.values()
        for part, axes in _parts(t).items()
        if part.partition("/")[0] == name
    ]
    return float(np.median(found))


def _parts(table: StageTable) -> dict[str, slice]:
    space = table.spaces["innovation"]
    assert isinstance(space, Product)
    return space.axes_at


def _peak(scores: Array, grid: Array) -> tuple[float, float]:
    """Where a cubic spline through the scores of the grid has its top, and how high that is."""
    fine, values = _spline(scores, grid)
    k = int(np.argmax(values))
    return float(fine[k]), float(values[k])


def _spline(scores: Array, grid: Array) -> tuple[Array, Array]:
    """Log factors, forty to each step of the grid, and a cubic spline through the grid's scores there."""
    fine = np.linspace(grid[0], grid[-1], 40 * (len(grid) - 1) + 1)
    return fine, np.asarray(scipy.interpolate.CubicSpline(grid, np.nan_to_num(scores, nan=-1e300, neginf=-1e300))(fine))


def _scores(case: Case, model: _Model, scale: dict[str, Array], B: int) -> Array | None:
    """The log-likelihood (B,) of the innovations under each set of factors, B at once.

    An update is one number after the other, of readings turned so that their noises are independent (Bierman 1977,
    chapter II): no matrix is inverted.
    """
    space = case.space
    noises = {
        name: t.noise[:, :, None] * np.array([scale[sensor] for sensor in t.sensors])
        for name, t in model.turned.items()
    }
    first = next((k for k, s in enumerate(case.sequence.stage) if s and s[0].step[s[1]] >= case.first), 0)
    d, score = len(space.axes), np.zeros(B)
    x, P = np.zeros((d, B)), None  # P (d, d, B)
    for stage in case.sequence.stage[first : first + _PLACES]:
        if stage is None:
            continue
        table, row = stage
        name = table.name
        if name in model.moves and P is not None:
            F = model.moves[name][row]
            x, P = F @ x, _mapped(P, F) + model.noise[name][row][:, :, None] * scale["Q"]
        elif name in model.updates and P is not None:
            readings = model.turned[name]
            if on := readings.on[row]:
                v, S = np.empty((2, len(on), B))
                for k, i in enumerate(on):
                    h = readings.H[row, i]
                    C = (h @ P.reshape(d, d * B)).reshape(d, B)
                    S[k] = h @ C + noises[name][row, i]
                    v[k] = readings.residual[row, i] - h @ x
                    gain = C / S[k]
                    x += gain * v[k]
                    P -= gain[:, None] * C
                score -= 0.5 * (v * v / S + np.log(S)).sum(0)
            x -= readings.moved[row]
            if not space.flat:
                T = model.carried[name][row]
                x, P = T @ x, _mapped(P, T)
        elif np.isfinite(table.cov[row]).all():
            x, P = np.zeros((d, B)), np.repeat(table.cov[row][:, :, None], B, axis=2)
    return score if P is not None and np.isfinite(score).any() else None


def _turned(case: Case, table: StageTable, before: Array) -> _Turned:
    get = table.values
    H, residual = jacobians(case, table).copy(), get["innovation.residual"].copy()
    noise, on, sensors = np.empty_like(residual), np.zeros(residual.shape, bool), []
    steps = {name: r.step[~outlying(r.nis, r.dof, len(case.sensors)).far] for name, r in case.sensors.items()}
    for i, (part, axes) in enumerate(_parts(table).items()):
        sensor = part.partition("/")[0]
        sensors += [sensor] * (axes.stop - axes.start)
        R = get["innovation.noise"][:, axes, axes]
        noise[:, axes], axis = np.linalg.eigh(np.nan_to_num(R))
        noise[~np.isfinite(R).all((1, 2)), axes] = np.nan
        H[:, axes] = np.swapaxes(axis, 1, 2) @ H[:, axes]
        residual[:, axes] = (np.swapaxes(axis, 1, 2) @ residual[:, axes, None])[..., 0]
        # As with a gate: an outlier that moved the estimate would make what comes after it a matter of Q.
        known = np.isin(table.step, steps.get(sensor, ()))
        on[:, axes] = (get["innovation.offered"][:, i] * get["innovation.used"][:, i] * known > 0)[:, None]
    nu = get["innovation.residual"]
    on &= np.asarray(np.isfinite(H).all((1, 2)) & np.isfinite(nu).all(1))[:, None]
    moved = np.nan_to_num(get["gain"]) @ np.nan_to_num(nu)[..., None]
    return _Turned(H, residual, noise, [np.flatnonzero(row).tolist() for row in on], moved, sensors)


def _mapped(P: Array, A: Array) -> Array:
    """A·P·Aᵀ of symmetric P (d, d, B), by two products of all at once."""
    half = (A @ P.reshape(len(A), -1)).reshape(P.shape)
    return (A @ np.swapaxes(half, 0, 1).reshape(len(A), -1)).reshape(P.shape)


def _carried(case: Case, table: StageTable) -> Array:
    """The matrices (M, d, d) that carry changes before an update to those at the mean after it."""
    mean, _ = case.sequence.before(table)
    return case.space.transport(mean, case.space.minus(table.mean, mean))


def _noise(table: StageTable, F: Array, before: Array) -> Array:
    """Q (M, d, d) as the filter had it: recorded, or P' − F·P·Fᵀ without what rounding makes negative."""
    if "noise" in table.values and table.values["noise"].shape == table.cov.shape:
        return table.values["noise"]
    Q = table.cov - F @ before @ np.swapaxes(F, 1, 2)
    Q = np.nan_to_num(0.5 * (Q + np.swapaxes(Q, 1, 2)))
    values, vectors = np.linalg.eigh(Q)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(vectors, 1, 2))
