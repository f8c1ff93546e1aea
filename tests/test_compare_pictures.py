"""What a real headless viewer shows of a comparison: every view draws, and none is empty, for two to six runs."""

import copy
from pathlib import Path
from typing import Any

import pytest
from conftest import SHORT, Cli
from test_pictures import emptiness, in_front, picture

from viz_estim.recording.viewer import Viewer

pytestmark = pytest.mark.draws

_IMU = ["imu-ukf-gyro", *(f"--set={setting}" for setting in SHORT), "--seed", "3"]
_DRIVE = ["diffdrive-ekf", "--set=data.duration=4", "--seed", "1"]
_BAYES = ["underwater-bayes", "--set=data.steps=60", "--seed", "1"]
_CLOUD = ["beacons-pf", "--set=particles=200", "--seed", "1"]
KINDS: dict[str, list[list[str]]] = {
    "attitudes": [_IMU, ["imu-gyro", *_IMU[1:]]],
    "six robots": [[*_DRIVE, f"--set=gps_noise={noise}"] for noise in (0.2, 0.5, 1, 2, 4, 8)],
    "three bars": [_BAYES, [*_BAYES, "--set=stay=0.7"], [*_BAYES, "--set=hazard=0.6"]],
    "clouds": [_CLOUD, [*_CLOUD, "--set=range_noise=2"]],
}
AT = {"attitudes": 3.5, "six robots": 2.0, "three bars": 30.0, "clouds": 2.0}


@pytest.fixture(scope="module", params=KINDS)
def compared(request: pytest.FixtureRequest, cli: Cli, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    folder = tmp_path_factory.mktemp("compared")
    files = [folder / f"{'abcdef'[i]}.rrd" for i in range(len(KINDS[request.param]))]
    for arguments, file in zip(KINDS[request.param], files, strict=True):
        assert cli("run", *arguments, "--out", file).code == 0
    assert cli("compare", *files, "--out", folder / "all.rrd").code == 1
    return request.param, folder / "all.rrd"


def layouts(blueprint: dict[str, Any]) -> list[dict[str, Any]]:
    """The view's own blueprint, and the same with other tabs in front, so that each is in front in one of them."""
    containers = {path: fields.get("ContainerBlueprint", {}) for path, fields in blueprint.items()}
    tabs = {path: c["contents"] for path, c in containers.items() if c.get("container_kind") == "Tabs"}
    variants = []
    for number in range(max(map(len, tabs.values()))):
        variants.append(copy.deepcopy(blueprint))
        for path, contents in tabs.items():
            variants[-1][path]["ContainerBlueprint"]["active_tab"] = contents[min(number, len(contents) - 1)]
    return variants


def test_every_view_of_a_comparison_draws_and_none_is_empty(compared: tuple[str, Path], tmp_path: Path) -> None:
    kind, path = compared
    with Viewer.start(headless=True, size=(1100, 750)) as viewer:
        viewer.open(path)
        shown: set[str] = set()
        for layout in layouts(viewer._client.get_blueprint().blueprint):
            viewer._client.set_blueprint(layout, of="recording")
            viewer.seek("time", AT[kind])
            assert viewer.snapshot(tmp_path / "settled.png")
            assert viewer.problems() == []
            front = in_front(layout)
            views = [v for v in viewer._client.get_state().views if v.view_id in front and v.view_id not in shown]
            lacks = {view.name: emptiness(view.view_class, picture(viewer, view.view_id)) for view in views}
            assert not any(lacks.values()), {name: lack for name, lack in lacks.items() if lack}
            shown |= {view.view_id for view in views}
        assert shown == {view.view_id for view in viewer._client.get_state().views}
