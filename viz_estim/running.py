"""From a scenario's name to a recorded run: find it, build it from data and parameters, run it, record it."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import inspect
import platform
import sys
import time
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from viz_estim.checking import check_scenario
from viz_estim.core.consistency import Tally
from viz_estim.core.run import Scenario, Step, run
from viz_estim.errors import BadInput
from viz_estim.files import check_writable, claimed, make_folder, sha256
from viz_estim.parameters import assign, check_seed, nearest, parameters
from viz_estim.scenarios import SCENARIOS, SYSTEMS

if typing.TYPE_CHECKING:
    from viz_estim.recording.recorder import Recorder

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Source:
    """A scenario function and the data function beside it, if it has one."""

    name: str
    scenario: Callable[..., Scenario]
    data: Callable[..., Any] | None
    system: str | None = None


@dataclass(frozen=True)
class Plan:
    """A run before it runs: what was asked, every parameter filled in."""

    source: Source
    params: dict[str, Any]
    data_params: dict[str, Any]
    files: list[Path] | None
    calibration: Path | None
    seed: int
    made_of: list[Path] = field(default_factory=list)

    def build(self) -> Scenario:
        """Reads or simulates the data and puts the estimator over it."""
        try:
            scenario = self._built(np.random.default_rng(self.seed))
        except BadInput:
            raise
        except Exception as error:
            if self.source.system:
                raise
            where = f"{type(error).__name__}: {error}"
            raise BadInput(f"{self.source.name}: raised {where}; mend the function, or give what it needs") from error
        check_scenario(scenario, self.source.name)
        return scenario

    def _built(self, rng: np.random.Generator) -> Scenario:
        if self.source.data is None:
            takes_rng = next(iter(inspect.signature(self.source.scenario).parameters), None) == "rng"
            return self.source.scenario(*([rng] if takes_rng else []), **self.params)
        extra = {"calibration": self.calibration} if self.calibration else {}
        data = self.source.data(self.files, rng, **self.data_params, **extra)
        log = getattr(data, "log", data)
        self.made_of.extend(getattr(log, "files", self.files or ()))
        return self.source.scenario(data, **self.params)

    def properties(self, scenario: Scenario) -> dict[str, Any]:
        """All that is needed to run it again."""
        files = [*self.made_of, *([self.calibration] if self.calibration else [])]
        return {
            "title": self.title(),
            "scenario": self.source.name,
            "system": self.source.system,
            "params": self.all_params(),
            "seed": self.seed,
            "data": [{"path": str(path), "sha256": sha256(path)} for path in files],
            "calibration": str(self.calibration) if self.calibration else None,
            "versions": {name: version(name) for name in ("viz-estim", "rerun-sdk", "numpy", "scipy")}
            | {"python": platform.python_version()},
            "first": max(scenario.beliefs),
        }

    def all_params(self) -> dict[str, Any]:
        return self.params | {f"data.{name}": value for name, value in self.data_params.items()}

    def title(self) -> str:
        """The scenario and what it ran on, as a file's name."""
        parts = [self.source.name.rpartition(":")[2]]
        if self.made_of:
            parts.append(self.made_of[0].stem)
        if not self.made_of or self.seed:
            parts.append(f"seed{self.seed}")
        return "-".join(parts)


def plan(
    name: str, *, data: list[Path] | None, calibration: Path | None, settings: list[str], seed: int | None
) -> Plan:
    """What `run` was asked for, checked. Without data and seed: the system's own file, else a simulation."""
    source = find(name)
    if source.data is None and data:
        raise BadInput(f"{name}: makes its data itself, it takes no --data")
    takes_calibration = source.data is not None and "calibration" in inspect.signature(source.data).parameters
    if calibration and not takes_calibration:
        raise BadInput(f"{name}: takes no --calibration")
    check_seed(seed)
    data_parameters = parameters(source.data) if source.data else {}
    params, data_params = assign(settings, parameters(source.scenario), data_parameters, name)
    if source.data and not data and seed is None and source.system:
        own = Path(__file__).parents[1] / "data" / source.system
        if own.is_dir():
            data = [own]
    if data and source.data and (changed := [k for k, v in data_params.items() if v != data_parameters[k].default]):
        raise BadInput(f"data.{changed[0]} belongs to the simulation; leave it out, or give --seed instead of --data")
    # The simulation's parameters say nothing of data that was read.
    return Plan(source, params, {} if data else data_params, data or None, calibration, seed or 0)


def find(name: str) -> Source:
    """A scenario by its name, or a function in a person's own file (`FILE.py:function`)."""
    if name in SCENARIOS:
        module = inspect.getmodule(SCENARIOS[name])
        system = next(key for key, value in SYSTEMS.items() if value is module)
        return Source(name, SCENARIOS[name], _data_function(module, SCENARIOS[name], name), system)
    if name.startswith("flawed:"):
        return _flawed(name)
    file, colon, function = name.rpartition(":")
    if not colon or not file.endswith(".py"):
        hint = "" if not name.endswith(".py") else "; name the function too: FILE.py:function"
        raise BadInput(f"no scenario {name}{hint or nearest(name, SCENARIOS)}")
    module = _import(Path(file))
    found = getattr(module, function, None)
    if not inspect.isfunction(found):
        own = [k for k, v in vars(module).items() if inspect.isfunction(v) and v.__module__ == module.__name__]
        raise BadInput(f"{file}: no function {function}{nearest(function, own)}")
    return Source(name, found, _data_function(module, found, name))


def _flawed(name: str) -> Source:
    """A filter of the gallery of broken ones, over the healthy system's data."""
    from viz_estim.scenarios.flawed import FLAWED

    flaw = FLAWED.get(name.removeprefix("flawed:"))
    if flaw is None:
        raise BadInput(f"no scenario {name}{nearest(name, [f'flawed:{known}' for known in FLAWED])}")
    return Source(name, flaw.scenario, flaw.data, next(key for key, value in SYSTEMS.items() if value is flaw.system))


class _FromSource(importlib.machinery.SourceFileLoader):
    """Neither takes nor leaves byte code: which source it is of is told by the second, and a person edits and runs."""

    def path_stats(self, path: str) -> Any:
        raise OSError


def _import(path: Path) -> Any:
    if not path.is_file():
        raise BadInput(f"{path}: no such file")
    name = f"viz_estim_user_{path.stem}"
    loader = _FromSource(name, str(path))
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    assert spec
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    sys.path.insert(0, str(path.parent.resolve()))
    try:
        loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise BadInput(f"{path}: cannot be imported ({type(error).__name__}: {error})") from error
    finally:
        sys.path.pop(0)
    return module


def _data_function(module: Any, scenario: Callable[..., Any], name: str) -> Callable[..., Any] | None:
    """The function `(source, rng, *, …)` of the module; by its return type where there are several."""
    first = next(iter(inspect.signature(scenario).parameters.values()), None)
    if first is None or first.kind is first.KEYWORD_ONLY or first.name == "rng":
        return None
    functions = [f for f in vars(module).values() if inspect.isfunction(f) and f.__module__ == module.__name__]
    makers = [f for f in functions if list(inspect.signature(f).parameters)[:2] == ["source", "rng"]]
    wanted = typing.get_type_hints(scenario).get(first.name)
    matching = [f for f in makers if typing.get_type_hints(f).get("return") is wanted and wanted is not None]
    chosen = matching or makers
    if len(chosen) != 1:
        raise BadInput(
            f"{name}: takes data; its file needs one function (source, rng, …) that makes it, not {len(chosen)}"
        )
    return chosen[0]


def recorded(steps: Iterator[Step], scenario: Scenario, recorder: Recorder, progress: Progress) -> dict[str, Any]:
    """Runs the steps into the recorder; the result as `run --json` has it."""
    tally = Tally(scenario.space, max(scenario.beliefs), scenario.facts)
    estimate = record = 0.0
    count = stages = 0
    error = ended = None
    while True:
        began = time.perf_counter()
        step = next(steps, None)
        estimated = time.perf_counter()
        estimate += estimated - began
        if step is None:
            break
        recorder.add(step)
        tally.add(step)
        record += time.perf_counter() - estimated
        count, stages = count + 1, stages + len(step.stages)
        error, ended = step.error, step
        progress(count, len(scenario.ticks))
    last = scenario.ticks[max(count - 1, 0)].time
    if scenario.figures and ended and not error:
        tally.facts = {**tally.facts, **scenario.figures(ended)}
    result = {
        "steps": count,
        "stages": stages,
        "duration_s": last - scenario.ticks[0].time,
        "error": {"step": error.step, "stage": error.stage, "message": error.message} if error else None,
        **tally.summary(),
    }
    began = time.perf_counter()
    recorder.close(result, facts=tally.facts)
    record += time.perf_counter() - began
    return result | {"wall_s": {"estimate": estimate, "record": record}}


def execute(planned: Plan, out: Path | None, *, every: int, live: str | None, progress: Progress) -> dict[str, Any]:
    """Runs a plan and records it; returns what `run --json` prints."""
    from viz_estim.recording.recorder import Recorder, partial_of  # here: whoever does not record need not wait for it

    scenario = planned.build()
    path = out or Path("recordings") / f"{planned.title()}.rrd"
    if out is None:
        make_folder(path.parent)
    check_writable(path, suffix=".rrd")
    properties = planned.properties(scenario) | {"every": every}
    with (
        claimed(partial_of(path)),
        Recorder(path, scenario, properties, every=every, live=live) as recorder,
    ):
        result = recorded(run(scenario, planned.seed), scenario, recorder, progress)
    head = {"scenario": planned.source.name, "recording": str(path)}
    return head | {"params": planned.all_params(), "seed": planned.seed} | result
