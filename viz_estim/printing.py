"""What commands print: JSON-ready values, and the same as text for a person."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from viz_estim import figures
from viz_estim.core.measurement import split
from viz_estim.errors import one_line
from viz_estim.figures import short
from viz_estim.parameters import kind_text, parameters

if TYPE_CHECKING:
    from viz_estim.core.spaces import Space
    from viz_estim.recording.reader import Run
    from viz_estim.recording.tables import StageTable
    from viz_estim.running import Source


def plain(value: Any) -> Any:
    """The value with arrays as lists, paths as texts, and NaN or infinity, which JSON lacks, as null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def scenarios(sources: list[Source]) -> dict[str, Any]:
    """Every scenario, with its parameters and those of its data."""
    listed = []
    for source in sources:
        own = parameters(source.scenario)
        data = {f"data.{k}": p for k, p in (parameters(source.data) if source.data else {}).items()}
        listed.append(
            {
                "name": source.name,
                "system": source.system,
                "description": (source.scenario.__doc__ or "").strip().split("\n")[0],
                "parameters": {k: {"default": p.default, "type": kind_text(p)} for k, p in {**own, **data}.items()},
            }
        )
    return {"scenarios": listed}


def scenarios_text(value: dict[str, Any]) -> str:
    lines = []
    for one in value["scenarios"]:
        lines += [f"{one['name']}: {one['description']}"]
        lines += [f"    {k}={short(p['default'])}  ({p['type']})" for k, p in one["parameters"].items()]
    return "\n".join([*lines, "", "viz-estim run NAME --data PATH --set K=V runs one."])


def result_text(result: dict[str, Any]) -> str:
    """A run's result as a person reads it; the last line opens the recording, or debugs it where the run failed."""
    wall = result["wall_s"]
    lines = [
        f"{result['scenario']}: {result['steps']} steps, {result['stages']} stages, {result['duration_s']:.2f} s of "
        f"data; {wall['estimate']:.2f} s to estimate, {wall['record']:.2f} s to record",
        *figures.lines(result),
    ]
    command = "debug" if result.get("error") else "open"
    return "\n".join([*lines, f"viz-estim {command} {shlex.quote(result['recording'])}"])


def overview(run: Run) -> dict[str, Any]:
    """What a recording holds."""
    facts = run.properties
    return {
        "recording": str(run.path),
        "complete": run.complete,
        "scenario": facts.get("scenario"),
        "params": facts.get("params", {}),
        "seed": facts.get("seed"),
        "data": facts.get("data", []),
        "calibration": facts.get("calibration"),
        "versions": facts.get("versions", {}),
        "steps": len(run.step),
        "first_step": int(run.step[0]),
        "last_step": int(run.step[-1]),
        "duration_s": float(run.time[-1] - run.time[0]),
        "stages": {name: len(table.step) for name, table in run.stages.items()},
        "state": dict(zip(run.space.names, run.space.units, strict=True)) or dict.fromkeys(run.labels, ""),
        "inputs": list(run.inputs),
        "error": run.error if run.complete is False else (facts["result"] or {}).get("error"),
        **run.summary(),
    }


def overview_text(value: dict[str, Any]) -> str:
    ended = "" if value["complete"] else " (the run was cut off: this is what it had recorded)"
    lines = [
        f"{value['recording']}: {value['scenario']}, {value['steps']} steps over {value['duration_s']:.2f} s{ended}",
        f"  stages: {', '.join(f'{name} {count}' for name, count in value['stages'].items())}",
        f"  state:  {', '.join(f'{k} [{u}]' if u else k for k, u in value['state'].items())}",
        *_origin(value),
        *figures.lines(value | {"error": value["error"] if isinstance(value["error"], dict) else None}),
        f"viz-estim show {shlex.quote(value['recording'])} --step {value['last_step']}",
    ]
    return "\n".join(lines)


def _origin(value: dict[str, Any]) -> list[str]:
    """What the run was made of; nothing where a person's own code told of it."""
    if value["seed"] is None:
        return []
    files = ", ".join(one["path"] for one in value["data"]) or "simulated"
    settings = ", ".join(f"{k}={short(v)}" for k, v in value["params"].items())
    return [f"  data:   {files}, seed {value['seed']}", *([f"  set:    {settings}"] if settings else [])]


def step(run: Run, row: int) -> dict[str, Any]:
    """One step: every stage's belief and numbers, the inputs, the truth."""
    number = int(run.step[row])
    stages = []
    for table, at in run.at(number):
        numbers = {name: values[at] for name, values in table.values.items() if name not in run.ends}
        stages.append(
            {"name": table.name, "stage": int(table.place[at]), "belief": _belief(run, table, at)}
            | {name: value for name, value in numbers.items() if not np.isnan(value).all()}
            | _moved(run, table, at)
        )
    result = run.properties.get("result") or {}
    error = result.get("error") if number == run.step[-1] else None
    truth = run.truth[row]
    return {
        "step": number,
        "time": float(run.time[row]),
        "dt": float(run.dt[row]),
        "stages": stages,
        "truth": truth if np.isfinite(truth).any() else None,
        "inputs": {name: values[row] for name, values in run.inputs.items()},
        "error": error,
    }


def _belief(run: Run, table: StageTable, at: int) -> dict[str, Any]:
    if run.labels:
        p = np.exp(table.values["log_probabilities"][at])
        return {"probabilities": dict(zip(run.labels, p, strict=True))}
    moments = {"mean": table.mean[at], "cov": table.cov[at]}
    count = int(run.properties.get("particles", {}).get("count", 0))
    return {"particles": count, "ess": _ess(run, table, at, count)} | moments if count else moments


def _ess(run: Run, table: StageTable, at: int, count: int) -> float:
    """The effective sample size of a stage's cloud: by its weights, or, where they were thinned, by what was noted.

    A cloud is resampled to equal weights, weighing notes what it leaves, and a prediction changes no weight.
    """
    found: tuple[StageTable, int] | None = (table, at)
    while found is not None:
        values, row = found[0].values, found[1]
        log_weights = values["log_weights"][row] if "log_weights" in values else np.empty(0)
        if len(log_weights) == count and np.isfinite(log_weights).all():
            return float(1 / np.square(np.exp(log_weights)).sum())
        if "distinct" in values:
            break
        if "ess" in values:
            return float(values["ess"][row])
        found = run.before(*found)
    return float(count)


def _moved(run: Run, table: StageTable, at: int) -> dict[str, Any]:
    """What each component of an update's reading moved: K[:, j]·ν_j by name, largest first in σ of the state before."""
    before = run.before(table, at)
    if before is None or "gain" not in table.values or "innovation" not in table.spaces:
        return {}
    std = np.sqrt(np.maximum(np.diagonal(before[0].cov[before[1]]), 0))
    moved, in_sigma = split(table.values["gain"][at], table.values["innovation.residual"][at], std)
    order = np.argsort(-np.abs(in_sigma).max(0))
    names = table.spaces["innovation"].axes
    return {"moved": {names[j]: {"by": moved[:, j], "sigmas": in_sigma[:, j]} for j in order.tolist()}}


def step_text(run: Run, value: dict[str, Any]) -> str:
    lines = [f"step {value['step']} at {value['time']:.4f} s (dt {value['dt']:.4f} s)"]
    lines += [f"  {name:18} {_row(numbers)}" for name, numbers in value["inputs"].items()]
    if value["truth"] is not None:
        lines.append(f"  {'truth':18} {_row(value['truth'])}")
    for stage in value["stages"]:
        lines.append(f"{stage['name']}  (stage {stage['stage']})")
        if run.labels:
            p = stage["belief"]["probabilities"]
            lines.append(f"  {'probability':18} {_named(run.labels, p.values(), ('',) * len(p))}")
        else:
            mean, cov = stage["belief"]["mean"], stage["belief"]["cov"]
            if "particles" in stage["belief"]:
                lines.append(f"  {'particles':18} {stage['belief']['particles']}, ESS {stage['belief']['ess']:.5g}")
            lines.append(f"  {'mean':18} {_named(run.space.names, mean, run.space.units)}")
            sigma = np.sqrt(np.maximum(np.diagonal(cov), 0))
            lines.append(f"  {'σ':18} {_named(run.space.axes, sigma, run.space.axis_units)}")
        table = run.stages[stage["name"]]
        for name, numbers in stage.items():
            if name in ("name", "stage", "belief"):
                continue
            if name == "moved":
                for reading, one in numbers.items():
                    lines.append(f"  {f'moved by {reading}':18} {_moves(run.space, one)}")
                continue
            space = table.spaces.get(name.partition(".")[0])
            if name.endswith((".residual", ".z", ".predicted")) and space is not None:
                along = name.endswith("residual")
                names, units = (space.axes, space.axis_units) if along else (space.names, space.units)
                lines.append(f"  {name:18} {_named(names, numbers, units)}")
            elif numbers.size <= 20 and numbers.ndim < 2:
                lines.append(f"  {name:18} {_row(numbers)}")
            else:
                lines.append(f"  {name:18} {'×'.join(map(str, numbers.shape))} (see --json)")
    if value["error"]:
        lines.append(f"FAILED in {value['error']['stage']}: {one_line(value['error']['message'])}")
    return "\n".join(lines)


def _moves(space: Space, one: dict[str, Any]) -> str:
    """The directions that a reading moved, those it moved most (in σ) first."""
    order = np.argsort(-np.abs(one["sigmas"]))[:4]
    units = space.axis_units
    cells = [f"{space.axes[i]} {one['by'][i]:+.3g} {units[i]}".rstrip() + f" ({one['sigmas'][i]:+.2g}σ)" for i in order]
    return "  ".join(cells)


def calibration_text(value: dict[str, Any]) -> str:
    lines, scenario = (_constants(value), "imu-ukf") if value["system"] == "imu" else (_noises(value), "diffdrive-ekf")
    if "calibration" in value:
        lines.append(f"viz-estim run {scenario} --data PATH --calibration {shlex.quote(value['calibration'])}")
    if "recording" in value:
        lines.append(f"viz-estim open {shlex.quote(value['recording'])}")
    return "\n".join(lines)


def _constants(value: dict[str, Any]) -> list[str]:
    lines = []
    for sensor, unit, shown in (("accel", "mps2", "m/s²"), ("gyro", "radps", "rad/s")):
        fitted = value[sensor]
        lines.append(f"{sensor}:            {'x':>18}{'y':>18}{'z':>18}")
        for label, key, error in (
            ("bias [counts]", "bias_counts", "bias_se"),
            (f"sensitivity [mV/({shown})]", f"sensitivity_mv_per_{unit}", "sensitivity_se"),
        ):
            cells = "".join(f"{f'{v:.3f} ± {e:.3f}':>18}" for v, e in zip(fitted[key], fitted[error], strict=True))
            lines.append(f"  {label}\n{'':18}{cells}")
    for one in value["sets"]:
        lines.append(
            f"{one['files'][0]['name']}: motion capture's stamps are {1e3 * one['time_offset_s']:+.1f} ± "
            f"{1e3 * one['time_offset_se']:.1f} ms late; {one['windows']} windows, {one['frozen']} frozen samples "
            "left out"
        )
    return lines


def _noises(value: dict[str, Any]) -> list[str]:
    lines = []
    for noise, symbol, names in (
        ("input", "V", ("speed [m/s]", "turn rate [rad/s]")),
        ("gps", "W", ("x [m]", "y [m]")),
    ):
        lines.append(f"{symbol}, covariance of the {noise} noise, from {value[f'{noise}_count']} samples:")
        lines.append(f"  {'':18}" + "".join(f"{name:>20}" for name in (*names, "mean")))
        for i, name in enumerate(names):
            numbers = [*zip(value[f"{noise}_cov"][i], value[f"{noise}_cov_se"][i], strict=True)]
            numbers.append((value[f"{noise}_mean"][i], value[f"{noise}_mean_se"][i]))
            lines.append(f"  {name:18}" + "".join(f"{f'{v:.4f} ± {e:.4f}':>20}" for v, e in numbers))
    return lines


def _named(names: tuple[str, ...], values: Any, units: tuple[str, ...]) -> str:
    return "  ".join(f"{n}={short(v)}{f' {u}' if u else ''}" for n, v, u in zip(names, values, units, strict=True))


def _row(values: Any) -> str:
    return "  ".join(short(v) for v in np.atleast_1d(values))
