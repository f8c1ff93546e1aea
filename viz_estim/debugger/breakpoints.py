"""Where a session stops by itself."""

from __future__ import annotations

import ast
from dataclasses import dataclass

import numpy as np

from viz_estim.debugger import expressions
from viz_estim.debugger.quantities import Frame


@dataclass(frozen=True)
class Breakpoint:
    """Holds wherever its expression is true; without one, at the first stage of a step."""

    text: str
    tree: ast.expr | None
    step: int = 0

    @property
    def of_findings(self) -> bool:
        """Whether it asks where a finding begins."""
        return self.tree is not None and "finding" in expressions.names_in(self.tree)

    def holds(self, frame: Frame) -> np.ndarray:
        """Where (M,), of a frame of M moments."""
        if self.tree is None:
            return np.asarray((frame.step == self.step) & (frame.index == 0))
        return np.broadcast_to(expressions.holds(self.tree, frame.lookup), frame.step.shape)
