"""Runs side by side: one recording with all of them, one table of their figures, and where they part first."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from viz_estim.core.alignment import on_stamps
from viz_estim.core.consistency import metrics
from viz_estim.core.spaces import Product
from viz_estim.differences import Difference, first_difference, other_data
from viz_estim.errors import BadInput
from viz_estim.files import check_writable, make_folder
from viz_estim.recording import merged
from viz_estim.recording.compared import COLOURS, Compared, light, shared_parts
from viz_estim.recording.reader import Run, load

Table = list[tuple[str, list[str]]]


def compare(paths: list[Path], out: Path | None, tol: float) -> tuple[dict[str, Any], str]:
    """Compares recordings with the first; writes the merged one. What `--json` prints, and the same for a person."""
    if not 2 <= len(paths) <= len(COLOURS):
        raise BadInput(f"compare takes two to {len(COLOURS)} recordings, got {len(paths)}; name as many")
    if not (math.isfinite(tol) and tol >= 0):
        raise BadInput(f"--tol {tol:g}: expected a number from 0 on")
    names = _names(paths)
    path = _target(paths, out, names)
    runs, figures = [], []
    for file in paths:
        run = load(file, points=False)
        figures.append(run.summary())
        runs.append(light(run))
    reasons = [None, *(other_data(runs[0], run) for run in runs[1:])]
    compared = [
        Compared(run, i, name, reason is None)
        for i, (run, name, reason) in enumerate(zip(runs, names, reasons, strict=True))
    ]
    found = [
        None if other_one else first_difference(runs[0], run, tol) for run, other_one in zip(runs, reasons, strict=True)
    ]
    earliest = min((one for one in found if one), key=lambda one: one.step, default=None)
    reason = "; ".join(f"{name}: {why}" for name, why in zip(names, reasons, strict=True) if why) or None
    result: dict[str, Any] = {
        "recording": str(path),
        "runs": [
            {"name": name, "file": str(file), **figure}
            for name, file, figure in zip(names, paths, figures, strict=True)
        ],
        "first_difference": earliest._asdict() if earliest else None,
        "same": earliest is None and reason is None,
        "reason": reason,
    }  # fmt: skip
    table = _table(compared, figures)
    verdicts = _verdicts(compared, found, reasons, tol)
    merged.write(path, compared, result, _markdown(names, table, verdicts))
    return result, "\n".join([*_aligned(names, table), *verdicts, f"viz-estim open {path}"])


def _names(paths: list[Path]) -> list[str]:
    """The files' names, with their folders' where those are the same, and a number where that does not help."""
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        names = [f"{path.resolve().parent.name}/{path.stem}" for path in paths]
    if len(set(names)) == 1:
        names = [paths[0].stem] * len(paths)
    earlier = [names[:i].count(name) for i, name in enumerate(names)]
    return [f"{name} {count + 1}" if count else name for name, count in zip(names, earlier, strict=True)]


def _target(paths: list[Path], out: Path | None, names: list[str]) -> Path:
    """Where the comparison is written: never over what it is made of."""
    if out is None:
        words = "-".join(re.sub(r"[^\w.-]+", "-", name) for name in names)
        out = Path("recordings") / (f"compare-{words[:120]}.rrd")
        make_folder(out.parent)
    check_writable(out, suffix=".rrd")
    if any(path.exists() and out.exists() and path.samefile(out) for path in paths):
        raise BadInput(f"{out}: is one of the recordings to compare; choose another --out")
    return out


def _verdicts(
    runs: list[Compared], found: list[Difference | None], reasons: list[str | None], tol: float
) -> list[str]:  # fmt: skip
    """Per run after the first, one line: where it parts from it, or why that can't be said."""
    lines = []
    first = runs[0]
    for one, difference, reason in list(zip(runs, found, reasons, strict=True))[1:]:
        if reason:
            lines.append(f"{one.name} cannot be held against {first.name} number by number: {reason}")
        elif difference is None:
            within = "to the bit" if tol == 0 else f"within {tol:g}"
            lines.append(f"{one.name} is the same as {first.name}, {within}{_overlap(first.run, one.run)}")
        else:
            time = first.run.time[first.run.row(step=difference.step)]
            where = f"step {difference.step} ({time:.4f} s), stage {difference.stage}"
            lines.append(f"{one.name} parts from {first.name} first at {where}: {_worded(difference)}")
    return lines


def _worded(one: Difference) -> str:
    if one.quantity == "stage":
        return "one of the two has no such stage"
    if one.by is None:
        return f"the {one.quantity} is a number in one of the two alone"
    unit = {"mean": " σ", "residual": " σ of S", "cov": " of its norm"}.get(one.quantity, "")
    return f"the {one.quantity}, by {one.by:.3g}{unit}"


def _overlap(a: Run, b: Run) -> str:
    """That one ended before the other, if it did."""
    if len(a.step) == len(b.step):
        return ""
    return f" where both have steps ({len(a.step)} and {len(b.step)})"


def _table(runs: list[Compared], figures: list[dict[str, Any]]) -> Table:
    """Rows of a name and a cell a run: what was set differently, metrics, NIS, NEES, and how far from the first."""
    rows: Table = [("colour", [one.hue for one in runs]), ("steps", [_steps(one.run) for one in runs])]
    facts = [
        {k: one.run.properties.get(k) for k in ("scenario", "seed", "calibration")}
        | one.run.properties.get("params", {})
        for one in runs
    ]
    for name in dict.fromkeys(key for one in facts for key in one):
        values = [one.get(name, "–") for one in facts]
        if any(value != values[0] for value in values):
            rows.append((name, [_short(value) for value in values]))
    for name in dict.fromkeys(key for one in figures for key in one["metrics"]):
        rows.append((name, [_short(one["metrics"].get(name, "–")) for one in figures]))
    for sensor in dict.fromkeys(key for one in figures for key in one["nis"]):
        dofs = [one["nis"][sensor]["dof"] for one in figures if sensor in one["nis"]]
        rows.append((f"NIS {sensor} (expected {dofs[0]})", [_nis(one["nis"].get(sensor)) for one in figures]))
    if any(one["nees"] for one in figures):
        rows.append(("NEES", [_nees(one["nees"]) for one in figures]))
    apart = [_apart(runs[0], one) for one in runs]
    for name in dict.fromkeys(key for one in apart for key in one):
        rows.append((f"to {runs[0].name}: {name}", [_short(one.get(name, "–")) for one in apart]))
    return rows


def _steps(run: Run) -> str:
    ended = "" if run.complete and run.error is None else ", failed" if run.error else ", cut off"
    return f"{len(run.step)}{ended}"


def _nis(one: dict[str, Any] | None) -> str:
    if one is None:
        return "–"
    word = "inside" if one["low"] <= one["mean"] <= one["high"] else "above" if one["mean"] > one["high"] else "below"
    return f"{one['mean']:.3g} ({word} {one['low']:.3g} to {one['high']:.3g})"


def _nees(one: dict[str, Any] | None) -> str:
    return f"{one['mean']:.3g} (expected {one['dof']}; {one['inside']:.0%} inside)" if one else "–"


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


def _aligned(names: list[str], table: Table) -> list[str]:
    rows = [("", names), *table]
    wide = max(len(name) for name, _ in rows)
    widths = [max(len(cells[i]) for _, cells in rows) for i in range(len(names))]
    return [
        f"{name:{wide}}" + "".join(f"  {cell:{width}}" for cell, width in zip(cells, widths, strict=True)).rstrip()
        for name, cells in rows
    ]


def _markdown(names: list[str], table: Table, verdicts: list[str]) -> str:
    rows = [["", *names], ["---"] * (len(names) + 1), *([name, *cells] for name, cells in table)]
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join([*(f"- {line}" for line in verdicts), "", *lines])


def _short(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, (float, np.floating)) else str(value)
