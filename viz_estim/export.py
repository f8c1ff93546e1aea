"""A recorded run for other tools: TUM trajectories, a CSV of series, an NPZ of everything."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np

from viz_estim.core.consistency import nees, nis
from viz_estim.core.euler import EulerAngles
from viz_estim.core.quaternions import Array, exp
from viz_estim.core.spaces import SE2, SO2, SO3, Euclidean, Product
from viz_estim.errors import BadInput
from viz_estim.files import whole
from viz_estim.recording.layout import as_product
from viz_estim.recording.reader import Run


def export(run: Run, kind: str, out: Path) -> list[Path]:
    """Writes the run as `kind` and returns the files written; each appears whole or not at all."""
    if kind == "tum":
        if run.labels:
            raise BadInput(f"{run.path}: a belief over labels has no trajectory; use --to csv")
        files = {out: run.mean, out.with_name(f"{out.stem}.truth{out.suffix}"): run.truth}
        known = {path: states for path, states in files.items() if np.isfinite(states).any()}
        if not known:
            raise BadInput(f"{run.path}: its states are no numbers (NaN); there is no trajectory to write")
        return [_write_tum(path, run, states) for path, states in known.items()]
    if kind == "csv":
        names, columns = zip(*_series(run).items(), strict=True)
        return [_whole(out, lambda file: _write_csv(file, names, np.stack(columns, axis=1)), text=True)]
    return [_whole(out, lambda file: np.savez_compressed(file, **_everything(run)))]


def _write_tum(path: Path, run: Run, states: Array) -> Path:
    """`time tx ty tz qx qy qz qw` a line, as evo reads it; what the state lacks is 0 or no turn."""
    space = as_product(run.space)
    position, attitude = np.zeros((len(states), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(states), 1))
    posed = False
    for name, part in space.parts.items():
        x = states[:, space.at[name]]
        if isinstance(part, SO3):
            attitude, posed = x, True
        elif isinstance(part, EulerAngles):
            attitude, posed = part.to_quaternion(x), True
        elif isinstance(part, SE2):
            position[:, :2], posed = x[:, :2], True
            attitude = exp(x[:, 2:] * [0.0, 0.0, 1.0])
        elif isinstance(part, SO2) and name == "heading":
            attitude = exp(x * [0.0, 0.0, 1.0])
        elif isinstance(part, Euclidean) and name == "position":
            position[:, : x.shape[1]], posed = x[:, :3], True
    if not posed:
        parts = ", ".join(space.parts)
        raise BadInput(f"{run.path}: no attitude, pose or position in its state ({parts}); use --to csv")
    known = np.isfinite(position).all(1) & np.isfinite(attitude).all(1)
    rows = np.concatenate([run.time[:, None], position, attitude[:, [1, 2, 3, 0]]], axis=1)[known]
    return _whole(path, lambda file: np.savetxt(file, rows, fmt="%.9f"))


def _series(run: Run) -> dict[str, Array]:
    """One row a step: the estimate, its σ, the truth, the error, NEES, and each sensor's residual and NIS."""
    columns: dict[str, Array] = {"step": run.step.astype(float), "time_s": run.time, "dt_s": run.dt}
    if run.labels:
        columns |= {f"p.{name}": np.exp(run.ends["log_probabilities"][:, i]) for i, name in enumerate(run.labels)}
        return columns | {"truth": run.truth[:, 0]} | _inputs(run)
    columns |= {name: run.mean[:, i] for i, name in enumerate(run.space.names)}
    sigma = np.sqrt(np.maximum(np.diagonal(run.cov, axis1=1, axis2=2), 0))
    columns |= {f"sigma.{name}": sigma[:, i] for i, name in enumerate(run.space.axes)}
    if np.isfinite(run.truth).any():
        columns |= {f"truth.{name}": run.truth[:, i] for i, name in enumerate(run.space.names)}
        error = run.space.minus(run.mean, run.truth)
        columns |= {f"error.{name}": error[:, i] for i, name in enumerate(run.space.axes)}
        columns["nees"] = nees(run.space, run.mean, run.cov, run.truth)[0]
    columns |= _inputs(run)
    for table in run.stages.values():
        if "innovation.residual" in table.values:
            space = table.spaces["innovation"]
            assert isinstance(space, Product)
            at = np.searchsorted(run.step, table.step)
            residual, S = table.values["innovation.residual"], table.values["innovation.cov"]
            for i, axis in enumerate(space.axes):
                columns[f"residual.{axis}"] = _spread(at, residual[:, i], len(run.step))
            for name, found in nis(space, residual, S, table.values["innovation.offered"].astype(bool)).items():
                columns[f"nis.{name}"] = _spread(at, found.values, len(run.step))
    return columns


def _inputs(run: Run) -> dict[str, Array]:
    return {f"{name}.{i}": values[:, i] for name, values in run.inputs.items() for i in range(values.shape[1])}


def _spread(at: np.ndarray, values: Array, count: int) -> Array:
    out = np.full(count, np.nan)
    inside = at < count
    out[at[inside]] = values[inside]
    return out


def _everything(run: Run) -> dict[str, Any]:
    arrays: dict[str, Any] = {"step": run.step, "time": run.time, "dt": run.dt, **run.ends}
    arrays |= {"truth": run.truth, "names": np.array(run.space.names), "axes": np.array(run.space.axes)}
    arrays |= {f"inputs/{name}": values for name, values in run.inputs.items()}
    for table in run.stages.values():
        arrays |= {f"stages/{table.name}/step": table.step, f"stages/{table.name}/place": table.place}
        for name, values in table.values.items():
            arrays |= _plain(f"stages/{table.name}/{name}", values)
    return arrays | ({"labels": np.array(run.labels)} if run.labels else {})


def _plain(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """An array; of rows of different lengths all of them, one after the other, and beside them how many each has."""
    if values.dtype != object:
        return {name: values}
    return {name: np.concatenate(list(values)), f"{name}.count": np.array([len(row) for row in values])}


def _write_csv(file: IO[str], names: tuple[str, ...], rows: Array) -> None:
    writer = csv.writer(file)
    writer.writerow(names)
    writer.writerows([int(row[0]), *(repr(float(v)) for v in row[1:])] for row in rows)


def _whole(path: Path, write: Callable[[Any], object], *, text: bool = False) -> Path:
    how: dict[str, Any] = {"mode": "w", "newline": "", "encoding": "utf-8"} if text else {"mode": "wb"}
    with whole(path) as aside, aside.open(**how) as file:
        write(file)
    return path
