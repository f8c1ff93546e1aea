"""Points of a PLY file (Turk 1994): x, y[, z] of its vertices, of any scalar type; ASCII and binary, of either order.

What else a file holds is passed over. Lists among the vertices' properties, or before them in a binary file, are
refused: with them a point's place in the file is not known until all before it are read.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    """So many rows of one kind, with a type for each property's name; None is a list."""

    name: str
    count: int
    properties: dict[str, str | None] = field(default_factory=dict)


def is_ply(path: Path) -> bool:
    """Whether the file says that it is one."""
    with path.open("rb") as file:
        return file.read(4) in (b"ply\n", b"ply\r")


def read(path: Path) -> Array:
    """The vertices (N, 2) or (N, 3); BadInput where the file is damaged or of a kind that is refused."""
    data = path.read_bytes()
    start, order, elements = _header(path, data)
    before: list[_Element] = []
    for element in elements:
        if element.name == "vertex":
            break
        before.append(element)
    else:
        raise BadInput(f"{path}: no element vertex (elements: {', '.join(e.name for e in elements) or 'none'})")
    names = {name.lower(): name for name in element.properties}
    axes = [names[axis] for axis in ("x", "y", "z") if axis in names]
    if not {"x", "y"} <= set(names):
        raise BadInput(f"{path}: its vertices lack x or y (properties: {', '.join(element.properties) or 'none'})")
    if None in element.properties.values():
        raise BadInput(f"{path}: its vertices hold a list; write them without it")
    if order:
        return _binary(path, data[start:], order, before, element, axes)
    return _ascii(path, data[start:], before, element, axes)


def _header(path: Path, data: bytes) -> tuple[int, str, list[_Element]]:
    """Where the data begins, its byte order ("" for ASCII), and the elements in order."""
    order, elements, at = None, list[_Element](), 0
    while (end := data.find(b"\n", at)) >= 0:
        words, at = data[at:end].decode("latin-1").split(), end + 1
        try:
            match words:
                case ["format", name, _]:
                    order = _ORDERS[name]
                case ["element", name, count]:
                    elements.append(_Element(name, int(count)))
                    if elements[-1].count < 0:
                        raise ValueError
                case ["property", "list", _, _, name]:
                    elements[-1].properties[name] = None
                case ["property", kind, name]:
                    elements[-1].properties[name] = _TYPES[kind]
                case ["end_header"] if order is not None:
                    return at, order, elements
                case [] | ["ply" | "comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError
        except (ValueError, KeyError, IndexError):
            raise BadInput(f"{path}: its PLY header has a line of no known form: {' '.join(words)[:80]!r}") from None
    raise BadInput(f"{path}: its PLY header has no end; the file may be truncated")


def _binary(path: Path, data: bytes, order: str, before: list[_Element], vertex: _Element, axes: list[str]) -> Array:
    skipped = 0
    for element in before:
        if None in element.properties.values():
            raise BadInput(f"{path}: holds lists before its vertices; write the vertices first")
        skipped += element.count * _row(element, order).itemsize
    row = _row(vertex, order)
    held = max(0, len(data) - skipped) // row.itemsize
    if held < vertex.count:
        raise _truncated(path, held, vertex.count)
    rows = np.frombuffer(data, row, vertex.count, skipped)
    return np.stack([rows[axis].astype(float) for axis in axes], axis=1)


def _ascii(path: Path, data: bytes, before: list[_Element], vertex: _Element, axes: list[str]) -> Array:
    lines = [line for line in data.decode("latin-1").splitlines() if line.strip()]
    lines = lines[sum(element.count for element in before) :][: vertex.count]
    if len(lines) < vertex.count:
        raise _truncated(path, len(lines), vertex.count)
    columns = [list(vertex.properties).index(axis) for axis in axes]
    points = np.empty((vertex.count, len(axes)))
    for k, line in enumerate(lines):
        cells = line.split()
        if len(cells) != len(vertex.properties):
            raise BadInput(f"{path}: vertex {k} has {len(cells)} numbers, the header names {len(vertex.properties)}")
        try:
            points[k] = [float(cells[i]) for i in columns]
        except ValueError:
            raise BadInput(f"{path}: vertex {k} is not made of numbers: {line[:60]!r}") from None
    return points


def _row(element: _Element, order: str) -> np.dtype:
    return np.dtype([(name, f"{order}{kind}") for name, kind in element.properties.items()])


def _truncated(path: Path, held: int, count: int) -> BadInput:
    return BadInput(f"{path}: holds {held} of the {count} vertices that its header announces; it is truncated")
