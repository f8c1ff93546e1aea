"""How long a person waits in the debugger: `python tests/bench/debugger.py` prints a table.

Never a test: machines differ. The viewer's row needs a graphics card, or Mesa's software renderer.
"""

from __future__ import annotations

import contextlib
import io
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from viz_estim.cli import main as command_line
from viz_estim.core.run import run
from viz_estim.debugger import branches, forking
from viz_estim.debugger.branches import Branch
from viz_estim.debugger.live import Live
from viz_estim.debugger.recorded import Recorded
from viz_estim.debugger.screen import Screen
from viz_estim.debugger.session import Session
from viz_estim.recording.viewer import Viewer
from viz_estim.running import plan

ROUNDS = 3
DURATION = 960  # s of imu-ukf at 104 Hz: some 100 000 steps
Row = tuple[str, str]


def timed(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def do(session: Session, *commands: str) -> None:
    for command in commands:
        session.onecmd(command)


def through_a_recording(folder: Path) -> Row:
    path = folder / "long.rrd"
    with contextlib.redirect_stdout(io.StringIO()):
        command_line(["run", "imu-ukf", "--seed", "3", "--set", f"data.duration={DURATION}", "--out", str(path)])
    source = Recorded(path)
    session = Session(Branch(1, "long", 0, None, source), Screen(None), io.StringIO(), io.StringIO())
    do(session, "break nis.accel > 1e9")
    taken = []
    for _ in range(ROUNDS):
        session.place = 0
        taken.append(timed(lambda: do(session, "continue")))
    return f"continue through {len(source.run.step)} recorded steps", f"{min(taken):.2f} s (≤ 0.5)"


def live(screen: Screen) -> tuple[Session, object, int]:
    made = plan("imu-ukf", data=None, calibration=None, settings=["data.duration=6"], seed=3)
    part = forking.Part(0, made, made.build())
    branch = branches.of_parts(1, "live", [part], Live(part.scenario, made.seed), screen, None)
    return Session(branch, screen, io.StringIO(), io.StringIO()), part.scenario, made.seed


def a_step() -> Row:
    session, scenario, seed = live(Screen(None))
    do(session, "break nis.accel > 1e9", "display mean", "step")

    def bare() -> None:
        for _ in zip(range(100), run(scenario, seed), strict=False):  # type: ignore[arg-type]
            pass

    extra = min((timed(lambda: do(session, *["step"] * 100)) - timed(bare)) / 100 for _ in range(ROUNDS))
    return "a step, beyond the filter's own", f"{1e3 * extra:.2f} ms (≤ 2)"


def the_cursor() -> Row:
    with Viewer.start(headless=True, size=(600, 400)) as viewer:
        screen = Screen(viewer)
        session, *_ = live(screen)
        session.stop()
        taken = []
        for command in ["step", "stage", "step 5", "back 2", "goto 30", "step 3"]:
            taken.append(timed(lambda command=command: (do(session, command), screen.settle(20))))  # type: ignore[misc]
        for branch in session.branches:
            if branch.file:
                branch.file.close()
    return "a command until the viewer's cursor stands", f"{statistics.median(taken):.2f} s (≤ 0.5)"


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)  # branches are recorded where one is
        for what, figure in (a_step(), the_cursor(), through_a_recording(Path(name))):
            print(f"  {what:45} {figure}", flush=True)


if __name__ == "__main__":
    main()
