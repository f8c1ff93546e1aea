"""Runs side by side: one recording with all of them, one table of their figures, and where they part first."""

from __future__ import annotations

import math
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

from viz_estim import comparison_table
from viz_estim.differences import Difference, first_difference, other_data
from viz_estim.errors import BadInput
from viz_estim.files import check_writable, make_folder
from viz_estim.recording import merged, schema
from viz_estim.recording.compared import COLOURS, Compared, light
from viz_estim.recording.links import link
from viz_estim.recording.reader import Run, load


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
        run = load(file, points=None)
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
    table = comparison_table.rows(compared, figures)
    verdicts = _verdicts(compared, found, reasons, tol)
    listed = [f"- {_linked(line, compared[0], one)}" for line, one in zip(verdicts, found[1:], strict=True)]
    notes = "\n".join([*listed, "", comparison_table.markdown(names, table)])
    merged.write(path, compared, result, notes)
    lines = comparison_table.text(names, table, shutil.get_terminal_size((120, 24)).columns)
    return result, "\n".join([*lines, *verdicts, f"viz-estim open {shlex.quote(str(path))}"])


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


def _linked(verdict: str, first: Compared, one: Difference | None) -> str:
    """The line with its step as a link there."""
    if one is None:
        return verdict
    step, run = f"step {one.step}", first.run
    entity = first.path + (schema.stage(one.stage) if one.stage in run.stages else schema.STEPS)
    return verdict.replace(f"{step} ", link(step, entity, float(run.time[run.row(step=one.step)])) + " ", 1)


def _worded(one: Difference) -> str:
    if one.quantity == "stage":
        return "one of the two has no such stage"
    word = "covariance" if one.quantity == "cov" else one.quantity
    if one.by is None:
        return f"the {word} is a number in one of the two alone"
    unit = {"mean": " σ", "residual": " σ of S", "cov": " of its norm"}.get(one.quantity, "")
    return f"the {word}, by {one.by:.3g}{unit}"


def _overlap(a: Run, b: Run) -> str:
    """That one ended before the other, if it did."""
    if len(a.step) == len(b.step):
        return ""
    return f" where both have steps ({len(a.step)} and {len(b.step)})"
