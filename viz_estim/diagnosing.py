"""The command `diagnose`: its arguments, and what it does with them."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

from viz_estim import printing
from viz_estim.errors import BadInput
from viz_estim.files import check_writable


def add(command: Callable[..., argparse.ArgumentParser]) -> None:
    """Adds the command to the command line's."""
    p = command("diagnose", _diagnose, "what is wrong with this filter, since when, on what evidence, and what to try")
    p.add_argument("file", nargs="?", type=Path, metavar="FILE")
    p.add_argument("--out", type=Path, metavar="FILE", help="a copy of the recording with the findings marked in it")
    p.add_argument("--codes", action="store_true", help="the codes of all findings there are, and what they mean")
    p.add_argument("--json", action="store_true", help="one JSON object on stdout, and nothing else there")


def _diagnose(arguments: argparse.Namespace) -> int:
    from viz_estim import diagnose
    from viz_estim.diagnosis.finding import CODES

    if arguments.codes:
        print(json.dumps(CODES, ensure_ascii=False) if arguments.json else diagnose.codes_text())
        return 0
    if arguments.file is None:
        raise BadInput("diagnose needs a recording: viz-estim diagnose FILE (or --codes)")
    from viz_estim.recording.reader import load

    out: Path | None = arguments.out
    if out:
        check_writable(out, suffix=".rrd")
        if out.exists() and out.samefile(arguments.file):
            raise BadInput(f"{out}: is the recording itself; choose another name for the copy")
    run = load(arguments.file)
    findings = diagnose.diagnose(run)
    if out:
        from viz_estim.recording import marks

        marks.write(arguments.file, out, run, diagnose.marks_of(findings), diagnose.markdown(run, findings))
    result = diagnose.to_json(findings)
    text = diagnose.text(findings) + (f"\n{out}: the recording with its findings marked" if out else "")
    print(json.dumps(printing.plain(result), allow_nan=False) if arguments.json else text)
    return int(any(finding.severity == "error" for finding in findings))
