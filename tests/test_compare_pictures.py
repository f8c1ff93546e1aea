"""What a real headless viewer shows of comparisons, for two to six runs, and of a diagnosis: every view draws, none is
empty, and the panels' links jump."""

import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import SHORTEST, Cli
from panels import assert_all_drawn

import viz_estim
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
SIZE = (760, 600)


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
    assert_all_drawn(viewer, SIZE, "time", AT[kind], tmp_path / "all.png")
    assert len(links(viewer)) == len(files) - 1
    viewer._client.open(links(viewer)[0])


def test_every_view_of_a_diagnosis_draws_and_its_links_jump(
    viewer: Viewer, cli: Cli, recording: Path, tmp_path: Path
) -> None:
    findings = json.loads(cli("diagnose", recording, "--out", tmp_path / "marked.rrd", "--json").out)["findings"]
    viewer.open(tmp_path / "marked.rrd")
    assert_all_drawn(viewer, SIZE, "time", 3.0, tmp_path / "marked.png")
    run = viz_estim.load(recording)
    for url, finding in list(zip(links(viewer), findings, strict=True))[:3]:
        assert url.startswith("rerun+http://127.0.0.1:")
        viewer._client.open(url)  # what the viewer does at a click
        expected = round(1e9 * run.time[run.row(step=finding["steps"][0])])
        deadline = time.monotonic() + 5
        while (now := cursor(viewer)) != ("time", expected) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert now == ("time", expected)


def links(viewer: Viewer) -> list[str]:
    """The addresses in the text panels of the recording in front."""
    texts = [fields.get("TextDocument", {}) for fields in viewer._client.get_blueprint().blueprint.values()]
    return [url for text in texts if text for url in re.findall(r"\]\(([^)]*)\)", text["text"])]


def cursor(viewer: Viewer) -> tuple[str, int]:
    state = viewer._client.get_state()
    (front,) = [recording for recording in state.recordings if recording.store_id == state.active_recording]
    return front.current_timeline, front.current_time
