"""The differential drive: the documented figures on the real files, consistency, calibration, files, bad input."""

import json
from pathlib import Path
from typing import Any

import drawn
import numpy as np
import pytest
import scipy.io
from conftest import Cli, strict

from viz_estim.core.beliefs import Gaussian, normal
from viz_estim.core.consistency import Tally, band, squared_distance
from viz_estim.core.identification import identify, input_noise
from viz_estim.core.kalman import KalmanFilter, finite_differences
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.core.stages import Update
from viz_estim.scenarios import diffdrive, diffdrive_calibration, diffdrive_files
from viz_estim.scenarios.diffdrive import DriveData, diffdrive_ekf, simulate
from viz_estim.scenarios.diffdrive_calibration import DOCUMENTED
from viz_estim.scenarios.diffdrive_model import SPACE, effect, moved, path, transition

SEEDS, LONG = 50, 10.0


def simulated(seed: int = 0, **settings: float) -> DriveData:
    return diffdrive.diffdrive(None, np.random.default_rng(seed), **settings)


def real(folder: Path, name: str) -> DriveData:
    return diffdrive.diffdrive([folder / "cmu16642" / name], np.random.default_rng())


def summary(scenario: Scenario) -> dict[str, Any]:
    tally = Tally(scenario.space, max(scenario.beliefs))
    for step in run(scenario):
        assert step.error is None
        tally.add(step)
    return tally.summary()


# The model


def test_the_jacobians_are_the_derivatives() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        x, u, dt = rng.uniform(-3, 3, 3), rng.standard_normal(2), 0.1
        F = finite_differences(lambda y, u=u, dt=dt: moved(y, u, dt), x, SPACE, SPACE)
        np.testing.assert_allclose(transition(x, u, dt), F, atol=1e-8)
        ahead, behind = (np.stack([moved(x, u + sign * 1e-6 * e, dt) for e in np.eye(2)], axis=-1) for sign in (1, -1))
        np.testing.assert_allclose(effect(x, dt), (ahead - behind) / 2e-6, atol=1e-8)


def test_a_path_is_one_move_after_another_and_batches_are_members() -> None:
    rng = np.random.default_rng(1)
    u, dt = rng.standard_normal((30, 2)) * [3.0, 5.0], rng.uniform(0.05, 0.15, 30)
    states = [np.array([1.0, -2.0, 3.0])]
    for k in range(30):
        states.append(moved(states[-1], u[k], dt[k]))
    np.testing.assert_allclose(SPACE.minus(path(states[0], u, dt), np.stack(states)), 0, atol=1e-12)
    x = np.stack(states[:-1])
    for one in (moved, transition):
        np.testing.assert_array_equal(one(x, u, dt), np.stack([one(*row) for row in zip(x, u, dt, strict=True)]))
    np.testing.assert_array_equal(effect(x, dt), np.stack([effect(*row) for row in zip(x, dt, strict=True)]))


# The real files


def test_the_documented_figures_on_the_course_s_file(real_data: Path) -> None:
    scenario = diffdrive_ekf(real(real_data, "kfData.mat"))
    np.testing.assert_array_equal(scenario.beliefs[0].mean, [0.355, -1.590, 0.682])
    np.testing.assert_allclose(scenario.beliefs[0].cov, np.diag([25, 25, 0.154]), atol=1e-4)
    assert scenario.facts["gps_rmse_m"] == pytest.approx(2.009, abs=5e-4)
    found = summary(scenario)
    assert found["metrics"]["position_rmse_m"] == pytest.approx(0.561, abs=6e-4)
    assert found["metrics"]["heading_rmse_rad"] == pytest.approx(0.0628, abs=6e-5)
    assert found["nis"]["gps"]["mean"] == pytest.approx(2.01, abs=6e-3)
    assert found["nis"]["gps"]["low"] < found["nis"]["gps"]["mean"] < found["nis"]["gps"]["high"]
    assert found["nees"]["mean"] == pytest.approx(4.77, abs=0.02)


@pytest.mark.parametrize("initial", ["course", "gps", "truth"])
@pytest.mark.parametrize("name", ["kfData.mat", "calibration.mat"])
def test_every_start_finds_its_way(initial: Any, name: str, real_data: Path) -> None:
    found = summary(diffdrive_ekf(real(real_data, name), initial=initial))
    assert found["metrics"]["position_rmse_m"] < 0.6
    assert found["metrics"]["heading_rmse_rad"] < 0.07
    assert found["nis"]["gps"]["low"] < found["nis"]["gps"]["mean"] < found["nis"]["gps"]["high"]


def test_calibrate_finds_the_documented_covariances(real_data: Path, cli: Cli, tmp_path: Path) -> None:
    data, out = real_data / "cmu16642", tmp_path / "cal.json"
    done = strict(cli("calibrate", "diffdrive", "--data", data / "calibration.mat", "--out", out, "--json"))
    np.testing.assert_array_equal(np.round(done["gps_cov"], 4), [[1.8817, 0.0632], [0.0632, 2.1384]])
    assert (done["W"], done["V"]) == (done["gps_cov"], done["input_cov"])
    np.testing.assert_array_equal(np.round(done["input_cov"], 4), [[0.2590, 0.0010], [0.0010, 0.0625]])
    assert (done["gps_count"], done["input_count"], done["calibration"]) == (250, 2500, str(out))
    assert list(tmp_path.iterdir()) == [out]
    text = cli("calibrate", "diffdrive", "--data", data / "calibration.mat").out
    for number in ("0.2590 ±", "0.0010 ±", "0.0625 ±", "1.8817 ±", "0.0632 ±", "2.1384 ±"):
        assert number in text
    fitted = diffdrive.diffdrive([data / "kfData.mat"], np.random.default_rng(), calibration=out)
    np.testing.assert_array_equal(fitted.noise.gps_cov, done["gps_cov"])
    assert summary(diffdrive_ekf(fitted))["metrics"]["position_rmse_m"] < 0.565


def test_the_file_with_beacons_is_another_system_s(real_data: Path, cli: Cli, tmp_path: Path) -> None:
    folder = real_data / "cmu16642"
    for given, words in (("pfData.mat", "ranges to two beacons"), (".", "2 files of a differential drive found")):
        done = cli("run", "diffdrive-ekf", "--data", folder / given, "--out", tmp_path / "a.rrd")
        assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
        assert words in done.err
    assert len(diffdrive_files.find([folder])) == 2


# Consistency


def over_seeds(scenario: Scenario) -> tuple[Array, Array]:
    """NIS (M, seeds) and NEES (T, seeds) on states and readings drawn from the default model, as one batch."""
    own, start = diffdrive_ekf(simulated(duration=LONG)), scenario.beliefs[0]
    assert isinstance(own.estimator, KalmanFilter)
    assert isinstance(start, Gaussian)
    mean, cov = np.tile(start.mean, (SEEDS, 1)), np.tile(start.cov, (SEEDS, 1, 1))
    rng = np.random.default_rng(11)
    belief, x = Gaussian(SPACE, mean, cov), normal(SPACE, mean, cov, rng)
    nis, nees = [], []
    for tick in own.ticks:
        x = drawn.next_state(own.estimator, SPACE, x, tick, rng)
        readings = drawn.readings(own.estimator, x, rng) if tick.measurements else {}
        for stage in scenario.estimator.step(belief, Tick(tick.time, tick.dt, tick.control, readings), rng):
            belief = stage.belief
            if isinstance(stage, Update):
                nis.append(squared_distance(stage.innovation.residual, stage.innovation.cov))
        nees.append(squared_distance(SPACE.minus(x, belief.mean), belief.cov))
    return np.stack(nis), np.stack(nees)


def share(means: Array, dof: int, count: int) -> float:
    low, high = band(dof, count)
    return float(((means >= low) & (means <= high)).mean())


def test_it_is_consistent_on_data_of_its_own_model() -> None:
    nis, nees = over_seeds(diffdrive_ekf(simulated()))
    assert share(nis.mean(0), 2, len(nis)) >= 43 / 50
    # The heading's first error, σ 0.39 rad, bends the ellipse more than a linear filter knows: it fades by mid-run.
    assert share(nees[500:].mean(1), 3, SEEDS) >= 0.9, nees.mean(1)[::50]


@pytest.mark.parametrize("change", [{"gps_noise": 0.5}, {"gps_noise": 4.0}, {"speed_noise": 0.05, "turn_noise": 0.02}])
def test_a_wrong_noise_is_seen(change: dict[str, float]) -> None:
    nis, nees = over_seeds(diffdrive_ekf(simulated(), **change))
    assert share(nees[500:].mean(1), 3, SEEDS) < 0.1
    assert "gps_noise" not in change or share(nis.mean(0), 2, len(nis)) == 0


def test_simulations_drawn_with_their_own_start_are_consistent_from_end_to_end() -> None:
    runs = [summary(diffdrive_ekf(simulated(seed, duration=5.0))) for seed in range(12)]
    inside = [one["nis"]["gps"]["low"] <= one["nis"]["gps"]["mean"] <= one["nis"]["gps"]["high"] for one in runs]
    assert sum(inside) >= 10
    assert max(one["metrics"]["position_rmse_m"] for one in runs) < 3


# Parameters and starts


def test_noises_are_standard_deviations_and_keep_the_correlation() -> None:
    estimator = diffdrive_ekf(simulated(), gps_noise=2.0, turn_noise=0.5).estimator
    assert isinstance(estimator, KalmanFilter)
    W, V = estimator.sensors["gps"].noise, DOCUMENTED.input_cov
    np.testing.assert_allclose(np.diagonal(W), 4.0)
    correlation = DOCUMENTED.gps_cov[0, 1] / np.sqrt(np.prod(np.diagonal(DOCUMENTED.gps_cov)))
    assert W[0, 1] / 4 == pytest.approx(correlation)
    Q = estimator.process_noise(np.zeros(3), Tick(0.1, 0.1, np.zeros(2)))
    scale = 0.5 / np.sqrt(V[1, 1])
    np.testing.assert_allclose(Q[::2, ::2], 0.01 * V * np.array([[1, scale], [scale, scale**2]]))
    np.testing.assert_array_equal(Q[1], 0.0)


def test_a_drive_that_starts_elsewhere_starts_where_its_readings_are() -> None:
    log = simulated(2).log
    turned, away = 2.5, np.array([300.0, -80.0])
    R = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
    truth = np.column_stack([log.truth[:, :2] @ R.T + away, log.truth[:, 2] + turned])
    moved_log = diffdrive_files.DriveLog(log.time, log.inputs, log.gps @ R.T + away, log.gps_step, truth)
    scenario = diffdrive_ekf(DriveData(moved_log, DOCUMENTED, ""))
    off = SPACE.minus(scenario.beliefs[0].mean, truth[0])
    assert np.abs(off[:2]).max() < 2
    assert abs(off[2]) < 0.4
    assert "first GPS readings" in scenario.notes
    assert summary(scenario)["metrics"]["position_rmse_m"] < 0.8
    near = diffdrive_ekf(DriveData(log, DOCUMENTED, ""), initial="gps")
    np.testing.assert_allclose(SPACE.minus(near.beliefs[0].mean, log.truth[0]), off @ np.block(
        [[R, np.zeros((2, 1))], [np.zeros((1, 2)), np.eye(1)]]), atol=1e-9)  # fmt: skip


def test_a_truth_that_begins_later_sets_the_belief_there() -> None:
    log = simulated(3).log
    truth = log.truth.copy()
    truth[:40] = np.nan
    data = DriveData(diffdrive_files.DriveLog(log.time, log.inputs, log.gps, log.gps_step, truth), DOCUMENTED, "")
    scenario = diffdrive_ekf(data, initial="truth")
    assert list(scenario.beliefs) == [0, 40]
    np.testing.assert_array_equal(scenario.beliefs[40].mean, truth[40])
    assert scenario.ticks[40].dt == 0
    assert summary(scenario)["metrics"]["position_rmse_m"] < 1


# Calibration


def test_identified_noise_is_the_sample_s_and_its_standard_errors_are_honest() -> None:
    rng = np.random.default_rng(4)
    cov = np.array([[2.0, -0.6], [-0.6, 0.5]])
    samples = rng.standard_normal((2000, 80, 2)) @ np.linalg.cholesky(cov).T + [3.0, -1.0]
    found = identify(samples)
    np.testing.assert_allclose(found.cov[7], np.cov(samples[7].T))
    np.testing.assert_allclose(identify(samples, unbiased=False).cov[7], np.cov(samples[7].T, bias=True))
    np.testing.assert_allclose(found.mean[7], samples[7].mean(0))
    np.testing.assert_allclose(found.cov.mean(0), cov, atol=0.02)
    np.testing.assert_allclose(found.cov.std(0), found.cov_se.mean(0), rtol=0.05)
    np.testing.assert_allclose(found.mean.std(0), found.mean_se.mean(0), rtol=0.05)
    with pytest.raises(ValueError, match="more than 2"):
        identify(samples[0, :2])


def test_input_noise_solves_for_what_the_inputs_were_off_by() -> None:
    rng = np.random.default_rng(5)
    G, w = rng.standard_normal((9, 3, 2)), rng.standard_normal((9, 2))
    across = np.cross(G[..., 0], G[..., 1])  # what no input could do
    np.testing.assert_allclose(input_noise((G @ w[..., None])[..., 0] + 5 * across, G), w, atol=1e-10)


def test_a_calibration_finds_the_noise_of_simulations_and_leaves_out_what_has_no_truth() -> None:
    logs = [simulate(np.random.default_rng(seed), 25.0, 1.5) for seed in range(4)]
    logs[0].truth[200:900] = np.nan
    fitted = diffdrive_calibration.fit(logs)
    assert (fitted.inputs.count, fitted.gps.count) == (4 * 2500 - 701, 4 * 250 - 70)
    for found, true in ((fitted.inputs, DOCUMENTED.input_cov), (fitted.gps, DOCUMENTED.gps_cov)):
        assert (np.abs(found.cov - 1.5**2 * true) < 4 * found.cov_se).all()
        assert (np.abs(found.mean) < 4 * found.mean_se).all()
        assert (found.cov_se < 0.2 * found.cov[0, 0]).all()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such calibration"),
        ("hello", "not a JSON file"),
        ("[1]", "not a calibration of the system diffdrive"),
        ('{"system": "imu"}', "not a calibration of the system diffdrive"),
        ('{"system": "diffdrive", "input_cov": [[1, 0], [0, 1]]}', "gps_cov must be"),
        ('{"system": "diffdrive", "input_cov": [[1, 2], [2, 1]], "gps_cov": [[1, 0], [0, 1]]}', "input_cov must be"),
        ('{"system": "diffdrive", "input_cov": [[1, 2], [0, 9]], "gps_cov": [[1, 0], [0, 1]]}', "input_cov must be"),
        ('{"system": "diffdrive", "input_cov": [1, 2], "gps_cov": [[1, 0], [0, 1]]}', "input_cov must be"),
    ],
)
def test_a_bad_calibration_is_refused(content: str | None, words: str, cli: Cli, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "cal.json").write_text(content)
    refused(cli, tmp_path, words, "run", "diffdrive-ekf", "--seed", 1, "--calibration", tmp_path / "cal.json")


# Files


def test_files_come_back_as_they_were_saved(tmp_path: Path) -> None:
    data = simulated(6, duration=4.0)
    (file,) = diffdrive.save(data, tmp_path)
    (tmp_path / "other.mat").write_text("no MATLAB file")
    scipy.io.savemat(tmp_path / "beacons.mat", {"u": np.ones((2, 9)), "y": np.ones((2, 9))})
    for source in ([file], [tmp_path]):
        again = diffdrive.diffdrive(source, np.random.default_rng()).log
        for name in ("time", "inputs", "gps", "gps_step", "truth"):
            np.testing.assert_array_equal(getattr(again, name), getattr(data.log, name), err_msg=name)
        assert again.files == (file,)


N, M = 60, 6
FIELDS = {
    "q_groundTruth": np.cumsum(np.ones((3, N + 1)), axis=1),
    "u": np.ones((2, N)),
    "y": np.ones((2, M)),
    "t_y": 0.01 * np.arange(9, N, 10)[None],
    "T": 0.01,
}


def write(file: Path, **change: Any) -> Path:
    scipy.io.savemat(file, {name: value for name, value in (FIELDS | change).items() if value is not None})
    return file


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"q_groundTruth": None, "q_groundtruth": FIELDS["q_groundTruth"]},
        {"u": None, "U": FIELDS["u"], "T_Y": FIELDS["t_y"], "t_y": None},
        {"T": None, "t": 0.01 * np.arange(N + 1)[None]},
        {"T": None, "t_groundTruth": 0.01 * np.arange(N + 1)[None]},
        {"T": None, "t": 5 + 0.01 * np.arange(N + 1)[:, None], "t_y": 5 + np.ravel(FIELDS["t_y"])},
        {"T": None},
        {"T": 0.1, "t_y": 10 * np.ravel(FIELDS["t_y"])},
    ],
)
def test_other_people_s_spellings_are_read(change: dict[str, Any], tmp_path: Path) -> None:
    log = diffdrive_files.load(write(tmp_path / "a.mat", **change))
    np.testing.assert_array_equal(log.gps_step, np.arange(9, N, 10))
    np.testing.assert_allclose(log.time, (change.get("T") or 0.01) * np.arange(N + 1.0), atol=1e-12)
    assert np.isfinite(log.truth).all()
    assert (np.abs(log.truth[:, 2]) <= np.pi).all()


def test_a_file_without_truth_is_run_and_not_calibrated(cli: Cli, tmp_path: Path) -> None:
    file = write(tmp_path / "a.mat", q_groundTruth=None)
    scenario = diffdrive_ekf(diffdrive.diffdrive([file], np.random.default_rng()))
    assert scenario.facts == {}
    assert summary(scenario)["metrics"] == {}
    refused(cli, tmp_path, "truth (`q_groundTruth`)", "calibrate", "diffdrive", "--data", file)
    refused(cli, tmp_path, "initial=truth", "run", "diffdrive-ekf", "--data", file, "--set", "initial=truth")


def poked(name: str, value: float = np.nan) -> dict[str, Array]:
    array = np.array(FIELDS[name], float)
    array[0, 3] = value
    return {name: array}


BAD_FILES: dict[str, tuple[dict[str, Any], str]] = {
    "no u": ({"u": None}, "no field `u` (it holds"),
    "no y": ({"y": None}, "no field `y`"),
    "no t_y": ({"t_y": None}, "no field `t_y`"),
    "beacons": ({"y": np.ones((2, N)), "t_y": None}, "ranges to two beacons"),
    "u of three rows": ({"u": np.ones((3, N))}, "`u` of shape 2×N, got 3×60"),
    "u transposed": ({"u": np.ones((N, 2))}, "`u` of shape 2×N, got 60×2"),
    "y of one row": ({"y": np.ones((1, M))}, "`y` of shape 2×N, got 1×6"),
    "no input": ({"u": np.ones((2, 0))}, "`u` of shape"),
    "no reading": ({"y": np.ones((2, 0)), "t_y": np.ones((1, 0))}, "`y` of shape"),
    "truth too short": ({"q_groundTruth": np.ones((3, N))}, "3×61, one column more than `u`"),
    "truth of two rows": ({"q_groundTruth": np.ones((2, N + 1))}, "3×61"),
    "t_y too short": ({"t_y": np.ones((1, M - 1))}, "must agree"),
    "t_y goes back": ({"t_y": FIELDS["t_y"][:, ::-1]}, "does not increase at sample 1"),  # type: ignore[index]
    "t_y too late": ({"t_y": 10 * np.ravel(FIELDS["t_y"])}, "give the right step as `T`"),
    "two in a step": ({"t_y": 0.3 + 0.001 * np.arange(M)}, "in one step"),
    "T of zero": ({"T": 0.0}, "`T` is the length of a step"),
    "T is NaN": ({"T": np.nan}, "T is not a number"),
    "t too short": ({"t": 0.01 * np.arange(N)}, "`t` has 60 stamps"),
    "t goes back": ({"t": -0.01 * np.arange(N + 1)}, "`t` does not increase"),
    "NaN in u": (poked("u"), "u is not a number at sample 3"),
    "NaN in y": (poked("y"), "y is not a number at sample 3"),
    "infinity in y": (poked("y", np.inf), "y is not a number at sample 3"),
    "NaN in t_y": (poked("t_y"), "t_y is not a number at sample 3"),
    "a text": ({"u": "hello"}, "`u` must hold numbers"),
}


@pytest.mark.parametrize("what", BAD_FILES)
def test_a_bad_file_is_refused_in_one_line(what: str, cli: Cli, tmp_path: Path) -> None:
    change, words = BAD_FILES[what]
    file = write(tmp_path / "bad.mat", **change)
    for command in (("run", "diffdrive-ekf"), ("calibrate", "diffdrive")):
        refused(cli, tmp_path, words, *command, "--data", file)


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_a_truncated_file_is_refused(part: float, cli: Cli, tmp_path: Path) -> None:
    file = write(tmp_path / "bad.mat")
    file.write_bytes(file.read_bytes()[: int(part * file.stat().st_size)])
    refused(cli, tmp_path, "bad.mat", "run", "diffdrive-ekf", "--data", file)


def test_nothing_to_find_is_refused(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "a.csv").write_text("u\n1\n")
    still = {"q_groundTruth": path(np.zeros(3), FIELDS["u"].T, np.full(N, 0.01)).T}  # type: ignore[union-attr]
    noiseless = write(tmp_path / "same.mat", **still)
    for given, words in (("gone.mat", "no such file"), ("a.csv", "expected a .mat"), ("empty", "no file of a diff")):
        refused(cli, tmp_path, words, "run", "diffdrive-ekf", "--data", tmp_path / given)
        refused(cli, tmp_path, words, "calibrate", "diffdrive", "--data", tmp_path / given)
    refused(cli, tmp_path, "the truth", "calibrate", "diffdrive", "--data", noiseless)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("gps_noise=0", "gps_noise must be a positive number"),
        ("speed_noise=-1", "speed_noise must be a positive number"),
        ("turn_noise=0", "turn_noise must be a positive number"),
        ("initial_heading_std=0", "initial_heading_std must be a positive number"),
        ("gate=1", "gate is a probability"),
        ("initial=here", "auto or course or gps or truth"),
        ("data.duration=0", "duration of 2 to 3600 s"),
        ("data.noise_scale=0", "noise_scale must be a positive number"),
    ],
)
def test_a_bad_setting_is_refused(setting: str, words: str, cli: Cli, tmp_path: Path) -> None:
    refused(cli, tmp_path, words, "run", "diffdrive-ekf", "--seed", 1, "--set", setting)


def refused(cli: Cli, folder: Path, words: str, *arguments: object) -> None:
    """Holds that the command says one line with the words, exits with 2, and leaves no recording."""
    out = ["--out", folder / ("out.json" if arguments[0] == "calibrate" else "out.rrd")]
    done = cli(*arguments, *out)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1), done.err
    assert words in done.err, done.err
    assert not list(folder.glob("out.*"))


def test_the_json_says_what_it_was_made_from(cli: Cli, tmp_path: Path) -> None:
    assert cli("simulate", "diffdrive", "--seed", 1, "--out", tmp_path).code == 0
    out = tmp_path / "cal.json"
    done = strict(cli("calibrate", "diffdrive", "--data", tmp_path, "--out", out, "--json"))
    held = json.loads(out.read_text())
    assert held == {name: value for name, value in done.items() if name != "calibration"}
    assert [file["name"] for file in held["files"]] == ["diffdrive.mat"]
    text = cli("calibrate", "diffdrive", "--data", tmp_path, "--out", out).out.splitlines()
    assert text[-1] == f"viz-estim run diffdrive-ekf --data PATH --calibration {out}"
