"""The gallery's entries: what each broken filter is found by, and what it is made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from viz_estim.core.run import Scenario


class Flaw(NamedTuple):
    """A broken scenario, the code by which it is found, and the module of the healthy system that it wraps."""

    scenario: Callable[..., Scenario]
    code: str
    system: Any

    @property
    def data(self) -> Callable[..., Any]:
        """The data function of the healthy system."""
        return getattr(self.system, self.system.__name__.rpartition(".")[2])


FLAWED: dict[str, Flaw] = {}
Maker = Callable[..., Scenario]


def flaw(code: str, system: Any) -> Callable[[Maker], Maker]:
    """Enters a scenario into the gallery under its name, with hyphens."""

    def enter(make: Maker) -> Maker:
        FLAWED[make.__name__.replace("_", "-")] = Flaw(make, code, system)
        return make

    return enter


def broken(scenario: Scenario, change: Callable[[Any], Any]) -> Scenario:
    """The scenario with its estimator changed."""
    return replace(scenario, estimator=change(scenario.estimator))
