"""The command line's `debug` and `fork`: their options, and what they call."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

Function = Callable[[argparse.Namespace], int | None]


def add(
    command: Callable[[str, Function, str], argparse.ArgumentParser],
    inputs: Callable[[argparse.ArgumentParser], None],
    progress: Callable[[], Any],
) -> None:
    """Registers both; inputs: adds the options that `run` has too; progress: makes what shows a count."""
    p = command("debug", _debug, "step through a filter or a recording, look inside, change it, go on")
    p.add_argument("run", metavar="SCENARIO|FILE", help="a name (see list), FILE.py:function, or a recording")
    inputs(p)
    p.add_argument("--no-viewer", action="store_true", help="over a plain terminal, without a viewer beside it")

    def fork(arguments: argparse.Namespace) -> None:
        from viz_estim import printing
        from viz_estim.debugger.forking import fork as run_again

        result = run_again(arguments.file, arguments.at, arguments.settings, arguments.out, progress())
        print(printing.result_text(result))

    p = command("fork", fork, "the same run again, with other estimator parameters from a step on")
    p.set_defaults(records=True)
    p.add_argument("file", type=Path, metavar="FILE")
    p.add_argument("--at", type=int, required=True, metavar="STEP")
    p.add_argument("--set", action="append", required=True, metavar="K=V", dest="settings", help="a parameter")
    p.add_argument("--out", type=Path, metavar="FILE", help="the recording (default: FILE-forkSTEP.rrd)")


def _debug(arguments: argparse.Namespace) -> None:
    # A viewer that a person closes is no error: the session says so itself. Rerun reads this when it is imported.
    os.environ.setdefault("RUST_LOG", "warn,re_grpc_client=off,re_sdk=off")
    from viz_estim.debugger.session import debug

    debug(
        arguments.run,
        data=arguments.data,
        calibration=arguments.calibration,
        settings=arguments.settings,
        seed=arguments.seed,
        viewer=not arguments.no_viewer,
        stdin=sys.stdin,
        stdout=sys.stdout,
    )
