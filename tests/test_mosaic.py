"""The mosaic: projection against a slow transcription, what is shared and kept, its files, what a recording shows."""

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from conftest import Cli, strict
from PIL import Image
from rerun.chunk import RrdReader

from viz_estim.core import quaternions
from viz_estim.core.mosaic import Mosaic, Paint, Painter
from viz_estim.core.panoramas import (
    HEIGHT,
    blank,
    directions,
    paint,
    place_on,
    rays,
    sample,
    seen_from,
    similarity,
    unrolled,
)
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Step, Tick, run
from viz_estim.core.scenery import Camera
from viz_estim.errors import BadInput
from viz_estim.scenarios import camera, camera_files, imu
from viz_estim.scenarios.camera_simulation import draw_panorama, take_pictures

FOV = (np.radians(60.0), np.radians(45.0))
DATA = Path(__file__).parents[1] / "data" / "camera"
RNG = np.random.default_rng
SMALL = {"duration": 6.0, "still": 1.0, "freeze": 0.0, "rate_hz": 4.0, "width": 32}


@pytest.fixture(scope="module")
def data() -> camera.CameraData:
    return camera.camera(None, RNG(1), **SMALL)


@pytest.fixture(scope="module")
def files(data: camera.CameraData, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("camera")
    camera.save(data, folder)
    return folder


def attitudes(count: int, seed: int = 0) -> Array:
    """Any attitudes, and those where a projection may trip: level, upside down, straight up and down, backwards."""
    named = np.array([[0, 0, 0], [np.pi, 0, 0], [0, -np.pi / 2, 0], [0.3, np.pi / 2, 0], [0, 0, np.pi], [0.2, 0.1, 3]])
    return np.concatenate([quaternions.from_euler(named), quaternions.normalise(RNG(seed).normal(size=(count, 4)))])


def noise(rows: int = 30, columns: int = 40, seed: int = 0) -> Any:
    return RNG(seed).integers(0, 256, (rows, columns, 3), dtype=np.uint8)


def last(scenario: Scenario) -> Step:
    *_, step = run(scenario)
    assert step.error is None
    return step


# Projection


def naive_pixel(picture: Any, q: Array, row: int, column: int) -> tuple[Array, float]:
    """Colour and weight that a picture gives to one pixel of the canvas: the geometry written out."""
    elevation, azimuth = np.pi / 2 - np.pi * (row + 0.5) / HEIGHT, np.pi - np.pi * (column + 0.5) / HEIGHT
    world = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    x, y, z = quaternions.rotate(quaternions.conjugate(q), world)
    left, up = np.arctan2(y, x), np.arctan2(z, x)
    if x <= 0 or abs(left) >= FOV[0] / 2 or abs(up) >= FOV[1] / 2:
        return np.zeros(3), 0.0
    a, b = -np.tan(left) / np.tan(FOV[0] / 2), -np.tan(up) / np.tan(FOV[1] / 2)
    rows, columns = picture.shape[:2]
    v, u = min(max((b + 1) / 2 * rows - 0.5, 0), rows - 1), min(max((a + 1) / 2 * columns - 0.5, 0), columns - 1)
    i, j = min(int(v), rows - 2), min(int(u), columns - 2)
    p = picture.astype(float)
    top = p[i, j] + (u - j) * (p[i, j + 1] - p[i, j])
    bottom = p[i + 1, j] + (u - j) * (p[i + 1, j + 1] - p[i + 1, j])
    return top + (v - i) * (bottom - top), (1 - abs(a)) * (1 - abs(b))


@pytest.mark.parametrize("q", attitudes(4), ids=lambda q: str(np.round(q, 2)))
def test_painting_is_what_a_loop_over_pixels_does(q: Array) -> None:
    pictures, tiles = [noise(seed=1), noise(seed=2)], blank()
    turned = quaternions.multiply(q, quaternions.exp(np.array([0.1, 0.2, -0.1])))
    for picture, attitude in zip(pictures, (q, turned), strict=True):
        tiles, _ = paint(tiles, picture, attitude, FOV)
    canvas, seen = unrolled(tiles)
    rows, columns = np.nonzero(seen)
    picked = RNG(0).choice(len(rows), 60, replace=False)
    anywhere = RNG(1).integers(0, [HEIGHT, 2 * HEIGHT], (60, 2))
    for row, column in [*zip(rows[picked], columns[picked], strict=True), *anywhere]:
        both = [naive_pixel(p, a, row, column) for p, a in zip(pictures, (q, turned), strict=True)]
        weight = sum(w for _, w in both)
        assert seen[row, column] == (weight > 0)
        if weight > 1e-6:
            np.testing.assert_allclose(canvas[row, column], sum(w * c for c, w in both) / weight, atol=0.51)


def test_a_direction_and_its_place_on_the_canvas_are_each_other_s_inverse() -> None:
    row, column = np.moveaxis(place_on(HEIGHT, directions(HEIGHT)), -1, 0)
    np.testing.assert_allclose(row, np.broadcast_to(np.arange(HEIGHT)[:, None], row.shape), atol=1e-9)
    np.testing.assert_allclose(column, np.broadcast_to(np.arange(2 * HEIGHT), column.shape), atol=1e-9)


def test_the_left_of_a_picture_is_to_the_left_and_its_top_is_up() -> None:
    centre, left, top = rays(np.array([0, -1, 0]), np.array([0, 0, -1]), FOV)
    np.testing.assert_allclose(centre, [1, 0, 0])
    np.testing.assert_allclose(np.arctan2(left[1], left[0]), FOV[0] / 2)
    np.testing.assert_allclose(np.arctan2(top[2], top[0]), FOV[1] / 2)


def test_sampling_is_exact_on_pixels_linear_between_and_goes_around() -> None:
    picture = noise(5, 7)
    at = np.stack(np.mgrid[:5, :7], axis=-1).astype(float)
    np.testing.assert_array_equal(sample(picture, at), picture)
    np.testing.assert_allclose(sample(picture, at[:-1, :-1] + 0.5), sum(
        picture[i : 4 + i, j : 6 + j].astype(float) for i in (0, 1) for j in (0, 1)) / 4)  # fmt: skip
    np.testing.assert_array_equal(sample(picture, np.array([-9.0, 99.0])), picture[0, -1])
    seam = (picture[2, -1].astype(float) + picture[2, 0]) / 2
    np.testing.assert_allclose(sample(picture, np.array([[2.0, 6.5], [2.0, -0.5]]), around=True), [seam, seam])


@pytest.mark.parametrize("q", attitudes(6, seed=3), ids=lambda q: str(np.round(q, 2)))
def test_what_a_camera_saw_is_put_back_where_it_was(q: Array) -> None:
    world = directions(HEIGHT)
    smooth = np.round(127 + 100 * np.stack([world[..., 0], world[..., 1], world[..., 2]], axis=-1)).astype(np.uint8)
    tiles, mismatch = paint(blank(), seen_from(smooth, q, (90, 120), FOV), q, FOV)
    assert similarity(tiles, smooth)["psnr_db"] > 50
    assert mismatch == 0
    wrong = quaternions.multiply(q, quaternions.exp(np.array([0, 0, 0.1])))
    assert similarity(paint(blank(), seen_from(smooth, q, (90, 120), FOV), wrong, FOV)[0], smooth)["psnr_db"] < 40


def test_a_camera_held_upside_down_paints_the_same_world() -> None:
    q = quaternions.from_euler(np.array([0.2, -0.1, 2.9]))
    over = quaternions.multiply(q, quaternions.exp(np.array([np.pi, 0, 0])))
    upright, turned = (unrolled(paint(blank(), p, a, FOV)[0]) for p, a in ((noise(), q), (noise()[::-1, ::-1], over)))
    assert np.abs(upright[0].astype(int) - turned[0]).max() <= 1
    assert (upright[1] != turned[1]).mean() < 1e-5


def test_a_picture_s_share_of_the_sphere_is_its_solid_angle() -> None:
    tiles, _ = paint(blank(), noise(), attitudes(1)[-1], FOV)
    slopes = np.tan(0.5 * np.array(FOV))
    solid = 4 * np.arcsin(np.prod(slopes / np.sqrt(1 + slopes**2)))
    assert similarity(tiles, noise(4, 8))["seen_percent"] == pytest.approx(100 * solid / (4 * np.pi), rel=0.01)


def test_painting_shares_what_it_leaves_changes_nothing_old_and_knows_no_order() -> None:
    empty = blank()
    one, _ = paint(empty, noise(seed=1), attitudes(0)[0], FOV)
    assert sum(a is not b for a, b in zip(empty, one, strict=True)) < 0.15 * len(one)
    assert not unrolled(empty)[1].any()
    both, other = (
        paint(paint(empty, noise(seed=a), attitudes(0)[a], FOV)[0], noise(seed=b), attitudes(0)[b], FOV)[0]
        for a, b in ((0, 5), (5, 0))
    )
    np.testing.assert_allclose(np.stack(both), np.stack(other), atol=1e-3)


def test_mismatch_is_the_difference_from_what_was_there() -> None:
    grey = np.full((30, 40, 3), 100, np.uint8)
    tiles, first = paint(blank(), grey, attitudes(0)[0], FOV)
    _, same = paint(tiles, grey, attitudes(0)[5], FOV)
    _, lighter = paint(tiles, grey + np.uint8(30), attitudes(0)[0], FOV)
    assert (first, round(same, 3)) == (0, 0)
    assert lighter == pytest.approx(30, abs=0.01)


def test_similarity_is_the_psnr_over_solid_angle() -> None:
    assert similarity(blank(), noise(4, 8)) == {}
    grey, true = np.full((30, 40, 3), 100, np.uint8), np.full((HEIGHT, 2 * HEIGHT, 3), 110, np.uint8)
    tiles, _ = paint(blank(), grey, attitudes(0)[0], FOV)
    assert similarity(tiles, true)["psnr_db"] == pytest.approx(20 * np.log10(255 / 10))
    true[: HEIGHT // 2] = 100  # the upper half is right: half the area, so half the squared error
    assert similarity(tiles, true)["psnr_db"] == pytest.approx(20 * np.log10(255 / 10) + 10 * np.log10(2), abs=0.05)


# The estimator and its scenario


def test_the_filter_is_as_it_is_without_a_camera(data: camera.CameraData) -> None:
    for by, alone in (("imu-gyro", imu.imu_gyro), ("imu-ukf-gyro", imu.imu_ukf_gyro)):
        with_it, without_it = camera.mosaic(data, by=by, initial="accel"), alone(data.imu)
        pair = (replace(scenario, ticks=scenario.ticks[:250]) for scenario in (with_it, without_it))
        for with_camera, without in zip(*map(run, pair), strict=True):
            stages = [stage for stage in with_camera.stages if not isinstance(stage, Paint)]
            assert [type(stage) for stage in stages] == [type(stage) for stage in without.stages]
            for mine, theirs in zip(stages, without.stages, strict=True):
                np.testing.assert_array_equal(mine.belief.mean, theirs.belief.mean)
                np.testing.assert_array_equal(mine.belief.cov, theirs.belief.cov)


def test_a_picture_lies_where_the_attitude_was_when_it_was_taken(data: camera.CameraData) -> None:
    """Between two ticks, on the way from one attitude to the next."""
    scenario = camera.mosaic(data, by="imu-gyro")
    space, rate, dt = scenario.space, np.array([0.4, -0.8, 0.5]), 0.2
    before = Mosaic(space, np.array([1.0, 0, 0, 0]), np.eye(3), blank())
    painter = Painter(imu.GyroIntegrator(0.01), Camera(noise()[None], FOV))
    for share in (0.25, 0.9, 1.0):
        tick = Tick(5.0, dt, rate, {"picture": np.array([0, 5.0 - (1 - share) * dt])})
        *_, stage = painter.step(before, tick, RNG(0))
        assert isinstance(stage, Paint)
        expected = quaternions.to_euler(quaternions.exp(share * dt * rate))
        np.testing.assert_allclose(stage.angles, expected, atol=1e-12)
        np.testing.assert_array_equal(stage.belief.mean, quaternions.exp(dt * rate))


def test_every_picture_within_the_data_is_painted_at_the_first_tick_after_it(data: camera.CameraData) -> None:
    steps = list(run(camera.mosaic(data, by="imu-gyro")))
    painted = [(step, stage) for step in steps for stage in step.stages if isinstance(stage, Paint)]
    assert [int(stage.picture[0]) for _, stage in painted] == list(range(len(data.stamps)))
    for step, stage in painted:
        assert data.imu.time[step.index - 1] < stage.picture[1] <= step.tick.time
        assert stage is step.stages[-1]


def test_the_same_run_again_paints_the_same_canvas(data: camera.CameraData) -> None:
    one, two = (last(camera.mosaic(data, by="imu-gyro")).stages[-1].belief.tiles for _ in range(2))
    np.testing.assert_array_equal(np.stack(one), np.stack(two))


def test_by_the_truth_no_picture_is_painted_where_the_truth_is_lost(data: camera.CameraData) -> None:
    lost = data.imu.truth.copy()
    lost[(data.imu.time > 2) & (data.imu.time < 3)] = np.nan
    gap = camera.CameraData(replace(data.imu, truth=lost), data.stamps, data.pictures, None, ())
    scenario = camera.mosaic(gap, by="truth")
    stamps = [s.picture[1] for step in run(scenario) for s in step.stages if isinstance(s, Paint)]
    assert stamps == [t for t in data.stamps if not 2 < t < 3]
    assert scenario.truth is None
    assert scenario.figures is not None
    assert scenario.figures(last(scenario)) == {}  # nobody knows the true world


def similarities(data: camera.CameraData, until: float, **parameters: Any) -> list[float]:
    """psnr_db by the truth, by the UKF and by the gyro alone."""
    found = []
    for by in ("truth", "imu-ukf-gyro", "imu-gyro"):
        scenario = replace(camera.mosaic(data, by=by, **parameters), until=lambda step: step.tick.time > until)
        assert scenario.figures is not None
        found.append(scenario.figures(last(scenario))["psnr_db"])
    return found


def test_the_world_is_like_itself_truth_before_ukf_before_gyro() -> None:
    found = similarities(camera.camera([DATA], RNG(0)), until=12)
    assert found[0] > 25 > 20 > found[1] > 18 > 16 > found[2]


def test_the_same_along_a_real_attitude(real_data: Path) -> None:
    made = camera.camera(None, RNG(0), along=str(real_data / "ese650" / "imuRaw1.mat"), rate_hz=2.0, width=80)
    found = similarities(made, until=18, frozen="reject")
    assert found[0] > 24 > 22 > found[1] > 18 > 16 > found[2]


# Files


def test_files_come_back_as_they_were_saved(data: camera.CameraData, files: Path) -> None:
    assert scipy.io.loadmat(files / "cam1.mat")["cam"].shape == (24, 32, 3, len(data.stamps))
    for source in ([files], [files / "imuRaw1.mat"], [files / "cam1.mat", files / "imuRaw1.mat"]):
        again = camera.camera(source, RNG(0))
        np.testing.assert_array_equal(again.pictures, data.pictures)
        np.testing.assert_allclose(again.stamps, data.stamps, atol=1e-6)  # Unix stamps resolve no finer
        np.testing.assert_array_equal(again.panorama, data.panorama)
        assert [f.name for f in again.files] == ["imuRaw1.mat", "viconRot1.mat", "cam1.mat", "panorama1.mat"]


def test_a_set_s_pictures_are_known_by_its_number_and_lie_beside_or_in_a_folder_of_their_own(
    files: Path, tmp_path: Path
) -> None:
    for name, source in (("imu/imuRaw7", "imuRaw1"), ("cam/cam7", "cam1"), ("cam/cam8", "cam1")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.mat").write_bytes((files / f"{source}.mat").read_bytes())
    found = camera_files.find([tmp_path / "imu"])
    assert found == camera_files.find([tmp_path / "cam", tmp_path / "imu"])
    assert (found.truth, found.panorama) == (None, None)
    assert found.camera == tmp_path / "cam" / "cam7.mat"
    # One camera file that is named itself is taken, whatever its number.
    named = camera_files.find([tmp_path / "imu" / "imuRaw7.mat", tmp_path / "cam" / "cam8.mat"])
    assert named.camera == tmp_path / "cam" / "cam8.mat"


def test_without_motion_capture_it_starts_level_and_says_so(files: Path, tmp_path: Path) -> None:
    for name in ("imuRaw1.mat", "cam1.mat"):
        (tmp_path / name).write_bytes((files / name).read_bytes())
    found = camera.camera([tmp_path], RNG(0))
    scenario = camera.mosaic(found)
    assert "starts with heading 0" in scenario.notes
    with pytest.raises(BadInput, match="by=truth needs motion capture"):
        camera.mosaic(found, by="truth")


def test_pictures_of_a_followed_set_take_its_number_and_leave_its_files(files: Path, tmp_path: Path) -> None:
    made = camera.camera(None, RNG(0), along=str(files / "imuRaw1.mat"), rate_hz=2.0, width=16)
    assert [path.name for path in camera.save(made, tmp_path)] == ["cam1.mat", "panorama1.mat"]
    again = camera.camera([files / "imuRaw1.mat", tmp_path], RNG(0))
    np.testing.assert_array_equal(again.pictures, made.pictures)
    with pytest.raises(BadInput, match="is there already"):
        camera.save(made, tmp_path)


def test_one_picture_in_whatever_case_and_type(files: Path, tmp_path: Path) -> None:
    cam = scipy.io.loadmat(files / "cam1.mat")
    scipy.io.savemat(tmp_path / "c.mat", {"CAM": cam["cam"][..., 0].astype(float), "Ts": cam["ts"][:, :1]})
    stamps, pictures = camera_files.load_pictures(tmp_path / "c.mat")
    assert (stamps.shape, pictures.shape, pictures.dtype) == ((1,), (1, 24, 32, 3), np.uint8)


def test_no_picture_is_taken_beside_an_unknown_attitude() -> None:
    stamps = np.arange(0, 2, 0.01)
    q = np.tile([1.0, 0, 0, 0], (200, 1))
    q[50:100] = np.nan
    times, pictures = take_pictures(draw_panorama(RNG(0)), stamps, q, rate_hz=10, shape=(3, 4))
    np.testing.assert_allclose(times, [t for t in np.arange(0.05, 1.99, 0.1) if not 0.49 < t < 1])
    assert pictures.shape == (len(times), 3, 4, 3)


def changed(**change: Callable[[np.ndarray], Any]) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        held = scipy.io.loadmat(folder / "cam1.mat")
        fields = {name: held[name] for name in ("cam", "ts")}
        fields |= {name: f(fields[name]) for name, f in change.items()}
        scipy.io.savemat(folder / "cam1.mat", {k: v for k, v in fields.items() if v is not None})

    return write


def cut(folder: Path) -> None:
    (folder / "cam1.mat").write_bytes((folder / "cam1.mat").read_bytes()[:2000])


def second(folder: Path) -> None:
    for name in ("cam2.mat", "cam3.mat"):
        (folder / name).write_bytes((folder / "cam1.mat").read_bytes())
    (folder / "cam1.mat").unlink()


def poked(values: np.ndarray, value: float) -> np.ndarray:
    values = values.astype(float)
    values[0, 0] = value
    return values


BAD = {
    "truncated": (cut, [], "cam1.mat: cannot be read"),
    "no pictures": (lambda folder: (folder / "cam1.mat").unlink(), [], "no camera file"),
    "pictures alone": (lambda folder: None, ["cam1.mat"], "no IMU file there"),
    "nowhere": (lambda folder: None, ["cam9.mat"], "cam9.mat: no such file"),
    "two sets of pictures": (second, [], "2 cam files found"),
    "a missing field": (changed(ts=lambda t: None), [], "no field `ts` (it holds cam)"),
    "grey pictures": (changed(cam=lambda c: c[:, :, :1]), [], "M×N×3×K"),
    "lengths that differ": (changed(ts=lambda t: t[:, :-1]), [], "must agree"),
    "NaN stamp": (changed(ts=lambda t: poked(t, np.nan)), [], "ts is not a number at sample 0"),
    "NaN colour": (changed(cam=lambda c: poked(c, np.nan)), [], "cam is not a number"),
    "colours up to 1": (changed(cam=lambda c: c / 255.0), [], "whole numbers from 0 to 255"),
    "colours beyond": (changed(cam=lambda c: poked(c, 300)), [], "whole numbers from 0 to 255"),
    "stamps that go back": (changed(ts=lambda t: t[:, ::-1]), [], "ts goes back"),
    "another clock": (changed(ts=lambda t: t + 1e5), [], "stamps agree"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_refused_in_one_line(what: str, cli: Cli, files: Path, tmp_path: Path) -> None:
    spoil, named, words = BAD[what]
    for file in files.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    spoil(tmp_path)
    source = [f"--data={tmp_path / name}" for name in named] or [f"--data={tmp_path}"]
    done = cli("run", "mosaic", *source, "--out", tmp_path / "out.rrd")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert words in done.err
    assert not (tmp_path / "out.rrd").exists()


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("horizontal_fov_deg=180", "fields of view"),
        ("vertical_fov_deg=0", "fields of view"),
        ("by=eye", "imu-gyro or imu-ukf-gyro or truth"),
        ("data.rate_hz=0", "rate_hz up to 100"),
        ("data.width=1", "width of 8 to 2000"),
        ("data.along=nowhere.mat", "nowhere.mat: no such file"),
    ],
)
def test_bad_parameters_are_refused_in_one_line(setting: str, words: str, cli: Cli, tmp_path: Path) -> None:
    source = ["--seed", 1] if setting.startswith("data.") else ["--data", DATA]
    done = cli("run", "mosaic", *source, "--set", setting, "--out", tmp_path / "out.rrd")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert words in done.err


# The recording


def rows(path: Path, entity: str) -> list[dict[str, Any]]:
    """The rows of an entity that stand on a timeline, in order."""
    found = []
    for chunk in RrdReader(path).stream().filter(content=[entity]):
        batch = chunk.to_record_batch()
        if "stage" in batch.schema.names:
            assert {"step", "time", "stage"} <= set(batch.schema.names)
            found += batch.drop_columns("time").to_pylist()  # in ns, which Python has not
    return sorted(found, key=lambda row: row["stage"])


@pytest.mark.parametrize("every", [1, 100])
def test_the_recording_shows_each_picture_where_it_lay(
    every: int, data: camera.CameraData, files: Path, cli: Cli, tmp_path: Path
) -> None:
    out = tmp_path / "out.rrd"
    ran = strict(cli("run", "mosaic", "--set=by=imu-gyro", "--data", files, "--every", every, "--out", out, "--json"))
    assert {"psnr_db", "seen_percent", "attitude_rmse_deg"} <= ran["metrics"].keys()
    painted = [
        (step, s) for step in run(camera.mosaic(data, by="imu-gyro")) for s in step.stages if isinstance(s, Paint)
    ]
    first = {step.index // every: (step, stage) for step, stage in reversed(painted)}
    expected = [first[turn] for turn in sorted(first)]
    canvases, pictures = rows(out, "/canvas/mosaic"), rows(out, "/attitude/camera/picture")
    frustums, frames = rows(out, "/attitude/camera"), rows(out, "/canvas/frame/estimate")
    steps = [step.index for step, _ in expected]
    assert all([row["step"] for row in found] == steps for found in (canvases, pictures, frustums, frames))
    _, stage = expected[-1]
    shown = np.asarray(Image.open(io.BytesIO(bytes(canvases[-1]["EncodedImage:blob"][0]))), float)
    assert np.abs(shown - unrolled(stage.belief.tiles)[0]).mean() < 4  # but for what JPEG loses
    x, y, z, w = frustums[-1]["Transform3D:quaternion"][0]
    np.testing.assert_allclose(np.abs(np.dot([w, x, y, z], quaternions.from_euler(stage.angles))), 1, atol=1e-6)
    corner = quaternions.rotate(quaternions.from_euler(stage.angles), rays(np.array(-1), np.array(-1), FOV))
    np.testing.assert_allclose(
        frames[-1]["Points2D:positions"][0], place_on(HEIGHT, corner)[::-1] + 0.5, rtol=1e-3, atol=0.02
    )


@pytest.mark.draws
def test_the_view_has_the_canvas(files: Path, cli: Cli, tmp_path: Path) -> None:
    out, png = tmp_path / "out.rrd", tmp_path / "a.png"
    strict(cli("run", "mosaic", "--data", files, "--set=by=imu-gyro", "--every", 50, "--out", out, "--json"))
    done = cli("snapshot", out, "--time", 5.5, "--size", "1000x700", "-o", png)
    assert (done.code, done.err) == (0, "")
    picture = np.asarray(Image.open(png).convert("RGB"), int)
    canvas = picture[280:504, :400]  # the panel at the left, in the middle
    sky = (canvas[..., 2] > 180) & (canvas[..., 2] > canvas[..., 0] + 20)
    assert sky.mean() > 0.005
