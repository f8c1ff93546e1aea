"""The figures of several runs side by side, as a table for the terminal or in markdown."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from viz_estim.core.alignment import on_stamps
from viz_estim.core.consistency import metrics
from viz_estim.core.spaces import Product
from viz_estim.recording.compared import Compared, shared_parts
from viz_estim.recording.reader import Run

NONE = "–"  # the cell of a run that has no such figure


class Row(NamedTuple):
    """A line of the table: a name and a cell a run; without cells a heading."""

    name: str
    cells: list[str]


def rows(runs: list[Compared], figures: list[dict[str, Any]]) -> list[Row]:
    """What was set differently, metrics, NIS with its band, NEES, and how far each run is from the first."""
    found = [Row("colour", [one.hue for one in runs]), Row("steps", [_steps(one.run) for one in runs])]
    found += _settings(runs)
    found += _numbers([one["metrics"] for one in figures])
    for sensor, dof in dict.fromkeys((key, value["dof"]) for one in figures for key, value in one["nis"].items()):
        of_each = [one["nis"].get(sensor) for one in figures]
        of_each = [one if one and one["dof"] == dof else None for one in of_each]
        found.append(Row(f"NIS {sensor} ({dof} expected)", [_nis(one) for one in of_each]))
        bands = [f"{one['low']:.3g} to {one['high']:.3g}" if one else NONE for one in of_each]
        found.append(Row("  its mean's 95 % band", bands))
    for dof in dict.fromkeys(one["nees"]["dof"] for one in figures if one["nees"]):
        errors = [one["nees"] if one["nees"] and one["nees"]["dof"] == dof else None for one in figures]
        found.append(Row(f"NEES ({dof} expected)", [f"{one['mean']:.3g}" if one else NONE for one in errors]))
        found.append(Row("  steps in its 95 % band", [f"{one['inside']:.0%}" if one else NONE for one in errors]))
    apart = _numbers([_apart(runs[0], one) for one in runs], indent="  ")
    return found + ([Row(f"difference to {runs[0].name}:", []), *apart] if apart else [])


def text(names: list[str], table: list[Row], width: int) -> list[str]:
    """The table's lines; where it is wider than that, in as many blocks of runs one below the other as it takes."""
    label = max(len(row.name) for row in table if row.cells)
    widths = [max(len(name), *(len(row.cells[i]) for row in table if row.cells)) for i, name in enumerate(names)]
    blocks: list[list[int]] = [[]]
    for i in range(len(names)):
        if blocks[-1] and label + sum(2 + widths[k] for k in [*blocks[-1], i]) > width:
            blocks.append([])
        blocks[-1].append(i)
    lines: list[str] = []
    for block in blocks:
        lines += [""] if lines else []
        for name, cells in [Row("", names), *table]:
            if cells and all(cells[i] == NONE for i in block):
                continue
            lines.append((f"{name:{label}}" + "".join(f"  {cells[i]:{widths[i]}}" for i in block if cells)).rstrip())
    return lines


def markdown(names: list[str], table: list[Row]) -> str:
    """The same for the viewer's panel."""
    lines = [["", *names], ["---"] * (len(names) + 1)]
    lines += [[row.name.strip(), *(row.cells or [""] * len(names))] for row in table]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _steps(run: Run) -> str:
    ended = "" if run.complete and run.error is None else ", failed" if run.error else ", cut off"
    return f"{len(run.step)}{ended}"


def _settings(runs: list[Compared]) -> list[Row]:
    """The scenario, the seed and the parameters in which the runs that have them differ."""
    found = []
    facts = [
        {k: one.run.properties.get(k) for k in ("scenario", "seed", "calibration")}
        | one.run.properties.get("params", {})
        for one in runs
    ]
    for name in dict.fromkeys(key for one in facts for key in one):
        values = [one[name] for one in facts if name in one]
        if any(value != values[0] for value in values):
            found.append(Row(name, [_short(one.get(name, NONE)) for one in facts]))
    return found


def _numbers(of_runs: list[dict[str, Any]], indent: str = "") -> list[Row]:
    names = dict.fromkeys(key for one in of_runs for key in one)
    return [Row(indent + name, [_short(one.get(name, NONE)) for one in of_runs]) for name in names]


def _nis(one: dict[str, Any] | None) -> str:
    if one is None:
        return NONE
    word = "inside" if one["low"] <= one["mean"] <= one["high"] else "above" if one["mean"] > one["high"] else "below"
    return f"{one['mean']:.3g} {word}"


def _apart(first: Compared, other: Compared) -> dict[str, float]:
    """The metrics of a run with the first run in the truth's place, on its stamps, by the parts that both have."""
    names = shared_parts(first, other)
    if other.place == 0 or not names:
        return {}
    a, b = first.run, other.run
    space = Product(**{name: first.space.parts[name] for name in names})
    mine = np.concatenate([a.mean[:, first.space.at[name]] for name in names], axis=1)
    parts = [on_stamps(space.parts[k], b.time, b.mean[:, other.space.at[k]], a.time) for k in names]
    return metrics(space, np.concatenate(parts, axis=1), mine)


def _short(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, (float, np.floating)) else str(value)
