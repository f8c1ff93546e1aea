"""A run again, with other estimator parameters from some step on: the scenario and its data are found by what the
recording says of them, and must still be the same."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from viz_estim.core.beliefs import Belief, Particles
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.debugger.live import Live
from viz_estim.errors import BadInput
from viz_estim.files import check_writable, sha256
from viz_estim.parameters import nearest, parameters
from viz_estim.recording.reader import Run, load
from viz_estim.recording.recorder import Recorder
from viz_estim.running import Plan, Progress, find, recorded

_TRIED = 50  # steps after which a parameter that changed nothing but the start is taken for the start's


class Part(NamedTuple):
    """From a step on, the run is this plan's."""

    first: int
    plan: Plan
    scenario: Scenario


def live(parts: list[Part]) -> Live:
    """The run of these parts, one after the other."""
    found = Live(parts[0].scenario, parts[0].plan.seed)
    for part in parts[1:]:
        found = found.fork(part.first, part.scenario)
    return found


def revive(run: Run) -> list[Part]:
    """The recorded run's scenario and data, found again. BadInput where they are gone, or are not what they were."""
    facts = run.properties
    if facts.get("recorded_by"):
        raise BadInput(f"{run.path}: recorded by {facts['recorded_by']}: there is no scenario that could run again")
    try:
        source = find(facts["scenario"])
    except (BadInput, KeyError) as error:
        raise BadInput(f"{run.path}: its scenario is gone ({error})") from error
    files = [Path(one["path"]) for one in facts.get("data", [])]
    for path, one in zip(files, facts.get("data", []), strict=True):
        if not path.is_file():
            raise BadInput(f"{run.path}: its data {path} is gone; put it back, or call this from where it was recorded")
        if sha256(path) != one["sha256"]:
            raise BadInput(f"{run.path}: its data {path} has changed since (its SHA-256 is another)")
    calibration = Path(facts["calibration"]) if facts.get("calibration") else None
    data = [path for path in files if path != calibration] or None
    known = {**parameters(source.scenario), **{f"data.{k}": p for k, p in parameters(source.data).items()}} if (
        source.data
    ) else parameters(source.scenario)  # fmt: skip
    parts: list[Part] = []
    for one in facts.get("forks") or [{"at": 0, "params": facts["params"]}]:
        if gone := [name for name in one["params"] if name not in known]:
            raise BadInput(f"{run.path}: its scenario has no parameter {gone[0]} any more")
        own = {k: v for k, v in one["params"].items() if not k.startswith("data.")}
        data_params = {k[5:]: v for k, v in one["params"].items() if k.startswith("data.")}
        plan = Plan(source, own, data_params, data, calibration, facts["seed"])
        parts.append(Part(one["at"], plan, plan.build()))
    return parts


def changed(parts: list[Part], step: int, settings: list[str], run: Live) -> list[Part]:
    """The parts of the same run with `K=V` texts set from a step on; BadInput where one says what it may not."""
    last = next(part for part in reversed(parts) if part.first <= step)
    params = dict(last.plan.params)
    for text in settings:
        params |= _assigned(last.plan, text)
    if not settings:
        raise BadInput("set what? Give NAME=VALUE")
    scenario = _rebuilt(last.plan, params)
    for name, value in params.items():
        if value != last.plan.params[name]:
            one = (
                scenario.scenario
                if len(settings) == 1
                else _rebuilt(last.plan, last.plan.params | {name: value}).scenario
            )
            _refuse(name, last, one, step, run)
    return [part for part in parts if part.first < step] + [scenario._replace(first=step)]


def _assigned(plan: Plan, text: str) -> dict[str, Any]:
    name, equals, value = (word.strip() for word in text.partition("="))
    own = parameters(plan.source.scenario)
    if not equals or not name:
        raise BadInput(f"{text}: expected NAME=VALUE")
    if name.startswith("data."):
        raise BadInput(f"{name} belongs to the data: a fork changes the estimator alone; start a new run for it")
    if name not in own:
        raise BadInput(f"{plan.source.name} has no parameter {name}{nearest(name, own)}")
    return {name: own[name].parse(value)}


def _rebuilt(plan: Plan, params: dict[str, Any]) -> Part:
    plan = replace(plan, params=params, made_of=[])
    return Part(0, plan, plan.build())


def _refuse(name: str, old: Part, scenario: Scenario, step: int, run: Live) -> None:
    """BadInput where the parameter changed the data of a scenario that makes its own, or nothing but a start that is
    past."""
    ticks = zip(old.scenario.ticks, scenario.ticks, strict=False)
    if old.plan.source.data is None and not all(_same_tick(a, b) for a, b in ticks):
        raise BadInput(f"{name} changes the data, which this scenario makes itself; start a new run for it")
    if step == 0:
        return
    starts = old.scenario.beliefs, scenario.beliefs
    past = [{k: b for k, b in beliefs.items() if k < step} for beliefs in starts]
    if past[0].keys() == past[1].keys() and all(_same(past[0][k], past[1][k]) for k in past[0]):
        return
    belief = run.before(step)
    shapes = getattr(belief, "shapes", None)
    if shapes != getattr(scenario.beliefs[0], "shapes", None) or _same_steps(old, scenario, step, belief):
        raise BadInput(f"{name} belongs to the start, which is past at step {step}; fork at step 0, or start a new run")


def _same_steps(old: Part, scenario: Scenario, step: int, belief: Belief) -> bool:
    """Whether the next steps come out alike, from the same belief."""
    both = [run(one, old.plan.seed, first=step, belief=belief) for one in (old.scenario, scenario)]
    for _, a, b in zip(range(_TRIED), *both, strict=False):
        if len(a.stages) != len(b.stages) or bool(a.error) != bool(b.error):
            return False
        if not all(_same(x.belief, y.belief) for x, y in zip(a.stages, b.stages, strict=True)):
            return False
    return True


def _same(one: Belief, other: Belief) -> bool:
    names = getattr(one, "shapes", {})
    return names == getattr(other, "shapes", {}) and all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in names
    )


def _same_tick(one: Tick, other: Tick) -> bool:
    if (one.time, one.dt) != (other.time, other.dt) or one.measurements.keys() != other.measurements.keys():
        return False
    pairs = [(one.control, other.control), *((z, other.measurements[k]) for k, z in one.measurements.items())]
    return all((a is None and b is None) or np.array_equal(a, b) for a, b in pairs)  # type: ignore[arg-type]


def check_same(run: Run, again: Live, count: int) -> None:
    """BadInput unless the first steps, done again, end as they were recorded: to the bit, or a cloud's moments, whose
    sums depend on how many are summed at once, to rounding."""
    for row, step in enumerate(run.step[:count].tolist()):
        again.span(step)
        belief = again.before(step + 1)
        for name, values in run.ends.items():
            now = getattr(belief, name)
            alike = np.allclose(now, values[row], 1e-9, 1e-12) if isinstance(belief, Particles) else (
                np.array_equal(now, values[row], equal_nan=True))  # fmt: skip
            if not alike and not np.isnan(values[row]).all():
                raise BadInput(
                    f"{run.path}: step {step} comes out different from what was recorded: the scenario's code or a "
                    "library has changed since; run it anew, and fork that"
                )


def properties(parts: list[Part]) -> dict[str, Any]:
    """What a recording of these parts says of how to run it again; parameters are those of its last steps."""
    last = parts[-1]
    found = last.plan.properties(last.scenario)
    if len(parts) > 1 or last.first:
        forks = [{"at": part.first, "params": part.plan.all_params()} for part in parts]
        found |= {"forks": forks, "title": f"{found['title']}-fork{last.first}"}
    return found


def fork(path: Path, step: int, settings: list[str], out: Path | None, progress: Progress) -> dict[str, Any]:
    """Runs a recorded run again with other parameters from a step on, and records that; what `run --json` prints."""
    run_ = load(path, points=False)
    parts = revive(run_)
    if not 0 <= step <= run_.step[-1]:
        raise BadInput(f"--at {step}: {path} holds steps {run_.step[0]} to {run_.step[-1]}")
    original = live(parts)
    check_same(run_, original, step)
    parts = changed(parts, step, settings, original)
    last = parts[-1]
    out = out or path.with_name(f"{path.stem.removesuffix('.partial')}-fork{step}.rrd")
    check_writable(out, suffix=".rrd")
    if out.exists() and out.samefile(path):
        raise BadInput(f"{out}: is the recording itself; choose another name for the fork")
    again = live(parts)
    earlier = (again.step(k) for k in range(step))
    later = run(last.scenario, last.plan.seed, first=step, belief=original.before(step))
    with Recorder(out, last.scenario, properties(parts)) as recorder:
        result = recorded(chain(earlier, later), last.scenario, recorder, progress)
    head = {"scenario": last.plan.source.name, "recording": str(out)}
    return head | {"params": last.plan.all_params(), "seed": last.plan.seed} | result
