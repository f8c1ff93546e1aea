"""What a real headless viewer shows of a run: every view draws, none is empty, and a stage shows what it alone drew."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import SHORT, Cli, strict
from panels import assert_all_drawn, emptiness, picture

import viz_estim
from viz_estim.parameters import parameters
from viz_estim.recording.viewer import Viewer
from viz_estim.running import find
from viz_estim.scenarios import SCENARIOS

pytestmark = pytest.mark.draws

STEP = 300  # while it turns, and the gyro is alive
SIZE = (1600, 1100)
DURATIONS = ["data.duration=20", "data.steps=60", "data.points=1500", "particles=400", "by=imu-gyro"]


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with Viewer.start(headless=True, size=SIZE) as started:
        yield started


@pytest.mark.parametrize("timeline", ["step", "time", "stage"])
def test_every_view_draws_and_none_is_empty(timeline: str, viewer: Viewer, recording: Path, tmp_path: Path) -> None:
    run = viz_estim.load(recording)
    value = {"step": STEP, "time": float(run.time[STEP]), "stage": run.at(STEP)[-1][0].place[STEP]}[timeline]
    viewer.open(recording)
    assert_all_drawn(viewer, SIZE, timeline, value, tmp_path / "settled.png")


@pytest.mark.parametrize("name", [name for name in SCENARIOS if not name.startswith("imu")])
def test_every_scenario_has_its_view(name: str, viewer: Viewer, cli: Cli, tmp_path: Path) -> None:
    source = find(name)
    assert source.data
    known = parameters(source.scenario) | {f"data.{k}": v for k, v in parameters(source.data).items()}
    shorter = [f"--set={s}" for s in [*SHORT[1:], *DURATIONS] if s.partition("=")[0] in known]
    strict(cli("run", name, "--seed", 1, *shorter, "--out", tmp_path / "run.rrd", "--json"))
    # Half-way through, at a step that has all stages.
    run = viz_estim.load(tmp_path / "run.rrd")
    rarest = min((t for t in run.stages.values() if t.name != "start"), key=lambda table: len(table.step))
    viewer.open(tmp_path / "run.rrd")
    step = int(rarest.step[len(rarest.step) // 2])
    assert_all_drawn(viewer, SIZE, "step", step, tmp_path / "settled.png")


def test_a_stage_shows_its_own_sigma_points_and_no_other_s(viewer: Viewer, recording: Path, tmp_path: Path) -> None:
    run = viz_estim.load(recording)
    viewer.open(recording)
    taken = []
    world = next(v.view_id for v in viewer._client.get_state().views if v.origin == "/attitude")
    sensor = next(v.view_id for v in viewer._client.get_state().views if v.origin == "/sensors/accel")
    for table, row in run.at(STEP):
        viewer.seek("stage", int(table.place[row]))
        assert viewer.snapshot(tmp_path / "settled.png")
        taken.append((table.name, picture(viewer, world), picture(viewer, sensor)))
    assert [name for name, *_ in taken] == ["predict", "update"]
    (_, world_before, sensor_before), (_, world_after, sensor_after) = taken
    assert (np.abs(world_before - world_after).max(-1) > 20).sum() > 20  # points drawn from the belief, or propagated
    assert emptiness("3D", sensor_before) == "0 pixels of any colour"
    assert emptiness("3D", sensor_after) == ""
    table, row = run.at(STEP)[0]
    viewer.seek("stage", int(table.place[row]))
    assert viewer.snapshot(tmp_path / "settled.png")
    np.testing.assert_array_equal(picture(viewer, world), world_before)
    np.testing.assert_array_equal(picture(viewer, sensor), sensor_before)
