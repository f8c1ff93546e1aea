"""What a real headless viewer shows of a run: every view draws, none is empty, and a stage shows what it alone drew."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import SHORT, Cli, strict
from panels import assert_all_drawn, emptiness, side_by_side
from PIL import Image

import viz_estim
from viz_estim.parameters import parameters
from viz_estim.recording.viewer import Viewer
from viz_estim.running import find
from viz_estim.scenarios import SCENARIOS

pytestmark = pytest.mark.draws

STEP = 300  # while it turns, and the gyro is alive
SIZE = (840, 800)  # drawn without a graphics card, every pixel costs
WORLD_AND_SENSOR = ("/attitude", "/sensors/accel")  # where two views look
BRIEF = [*SHORT, "data.steps=60", "data.points=1500", "particles=400", "by=imu-gyro"]


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
    shorter = [f"--set={s}" for s in BRIEF if s.partition("=")[0] in known]
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
    cells = side_by_side(viewer, SIZE)

    def drawn(place: int) -> dict[str, np.ndarray]:
        """By the view's name, its pixels at a stage."""
        viewer.seek("stage", place)
        assert viewer.snapshot(tmp_path / "settled.png")
        pixels = np.asarray(Image.open(tmp_path / "settled.png").convert("RGB")).astype(int)
        return {name: pixels[rows, columns] for name, _, rows, columns in cells}

    tables = run.at(STEP)
    assert [table.name for table, _ in tables] == ["predict", "update"]
    places = [int(table.place[row]) for table, row in tables]
    before, after, again = drawn(places[0]), drawn(places[1]), drawn(places[0])
    world, sensor = (next(v.name for v in viewer._client.get_state().views if v.origin == o) for o in WORLD_AND_SENSOR)
    assert (np.abs(before[world] - after[world]).max(-1) > 20).sum() > 20  # points of the belief, or propagated
    assert emptiness("3D", before[sensor]) == "0 pixels of any colour"
    assert emptiness("3D", after[sensor]) == ""
    np.testing.assert_array_equal(again[world], before[world])
    np.testing.assert_array_equal(again[sensor], before[sensor])
