"""What a real headless viewer shows of a comparison: every view draws, and none is empty, for two to six runs."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import SHORTEST, Cli
from test_pictures import emptiness, picture

from viz_estim.recording.viewer import Viewer

pytestmark = pytest.mark.draws

_IMU = ["imu-ukf-gyro", *(f"--set={setting}" for setting in SHORTEST), "--seed", "3"]
_DRIVE = ["diffdrive-ekf", "--set=data.duration=3", "--seed", "1"]
_BAYES = ["underwater-bayes", "--set=data.steps=40", "--seed", "1"]
_CLOUD = ["beacons-pf", "--set=particles=200", "--set=data.duration=3", "--seed", "1"]
KINDS: dict[str, list[list[str]]] = {
    "attitudes": [_IMU, ["imu-gyro", *_IMU[1:]]],
    "six robots": [[*_DRIVE, f"--set=gps_noise={noise}"] for noise in (0.2, 0.5, 1, 2, 4, 8)],
    "three bars": [_BAYES, [*_BAYES, "--set=stay=0.7"], [*_BAYES, "--set=hazard=0.6"]],
    "clouds": [_CLOUD, [*_CLOUD, "--set=range_noise=2"]],
}
AT = {"attitudes": 2.5, "six robots": 2.0, "three bars": 30.0, "clouds": 2.0}
SIZE, HEAD, FOOT = (1400, 1000), 31, 28  # a window, and what the viewer takes of it above and below the views


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    with Viewer.start(headless=True, size=SIZE) as started:
        yield started


@pytest.mark.parametrize("kind", KINDS)
def test_every_view_of_a_comparison_draws_and_none_is_empty(
    kind: str, viewer: Viewer, cli: Cli, tmp_path: Path
) -> None:
    files = [tmp_path / f"{'abcdef'[i]} {kind}.rrd" for i in range(len(KINDS[kind]))]
    for arguments, file in zip(KINDS[kind], files, strict=True):
        assert cli("run", *arguments, "--out", file).code == 0
    assert cli("compare", *files, "--out", tmp_path / "all.rrd").code == 1
    viewer.open(tmp_path / "all.rrd")
    cells = side_by_side(viewer)
    viewer.seek("time", AT[kind])
    assert viewer.snapshot(tmp_path / "settled.png")
    assert viewer.problems() == []
    assert len(viewer.views()) == len(cells)
    pixels = picture(viewer)
    lacks = {name: emptiness(kind, pixels[rows, columns]) for name, kind, rows, columns in cells}
    assert not any(lacks.values()), {name: lack for name, lack in lacks.items() if lack}


def side_by_side(viewer: Viewer) -> list[tuple[str, str, slice, slice]]:
    """Puts all views of all tabs into one grid; each one's name and class, and the pixels that it has for itself."""
    blueprint = viewer._client.get_blueprint().blueprint
    views = [path.lstrip("/") for path, fields in blueprint.items() if "ViewBlueprint" in fields]
    across = int(np.ceil(np.sqrt(len(views))))
    down = -(-len(views) // across)
    root = blueprint["/viewport"]["ViewportBlueprint"]["root_container"]
    kept = {path: fields for path, fields in blueprint.items() if not path.startswith("/container/")}
    grid = {"container_kind": "Grid", "contents": views, "grid_columns": across}
    viewer._client.set_blueprint(kept | {f"/container/{root}": {"ContainerBlueprint": grid}}, of="recording")
    width, height = SIZE[0] / across, (SIZE[1] - HEAD - FOOT) / down
    cells = []
    for i, path in enumerate(views):
        view = blueprint[f"/{path}"]["ViewBlueprint"]
        x, y = i % across * width, HEAD + i // across * height
        rows, columns = slice(int(y) + 28, int(y + height) - 2), slice(int(x) + 2, int(x + width) - 2)
        cells.append((view["display_name"], view["class_identifier"], rows, columns))
    return cells
