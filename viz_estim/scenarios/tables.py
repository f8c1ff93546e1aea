"""Tables with named columns: text, separated by commas, semicolons, tabs or blanks, and NPZ; as people write them.

Names are in any case, may be quoted and may carry a unit: `Gyro_X [rad/s]` is `gyro_x`. Blank lines and lines that
begin with `#` or `%` are passed over, unless one of these is where the names stand. A column is turned into numbers
when it is asked for, so that one of texts, or of Python objects (which are never unpickled), is in nobody's way.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios.reading import unreadable

_SEPARATORS = (";", ",", "\t", None)  # None: blanks. A comma beside semicolons is a decimal one
_MISSING = ("", "na", "n/a", "null")  # what tools write for a number that is not there
_UNIT = re.compile(r"\s*[\[(]\s*([^\])]*?)\s*[\])]")
_FOREIGN = re.compile(r"deg|°|dps|\b[mµuk]?g\b|^([mµun]s|min|h)$|\b[mck]m\b", re.IGNORECASE)  # not SI, nor radians


@dataclass(frozen=True)
class Table:
    """A file's columns: names as they are asked for, units as the file has them ("" where it says none).

    cells: a column of texts, or an array as an .npz holds it; an error where there is none to be had.
    """

    path: Path
    names: tuple[str, ...]
    units: tuple[str, ...]
    cells: tuple[list[str] | np.ndarray | BadInput, ...]
    lines: tuple[int, ...] | None = None  # of the file, by row; None where it has none

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def where(self, row: int) -> str:
        """The row as a person finds it: `line 7`, or `sample 5` where there are no lines."""
        return f"line {self.lines[row]}" if self.lines else f"sample {row}"

    def held(self) -> str:
        """The names there are, to be said where one is missing."""
        return f"columns: {', '.join(self.names)[:200]}"

    def require(self, names: tuple[str, ...]) -> None:
        """BadInput where one of these columns is missing."""
        missing = [name for name in names if name not in self.names]
        if missing:
            raise BadInput(f"{self.path}: missing {', '.join(missing)} ({self.held()})")

    def texts(self, name: str) -> list[str]:
        """A column's cells as texts."""
        found = self._cells(name)
        return found if isinstance(found, list) else [str(value) for value in found.ravel()]

    def numbers(self, name: str) -> Array:
        """A column (N,); an empty cell or `NA` is NaN. BadInput where one is no number, or not in SI units, radians."""
        found, unit = self._cells(name), self.units[self.names.index(name)]
        if _FOREIGN.search(unit):
            raise BadInput(f"{self.path}: {name} is in {unit}; convert it to SI units and radians")
        if not isinstance(found, list):
            if found.dtype.kind not in "uifb" or found.size != max(found.shape, default=1):
                raise BadInput(f"{self.path}: {name} must be one column of numbers")
            return found.astype(float).ravel()
        out = np.empty(len(found))
        for row, cell in enumerate(found):
            try:
                out[row] = np.nan if cell.lower() in _MISSING else float(cell)
            except ValueError:
                raise BadInput(f"{self.path}: {self.where(row)}, {name}: {cell[:40]!r} is not a number") from None
        return out

    def columns(self, names: tuple[str, ...]) -> dict[str, Array]:
        """Those of the columns that are there, each (N,) as long as the others."""
        found = {name: self.numbers(name) for name in names if name in self.names}
        if len({len(values) for values in found.values()}) > 1:
            sizes = ", ".join(f"{name} {len(values)}" for name, values in found.items())
            raise BadInput(f"{self.path}: columns of different lengths ({sizes}); they must agree")
        return found

    def _cells(self, name: str) -> list[str] | np.ndarray:
        if self.names.count(name) > 1:
            raise BadInput(f"{self.path}: two columns have one name, {name} ({self.held()}); keep one of them")
        found = self.cells[self.names.index(name)]
        if isinstance(found, BadInput):
            raise found
        return found


def read_table(path: Path, spellings: dict[str, str] | None = None) -> Table:
    """The file's columns; spellings: other names that a column may have, and its own."""
    try:
        table = _read_npz(path) if path.suffix.lower() == ".npz" else _read_text(path)
    except BadInput:
        raise
    except Exception as error:  # numpy raises whatever a damaged file makes it trip over
        raise unreadable(path, error) from error
    alone = {own for other, own in (spellings or {}).items() if own not in table.names}
    names = tuple(spellings[name] if spellings and spellings.get(name) in alone else name for name in table.names)
    return Table(path, names, table.units, table.cells, table.lines)


def _read_npz(path: Path) -> Table:
    with path.open("rb"):  # else nobody says why it is none
        pass
    if not zipfile.is_zipfile(path):
        raise BadInput(f"{path}: cannot be read, it is no .npz or truncated; write it with numpy.savez(FILE, NAME=…)")
    cells: list[np.ndarray | BadInput] = []
    with np.load(path, allow_pickle=False) as file:
        held = tuple(file.files)
        for name in held:
            try:
                cells.append(file[name])
            except ValueError:  # objects, which numpy refuses to unpickle; anything else is damage
                if not _is_of_objects(path, name):
                    raise
                cells.append(BadInput(f"{path}: {name} holds Python objects, which are not read; save plain numbers"))
    names, units = zip(*map(_name_and_unit, held), strict=True) if held else ((), ())
    return Table(path, names, units, tuple(cells))


def _is_of_objects(path: Path, name: str) -> bool:
    """Whether the array's header says that it is made of Python objects."""
    with zipfile.ZipFile(path) as archive, archive.open(f"{name}.npy") as file:
        version = np.lib.format.read_magic(file)
        read: Callable[..., tuple[object, bool, np.dtype]] = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        return read(file)[2].hasobject


def _read_text(path: Path) -> Table:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: cannot be read, it is no text in UTF-8; save it as CSV in UTF-8") from error
    lines = [(number, line.strip(" \r")) for number, line in enumerate(text.split("\n"), 1) if line.strip()]
    if "\r" in text.replace("\r\n", ""):  # an old Macintosh's ends of lines
        lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    remarks = [(number, line.lstrip("#% \t")) for number, line in lines if line.lstrip().startswith(("#", "%"))]
    lines = [(number, line) for number, line in lines if not line.lstrip().startswith(("#", "%"))]
    if not lines:
        raise BadInput(f"{path}: is empty")
    first = lines[0]
    above = [remark for remark in remarks if remark[0] < first[0]]
    header = above[-1][1] if above and is_number(re.split(r"[;,\s]", first[1].strip())[0]) else lines.pop(0)[1]
    header = _UNIT.sub(lambda found: f"[{found[1].replace(' ', '')}]", header)
    if not lines:
        raise BadInput(f"{path}: is empty, or holds column names alone")
    separator = next(s for s in _SEPARATORS if s is None or (s in header and s in lines[0][1]))
    # Over rows of blanks, names in a comment are often separated otherwise.
    heads = _split(header if separator else re.sub("[;,]", " ", header), separator)
    while heads and not heads[-1]:
        heads.pop()
    rows = []
    for number, line in lines:
        cells = _split(line, separator)
        while len(cells) > len(heads) and not cells[-1]:  # a separator at the end
            cells.pop()
        if len(cells) != len(heads):
            raise BadInput(f"{path}: line {number} has {len(cells)} cells, the first line {len(heads)}")
        rows.append([cell.replace(",", ".") for cell in cells] if separator == ";" else cells)
    names, units = zip(*map(_name_and_unit, heads), strict=True)
    columns = tuple([row[i] for row in rows] for i in range(len(heads)))
    return Table(path, names, units, columns, tuple(number for number, _ in lines))


def _split(line: str, separator: str | None) -> list[str]:
    return [cell.strip().strip('"').strip() for cell in line.split(separator)]


def _name_and_unit(head: str) -> tuple[str, str]:
    unit = _UNIT.search(head)
    return _UNIT.sub("", head).strip().lower(), unit[1] if unit else ""


def is_number(cell: str) -> bool:
    """Whether a cell reads as a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True
