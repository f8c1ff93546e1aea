"""Checks of the parameters that a person sets."""

from __future__ import annotations

import math

from viz_estim.errors import BadInput

_LARGEST = 1e50  # of a standard deviation: the square of its square is still a number


def positive(**values: float | None) -> None:
    """BadInput where a value that is given is no positive number, or one that no computer squares."""
    for name, value in values.items():
        if value is not None and not (value > 0 and math.isfinite(value)):
            raise BadInput(f"{name} must be a positive number, got {value:g}")
        if value is not None and value > _LARGEST:
            raise BadInput(f"{name}={value:g} is too large; {_LARGEST:g} is the most")


def at_most(limit: float, **values: float) -> None:
    """BadInput where a size that is asked for is more than a machine holds or a person looks at."""
    for name, value in values.items():
        if not value <= limit:
            raise BadInput(f"{name} must be at most {limit:g}, got {value:g}")


def probability(name: str, value: float | None) -> float | None:
    """The value, where it is none or lies between 0 and 1."""
    if value is not None and not 0 < value < 1:
        raise BadInput(f"{name} is a probability between 0 and 1, such as 0.999, got {value:g}")
    return value
