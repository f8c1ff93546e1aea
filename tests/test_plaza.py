"""Odometry and ranges to beacons: the model's derivatives, what a bias does, odd files, bad input, the real set."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from conftest import Cli

from viz_estim.core.consistency import Tally, band
from viz_estim.core.kalman import finite_differences
from viz_estim.core.run import Tick, run
from viz_estim.core.spaces import Euclidean, wrap
from viz_estim.core.stages import Update
from viz_estim.scenarios import plaza, plaza_files
from viz_estim.scenarios.plaza_data import PlazaData, advance, located

Fields = dict[str, Any]


def data(seed: int = 0, **parameters: float) -> PlazaData:
    return plaza.plaza(None, np.random.default_rng(seed), **parameters)


def read(path: Path) -> PlazaData:
    return plaza.plaza([path], np.random.default_rng(0))


def score(made: PlazaData, count: int | None = None, **parameters: Any) -> tuple[dict[str, float], float, float, int]:
    """Metrics, mean NIS over all beacons, its band's upper end, and how many ranges were refused, of `count` steps."""
    scenario = plaza.range_ekf(made, **parameters)
    scenario = replace(scenario, ticks=scenario.ticks[:count])
    tally, nis, refused = Tally(scenario.space, max(scenario.beliefs)), [], 0
    for step in run(scenario):
        assert step.error is None
        tally.add(step)
        for stage in step.stages:
            if isinstance(stage, Update) and step.index >= tally.first:
                seen = stage.innovation
                nis.append(float(seen.residual[0] ** 2 / seen.cov[0, 0]))
                refused += not seen.used.all()
    return tally.summary()["metrics"], float(np.mean(nis)), band(1, len(nis))[1], refused


@pytest.mark.parametrize("range_bias", ["none", "constant", "estimate"])
def test_the_model_s_jacobians(range_bias: plaza.RangeBias) -> None:
    scenario = plaza.range_ekf(data(duration=20), range_bias=range_bias)
    ekf: Any = scenario.estimator
    space, rng = scenario.space, np.random.default_rng(1)
    assert len(space.names) == {"none": 3, "constant": 7, "estimate": 8}[range_bias]
    x = rng.normal(1, 0.3, len(space.names))
    x[:2] = 6.1, 8.2
    tick = Tick(0.0, 0.2, np.array([0.7, -0.3]))
    F = finite_differences(lambda x: ekf.process(x, tick), x, space, space)
    np.testing.assert_allclose(ekf.jacobian(x, tick), F, atol=1e-7)
    for i, label in enumerate(("0", "1", "5", "6")):
        sensor = ekf.sensors[f"range/{label}"]
        H = finite_differences(sensor.measure, x, space, sensor.space)
        np.testing.assert_allclose(sensor.jacobian(x), H, atol=1e-7)
        beacon = scenario.scenery["beacons"].positions[i]
        far = np.linalg.norm(x[:2] - beacon) * (x[-1] if range_bias == "estimate" else 1)
        assert sensor.measure(x)[0] == pytest.approx(far + (0 if range_bias == "none" else x[3 + i]))

    # The noise of the odometry enters where the odometry does.
    def moved(odometry: Any) -> Any:
        return np.stack([ekf.process(x, Tick(0.0, 0.2, one)) for one in np.atleast_2d(odometry)]).squeeze()

    G = finite_differences(moved, np.array([0.7, -0.3]), Euclidean(("distance", "turn")), space)
    want = G @ np.diag([0.05**2 * 0.7, 0.01**2 * 0.2]) @ G.T
    np.testing.assert_allclose(ekf.process_noise(x, tick), want, atol=1e-10)


def test_batches_are_run_as_their_members() -> None:
    scenario = plaza.range_ekf(data(duration=20))
    ekf: Any = scenario.estimator
    x = np.random.default_rng(2).normal(1, 3, (4, 8))
    tick = Tick(0.0, 0.2, np.array([0.7, -0.3]))
    for function in (ekf.process, ekf.jacobian, ekf.process_noise):
        np.testing.assert_allclose(function(x, tick), np.stack([function(one, tick) for one in x]))
    sensor = ekf.sensors["range/5"]
    for function in (sensor.measure, sensor.jacobian):
        np.testing.assert_allclose(function(x), np.stack([function(one) for one in x]))


@pytest.mark.parametrize("seed", range(3))
def test_only_the_scale_makes_the_ranges_consistent(seed: int) -> None:
    clean = data(seed, outliers=0)
    metrics, nis, high, _ = score(clean)
    assert nis < 1.05 * high
    assert metrics["position_rmse_m"] < 0.6
    constant, one, _, _ = score(clean, range_bias="constant")
    assert one > 1.2 * high
    nothing, none, _, _ = score(clean, range_bias="none", gate=None)
    assert none > 8 * high
    assert metrics["position_rmse_m"] < constant["position_rmse_m"] < nothing["position_rmse_m"]


@pytest.mark.parametrize("seed", range(3))
def test_the_gate_refuses_ranges_that_came_by_a_detour(seed: int) -> None:
    dirty = data(seed, outliers=0.05)
    gated, _, _, refused = score(dirty)
    ungated, _, _, none = score(dirty, gate=None)
    assert (refused > 10, none) == (True, 0)
    assert gated["position_rmse_m"] < 0.8 * ungated["position_rmse_m"]


@pytest.mark.parametrize("seed", range(3))
def test_the_ranges_tell_where_the_drive_begins(seed: int) -> None:
    made = data(seed)
    row, pose, scale = located(made)
    assert np.hypot(*(pose - made.truth[row])[:2]) < 1
    assert abs(wrap(pose - made.truth[row])[2]) < 0.15
    assert scale == pytest.approx(1.07, abs=0.02)
    beliefs = plaza.range_ekf(made, initial="ranges").beliefs
    assert list(beliefs) == [0, row]
    assert score(made, initial="ranges")[0]["position_rmse_m"] < 1


def fields(made: PlazaData, folder: Path) -> Fields:
    (path,) = plaza.save(made, folder)
    found = {k: v for k, v in scipy.io.loadmat(path).items() if not k.startswith("__")}
    path.unlink()
    return found


def write(folder: Path, held: Fields) -> Path:
    path = folder / "drive.mat"
    scipy.io.savemat(path, {k: v for k, v in held.items() if v is not None})
    return path


def test_a_drive_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    made = data(5, duration=30)
    (path,) = plaza.save(made, tmp_path)
    scipy.io.savemat(tmp_path / "other.mat", {"GT": np.zeros((3, 4)), "DR": np.zeros((3, 3))})
    (tmp_path / "broken.mat").write_text("not for us")
    again = plaza.plaza([tmp_path], np.random.default_rng(0))
    assert again.log.files == (path,)
    assert again.log.labels == made.log.labels
    for name in ("time", "odometry", "ranges", "truth"):
        np.testing.assert_allclose(getattr(again, name), getattr(made, name), atol=2e-6)


def test_odd_files_are_read(tmp_path: Path) -> None:
    made = data(6, duration=30)
    held = fields(made, tmp_path)
    # Blocks out of order, other spellings, a beacon that nobody has placed, an order of their own, NaN in the truth.
    late = np.concatenate([held["TD"][60:], held["TD"][:60], [[held["TD"][0, 0], 2, 90, 7]]])
    truth = np.where(np.arange(len(held["GT"]))[:, None] == 12, np.nan, held["GT"])
    again = read(write(tmp_path, {"dr": held["DR"], "Td": late, "tl": held["TL"][::-1], "gt": truth[::-1]}))
    np.testing.assert_allclose(again.ranges, made.ranges, atol=2e-6)
    np.testing.assert_allclose(again.truth, made.truth, atol=0.05)
    assert "1 are of beacons without a place" in again.notes
    # Two of three beacons, odometry in which every stamp stands twice, and no truth at all.
    twice = np.repeat(held["DR"], 2, axis=0) * [1, 0.5, 0.5]
    again = read(write(tmp_path, {**held, "DR": twice, "TL": held["TL"][1:], "GT": None}))
    np.testing.assert_allclose(again.odometry[::2], made.odometry, atol=2e-6)
    np.testing.assert_array_equal(again.odometry[1::2], 0)
    assert again.ranges.shape[1] == 3
    scenario = plaza.range_ekf(again)
    assert scenario.truth is None
    assert not [step.error for step in run(scenario) if step.error]


def test_a_range_belongs_to_the_nearest_row(tmp_path: Path) -> None:
    held = fields(data(7, duration=30), tmp_path)
    stamps = held["DR"][:, 0]
    held["TD"] = np.array(
        [[stamps[9] + 0.01, 2, 5, 11], [stamps[9] - 0.02, 2, 5, 13], [stamps[10] - 0.05, 2, 6, 7], [1, 2, 6, 8]]
    )
    again = read(write(tmp_path, held))
    want = np.full((len(stamps), 4), np.nan)
    want[9, 2], want[10, 3] = 12, 7  # the mean of two of one beacon
    np.testing.assert_array_equal(again.ranges, want)
    assert "1 times several" in again.notes
    assert "1 came while there was no odometry" in again.notes


def test_truth_is_interpolated_but_not_across_gaps_or_beyond_its_ends(tmp_path: Path) -> None:
    made = data(8, duration=40)
    held = fields(made, tmp_path)
    held["GT"][:, 3] = wrap(held["GT"][:, 3])
    held["GT"] = np.delete(held["GT"], np.s_[60:120], axis=0)[20:-20:2]
    again = read(write(tmp_path, held))
    known = np.isfinite(again.truth).all(1)
    want = np.ones(len(known), bool)
    want[:20] = want[-21:] = want[60:120] = False
    assert (known != want).sum() <= 3  # the ends of the thinned truth
    off = again.truth[known] - made.truth[known]
    np.testing.assert_allclose(off[:, :2], 0, atol=0.01)
    np.testing.assert_allclose(wrap(off[:, 2]), 0, atol=0.02)
    assert max(plaza.range_ekf(again).beliefs) == int(np.argmax(known))


def test_the_odometry_carries_a_pose_along_its_true_path() -> None:
    made = data(9, outliers=0)
    pose = made.truth[0]
    for odometry in made.odometry[1:100]:
        pose = advance(pose, odometry)
    assert np.hypot(*(pose - made.truth[99])[:2]) < 1.0  # of 22 m; 1 % of it is the odometry's own


def nan(table: Any, column: int) -> Any:
    table = table.copy()
    table[3, column] = np.nan
    return table


BAD: dict[str, tuple[Any, str]] = {
    "no TL": (lambda f: {**f, "TL": None}, "no field `TL` (it holds GT, DR, TD)"),
    "no DR": (lambda f: {**f, "DR": None}, "no field `DR`"),
    "no TD": (lambda f: {**f, "TD": None}, "no field `TD`"),
    "DR of 2 columns": (lambda f: {**f, "DR": f["DR"][:, :2]}, "`DR` of shape N×3"),
    "TD turned": (lambda f: {**f, "TD": f["TD"].T}, "`TD` of shape N×4"),
    "GT of 3 columns": (lambda f: {**f, "GT": f["GT"][:, :3]}, "`GT` of shape N×4"),
    "NaN in DR": (lambda f: {**f, "DR": nan(f["DR"], 1)}, "`DR` is not a number at row 3, column 1"),
    "NaN in TD": (lambda f: {**f, "TD": nan(f["TD"], 3)}, "`TD` is not a number at row 3"),
    "NaN in TL": (lambda f: {**f, "TL": nan(f["TL"], 2)}, "`TL` is not a number at row 3"),
    "DR goes back": (lambda f: {**f, "DR": f["DR"][::-1]}, "goes back in time at row 1"),
    "one stamp": (lambda f: {**f, "DR": f["DR"][:1]}, "`DR` has 1 stamps"),
    "no reading": (lambda f: {**f, "TD": f["TD"][:0]}, "`TD`"),
    "text": (lambda f: {**f, "TD": "hello"}, "`TD` must hold numbers"),
    "a beacon twice": (lambda f: {**f, "TL": f["TL"][[0, 1, 1]]}, "beacon 1 twice"),
    "ranges of another clock": (lambda f: {**f, "TD": f["TD"] + [[1e5, 0, 0, 0]]}, "no range came while there was"),
    "other beacons": (lambda f: {**f, "TL": f["TL"] + [[50, 0, 0]]}, "no reading is of a beacon"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_refused(what: str, cli: Cli, tmp_path: Path) -> None:
    change, words = BAD[what]
    held = fields(data(1, duration=20), tmp_path)
    path = write(tmp_path, change(held))
    refused(cli("run", "range-ekf", "--data", path, "--out", tmp_path / "a.rrd"), words)


def test_no_file_two_files_and_a_damaged_one_are_refused(cli: Cli, tmp_path: Path) -> None:
    run_on = ["run", "range-ekf", "--out", tmp_path / "a.rrd", "--data"]
    refused(cli(*run_on, tmp_path), "no file of odometry")
    refused(cli(*run_on, tmp_path / "nowhere.mat"), "no such file")
    (path,) = plaza_files.save(tmp_path, data(1, duration=20).log)
    refused(cli("simulate", "plaza", "--out", tmp_path), "there already")
    (tmp_path / "copy.mat").write_bytes(path.read_bytes())
    refused(cli(*run_on, tmp_path), "2 files of ranges")
    path.write_bytes(path.read_bytes()[:2000])
    refused(cli(*run_on, path), "Plaza.mat: cannot be read")
    (tmp_path / "a.txt").write_text("")
    refused(cli(*run_on, tmp_path / "a.txt"), "ends in .mat")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("range_noise=0", "range_noise must be a positive"),
        ("turn_noise=-1", "turn_noise"),
        ("initial_bias_std=0", "initial_bias_std"),
        ("gate=1", "gate"),
        ("range_bias=some", "none or constant or estimate"),
        ("data.outliers=1", "outliers"),
        ("data.duration=1", "duration"),
    ],
)
def test_bad_parameters_are_refused(setting: str, words: str, cli: Cli, tmp_path: Path) -> None:
    refused(cli("run", "range-ekf", "--seed", "1", "--set", setting, "--out", tmp_path / "a.rrd"), words)


def test_a_start_at_the_truth_needs_one(cli: Cli, tmp_path: Path) -> None:
    path = write(tmp_path, {**fields(data(1, duration=20), tmp_path), "GT": None})
    refused(cli("run", "range-ekf", "--data", path, "--set", "initial=truth", "--out", tmp_path / "a.rrd"), "`GT`")


def refused(done: Any, words: str) -> None:
    assert (done.code, done.out) == (2, ""), done
    assert done.err.count("\n") == 1
    assert words in done.err


def test_on_the_real_set_the_scale_tells_all(real_data: Path) -> None:
    made = read(real_data / "plaza" / "Plaza1_.mat")
    metrics, nis, high, refused = score(made)
    assert metrics["position_rmse_m"] < 0.35
    assert nis < high
    assert refused < 10
    metrics, nis, _, _ = score(made, 1800, range_bias="constant")  # a part of the drive is enough
    assert (metrics["position_rmse_m"] < 1.5, nis > 1.5) == (True, True)
    _, nis, _, _ = score(made, 3500, range_bias="none", gate=None)
    assert nis > 10
