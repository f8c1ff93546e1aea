"""The command line: what a person types. Each command is a function of its parsed arguments."""

from __future__ import annotations

import argparse
import functools
import io
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from viz_estim import diagnosing, printing, progress
from viz_estim.debugger import commands as debugging
from viz_estim.errors import BadInput, one_line
from viz_estim.files import check_writable

_ENDINGS = {"tum": (".tum", ".txt"), "csv": (".csv",), "npz": (".npz",)}  # of what `export` writes


def main(argv: list[str] | None = None) -> int:
    """Runs one command; returns the exit code: 0 done, 1 the answer is "no", 2 wrong usage or bad input."""
    arguments = argparse.Namespace(records=False)
    try:
        _parser().parse_args(argv, arguments)
        command: Callable[[argparse.Namespace], int | None] = arguments.command
        with np.errstate(over="ignore", invalid="ignore"):  # the run ends at the step where that is seen
            return command(arguments) or 0
    except _Usage as error:
        return _refuse(str(error))
    except BadInput as error:
        return _refuse(str(error))
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output went away; nothing is left to say
        return 0
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(f"{where}{error.strerror or error}")
    except MemoryError as error:
        return _refuse(f"not enough memory ({error or 'out of memory'}); ask for less: fewer particles, a shorter run")
    except KeyboardInterrupt:
        # Commands that record say so among their options; others leave nothing.
        return _refuse(
            "interrupted" + arguments.records * "; what was recorded so far is in the .partial.rrd file", 130
        )
    except RuntimeError as error:
        from viz_estim.recording.viewer import ViewerError

        if isinstance(error, ViewerError):
            return _refuse(str(error))
        if "writer thread" in str(error):  # Rerun's word for a file that takes no more
            return _refuse("the recording cannot be written any further: is the disk full? Free some, or use --out")
        raise


def entry() -> NoReturn:
    """The console script."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal of another alphabet shows ? for σ
    sys.exit(main())


def _refuse(message: str, code: int = 2) -> int:
    print(f"viz-estim: {one_line(message)}", file=sys.stderr)
    return code


class _Usage(Exception):
    """Wrong usage: what argparse would print in several lines."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise _Usage(f"{message} (see {self.prog} --help)")


@functools.cache
def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="viz-estim", description="The debugger for state estimators.")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=_Parser)

    def command(name: str, function: Callable[[argparse.Namespace], int | None], text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(command=function)
        return sub

    p = command("list", _list, "every scenario: name, one line, its parameters")
    _json(p)
    p = command("run", _run, "run a scenario and record it")
    p.set_defaults(records=True)
    p.add_argument("scenario", metavar="SCENARIO", help="a name (see list) or FILE.py:function")
    _inputs(p)
    p.add_argument("--out", type=Path, metavar="FILE", help="the recording (default: recordings/SCENARIO….rrd)")
    p.add_argument("--every", type=int, default=1, metavar="N", help="draw sigma points at every N-th step only")
    p.add_argument("--open", action="store_true", help="open the recording when it is done")
    p.add_argument("--live", action="store_true", help="watch it in a viewer while it runs")
    _json(p)
    p = command("open", _open, "open recordings in the viewer")
    p.add_argument("files", nargs="+", type=Path, metavar="FILE")
    p.add_argument("--web", action="store_true", help="in a browser, served on this machine alone")
    p = command("show", _show, "what a recording holds; with a step, every stage's numbers")
    p.add_argument("file", type=Path, metavar="FILE")
    _moment(p)
    _json(p)
    p = command("snapshot", _snapshot, "a picture of the viewer at a moment, drawn without a display")
    p.add_argument("file", type=Path, metavar="FILE")
    _moment(p).add_argument("--stage", type=int, metavar="N", help="place on the stage timeline")
    p.add_argument("--size", type=_size, default=(1600, 1000), metavar="WxH")
    p.add_argument("-o", "--out", type=Path, required=True, metavar="PNG")
    p = command("compare", _compare, "runs side by side in one recording, and their figures in one table")
    p.add_argument("files", nargs="+", type=Path, metavar="FILE")
    p.add_argument("--out", type=Path, metavar="FILE", help="the recording (default: recordings/compare-….rrd)")
    p.add_argument("--tol", type=float, default=1e-9, metavar="X", help="what differs by more is a difference")
    p.add_argument("--open", action="store_true", help="open the recording when it is done")
    _json(p)
    diagnosing.add(command)
    debugging.add(command, _inputs, progress.counter)
    p = command("calibrate", _calibrate, "fit sensor constants or noise covariances to ground truth")
    p.add_argument("system", choices=["imu", "diffdrive"], metavar="imu|diffdrive")
    p.add_argument("--data", type=Path, action="append", required=True, metavar="PATH")
    p.add_argument(
        "--out", type=Path, metavar="FILE.json", help="what was found; a picture of it, if any, goes beside it, as .rrd"
    )
    _json(p)
    p = command("export", _export, "a recording for other tools")
    p.add_argument("file", type=Path, metavar="FILE")
    p.add_argument("--to", required=True, choices=list(_ENDINGS), metavar="tum|csv|npz")
    p.add_argument("-o", "--out", type=Path, required=True, metavar="OUT")
    p = command("simulate", _simulate, "write data files in the formats that the scenarios read")
    p.add_argument("system", metavar="SYSTEM")
    p.add_argument("--seed", type=int, default=0, metavar="N")
    p.add_argument("--set", action="append", default=[], metavar="K=V", dest="settings")
    p.add_argument("--out", type=Path, required=True, metavar="DIR")
    return parser


def _json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout, and nothing else there")


def _inputs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, action="append", metavar="PATH", help="a file or folder; may repeat")
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="constants that `calibrate` wrote")
    parser.add_argument("--set", action="append", default=[], metavar="K=V", dest="settings", help="a parameter")
    parser.add_argument("--seed", type=int, metavar="N", help="of the simulation; with --data, of the estimator")


def _moment(parser: argparse.ArgumentParser) -> Any:
    moment = parser.add_mutually_exclusive_group()
    moment.add_argument("--step", type=int, metavar="N")
    moment.add_argument("--time", type=float, metavar="S", help="seconds from the first stamp")
    return moment


def _size(text: str) -> tuple[int, int]:
    width, x, height = text.partition("x")
    if not (x and width.isdigit() and height.isdigit() and 200 <= int(width) <= 8192 and 200 <= int(height) <= 8192):
        raise argparse.ArgumentTypeError(f"{text}: expected WIDTHxHEIGHT in pixels, 200 to 8192, such as 1600x1000")
    return int(width), int(height)


def _list(arguments: argparse.Namespace) -> None:
    from viz_estim.running import find
    from viz_estim.scenarios import SCENARIOS

    sources = [find(name) for name in SCENARIOS]
    _print(printing.scenarios(sources), printing.scenarios_text, arguments.json)


def _run(arguments: argparse.Namespace) -> None:
    from viz_estim.recording.viewer import Viewer, open_files
    from viz_estim.running import execute, plan

    if arguments.every < 1:
        raise BadInput(f"--every {arguments.every}: expected a whole number from 1 on")
    planned = plan(
        arguments.scenario,
        data=arguments.data,
        calibration=arguments.calibration,
        settings=arguments.settings,
        seed=arguments.seed,
    )
    viewer = Viewer.start(headless=False) if arguments.live else None
    result = execute(
        planned,
        arguments.out,
        every=arguments.every,
        live=viewer.url if viewer else None,
        progress=progress.counter(),
    )
    if viewer:
        viewer.detach()
    _print(result, printing.result_text, arguments.json)
    if arguments.open:
        open_files([Path(result["recording"])])


def _open(arguments: argparse.Namespace) -> None:
    from viz_estim.recording.viewer import open_files

    open_files(arguments.files, web=arguments.web)


def _show(arguments: argparse.Namespace) -> None:
    from viz_estim.recording.reader import load

    run = load(arguments.file, points=arguments.step is not None or arguments.time is not None)
    if arguments.step is None and arguments.time is None:
        _print(printing.overview(run), printing.overview_text, arguments.json)
    else:
        row = run.row(step=arguments.step, time=arguments.time)
        _print(printing.step(run, row), lambda shown: printing.step_text(run, shown), arguments.json)


def _snapshot(arguments: argparse.Namespace) -> None:
    from viz_estim.recording.reader import NotARun
    from viz_estim.recording.viewer import ViewerError, snapshot

    check_writable(arguments.out, suffix=".png")
    try:
        timeline, value = _asked(arguments)
    except NotARun:  # such as a calibration's picture: the viewer knows its moments
        given = {"step": arguments.step, "time": arguments.time, "stage": arguments.stage}
        timeline, value = next(((name, v) for name, v in given.items() if v is not None), ("time", None))
    progress.working("drawing")
    try:
        problems = snapshot(arguments.file, arguments.out, timeline=timeline, value=value, size=arguments.size)
    except ViewerError as error:
        known = str(error).startswith(str(arguments.file))
        raise error if known else ViewerError(f"{arguments.file}: {error}") from error
    for problem in problems:
        print(f"viz-estim: {problem}", file=sys.stderr)
    print(arguments.out)


def _asked(arguments: argparse.Namespace) -> tuple[str, float | None]:
    """The moment of a run that a person asked for, on the timeline they named; its last step if they named none."""
    from viz_estim.recording.reader import load

    run = load(arguments.file, points=False)
    if arguments.stage is not None:
        return "stage", run.place(arguments.stage)
    if arguments.time is not None:
        # The step's own stamp is where a row surely lies.
        return "time", float(run.time[run.row(time=arguments.time)])
    return "step", int(run.step[-1] if arguments.step is None else run.step[run.row(step=arguments.step)])


def _compare(arguments: argparse.Namespace) -> int:
    from viz_estim.compare import compare
    from viz_estim.recording.viewer import open_files

    progress.working("comparing")
    result, text = compare(arguments.files, arguments.out, arguments.tol)
    _print(result, lambda _: text, arguments.json)
    if arguments.open:
        open_files([Path(result["recording"])])
    return 0 if result["same"] else 1


def _calibrate(arguments: argparse.Namespace) -> None:
    from viz_estim.calibrating import calibrate

    progress.working("fitting")
    result = calibrate(arguments.system, arguments.data, arguments.out)
    _print(result, printing.calibration_text, arguments.json)


def _export(arguments: argparse.Namespace) -> None:
    from viz_estim.export import export
    from viz_estim.recording.reader import load

    endings = _ENDINGS[arguments.to]
    if arguments.out.suffix not in endings:  # else a slip would write over a recording, or over data
        raise BadInput(f"{arguments.out}: the output of --to {arguments.to} must end in {' or '.join(endings)}")
    check_writable(arguments.out)
    for path in export(load(arguments.file), arguments.to, arguments.out):
        print(path)


def _simulate(arguments: argparse.Namespace) -> None:
    from viz_estim.simulating import simulate

    progress.working("simulating")
    for path in simulate(arguments.system, arguments.settings, arguments.seed, arguments.out):
        print(path)


def _print(value: dict[str, Any], text: Callable[[Any], str], as_json: bool) -> None:
    print(json.dumps(printing.plain(value), allow_nan=False) if as_json else text(value))
