"""What a real headless viewer shows of a run: every view draws, none is empty, and a stage shows what it alone drew."""

import copy
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli, strict
from PIL import Image

import viz_estim
from viz_estim.recording.viewer import Viewer
from viz_estim.scenarios import SCENARIOS

pytestmark = pytest.mark.draws

STEP = 300  # while it turns, and the gyro is alive
COLOURFUL = 40  # pixels that a line or a few points have at least; an empty view has axes and texts, all grey


@pytest.fixture(scope="module")
def viewer(recording: Path) -> Iterator[Viewer]:
    with Viewer.start(headless=True, size=(1200, 800)) as started:
        started.open(recording)
        yield started


def in_front(blueprint: dict[str, Any], item: str = "") -> list[str]:
    """The ids of the views that are on the screen: not those behind another tab."""
    root = blueprint["/viewport"]["ViewportBlueprint"]["root_container"]
    kind, _, name = (item or f"container/{root}").partition("/")
    if kind == "view":
        return [name]
    container = blueprint[f"/container/{name}"]["ContainerBlueprint"]
    tabs = container["container_kind"] == "Tabs"
    return [v for i in ([container["active_tab"]] if tabs else listed(container)) for v in in_front(blueprint, i)]


def listed(container: dict[str, Any]) -> list[str]:
    """What a container holds; of one thing alone Rerun gives that."""
    contents = container["contents"]
    return [contents] if isinstance(contents, str) else contents


@pytest.fixture(scope="module")
def layouts(viewer: Viewer) -> Iterator[list[dict[str, Any]]]:
    """The view's own blueprint, and the same with other tabs in front."""
    variants = with_each_tab(viewer)
    yield variants
    viewer._client.set_blueprint(variants[0], of="recording")


def with_each_tab(viewer: Viewer) -> list[dict[str, Any]]:
    """The view's own blueprint first, and others, so that each tab is in front in one of them."""
    blueprint = viewer._client.get_blueprint().blueprint
    containers = {path: fields.get("ContainerBlueprint", {}) for path, fields in blueprint.items()}
    tabs = {path: listed(c) for path, c in containers.items() if c.get("container_kind") == "Tabs"}
    variants = []
    for number in range(max(map(len, tabs.values()))):
        variants.append(copy.deepcopy(blueprint))
        for path, contents in tabs.items():
            variants[-1][path]["ContainerBlueprint"]["active_tab"] = contents[min(number, len(contents) - 1)]
    return variants


def picture(viewer: Viewer, view_id: str | None = None) -> np.ndarray:
    """A picture (height, width, 3) of a view without its heading, or of the whole viewer."""
    png = viewer._client.take_screenshot(view_id)
    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    return pixels if view_id is None else pixels[28:]


def emptiness(view_class: str, pixels: np.ndarray) -> str:
    """What a view lacks to be called drawn, or nothing."""
    if view_class == "TextDocument":
        return "" if (pixels.max(-1) > 120).mean() > 0.005 else "no text"
    pale = 25 if view_class == "StateTimeline" else 50  # lanes are in quiet colours
    colourful = int((pixels.max(-1) - pixels.min(-1) > pale).sum())
    return "" if colourful >= COLOURFUL else f"{colourful} pixels of any colour"


def assert_all_drawn(viewer: Viewer, layouts: list[dict[str, Any]], timeline: str, value: float, folder: Path) -> None:
    """At a moment, each view of each tab draws without a complaint, and shows something."""
    shown: set[str] = set()
    for layout in layouts:
        viewer._client.set_blueprint(layout, of="recording")
        viewer.seek(timeline, value)
        assert viewer.snapshot(folder / "settled.png")
        assert viewer.problems() == []
        front = in_front(layout)
        views = [view for view in viewer._client.get_state().views if view.view_id in front and view.name not in shown]
        assert all(view.visible for view in viewer._client.get_state().views)
        found = {view.name: emptiness(view.view_class, picture(viewer, view.view_id)) for view in views}
        assert not any(found.values()), {name: lack for name, lack in found.items() if lack}
        shown |= set(found)
    assert shown == {name for name, _, _ in viewer.views()}


@pytest.mark.parametrize("timeline", ["step", "time", "stage"])
def test_every_view_draws_and_none_is_empty(
    timeline: str, viewer: Viewer, layouts: list[dict[str, Any]], recording: Path, tmp_path: Path
) -> None:
    run = viz_estim.load(recording)
    value = {"step": STEP, "time": float(run.time[STEP]), "stage": run.at(STEP)[-1][0].place[STEP]}[timeline]
    assert_all_drawn(viewer, layouts, timeline, value, tmp_path)


@pytest.mark.parametrize("name", [name for name in SCENARIOS if not name.startswith("imu")])
def test_every_scenario_has_its_view(name: str, cli: Cli, tmp_path: Path) -> None:
    done = cli("run", name, "--out", tmp_path / "run.rrd", "--json")
    last = strict(done)["steps"] - 1
    with Viewer.start(headless=True, size=(1400, 1000)) as viewer:
        viewer.open(tmp_path / "run.rrd")
        viewer.seek("step", last)
        # Half-way through, at a step that has all stages.
        run = viz_estim.load(tmp_path / "run.rrd")
        rarest = min(run.stages.values(), key=lambda table: len(table.step) if table.name != "start" else last + 2)
        step = int(rarest.step[len(rarest.step) // 2])
        assert_all_drawn(viewer, with_each_tab(viewer), "step", step, tmp_path)


def test_a_stage_shows_its_own_sigma_points_and_no_other_s(
    viewer: Viewer, layouts: list[dict[str, Any]], recording: Path, tmp_path: Path
) -> None:
    run = viz_estim.load(recording)
    viewer._client.set_blueprint(layouts[0], of="recording")
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
