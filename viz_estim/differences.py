"""Where two runs of the same data part for the first time: the step, the stage and the quantity to look at."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from viz_estim.core.alignment import paired
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product, Space
from viz_estim.recording.compared import shared_parts
from viz_estim.recording.layout import as_product
from viz_estim.recording.reader import Run
from viz_estim.recording.tables import StageTable


class Difference(NamedTuple):
    """A quantity (`mean`, `cov`, `residual`, `probabilities`), or a `stage` that one run alone has, and the ratio `by`
    which the two differ; None where there is none: of a stage, or where a number stands against none (NaN)."""

    step: int
    stage: str
    quantity: str
    by: float | None


def other_data(a: Run, b: Run) -> str | None:
    """Why the two cannot be held against each other, number by number, or None: another system, or other data.

    Recordings of a person's own code don't say what it ran on: they are taken to be of the same data.
    """
    if not all("recorded_by" in run.properties for run in (a, b)) and (why := _other_source(a, b)):
        return why
    if not len(paired(a.time, b.time)[0]):
        return (
            f"no step of it has a stamp of the first run's: it goes from {b.span}, the first from {a.span}; "
            "tell both runs the same stamps"
        )
    if a.labels != b.labels or not (a.labels or shared_parts(as_product(a.space), as_product(b.space))):
        return "its state has no part in common with the first run's"
    return None


def _other_source(a: Run, b: Run) -> str | None:
    if _system(a) != _system(b):
        return f"it ran another system ({_system(b)}, not {_system(a)})"
    if (mine := _files(a)) != (theirs := _files(b)):
        return "it ran on other data (by SHA-256)" if mine and theirs else "one ran on a simulation, one on files"
    if mine:
        return None
    if a.properties.get("seed") != b.properties.get("seed"):
        return f"its data were simulated with seed {b.properties.get('seed')}, not {a.properties.get('seed')}"
    made, other = (
        {k: v for k, v in run.properties.get("params", {}).items() if k.startswith("data.")} for run in (a, b)
    )
    changed = [k for k in made.keys() | other.keys() if made.get(k) != other.get(k)]
    return f"its data were simulated with another {', '.join(sorted(changed))}" if changed else None


def _system(run: Run) -> str:
    """The system, or of a person's own scenario the file that it is in."""
    facts = run.properties
    return str(facts.get("system") or str(facts.get("scenario")).rpartition(":")[0] or facts.get("scenario"))


def _files(run: Run) -> list[str]:
    """The SHA-256 of the data files; a calibration is no data but a parameter."""
    calibration = run.properties.get("calibration")
    return sorted(one["sha256"] for one in run.properties.get("data", []) if one["path"] != calibration)


def first_difference(a: Run, b: Run, tol: float = 1e-9) -> Difference | None:
    """The first step, and in it the first stage and quantity, in which b parts from a by more than tol.

    Steps pair by stamp, stages by name. In order: the belief's mean, as the largest |minus(b, a)| in σ of a (where σ is
    0: in units); its covariance, by the relative Frobenius norm; the residual, in σ of its S in a; of labels, the
    largest difference of a probability. tol 0: any bit.
    """
    rows = paired(a.time[: sound_steps(a)], b.time[: sound_steps(b)])
    pair_of = [_pairs(run, rows[i]) for i, run in enumerate((a, b))]
    found: dict[str, tuple[int, Difference]] = {}  # by stage: the first pair of steps that differs in it
    for name in dict.fromkeys([*a.stages, *b.stages]):
        tables = [run.stages.get(name) for run in (a, b)]
        keys = [
            np.empty(0, np.int64) if table is None else _keys(table, run, pairs)
            for table, run, pairs in zip(tables, (a, b), pair_of, strict=True)
        ]
        known, mine, theirs = np.intersect1d(keys[0], keys[1], assume_unique=True, return_indices=True)
        candidates: list[tuple[int, str, float | None]] = []
        alone = np.setxor1d(keys[0], keys[1], assume_unique=True)
        if len(alone := alone[alone >= 0]):
            candidates.append((int(alone.min()) // _MOST, "stage", None))
        mine, theirs, known = mine[known >= 0], theirs[known >= 0], known[known >= 0]
        for start in range(0, len(known), _BLOCK):  # most runs part early, if at all
            block = slice(start, start + _BLOCK)
            assert tables[0]
            assert tables[1]
            parted = [
                (int(known[start + np.argmax(differs)]) // _MOST, quantity, _finite(ratio[np.argmax(differs)]))
                for quantity, differs, ratio in _quantities(a, b, tables[0], tables[1], mine[block], theirs[block], tol)
                if differs.any()
            ]
            if parted:
                candidates += parted
                break
        if candidates:
            pair, quantity, by = min(candidates, key=lambda one: one[0])  # of equal ones the first in order
            found[name] = pair, Difference(int(a.step[rows[0][pair]]), name, quantity, by)
    if not found:
        return None
    pair = min(pair for pair, _ in found.values())
    orders = [[table.name for table, _ in run.at(int(run.step[rows[i][pair]]))] for i, run in enumerate((a, b))]
    return min((one for p, one in found.values() if p == pair), key=lambda one: _place(one.stage, *orders))


def sound_steps(run: Run) -> int:
    """How many steps have all their stages: all, unless the run was killed and the file ends between them."""
    if run.complete or not run.stages:
        return len(run.step)
    places = np.sort(np.concatenate([table.place for table in run.stages.values()]))
    gaps = np.flatnonzero(np.diff(places) > 1)
    last = places[gaps[0]] if len(gaps) else places[-1]
    ended = max(int(table.step[table.place <= last].max(initial=-1)) for table in run.stages.values())
    return int(np.searchsorted(run.step, ended))


def _finite(ratio: float) -> float | None:
    return float(ratio) if np.isfinite(ratio) else None


_BLOCK = 4096  # rows looked at in one go
_MOST = 1024  # times that one stage may come in one step


def _pairs(run: Run, rows: np.ndarray) -> np.ndarray:
    """By row of a run's steps the number of its pair, −1 where it has none."""
    found = np.full(len(run.step), -1)
    found[rows] = np.arange(len(rows))
    return found


def _keys(table: StageTable, run: Run, pair_of: np.ndarray) -> np.ndarray:
    """For each row of a stage one number for its pair of steps and which time it is in it; negative without a pair."""
    at = np.searchsorted(run.step, table.step)
    pair = np.where(at < len(run.step), pair_of[np.minimum(at, len(run.step) - 1)], -1)
    row = np.arange(len(table.step))
    starts = np.maximum.accumulate(np.where(np.diff(table.step, prepend=-1) != 0, row, 0))
    return np.where(pair >= 0, pair * _MOST + row - starts, -1 - row)


def _place(stage: str, mine: list[str], theirs: list[str]) -> tuple[int, int]:
    """Where a stage stands in a step: by the first run's order; one of the other's alone, after what came before it."""
    if stage in mine:
        return mine.index(stage), 0
    before = [mine.index(name) for name in theirs[: theirs.index(stage)] if name in mine]
    return max(before, default=-1), 1


def _quantities(
    a: Run, b: Run, one: StageTable, other: StageTable, mine: np.ndarray, theirs: np.ndarray, tol: float
) -> Iterator[tuple[str, np.ndarray, Array]]:
    """Each quantity's name, in which of the paired rows it differs (M,), and by which ratio (M,)."""
    if a.labels:
        p, q = one.values["log_probabilities"][mine], other.values["log_probabilities"][theirs]
        yield "probabilities", *_judged(p, q, np.abs(np.exp(q) - np.exp(p)).max(1), tol)
        return
    at, axes = _where(as_product(a.space), as_product(b.space))
    if {"mean", "cov"} <= one.values.keys() & other.values.keys():
        parts = Product(**{name: as_product(a.space).parts[name] for name in at})
        x, y = one.mean[mine][:, _flat(at, 0)], other.mean[theirs][:, _flat(at, 1)]
        mine_axes, their_axes = _flat(axes, 0), _flat(axes, 1)
        P = one.cov[mine][:, mine_axes][:, :, mine_axes]
        Q = other.cov[theirs][:, their_axes][:, :, their_axes]
        yield "mean", *_judged(x, y, _in_sigma(parts, x, y, P), tol)
        size = np.linalg.norm(P, axis=(1, 2))
        yield "cov", *_judged(P, Q, np.linalg.norm(Q - P, axis=(1, 2)) / np.where(size > 0, size, 1.0), tol)
    for name in one.values.keys() & other.values.keys():
        if name.endswith(".residual"):
            field = name.partition(".")[0]
            _, read = _where(*(as_product(table.spaces[field]) for table in (one, other)))
            here, there = _flat(read, 0), _flat(read, 1)
            S = np.diagonal(one.values[f"{field}.cov"][mine], axis1=1, axis2=2)[:, here]
            r, s = one.values[name][mine][:, here], other.values[name][theirs][:, there]
            yield "residual", *_judged(r, s, _largest(s - r, S), tol)


def _where(first: Product, other: Product) -> tuple[Any, Any]:
    """Of each shared part, where it stands in both spaces' numbers, and in their directions."""
    shared = shared_parts(first, other)
    at = {name: (first.at[name], other.at[name]) for name in shared}
    return at, {name: (first.axes_at[name], other.axes_at[name]) for name in shared}


def _flat(where: dict[str, tuple[slice, slice]], side: int) -> np.ndarray:
    return np.concatenate([np.arange(w[side].start, w[side].stop) for w in where.values()] or [np.empty(0, int)])


def _judged(x: Array, y: Array, ratio: Array, tol: float) -> tuple[np.ndarray, Array]:
    """Where two arrays (M, …) differ in any bit and by a ratio (M,) beyond tol, or one that is no number."""
    count = len(x)
    bits = [np.ascontiguousarray(v).view(np.int64).reshape(count, -1) for v in (x, y)]
    differs = np.asarray((bits[0] != bits[1]).any(1))
    return differs & (~(ratio <= tol) | (tol == 0)), ratio


def _in_sigma(space: Space, x: Array, y: Array, P: Array) -> Array:
    with np.errstate(invalid="ignore"):
        return _largest(space.minus(y, x), np.diagonal(P, axis1=1, axis2=2))


def _largest(delta: Array, variance: Array) -> Array:
    """The largest component of differences (M, d) in σ, in units where σ is 0."""
    if not delta.shape[1]:
        return np.zeros(len(delta))
    sigma = np.sqrt(np.maximum(variance, 0))
    found: Array = np.abs(delta / np.where(sigma > 0, sigma, 1.0)).max(1)
    return found
