"""A person's own scenario, looked over before it runs: what would fail in the midst of it is said in one line."""

from __future__ import annotations

from typing import Any

from viz_estim.core.names import check_name
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.yielded import shape_of
from viz_estim.errors import BadInput


def check_scenario(scenario: Any, name: str) -> None:
    """BadInput unless it is a scenario whose beliefs, ticks and truth fit each other; name: what it is called."""
    if not isinstance(scenario, Scenario):
        raise BadInput(f"{name}: returned {type(scenario).__name__}, expected a viz_estim Scenario")
    if not len(scenario.ticks) or 0 not in scenario.beliefs:
        raise BadInput(f"{name}: a scenario needs at least one tick, and a belief at step 0")
    for step, belief in scenario.beliefs.items():
        _check_belief(belief, f"{name}: the belief at step {step}")
    _check_ticks(scenario, name)
    if scenario.truth is not None:
        space = scenario.space
        shape = (len(scenario.ticks), 1 if space is None else len(space.names))
        wanted = "the label's index" if space is None else ", ".join(space.names)
        found = shape_of(scenario.truth)
        if found != shape:
            raise BadInput(f"{name}: truth: expected an array {shape}, a row a tick ({wanted}), got {found}")


def _check_belief(belief: Any, what: str) -> None:
    if not hasattr(belief, "shapes"):  # a belief of another kind tells of itself as these do
        kinds = "Gaussian, Particles or Categorical of viz_estim.core.beliefs"
        raise BadInput(f"{what}: expected a {kinds}, got {type(belief).__name__}")
    for field, shape in belief.shapes.items():
        found = shape_of(getattr(belief, field))
        if found != shape:
            raise BadInput(f"{what}: {field}: expected an array {shape}, got {found}")


def _check_ticks(scenario: Scenario, name: str) -> None:
    wrong = next((tick for tick in scenario.ticks if not isinstance(tick, Tick)), None)
    if wrong is not None:
        raise BadInput(f"{name}: ticks: expected Ticks of viz_estim.core.run, got {type(wrong).__name__}")
    try:
        for sensor in {sensor for tick in scenario.ticks for sensor in (*tick.measurements, *tick.raw)}:
            check_name(sensor, "reading")
    except ValueError as error:
        raise BadInput(f"{name}: {error}") from error
