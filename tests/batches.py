"""Runs that differ in their numbers alone, done side by side as one batch: what the filters' leading axes are for."""

import dataclasses
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import islice
from typing import Any

import numpy as np

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.run import Scenario, Step, Tick, run
from viz_estim.core.stages import Start
from viz_estim.core.unscented import AugmentedFilter, UnscentedFilter

# By name, the fields that are vectors; all others of a Gaussian filter's stages are matrices.
VECTORS = {"mean", "z", "predicted", "residual", "used", "offered", "mean_weights", "cov_weights"}


class Dts(np.ndarray):
    """Each member's own dt: a filter asks whether it is positive, and it is so for all members or for none."""

    def __gt__(self, other: object) -> bool:  # type: ignore[override]
        return bool((np.asarray(self) > other).all())

    def __array_wrap__(self, out: Any, context: Any = None, return_scalar: bool = False) -> Any:
        return np.asarray(out)


def together(scenarios: Sequence[Scenario], seeds: Sequence[int]) -> list[list[Step]]:
    """The steps of each, as `run` takes them: in one batch, or alone where they can't (chance, a failure, particles).

    The batch goes by the first one's estimator; that this is the others' too is seen by the last one's first steps.
    """
    alone = [run(scenario, seed) for scenario, seed in zip(scenarios, seeds, strict=True)]
    try:
        found = _batch(scenarios)
    except Exception:  # whatever it is, alone it happens to one of them
        return [list(steps) for steps in alone]
    for batched, single in zip(found[-1], islice(alone[-1], 20), strict=False):
        assert [stage.name for stage in batched.stages] == [stage.name for stage in single.stages]
        for one, other in zip(batched.stages, single.stages, strict=True):
            np.testing.assert_allclose(one.belief.mean, other.belief.mean, rtol=1e-7, atol=1e-9)
            np.testing.assert_allclose(one.belief.cov, other.belief.cov, rtol=1e-7, atol=1e-9)
    return found


def _batch(scenarios: Sequence[Scenario]) -> list[list[Step]]:
    first, steps = scenarios[0], [[] for _ in scenarios]
    assert all(list(scenario.beliefs) == [0] and scenario.until is None for scenario in scenarios)
    start = [scenario.beliefs[0] for scenario in scenarios]
    belief: Any = Gaussian(start[0].space, np.stack([b.mean for b in start]), np.stack([b.cov for b in start]))
    by_points = isinstance(first.estimator, UnscentedFilter | AugmentedFilter)
    for k, ticks in enumerate(zip(*(scenario.ticks for scenario in scenarios), strict=True)):
        stages: list[Any] = [Start("start", belief)] if k == 0 else []
        # A step that draws by chance fails here for want of a generator.
        for stage in first.estimator.step(belief, _stacked(ticks, by_points), None):  # type: ignore[arg-type]
            stages.append(stage)
            belief = stage.belief
            assert np.isfinite(belief.mean).all()
            assert np.isfinite(belief.cov).all()
        for i, (scenario, tick) in enumerate(zip(scenarios, ticks, strict=True)):
            truth = None if scenario.truth is None else scenario.truth[k]
            steps[i].append(Step(k, tick, tuple(member(stage, i) for stage in stages), truth))
    return steps


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


@cache
def fields_of(kind: type) -> list[tuple[str, int]]:
    """Its fields, each with the number of its own dimensions."""
    return [(field.name, 1 if field.name in VECTORS else 2) for field in dataclasses.fields(kind)]


def member(record: Any, i: int) -> Any:
    """A stage, or what it holds, of the batch's member i."""
    values = {}
    for name, own in fields_of(type(record)):
        value = getattr(record, name)
        if isinstance(value, np.ndarray):
            values[name] = value[i] if value.ndim > own else value
        else:
            values[name] = member(value, i) if dataclasses.is_dataclass(value) else value
    return type(record)(**values)
