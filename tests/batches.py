"""Runs that differ in their numbers alone, done side by side as one batch: what the filters' leading axes are for."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.run import Scenario, Step, Tick, run
from viz_estim.core.stages import Start
from viz_estim.core.unscented import AugmentedFilter, UnscentedFilter
from viz_estim.recording.memory import _table, collect
from viz_estim.recording.reader import Run
from viz_estim.recording.tables import StageTable, ends

# By name, the fields that are vectors; all others of a Gaussian filter's stages are matrices.
VECTORS = {"mean", "z", "predicted", "residual", "used", "offered"}


class Dts(np.ndarray):
    """Each member's own dt: a filter asks whether it is positive, and it is so for all members or for none."""

    def __gt__(self, other: object) -> bool:  # type: ignore[override]
        return bool((np.asarray(self) > other).all())

    def __array_wrap__(self, out: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return np.asarray(out)


def together(scenarios: Sequence[Scenario], seeds: Sequence[int]) -> list[Run]:
    """Each one's run as `collect` has it: in one batch, or alone where they can't (chance, a failure, particles).

    The batch goes by the first one's estimator; that this is the others' too is seen by the last one's first steps.
    """
    try:
        found = _batch(scenarios)
    except (TypeError, NameError):  # a slip of ours, which would only be seen by how long it takes
        raise
    except Exception:  # whatever it is, alone it happens to one of them
        return [collect(scenario, run(scenario, seed)) for scenario, seed in zip(scenarios, seeds, strict=True)]
    alone = collect(scenarios[-1], islice(run(scenarios[-1], seeds[-1]), 20))
    for name, table in alone.stages.items():
        batched, rows = found[-1].stages[name], slice(len(table.step))
        np.testing.assert_array_equal(batched.place[rows], table.place)
        np.testing.assert_allclose(batched.mean[rows], table.mean, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(batched.cov[rows], table.cov, rtol=1e-7, atol=1e-9)
    return found


def _batch(scenarios: Sequence[Scenario]) -> list[Run]:
    first = scenarios[0]
    assert all(list(scenario.beliefs) == [0] and scenario.until is None for scenario in scenarios)
    start = [scenario.beliefs[0] for scenario in scenarios]
    belief: Any = Gaussian(start[0].space, np.stack([b.mean for b in start]), np.stack([b.cov for b in start]))
    by_points = isinstance(first.estimator, UnscentedFilter | AugmentedFilter)
    found: dict[str, list[tuple[int, int, Any]]] = {}
    place = 0
    for k, ticks in enumerate(zip(*(scenario.ticks for scenario in scenarios), strict=True)):
        stages: list[Any] = [Start("start", belief)] if k == 0 else []
        # A step that draws by chance fails here for want of a generator.
        for stage in first.estimator.step(belief, _stacked(ticks, by_points), None):  # type: ignore[arg-type]
            stages.append(stage)
            belief = stage.belief
            assert np.isfinite(belief.mean).all()
            assert np.isfinite(belief.cov).all()
        for stage in stages:
            found.setdefault(stage.name, []).append((k, place, stage))
            place += 1
        place += not stages
    whole = {name: _table(name, rows, first.space) for name, rows in found.items()}
    return [_member(scenario, whole, i) for i, scenario in enumerate(scenarios)]


def _member(scenario: Scenario, whole: dict[str, StageTable], i: int) -> Run:
    """The run of the batch's member i: what `collect` finds of its steps without stages, and its part of the tables."""
    steps = [
        Step(k, tick, (), None if scenario.truth is None else scenario.truth[k])
        for k, tick in enumerate(scenario.ticks)
    ]
    tables = {}
    for name, table in whole.items():
        values = {key: v[:, i] if v.ndim == own(key) + 2 else v for key, v in table.values.items()}
        tables[name] = replace(table, values=values)
    made = collect(scenario, steps)
    return replace(made, stages=tables, ends=ends(made.step, tables, made.space, ()))


def own(name: str) -> int:
    """How many dimensions one value of a stage has."""
    return 1 if name.rpartition(".")[2] in VECTORS else 2


def _stacked(ticks: Sequence[Tick], by_points: bool) -> Tick:
    """One tick of all members; by_points: controls and dts get an axis for each member's sigma points."""
    one = ticks[0]
    assert len({tuple(tick.measurements) for tick in ticks}) == 1
    assert not any(tick.faults or tick.stand_ins for tick in ticks)
    dts = np.array([tick.dt for tick in ticks])
    assert (dts > 0).all() or not dts.any()
    assert by_points or len(set(dts)) == 1
    dt: Any = one.dt if len(set(dts)) == 1 else dts[:, None, None].view(Dts)
    control = None
    if one.control is not None:
        control = np.stack([tick.control for tick in ticks])
        control = control[:, None] if by_points else control
    readings = {name: np.stack([tick.measurements[name] for tick in ticks]) for name in one.measurements}
    return replace(one, dt=dt, control=control, measurements=readings, raw={})
