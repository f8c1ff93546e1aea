"""Spaces as JSON-ready data, and back."""

from __future__ import annotations

from typing import Any

from viz_estim.core.euler import EulerAngles
from viz_estim.core.spaces import S2, SE2, SO2, SO3, Euclidean, Product, Space

_PLAIN: dict[str, Any] = {kind.__name__: kind for kind in (SO2, SO3, SE2, S2)}


def describe(space: Space) -> dict[str, Any]:
    """The space as JSON-ready data, which `rebuild` turns back."""
    if isinstance(space, EulerAngles):
        return {"kind": "EulerAngles", "order": space.order}
    if isinstance(space, Product):
        return {"kind": "Product", "parts": {name: describe(part) for name, part in space.parts.items()}}
    if isinstance(space, Euclidean):
        return {"kind": "Euclidean", "names": list(space.names), "units": list(space.units)}
    return {"kind": type(space).__name__}


def rebuild(description: dict[str, Any]) -> Space:
    """The space that `describe` described."""
    if description["kind"] == "EulerAngles":
        return EulerAngles(description["order"])
    if description["kind"] == "Product":
        return Product(**{name: rebuild(part) for name, part in description["parts"].items()})
    if description["kind"] == "Euclidean":
        return Euclidean(description["names"], description["units"])
    plain: Space = _PLAIN[description["kind"]]()
    return plain
