"""What a person's own code tells of a stage, checked and copied into the records that every filter here makes."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from viz_estim.core.beliefs import Belief, Categorical, Gaussian, Particles
from viz_estim.core.discrete import LOG_ZERO
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO2, Euclidean, Product, Space
from viz_estim.core.stages import Innovation, Resample, SigmaPoints, Stage

Names = Space | Mapping[str, str] | Sequence[str]
_HEADINGS = ("heading", "theta", "yaw", "psi", "θ", "ψ")
_NUMBERS = (
    "mean", "states", "weights", "log_weights", "probabilities", "residual", "residual_cov", "gain", "sensor",
    "predicted", "noise", "transition", "log_likelihoods", "ancestors",
)  # fmt: skip
_LONGEST = 2.0**63 / 1e9  # s: 292 years, as much as a recording's nanoseconds hold
POINTS = ("sigma", "drawn", "propagated", "mapped")  # numbers of a stage that are points; the last in the reading


def space_of(names: Names) -> Space:
    """The geometry itself, or of plain names, with their units where they are a dict."""
    if hasattr(names, "plus"):
        return names  # type: ignore[return-value]
    if not isinstance(names, (Mapping, Sequence, np.ndarray)) or (
        not isinstance(names, str) and not all(isinstance(name, str) for name in names)
    ):
        raise ValueError(
            f"{names!r:.60}: expected names such as ('x', 'y'), with units {{'x': 'm', 'y': 'm'}}, or a space"
        )
    twice = [name for name, count in Counter(list(names)).items() if count > 1 and not isinstance(names, str)]
    if twice:
        raise ValueError(f"{twice[0]} is there twice: give each component a name of its own")
    if isinstance(names, Mapping):
        return Euclidean(list(names), list(names.values()))
    return Euclidean(names if isinstance(names, str) else list(names))


def state_of(names: Names) -> Space:
    """The same of a state. A place that comes first, x and y (and z) in m, is a part of its own, as is a heading in rad
    right after it, so that both are drawn in a plan and the heading is compared as an angle."""
    space = space_of(names)
    if not isinstance(space, Euclidean):
        return space
    size = next((n for n in (3, 2) if space.names[:n] == ("x", "y", "z")[:n] and set(space.units[:n]) == {"m"}), 0)
    if not size:
        return space
    parts: dict[str, Space] = {"position": Euclidean(space.names[:size], "m")}
    if size == 2 and space.names[2:3] and space.names[2] in _HEADINGS and space.units[2] == "rad":
        parts["heading"] = SO2()
        size = 3
    if space.names[size:]:
        parts["state"] = Euclidean(space.names[size:], space.units[size:])
    return Product(**parts)


def gaussian(where: str, space: Space | None, mean: ArrayLike, cov: ArrayLike | None) -> Gaussian:
    """N(mean (n,), cov (d, d)), of NaN where there is none; without a space its components are x0, x1, …."""
    x = _number(f"{where}: mean", mean).reshape(-1)
    space = space or Euclidean([f"x{i}" for i in range(len(x))])
    n, d = len(space.names), len(space.axes)
    P = np.full((d, d), np.nan) if cov is None else np.atleast_2d(_number(f"{where}: cov", cov))
    if len(x) != n:
        raise ValueError(
            f"{where}: mean: expected the shape ({n},), got ({len(x)},); a state keeps its size: give what is not "
            "there yet, such as a landmark, a variance that is very large"
        )
    fits(f"{where}: cov", P, (d, d))
    return Gaussian(space, x, P)


def particles(
    where: str, space: Space | None, states: ArrayLike, weights: ArrayLike | None, log_weights: ArrayLike | None
) -> Particles:
    """A cloud: states (N, n) with weights (N,), in proportion, or their logarithms; equal ones without.

    Where no weight is above 0 all are NaN: that is what a filter that lost its target holds.
    """
    x = np.array(states, float)
    x = x[:, None] if x.ndim == 1 else x
    space = space or Euclidean([f"x{i}" for i in range(x.shape[-1])])
    fits(f"{where}: states", x, (len(x), len(space.names)))
    if weights is not None and log_weights is not None:
        raise ValueError(f"{where}: give weights or log_weights, not both")
    if weights is not None:
        w = vector(weights)
        if (w < 0).any():
            raise ValueError(f"{where}: weights below 0 (are they logarithms? Give them as log_weights)")
        with np.errstate(divide="ignore"):
            logs = np.log(w)
    else:
        logs = np.zeros(len(x)) if log_weights is None else vector(log_weights)
    fits(f"{where}: weights", logs, (len(x),))
    return Particles(space, x, _normalised(logs))


def categorical(where: str, labels: tuple[str, ...], probabilities: ArrayLike | Mapping[str, float]) -> Categorical:
    """Probabilities (K,) of labels, or by label, in proportion; without names they are 0, 1, …."""
    if isinstance(probabilities, Mapping):
        labels = labels or tuple(map(str, probabilities))
        if set(labels) != set(map(str, probabilities)):
            raise ValueError(f"{where}: probabilities of {', '.join(map(str, probabilities))}, not of the labels")
        named = {str(label): p for label, p in probabilities.items()}
        probabilities = [named[label] for label in labels]
    p = vector(probabilities)
    labels = labels or tuple(map(str, range(len(p))))
    fits(f"{where}: probabilities", p, (len(labels),))
    if (p < 0).any():
        raise ValueError(f"{where}: probabilities below 0")
    with np.errstate(divide="ignore"):
        return Categorical(labels, np.maximum(_normalised(np.log(p)), LOG_ZERO))


def innovation(
    where: str, space: Product, directions: int, residual: ArrayLike, residual_cov: ArrayLike, *,
    gain: ArrayLike | None, z: ArrayLike | None, predicted: ArrayLike | None, noise: ArrayLike | None,
    used: ArrayLike, blind: ArrayLike | None,
) -> tuple[Innovation, Array | None]:  # fmt: skip
    """What a reading said against what was expected, and the gain (d, m) if it is known."""
    n, m, s, d = len(space.names), len(space.axes), len(space.parts), directions
    ν, S = vector(residual), matrix(residual_cov)
    fits(f"{where}: residual", ν, (m,))
    fits(f"{where}: residual_cov", S, (m, m))
    K = None if gain is None else matrix(gain, (d, m))
    if K is not None:
        fits(f"{where}: gain", K, (d, m))
    R = np.zeros((m, m)) if noise is None else _noise(noise, m)
    fits(f"{where}: noise", R, (m, m))
    expected = None if predicted is None else vector(predicted)
    flat = n == m
    guess = ν if expected is None else space.plus(expected, ν)
    reading = guess if z is None else vector(z)
    if z is not None:
        fits(f"{where}: z", reading, (n,))
    elif len(reading) != n:
        reading = np.full(n, np.nan)
    if expected is None:
        expected = reading - ν if flat else reading
    fits(f"{where}: predicted", expected, (n,))
    taken = np.broadcast_to(np.array(used, bool), (s,)).copy()
    unseen = np.zeros((d, s)) if blind is None else matrix(blind, (d, s))
    fits(f"{where}: blind", unseen, (d, s))
    C = np.zeros((d, m)) if K is None else K @ S
    return Innovation(space, reading, expected, ν, S, R, C, taken, np.ones(s, bool), unseen), K


def stage_of(name: str, belief: Belief, numbers: dict[str, Any]) -> Stage:
    """A stage's record with these numbers as its fields."""
    kind = _kind(tuple(numbers), Resample if {"ancestors", "distinct", "ess"} <= numbers.keys() else Stage)
    found: Stage = kind(name=name, belief=belief, **numbers)
    return found


@cache
def _kind(names: tuple[str, ...], base: type[Stage]) -> Any:
    known = {one.name for one in dataclasses.fields(base)}
    return dataclasses.make_dataclass(
        "Told", [(name, Any) for name in names if name not in known], bases=(base,), frozen=True
    )


def others(
    where: str, belief: Belief, before: Belief | None, reading: Space | None, sensor: str, z: ArrayLike | None,
    numbers: Mapping[str, ArrayLike],
) -> dict[str, Any]:  # fmt: skip
    """What else a stage has by name, as the records' fields, with what follows from it."""
    found: dict[str, Any] = {}
    for name, values in numbers.items():
        if not re.fullmatch(r"[a-z]\w*", name) or name in ("belief", "innovation"):
            raise ValueError(f"{where}: {name} cannot be a number's name")
        if name not in POINTS and (meant := get_close_matches(name, _NUMBERS, 1, 0.85)) and name != meant[0]:
            raise ValueError(f"{where}: {name}: did you mean {meant[0]}? A figure of your own needs another name")
        if name in POINTS:
            space = reading if name == "mapped" and reading else getattr(belief, "space", None)
            found[name] = _points(f"{where}: {name}", space, values)
        else:
            found[name] = _number(f"{where}: {name}", values)
    if isinstance(belief, Particles):
        for name in found.keys() & {"log_likelihoods", "ancestors"}:
            fits(f"{where}: {name}", found[name], belief.log_weights.shape)
        earlier = before if isinstance(before, Particles) else belief
        if "log_likelihoods" in found:
            found |= {"evidence": _evidence(earlier.log_weights + found["log_likelihoods"]), "ess": belief.ess}
        if "ancestors" in found:
            found["ancestors"] = found["ancestors"].astype(int)
            found |= {"distinct": np.asarray(float(len(np.unique(found["ancestors"])))), "ess": earlier.ess}
    elif isinstance(belief, Categorical) and "log_likelihoods" in found:
        fits(f"{where}: log_likelihoods", found["log_likelihoods"], (len(belief.labels),))
        read = np.full(1, np.nan) if z is None else vector(z)
        found |= {"sensors": (sensor,), "reading": read, "log_likelihoods": found["log_likelihoods"][None]}
    return found


def _points(where: str, space: Space | None, values: ArrayLike) -> SigmaPoints:
    """Points (N, n) of a space, of unknown weights."""
    found = np.array(values, float)
    found = found[:, None] if found.ndim == 1 else found
    fits(where, found, (len(found), len(space.names) if space else 0))
    assert space
    unknown = np.full(len(found), np.nan)
    return SigmaPoints(space, found, unknown, unknown)


def _evidence(logs: Array) -> Array:
    """log Σ w·p(z | x), of log w + log p(z | x) (N,)."""
    best = logs.max()
    return np.asarray(best + np.log(np.exp(logs - best).sum()) if np.isfinite(best) else np.nan)


def _number(what: str, values: Any) -> Array:
    if hasattr(values, "toarray"):  # of scipy.sparse
        values = values.toarray()
    if np.iscomplexobj(values) and np.imag(values).any():
        raise ValueError(f"{what}: expected real numbers, got complex ones")
    try:
        return np.array(np.real(values) if np.iscomplexobj(values) else values, float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: expected numbers, got {values!r:.60}") from error


def seconds(where: str, time: Any, last: float) -> float:
    """A step's time, not before the last one's."""
    if isinstance(time, np.ndarray) and time.size == 1:
        time = time.item()
    if not isinstance(time, (int, float, np.number)) or isinstance(time, np.timedelta64):
        stamp = "" if isinstance(time, (np.ndarray, str)) else "; of stamps it is (t − t0).total_seconds()"
        raise ValueError(f"{where}: expected a time in seconds, got {type(time).__name__}{stamp}")
    if not abs(time) < _LONGEST:
        raise ValueError(f"{where}: its time {time} is none in seconds; divide ns by 1e9, and ms by 1000")
    if time < last:
        raise ValueError(f"{where}: its time {time} is not after the last one's, {last}")
    return float(time)


def truth(where: str, labels: tuple[str, ...], space: Space | None, values: ArrayLike | str | None) -> Array | None:
    """The true state (n,), or the index (1,) of the true label; None where it is not told."""
    if isinstance(values, str):
        if values not in labels:
            raise ValueError(f"{where}: {values}: expected one of {', '.join(labels)}")
        values = labels.index(values)
    if values is None:
        return None
    true = vector(values)
    fits(where, true, (1 if space is None else len(space.names),))
    parts = space.at.values() if isinstance(space, Product) else [slice(None)]
    for at in parts:
        known = np.isfinite(true[at])
        if space is not None and known.any() and not known.all():
            names = np.array(space.names)[at]
            raise ValueError(
                f"{where}: {names[known][0]} is known and {names[~known][0]} is not, but a part's truth is kept whole; "
                "make parts of them, space=Product(a=Euclidean([…]), b=Euclidean([…]))"
            )
    return true


def vector(values: ArrayLike) -> Array:
    """A copy (n,) of a vector, a column, or one number."""
    return np.array(values, float).reshape(-1)


def matrix(values: ArrayLike, shape: tuple[int, int] | None = None) -> Array:
    """A copy as a matrix; one number is 1 × 1, and a vector a row or column where the shape asks for it."""
    found = np.array(values, float)
    if shape and found.size == shape[0] * shape[1] and found.ndim < 2:
        return found.reshape(shape)
    return np.atleast_2d(found)


def fits(what: str, values: Array, shape: tuple[int, ...]) -> None:
    """ValueError unless it has the shape."""
    if values.shape != shape:
        raise ValueError(f"{what}: expected the shape {shape}, got {values.shape}")


def _noise(noise: ArrayLike, size: int) -> Array:
    """A covariance (m, m), or one variance for all components."""
    found = np.array(noise, float)
    return np.eye(size) * found if found.size == 1 else matrix(found)


def _normalised(logs: Array) -> Array:
    """Log weights whose exponentials sum to one; NaN where none is above 0."""
    best = logs.max(initial=-np.inf)
    if not np.isfinite(best):
        return np.full(logs.shape, np.nan)
    shifted = np.maximum(logs - best, LOG_ZERO)
    normal: Array = shifted - np.log(np.exp(shifted).sum())
    return normal
