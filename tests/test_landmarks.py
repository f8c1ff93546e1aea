"""Ranges to two landmarks: the model's derivatives, consistency on its own data, the mirror image, files, bad input."""

from pathlib import Path
from typing import Any

import drawn
import numpy as np
import pytest
from conftest import Cli

from viz_estim.core.beliefs import Gaussian, normal
from viz_estim.core.consistency import Tally, band, squared_distance
from viz_estim.core.kalman import finite_differences
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Tick, run
from viz_estim.core.spaces import Euclidean
from viz_estim.core.stages import Update
from viz_estim.errors import BadInput
from viz_estim.scenarios import landmarks
from viz_estim.scenarios.ranges import directions, distances

SEEDS, STEPS = 50, 400


def data(seed: int = 0, **parameters: float) -> landmarks.LandmarksData:
    return landmarks.landmarks(None, np.random.default_rng(seed), **parameters)


def test_distances_and_their_derivatives() -> None:
    rng = np.random.default_rng(1)
    at, places = rng.normal(0, 9, (3, 4, 2)), rng.normal(0, 9, (5, 2))
    found = distances(at, places)
    for i, j, k in np.ndindex(3, 4, 5):
        assert found[i, j, k] == pytest.approx(np.linalg.norm(at[i, j] - places[k]))
        plane = Euclidean(("x", "y"))
        want = finite_differences(lambda x: distances(x, places), at[i, j], plane, Euclidean([*"abcde"]))
        np.testing.assert_allclose(directions(at[i, j], places), want, atol=1e-6)
    np.testing.assert_array_equal(directions(places[0], places[:1]), 0)


def test_the_model_s_jacobians_and_noise() -> None:
    scenario = landmarks.landmarks_ekf(data(duration=2), accel_noise=0.3)
    ekf: Any = scenario.estimator
    space, x, tick = scenario.space, np.array([3.0, 12.0, -1.0, 2.0]), Tick(0.0, 0.4)
    F = finite_differences(lambda x: ekf.process(x, tick), x, space, space)
    np.testing.assert_allclose(ekf.jacobian(x, tick), F, atol=1e-7)
    sensor = ekf.sensors["range"]
    H = finite_differences(sensor.measure, x, space, sensor.space)
    np.testing.assert_allclose(sensor.jacobian(x), H, atol=1e-7)
    np.testing.assert_allclose(ekf.process(x, tick), [2.6, 12.8, -1.0, 2.0])
    # Many short steps make up a long one.
    Q, fine = np.zeros((4, 4)), Tick(0.0, 0.1)
    for _ in range(4):
        Q = ekf.jacobian(x, fine) @ Q @ ekf.jacobian(x, fine).T + ekf.process_noise(x, fine)
    np.testing.assert_allclose(ekf.process_noise(x, tick), Q, atol=1e-12)


class Chances:
    """Generators 0 to 49 side by side: member i of a batch draws from seed i alone."""

    def __init__(self) -> None:
        self.seeds = [np.random.default_rng(seed) for seed in range(SEEDS)]

    def standard_normal(self, shape: tuple[int, ...]) -> Array:
        return np.stack([rng.standard_normal(shape[1:]) for rng in self.seeds])


def on_own_model(factor: float) -> tuple[Array, Array]:
    """NEES and NIS (T, seeds) on states and readings of the filter's model; its own range noise multiplied by factor.

    All seeds are one batch: each begins at a draw from the prior, and its stamps jitter.
    """
    scenario = landmarks.landmarks_ekf(data(duration=2))
    right: Any = scenario.estimator
    wrong: Any = landmarks.landmarks_ekf(data(duration=2), range_noise=0.3 * factor).estimator
    start, rng = scenario.beliefs[0], Chances()
    any_rng: Any = rng
    mean, cov = np.tile(start.mean, (SEEDS, 1)), np.tile(start.cov, (SEEDS, 1, 1))
    belief, x = Gaussian(start.space, mean, cov), normal(start.space, mean, cov, any_rng)
    dts = np.concatenate([[0.0], np.random.default_rng(0).uniform(0.05, 0.15, STEPS - 1)])
    errors, innovations = [], []
    for time, dt in zip(np.cumsum(dts), dts, strict=True):
        x = drawn.next_state(right, start.space, x, Tick(time, dt), any_rng)
        tick = Tick(time, dt, None, drawn.readings(right, x, any_rng))
        *_, last = wrong.step(belief, tick, np.random.default_rng())
        assert isinstance(last, Update)
        belief = last.belief
        errors.append(squared_distance(x - belief.mean, belief.cov))
        innovations.append(squared_distance(last.innovation.residual, last.innovation.cov))
    return np.stack(errors), np.stack(innovations)


def share(values: Array, dof: int, count: int) -> float:
    low, high = band(dof, count)
    return float(((values >= low) & (values <= high)).mean())


def test_the_filter_is_consistent_on_data_of_its_own_model() -> None:
    nees, nis = on_own_model(1.0)
    assert share(nees.mean(1), 4, SEEDS) >= 0.9, nees.mean()
    assert share(nis.mean(0), 2, STEPS) >= 43 / 50, nis.mean()


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_noise_is_seen(factor: float) -> None:
    assert share(on_own_model(factor)[1].mean(0), 2, STEPS) == 0


def summary(made: landmarks.LandmarksData, **parameters: Any) -> dict[str, Any]:
    scenario = landmarks.landmarks_ekf(made, **parameters)
    tally = Tally(scenario.space, 0)
    for step in run(scenario):
        assert step.error is None
        tally.add(step)
    return tally.summary()


def test_the_mirror_image_explains_the_ranges_as_well() -> None:
    made = data(3)
    for initial in ("ranges", "truth"):
        right = summary(made, initial=initial)
        assert right["metrics"]["position_rmse_m"] < 1
        assert 0.9 * right["nis"]["range"]["low"] < right["nis"]["range"]["mean"] < 1.1 * right["nis"]["range"]["high"]
    right, mirrored = summary(made), summary(made, side="right")
    assert mirrored["nis"]["range"]["mean"] == pytest.approx(right["nis"]["range"]["mean"])
    assert mirrored["metrics"]["position_rmse_m"] > 50


def test_the_start_is_where_the_first_ranges_cross() -> None:
    made = data(4, duration=2, range_noise=1e-6)
    start = landmarks.landmarks_ekf(made, range_noise=0.5).beliefs[0]
    np.testing.assert_allclose(start.mean, [0, 40, 0, 0], atol=1e-4)
    H = directions(start.mean[:2], made.landmarks)
    np.testing.assert_allclose(H @ start.cov[:2, :2] @ H.T, 0.25 * np.eye(2), atol=1e-3)
    made.ranges[0] = 19.0, 20.0  # circles that do not meet: 39 m of the 40 m between the landmarks
    start = landmarks.landmarks_ekf(made, range_noise=0.5).beliefs[0]
    np.testing.assert_allclose(start.mean[:2], [19.5125, 0.5])
    assert np.isfinite(start.cov).all()


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_files_come_back_as_they_were_saved(suffix: str, tmp_path: Path, cli: Cli) -> None:
    made = data(5, duration=3)
    (path,) = landmarks.save(made, tmp_path)
    if suffix == ".npz":
        table = np.genfromtxt(path, delimiter=",", names=True)
        path.unlink()
        path = path.with_suffix(".npz")
        np.savez(path, **{name.upper(): table[name] for name in table.dtype.names})
    (tmp_path / "other.csv").write_text("time,a\n0,1\n")
    for source in ([path], [tmp_path]):
        again = landmarks.landmarks(source, np.random.default_rng(0))
        assert again.files == (path,)
        for name in ("time", "ranges", "landmarks", "truth"):
            np.testing.assert_allclose(getattr(again, name), getattr(made, name), rtol=1e-6, atol=1e-6)


def test_truth_may_be_absent(tmp_path: Path) -> None:
    (path,) = landmarks.save(data(5, duration=3), tmp_path)
    rows = [line.split(",")[:7] for line in path.read_text().splitlines()]
    path.write_text("\n".join(",".join(row) for row in rows))
    scenario = landmarks.landmarks_ekf(landmarks.landmarks([path], np.random.default_rng(0)))
    assert scenario.truth is None
    assert len(list(run(scenario))) == 31


HEADER = "time,range_1,range_2,landmark_1_x,landmark_1_y,landmark_2_x,landmark_2_y"
ROW = "5,6,0,0,9,0"
BAD = {
    "no such file": (None, "no such file"),
    "empty": ("", "bad.csv"),
    "header alone": (HEADER, "empty"),
    "a field missing": (HEADER.replace("range_2", "rage") + f"\n0,{ROW}\n1,{ROW}", "missing range_2"),
    "one row": (f"{HEADER}\n0,{ROW}", "at least 2"),
    "truncated": (f"{HEADER}\n0,{ROW}\n1,5,6", "line 3"),
    "text": (f"{HEADER}\n0,{ROW}\n1,a,6,0,0,9,0", "not a number"),
    "NaN": (f"{HEADER}\n0,{ROW}\n1,nan,6,0,0,9,0", "range_1 is not a number at sample 1"),
    "time goes back": (f"{HEADER}\n1,{ROW}\n0,{ROW}", "goes back"),
    "a landmark moves": (f"{HEADER}\n0,{ROW}\n1,5,6,0,0,9,1", "move"),
    "one place": (f"{HEADER}\n0,5,6,1,1,1,1\n1,5,6,1,1,1,1", "one place"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_refused(what: str, cli: Cli, tmp_path: Path) -> None:
    content, words = BAD[what]
    path = tmp_path / "bad.csv"
    if content is not None:
        path.write_text(content)
    refused(cli("run", "landmarks-ekf", "--data", path, "--out", tmp_path / "a.rrd"), words)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("range_noise=0", "range_noise must be a positive"),
        ("accel_noise=-1", "accel_noise"),
        ("gate=2", "gate"),
        ("data.rate=0", "rate"),
        ("data.duration=0.01", "fewer than two"),
        ("side=up", "left or right"),
    ],
)
def test_bad_parameters_are_refused(setting: str, words: str, cli: Cli, tmp_path: Path) -> None:
    refused(cli("run", "landmarks-ekf", "--seed", "1", "--set", setting, "--out", tmp_path / "a.rrd"), words)


def test_what_is_there_is_not_written_over(cli: Cli, tmp_path: Path) -> None:
    assert cli("simulate", "landmarks", "--set", "duration=2", "--out", tmp_path).code == 0
    refused(cli("simulate", "landmarks", "--out", tmp_path), "there already")


def refused(done: Any, words: str) -> None:
    assert (done.code, done.out) == (2, ""), done
    assert done.err.count("\n") == 1
    assert words in done.err


def test_a_truth_that_begins_later_sets_the_belief_there() -> None:
    data = landmarks.landmarks(None, np.random.default_rng(3), duration=5.0)
    data.truth[:7, :2] = np.nan
    scenario = landmarks.landmarks_ekf(data, initial="truth")
    assert list(scenario.beliefs) == [0, 7]
    np.testing.assert_array_equal(scenario.beliefs[7].mean, data.truth[7])
    assert [k for k, tick in enumerate(scenario.ticks) if tick.dt == 0] == [0, 7]
    assert np.hypot(*(list(run(scenario))[-1].stages[-1].belief.mean - data.truth[-1])[:2]) < 1
    data.truth[:] = np.nan
    with pytest.raises(BadInput, match="initial=truth needs x and y"):
        landmarks.landmarks_ekf(data, initial="truth")
