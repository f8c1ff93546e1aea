"""Particles' readings against the truth: what they were expected to be is recovered from the likelihoods.

A particle filter records no prediction of a reading, but it has asked its model at every particle: with normal noise a
log-likelihood is c − Σ|z − h(x)|²/2σ² over the sensors, with one c a step. Of positions h is the particle's own; of
distances the places from which they are measured, and each σ, are found by least squares (Levenberg 1944, Marquardt
1963) from many starts. Taken for the model only where it gives the likelihoods to rounding.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice, permutations

import numpy as np
import scipy

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Euclidean, Space
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import FEWEST, TINY
from viz_estim.diagnosis.fits import Against
from viz_estim.diagnosis.frames import place_of
from viz_estim.diagnosis.rounding import epsilon
from viz_estim.recording.layout import leaves
from viz_estim.recording.tables import StageTable

# How far is searched: what is found must give all likelihoods to rounding, which no other model does by chance.
_STEPS, _PARTICLES = 12, 80  # that the model is fitted to
_STARTS, _ROUNDS = 24, 60


def by_particles(case: Case, attitude: Array | None) -> Iterator[Against]:
    """Each sensor's readings against what the truth would give; none where the likelihoods are of another kind."""
    run = case.run
    tables = [t for t in run.stages.values() if {"log_likelihoods", "states"} <= t.values.keys()]
    at = next((at for _, part, at in leaves(case.space) if _is_place(part)), None)
    readings = {name[2:]: z for name, z in run.inputs.items() if name.startswith("z.")}
    if len(tables) != 1 or at is None or not readings:
        return
    table, at = tables[0], slice(at.start, at.start + 2 + (at.stop - at.start == 3 and _solid(case)))
    rows = np.searchsorted(run.step, table.step)
    truth = run.truth[rows][:, at]
    fine = (table.step >= case.first) & np.isfinite(truth).all(1)
    fine &= np.all([np.isfinite(z[rows]).all(1) for z in readings.values()], axis=0)
    if fine.sum() < FEWEST:
        return
    z = {name: values[rows][fine] for name, values in readings.items()}
    p, logs, weights = _clouds(case, table, fine, at)
    if all(values.shape[1] == truth.shape[1] for values in z.values()) and len(z) == 1:
        (name, values), places = next(iter(z.items())), None
        variance = _of_positions(p, logs, values)
        found = [] if variance is None else [(name, values, truth[fine], p, variance, None)]
    elif all(values.shape[1] == 1 for values in z.values()):
        places = _of_distances(p, logs, np.concatenate(list(z.values()), axis=1), truth[fine])
        found = [] if places is None else [
            (name, values, np.linalg.norm(truth[fine] - L, axis=1)[:, None],
             np.linalg.norm(p - L, axis=-1)[..., None], variance, L)
            for (name, values), L, variance in zip(z.items(), *places, strict=True)
        ]  # fmt: skip
    else:
        return
    for name, values, true, expected, variance, L in found:
        m = values.shape[1]
        sensor = name.partition("/")[0]
        space = Euclidean(("x", "y", "z")[:m] if m > 1 else (sensor,), "m")
        mean = (weights[..., None] * expected).sum(1, keepdims=True)
        spread = (weights[..., None] * (expected - mean) ** 2).sum(1)
        noise = np.broadcast_to(variance * np.eye(m), (len(values), m, m))
        yield Against(
            name, space, table.step[fine], run.time[rows][fine], values, true, values - true, noise, spread,
            np.zeros(len(values)), "", True, None if attitude is None else attitude[rows][fine],
            None if L is None else L[None], truth[fine],
        )  # fmt: skip


def _is_place(part: Space) -> bool:
    return list(part.axis_units[:2]) == ["m", "m"]


def _solid(case: Case) -> bool:
    return any(list(part.axis_units) == ["m"] * 3 for _, part, _ in leaves(case.space))


def _clouds(case: Case, table: StageTable, fine: np.ndarray, at: slice) -> tuple[Array, Array, Array]:
    """Positions (M, N, d), log-likelihoods and weights (M, N) of the clouds that were weighed."""
    logs = table.values["log_likelihoods"][fine]
    before = table.values["log_weights"][fine] - logs
    weights = np.exp(before - before.max(1, keepdims=True))
    return table.values["states"][fine][..., at], logs, weights / weights.sum(1, keepdims=True)


def _of_positions(p: Array, logs: Array, z: Array) -> float | None:
    """σ² of log-likelihoods c − |z − p|²/2σ²."""
    x = -0.5 * ((p - z[:, None, :]) ** 2).sum(-1)
    x, y = x - x.mean(1, keepdims=True), logs - logs.mean(1, keepdims=True)
    slope = float((x * y).sum() / max(float((x * x).sum()), TINY))
    exact = np.sqrt(np.mean((y - slope * x) ** 2)) < _rounding(logs) * y.std()
    return 1 / slope if exact and slope > 0 else None


def _rounding(logs: Array) -> float:
    """Half of the digits: by how much of their own standard deviation log-likelihoods of the model may be off."""
    return float(np.sqrt(epsilon(logs.reshape(-1, 1))))


def _of_distances(p: Array, logs: Array, z: Array, truth: Array) -> tuple[Array, Array] | None:
    """Places (s, d) and σ² (s,) of s distances."""

    steps = np.linspace(0, len(p) - 1, _STEPS).astype(int)
    some = np.linspace(0, p.shape[1] - 1, min(_PARTICLES, p.shape[1])).astype(int)
    p, logs, z = p[steps][:, some], logs[steps][:, some], z[steps]
    s, d = z.shape[1], p.shape[-1]
    y = logs - logs.mean(1, keepdims=True)
    if not y.std() > 0:
        return None

    def taken(numbers: Array) -> tuple[Array, Array, Array]:
        """Precisions (s,), and of each distance what is read beyond it (M, N, s) and where from (M, N, s, d)."""
        away = p[..., None, :] - numbers[: s * d].reshape(s, d)
        distance = np.linalg.norm(away, axis=-1)
        off = z[:, None, :] - distance
        return np.exp(numbers[s * d :]), off, away / np.maximum(distance, TINY)[..., None]

    def missed(numbers: Array) -> Array:
        precision, off, _ = taken(numbers)
        made = -0.5 * (off**2 @ precision)
        return np.asarray(((made - made.mean(1, keepdims=True) - y) / y.std()).ravel())

    def slopes(numbers: Array) -> Array:
        """The derivatives of what is missed."""
        precision, off, direction = taken(numbers)
        by_place = -(precision * off)[..., None] * direction
        made = np.concatenate([by_place.reshape(*off.shape[:2], s * d), -0.5 * precision * off**2], axis=-1)
        return np.asarray(((made - made.mean(1, keepdims=True)) / y.std()).reshape(-1, s * (d + 1)))

    for places in islice(_starts(truth, z, steps), _STARTS):
        start = np.concatenate([places.ravel(), np.zeros(s)])
        fit = scipy.optimize.least_squares(missed, start, slopes, method="lm", max_nfev=_ROUNDS)
        if np.sqrt(np.mean(fit.fun**2)) < _rounding(logs):
            return fit.x[: s * d].reshape(s, d), np.exp(-fit.x[s * d :])
    return None


def _starts(truth: Array, z: Array, steps: np.ndarray) -> Iterator[Array]:
    """Where the readings come from by the truth, in each order; and places all around the way."""
    s, d = z.shape[1], truth.shape[1]
    middle, away = truth.mean(0), max(float(z.mean()), 1e-3)
    around = [middle + away * np.array([np.cos(a), np.sin(a), 0.0][:d]) for a in np.arange(8) * np.pi / 4]
    own = []
    for i in range(s):
        tried = [_place(truth[steps], z[:, i], start) for start in around]
        own.append(min(tried, key=lambda one: one[1])[0])
    yield from (np.array(order) for order in islice(permutations(own), 12))
    yield from (np.array([around[(k + 3 * i) % 8] for i in range(s)]) for k in range(8))


def _place(p: Array, distance: Array, place: Array) -> tuple[Array, float]:
    found = place_of(p, distance, place)
    return found, float(np.square(np.linalg.norm(p - found, axis=1) - distance).sum())
