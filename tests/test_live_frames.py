"""A step that is done and shown in the debugger makes the frame of each place once, however often it is asked for."""

import io
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from viz_estim.debugger import branches, forking, live
from viz_estim.debugger.live import Live
from viz_estim.debugger.screen import Screen
from viz_estim.debugger.session import Session
from viz_estim.running import plan


def test_a_step_makes_each_frame_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # branches are recorded where one is
    made = plan("landmarks-ekf", data=None, calibration=None, settings=["data.duration=3"], seed=3)
    part = forking.Part(0, made, made.build())
    branch = branches.of_parts(1, "live", [part], Live(part.scenario, made.seed), Screen(None), None)
    session = Session(branch, Screen(None), io.StringIO(), io.StringIO())
    counted: Counter[int] = Counter()
    frame_of = live.frame_of

    def counting(step: Any, index: int, before: Any, place: int, scenario: Any) -> Any:
        counted[place] += 1
        return frame_of(step, index, before, place, scenario)

    monkeypatch.setattr(live, "frame_of", counting)
    for command in ["display mean", *["step"] * 5]:
        session.onecmd(command)
    assert session.step == 5
    assert 0 < sum(counted.values()) <= 2 * 5 + 2
    first = session.frame
    session.onecmd("back 1")
    session.onecmd("step")
    assert session.frame.place == first.place
    assert (session.frame.values["mean"] == first.values["mean"]).all()
