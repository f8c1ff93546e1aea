"""The drive on SE(2): a reference of many particles, the exponential map, times, a real log, files, bad input."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli
from scipy.linalg import expm

from viz_estim.core.beliefs import Particles
from viz_estim.core.consistency import Tally
from viz_estim.core.particle import equal
from viz_estim.core.run import run
from viz_estim.core.spaces import wrap
from viz_estim.scenarios import se2, se2_files
from viz_estim.scenarios.se2 import SPACE
from viz_estim.scenarios.se2_files import Drive

RNG = np.random.default_rng(0)
PROBLEM = se2.se2(None, RNG)
WIFIBOT = Path("wifibot") / "wifibot1.txt"


def ends(seed: int = 0, data: Drive = PROBLEM, **parameters: Any) -> list[Particles]:
    """The belief at the end of each step but the first."""
    found = []
    for step in run(se2.se2_pf(data, **parameters), seed):
        assert step.error is None
        found.append(step.stages[-1].belief)
    return found[1:]


def figures(beliefs: list[Particles]) -> Any:
    """By step the mean's difference from the noiseless pose (*, 3), and the six numbers of the covariance."""
    rows = []
    for k, belief in enumerate(beliefs, 1):
        pose = se2.moved(np.zeros(3), np.array([1.5, 2.0]), 5.0 * k)
        upper = belief.cov[..., *np.triu_indices(3)]
        rows.append(
            np.concatenate([belief.mean[..., :2] - pose[:2], wrap(belief.mean - pose)[..., 2:], upper], axis=-1)
        )
    return np.stack(rows)


@pytest.mark.parametrize("measure", [True, False])
def test_it_agrees_with_two_hundred_thousand_particles(measure: bool) -> None:
    scenario = se2.se2_pf(PROBLEM, measure=measure)
    batch: Any = equal(SPACE, np.zeros((200, 1000, 3)))
    rng, over_seeds = np.random.default_rng(1), []
    for tick in scenario.ticks:
        for stage in scenario.estimator.step(batch, tick, rng):
            batch = stage.belief
        over_seeds.append(batch)
    spread = figures(over_seeds[1:]).std(1)
    reference = figures(ends(2, measure=measure, particles=200_000))
    for seed in range(5):
        assert (np.abs(figures(ends(seed, measure=measure)) - reference) <= 4 * spread).all()
    # Resampling adds to the spread that independent particles would have.
    plain = np.stack([np.sqrt(np.diagonal(belief.cov, axis1=-2, axis2=-1).mean(0) / 1000) for belief in over_seeds[1:]])
    ratio = spread[:, :2].mean() / plain[:, :2].mean()
    assert 1.1 < ratio < 2.4 if measure else 0.9 < ratio < 1.15


def test_the_figures_do_not_depend_on_how_often_they_are_asked_for() -> None:
    for one, other in zip(ends(3), ends(3, times="5, 10,15,20"), strict=True):
        np.testing.assert_array_equal(one.states, other.states)


def test_one_draw_held_for_ten_seconds_is_wider_than_two_of_five() -> None:
    (once,), twice = ends(measure=False, times="10", particles=20_000), ends(measure=False, particles=20_000)[1]
    assert np.sqrt(once.cov[2, 2] / twice.cov[2, 2]) == pytest.approx(np.sqrt(2), rel=0.03)
    turn_std = 0.25 / 0.5 * np.sqrt(2) * 0.05
    assert np.sqrt(once.cov[2, 2]) == pytest.approx(10 * turn_std, rel=0.03)
    # The reading at 10 s is taken in where that time is asked for, and no other is.
    assert ends(times="10")[0].ess == pytest.approx(1000)
    assert [len(step.stages) for step in run(se2.se2_pf(PROBLEM, times="7,10,12"))] == [1, 1, 3, 1]


def test_poses_move_by_the_matrix_exponential() -> None:
    rng = np.random.default_rng(4)

    def matrix(pose: Any) -> Any:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0, 0, 1]])

    for _ in range(20):
        pose, rates, dt = rng.normal(0, 2, 3), rng.normal(0, 2, 2), rng.uniform(0.01, 5)
        v, w = 0.25 * rates.sum() / 2, 0.25 / 0.5 * (rates[1] - rates[0])
        twist = dt * np.array([[0, -w, v], [w, 0, 0], [0, 0, 0]])
        np.testing.assert_allclose(matrix(se2.moved(pose, rates, dt)), matrix(pose) @ expm(twist), atol=1e-12)
        np.testing.assert_allclose(se2_files.wheel_rates(v, w), rates)


def bend(points: Any) -> float:
    """How much of the spread across a cloud (N, 2) a parabola along it explains, from 0 to 1."""
    centred = points - points.mean(0)
    across, along = (centred @ np.linalg.eigh(centred.T @ centred)[1]).T
    return float(np.corrcoef(across, along**2)[0, 1] ** 2)


def test_the_cloud_is_bent_in_the_plane_and_straight_in_the_group() -> None:
    for belief in ends(measure=False, particles=5000):
        in_plane, in_group = bend(belief.states[:, :2]), bend(SPACE.minus(belief.states, belief.mean)[:, :2])
        assert in_plane > max(0.05, 2 * in_group)


def test_noise_is_drawn_once_a_step_for_each_particle() -> None:
    quiet = ends(measure=False, wheel_noise=1e-9)[-1]
    np.testing.assert_allclose(quiet.mean, se2.moved(np.zeros(3), np.array([1.5, 2.0]), 20.0), atol=1e-6)


def test_the_wifibot_by_its_odometry(real_data: Path) -> None:
    data = se2.se2([real_data / WIFIBOT], RNG)
    assert len(data.time) == 1745
    scenario = se2.se2_pf(data, particles=100)
    tally = Tally(scenario.space)
    for step in run(scenario):
        assert step.error is None
        tally.add(step)
    found = tally.summary()
    assert found["metrics"]["position_rmse_m"] < 0.15
    assert found["metrics"]["heading_rmse_rad"] < 0.15
    assert found["nees"]["inside"] > 0.8


def log_text(rows: int = 40, truth: bool = True) -> str:
    time = 3 + 0.02 * np.arange(rows)
    lines = ["t gyro vx vy theta px py" if truth else "t,vx,gyro"]
    for t in time:
        lines.append(f"{t} 0.5 1.0 0 {0.5 * (t - 3)} {2 * np.sin(0.5 * (t - 3))} 0.1" if truth else f"{t},1.0,0.5")
    return "\n".join([*lines, ""])


def test_logs_are_read_with_and_without_a_truth(tmp_path: Path) -> None:
    (tmp_path / "log.txt").write_text(log_text())
    (tmp_path / "other.txt").write_text("x y z\n1 2 3\n4 5 6\n")
    data = se2.se2([tmp_path], RNG)
    assert data.files == (tmp_path / "log.txt",)
    assert data.time[0] == 0
    speed, turn = se2_files.speed_and_turn(data.rates)
    np.testing.assert_allclose(np.stack([speed, turn]), np.array([[1.0], [0.5]]) * np.ones((2, 40)))
    scenario = se2.se2_pf(data)
    np.testing.assert_allclose(scenario.beliefs[0].mean, [0, 0.1, 0])
    (tmp_path / "bare.CSV").write_text(log_text(truth=False).upper())
    bare = se2.se2_pf(se2.se2([tmp_path / "bare.CSV"], RNG))
    assert bare.truth is None
    np.testing.assert_allclose(bare.beliefs[0].mean, 0, atol=1e-12)
    (tmp_path / "named.txt").write_text(log_text().replace("t ", "time ", 1))
    np.testing.assert_array_equal(se2.se2([tmp_path / "named.txt"], RNG).time, data.time)
    late = Drive(data.time, data.rates, data.positions, data.truth.copy(), 0.4)
    late.truth[:5] = np.nan
    assert list(se2.se2_pf(late).beliefs) == [0, 5]
    assert [len(step.stages) for step in run(se2.se2_pf(late))][4:7] == [1, 1, 1]


def test_the_problem_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    (path,) = se2.save(PROBLEM, tmp_path)
    again = se2.se2([tmp_path], RNG)
    assert again.files == (path,)
    for name in ("time", "rates", "positions", "truth"):
        np.testing.assert_array_equal(getattr(again, name), getattr(PROBLEM, name))
    assert again.wheel_noise == PROBLEM.wheel_noise


@pytest.mark.parametrize("reading", [",", "1,2"])
def test_a_drive_of_one_row_is_a_run_of_one_step(reading: str, cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_text(f"time,left,right,x,y\n3,1.5,2,{reading}\n")
    done = cli("run", "se2-pf", "--data", tmp_path / "one.csv", "--out", tmp_path / "a.rrd", "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out)["steps"] == 1


HEADER = "time,left,right,x,y\n0,1,2,,\n"
BAD: dict[str, tuple[str, str]] = {
    "empty": ("", "is empty"),
    "names alone": ("time,left,right\n", "names alone"),
    "no right": ("time,left\n0,1\n5,1\n", "missing right (columns: time, left)"),
    "no gyro": ("t vx theta\n0 1 2\n1 1 2\n", "missing gyro"),
    "other columns": ("a,b\n1,2\n3,4\n", "missing time, vx, gyro"),
    "no header": ("0 1 2\n1 1 2\n2 3 4\n", "missing time, vx, gyro"),
    "a cell too few": (HEADER + "5,1,2,3\n", "line 3 has 4 cells"),
    "truncated": (log_text()[:-9], "line 41 has"),
    "text": (HEADER + "5,fast,2,,\n", "line 3, left: 'fast' is not a number"),
    "NaN": (HEADER + "5,nan,2,,\n", "line 3, left is not a finite number"),
    "infinite gyro": ("t vx gyro\n0 1 2\n1 1 inf\n", "line 3, gyro is not a finite number"),
    "half a position": (HEADER + "5,1,2,3,\n", "line 3, x and y must both"),
    "infinite position": (HEADER + "5,1,2,3,inf\n", "line 3, x and y must both"),
    "time stands": (HEADER + "0,1,2,,\n", "line 3, time does not increase"),
    "two columns of one name": ("time,left,right,LEFT\n0,1,2,3\n1,1,2,3\n", "one name"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_refused(what: str, cli: Cli, tmp_path: Path) -> None:
    text, words = BAD[what]
    (tmp_path / "drive.csv").write_text(text)
    refused(cli("run", "se2-pf", "--data", tmp_path / "drive.csv", "--out", tmp_path / "a.rrd"), words)


def test_no_file_two_files_and_a_damaged_one_are_refused(cli: Cli, tmp_path: Path) -> None:
    run_on = ["run", "se2-pf", "--out", tmp_path / "a.rrd", "--data"]
    refused(cli(*run_on, tmp_path), "no file of a drive")
    refused(cli(*run_on, tmp_path / "nowhere.csv"), "no such file")
    (path,) = se2.save(PROBLEM, tmp_path)
    refused(cli("simulate", "se2", "--out", tmp_path), "there already")
    (tmp_path / "copy.txt").write_bytes(path.read_bytes())
    refused(cli(*run_on, tmp_path), "2 files of a drive")
    path.write_bytes(b"\xff\xfe\x00garbage")
    refused(cli(*run_on, path), "se2.csv: cannot be read")
    (tmp_path / "a.mat").write_text("")
    refused(cli(*run_on, tmp_path / "a.mat"), "expected a .csv")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("particles=0", "particles must be at least 1"),
        ("wheel_noise=0", "wheel_noise must be a positive"),
        ("gps_noise=-1", "gps_noise"),
        ("resample_below=2", "resample_below"),
        ("resampling=often", "systematic"),
        ("measure=maybe", "yes|no"),
        ("times=5;10", "expected seconds with commas"),
        ("times=10,5", "that increase"),
        ("times=0", "above 0"),
        ("times=nan", "above 0"),
        ("times=30", "lasts 20 s"),
    ],
)
def test_bad_parameters_are_refused(setting: str, words: str, cli: Cli, tmp_path: Path) -> None:
    refused(cli("run", "se2-pf", "--seed", "1", "--set", setting, "--out", tmp_path / "a.rrd"), words)


def test_times_within_which_the_rates_change_are_refused(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,left,right\n0,1,1\n5,1,2\n10,2,2\n")
    run_on = ["run", "se2-pf", "--data", tmp_path / "a.csv", "--out", tmp_path / "a.rrd", "--set"]
    refused(cli(*run_on, "times=10"), "rates change between 0 and 10 s")
    data = se2.se2([tmp_path / "a.csv"], RNG)
    assert len(ends(data=data, times="2,5,8")) == 3


def refused(done: Any, words: str) -> None:
    assert (done.code, done.out) == (2, ""), done
    assert done.err.count("\n") == 1
    assert words in done.err
