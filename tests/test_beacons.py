"""The drive among two beacons: the course's file over seeds, the mirror image, the model, files, bad input."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from conftest import Cli

from viz_estim.core.run import Tick, run
from viz_estim.core.spaces import wrap
from viz_estim.scenarios import beacons, beacons_files
from viz_estim.scenarios.beacons import BEACONS, BeaconData

TRUE_NOISE = {"range_noise": 0.515, "speed_noise": 0.105, "turn_noise": 0.09}
COURSE = Path("cmu16642") / "pfData.mat"
# A mode and its mirror image at the beacons' line.
MIRROR = np.array([1.0, -1.0]), np.array([0.0, 10.0])


def read(path: Path, seed: int = 0) -> BeaconData:
    return beacons.beacons([path], np.random.default_rng(seed))


def simulated(seed: int = 11, **parameters: float) -> BeaconData:
    return beacons.beacons(None, np.random.default_rng(seed), **parameters)


def errors(data: BeaconData, seed: int, **parameters: Any) -> Any:
    """The distance (T,) of the mean's position from the truth's."""
    scenario = beacons.beacons_pf(data, **parameters)
    off = []
    for step in run(scenario, seed):
        assert step.error is None
        off.append(np.hypot(*(step.stages[-1].belief.mean - step.truth)[:2]))
    return np.array(off)


def test_the_course_s_file_over_seeds(real_data: Path) -> None:
    off = np.stack([errors(read(real_data / COURSE, seed), seed) for seed in range(20)])
    good = off[:, -1] <= 0.8
    assert good.sum() >= 17
    half = off[good, 30:].mean(1)
    assert half.mean() <= 0.5
    assert (half <= 0.5).sum() >= 17


def test_few_particles_at_the_true_noise_lose_the_true_mode_and_many_keep_it(real_data: Path) -> None:
    path = real_data / COURSE
    few = [errors(read(path, seed), seed, **TRUE_NOISE)[-1] for seed in range(20)]
    assert sum(one > 0.8 for one in few) > 10
    # All 20 take half a minute: 20 of 20 end within 0.8 m.
    many = [errors(read(path, seed), seed, particles=20_000, **TRUE_NOISE)[-1] for seed in range(2)]
    assert max(many) <= 0.8


@pytest.mark.parametrize("seed", range(4))
def test_both_mirrored_modes_are_seen_before_the_turn(seed: int, real_data: Path) -> None:
    for data in (read(real_data / COURSE, seed), simulated()):
        sides, turns = [], []
        for step in run(beacons.beacons_pf(data), seed):
            position = data.log.truth[step.index, :2]
            if step.index < 6:
                modes = [mode.mean[:2] for mode in step.stages[-1].belief.modes()]
                images = [position, position * MIRROR[0] + MIRROR[1]]
                sides.append(all(min(np.hypot(*(mode - at)) for mode in modes) < 1.5 for at in images))
            if step.index >= 45:
                turns.append(len(step.stages[-1].belief.modes()))
        assert sum(sides) >= 4
        assert np.mean(np.array(turns) == 1) > 0.9


def test_the_mirror_image_gives_the_same_readings_but_turns_the_other_way() -> None:
    data = simulated()
    truth = data.log.truth
    image = np.column_stack([truth[:, :2] * MIRROR[0] + MIRROR[1], wrap(-truth[:, 2])])
    pf: Any = beacons.beacons_pf(data).estimator
    ticks = beacons.beacons_pf(data).ticks
    for k in (0, 7, 40):
        both = pf.log_likelihood(np.stack([truth[k], image[k]]), ticks[k])
        assert both[0] == pytest.approx(both[1])
    assert (np.sign(wrap(np.diff(image[:, 2]))) == -np.sign(wrap(np.diff(truth[:, 2])))).all()


def test_the_model_against_a_plain_loop() -> None:
    scenario = beacons.beacons_pf(simulated(), range_noise=0.6, speed_noise=0.2, turn_noise=0.3)
    pf: Any = scenario.estimator
    rng = np.random.default_rng(0)
    states, tick = rng.uniform(0, 3, (2, 5, 3)), scenario.ticks[3]
    want = [
        [
            sum(
                -0.5 * ((z - np.hypot(x - b[0], y - b[1])) / 0.6) ** 2 - np.log(0.6 * np.sqrt(2 * np.pi))
                for z, b in zip(
                    (tick.measurements["range/1"][0], tick.measurements["range/2"][0]), BEACONS, strict=True
                )
            )
            for x, y, _ in row
        ]
        for row in states
    ]
    np.testing.assert_allclose(pf.log_likelihood(states, tick), want)
    many = np.tile([4.0, 5.0, 0.5], (50_000, 1))
    control = np.array([2.0, -0.7])
    moved = pf.propagate(many, Tick(0.0, 0.1, control), rng)
    change = moved - many
    along = change[:, 0] * np.cos(0.5) + change[:, 1] * np.sin(0.5)
    np.testing.assert_allclose(change[:, 1] * np.cos(0.5) - change[:, 0] * np.sin(0.5), 0, atol=1e-12)
    np.testing.assert_allclose([along.mean(), change[:, 2].mean()], [0.2, -0.07], atol=5e-4)
    np.testing.assert_allclose([along.std(), change[:, 2].std()], [0.02, 0.03], rtol=0.02)


@pytest.mark.parametrize("particles", [1, 3, 1000, 1200])
def test_the_start_is_spread_over_the_area(particles: int) -> None:
    data = simulated(2)
    states = beacons.beacons_pf(data, particles=particles).beliefs[0].states
    assert states.shape == (particles, 3)
    assert ((states >= [0, 0, -np.pi]) & (states <= [20, 10, np.pi])).all()
    np.testing.assert_array_equal(states, beacons.beacons_pf(data, particles=particles).beliefs[0].states)
    other = BeaconData(data.log, data.seed + 1)
    assert (states != beacons.beacons_pf(other, particles=particles).beliefs[0].states).any()
    if particles >= 1000:
        cells = np.histogramdd(states, (4, 4, 4))[0]
        assert (np.abs(cells - particles / 64) < 8).all()
    known = beacons.beacons_pf(data, initial="truth").beliefs[0]
    np.testing.assert_allclose(known.mean, data.log.truth[0])


def test_a_hundred_thousand_particles_run() -> None:
    off = errors(simulated(duration=1), 0, particles=100_000)
    assert np.isfinite(off).all()


def test_a_drive_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    made = simulated(3, duration=4)
    (path,) = beacons.save(made, tmp_path)
    scipy.io.savemat(tmp_path / "gps.mat", {"u": np.zeros((2, 9)), "y": np.zeros((2, 9)), "t_y": np.zeros((1, 9))})
    (tmp_path / "broken.mat").write_text("not for us")
    again = beacons.beacons([tmp_path], np.random.default_rng(3))
    assert again.log.files == (path,)
    for name in ("time", "inputs", "ranges", "truth"):
        np.testing.assert_allclose(getattr(again.log, name), getattr(made.log, name), atol=1e-12)


def fields(folder: Path) -> dict[str, Any]:
    (path,) = beacons.save(simulated(3, duration=2), folder)
    found = {k: v for k, v in scipy.io.loadmat(path).items() if not k.startswith("__")}
    path.unlink()
    return found


def write(folder: Path, held: dict[str, Any]) -> Path:
    path = folder / "drive.mat"
    scipy.io.savemat(path, {k: v for k, v in held.items() if v is not None})
    return path


@pytest.mark.parametrize("name", ["q_groundtruth", "Q_GROUNDTRUTH", "q_groundTruth"])
def test_odd_files_are_read(name: str, tmp_path: Path) -> None:
    held = fields(tmp_path)
    truth = held.pop("q_groundTruth")
    truth[:, 4] = np.nan
    log = read(write(tmp_path, {"U": held["u"], "Y": held["y"], "T": 0.2, name: truth})).log
    np.testing.assert_allclose(log.time, 0.2 * np.arange(20))
    np.testing.assert_array_equal(np.isnan(log.truth).all(1), np.arange(20) == 4)
    bare = read(write(tmp_path, {"u": held["u"], "y": held["y"]}))
    np.testing.assert_allclose(bare.log.time, beacons_files.PERIOD * np.arange(20))
    assert not [step.error for step in run(beacons.beacons_pf(bare)) if step.error]


def nan(table: Any) -> Any:
    table = table.copy()
    table[1, 3] = np.nan
    return table


BAD: dict[str, tuple[Any, str]] = {
    "no u": (lambda f: {**f, "u": None}, "no field `u` (it holds q_groundTruth, y, t)"),
    "no y": (lambda f: {**f, "y": None}, "no field `y`"),
    "u turned": (lambda f: {**f, "u": f["u"].T}, "`u` of shape 2×T"),
    "a y for every tenth u": (lambda f: {**f, "y": f["y"][:, ::10]}, "`y` of shape 2×20"),
    "truth of 2 rows": (lambda f: {**f, "q_groundTruth": f["q_groundTruth"][:2]}, "`q_groundTruth` of shape 3×20"),
    "a GPS": (lambda f: {**f, "t_y": f["t"]}, "diffdrive-ekf"),
    "NaN in u": (lambda f: {**f, "u": nan(f["u"])}, "u is not a number at sample 3"),
    "NaN in y": (lambda f: {**f, "y": nan(f["y"])}, "y is not a number at sample 3"),
    "stamps too few": (lambda f: {**f, "t": f["t"][:, 1:]}, "`t` has 19 stamps"),
    "stamps go back": (lambda f: {**f, "t": f["t"][:, ::-1]}, "does not increase at sample 1"),
    "step of zero": (lambda f: {**f, "t": 0}, "length of a step"),
    "text": (lambda f: {**f, "y": "hello"}, "`y` must hold numbers"),
    "nothing": (lambda f: {**f, "u": f["u"][:, :0], "y": f["y"][:, :0]}, "`u`"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_refused(what: str, cli: Cli, tmp_path: Path) -> None:
    change, words = BAD[what]
    path = write(tmp_path, change(fields(tmp_path)))
    refused(cli("run", "beacons-pf", "--data", path, "--out", tmp_path / "a.rrd"), words)


def test_no_file_two_files_and_a_damaged_one_are_refused(cli: Cli, tmp_path: Path) -> None:
    run_on = ["run", "beacons-pf", "--out", tmp_path / "a.rrd", "--data"]
    refused(cli(*run_on, tmp_path), "no file of ranges")
    refused(cli(*run_on, tmp_path / "nowhere.mat"), "no such file")
    (path,) = beacons.save(simulated(), tmp_path)
    refused(cli("simulate", "beacons", "--out", tmp_path), "there already")
    (tmp_path / "copy.mat").write_bytes(path.read_bytes())
    refused(cli(*run_on, tmp_path), "2 files of ranges")
    path.write_bytes(path.read_bytes()[:1000])
    refused(cli(*run_on, path), "beacons.mat: cannot be read")
    (tmp_path / "a.txt").write_text("")
    refused(cli(*run_on, tmp_path / "a.txt"), "expected a .mat")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("particles=0", "particles must be at least 1"),
        ("range_noise=0", "range_noise must be a positive"),
        ("speed_noise=-1", "speed_noise"),
        ("turn_noise=0", "turn_noise"),
        ("resampling=often", "systematic or stratified or residual or multinomial"),
        ("resample_below=0", "resample_below is a fraction"),
        ("resample_below=1.5", "resample_below is a fraction"),
        ("initial=somewhere", "unknown or truth"),
        ("data.noise_scale=0", "noise_scale"),
        ("data.duration=0", "duration"),
    ],
)
def test_bad_parameters_are_refused(setting: str, words: str, cli: Cli, tmp_path: Path) -> None:
    refused(cli("run", "beacons-pf", "--seed", "1", "--set", setting, "--out", tmp_path / "a.rrd"), words)


def test_a_start_at_the_truth_needs_one(cli: Cli, tmp_path: Path) -> None:
    path = write(tmp_path, {**fields(tmp_path), "q_groundTruth": None})
    out = ["--out", tmp_path / "a.rrd"]
    refused(cli("run", "beacons-pf", "--data", path, "--set", "initial=truth", *out), "q_groundTruth")


def test_a_truth_that_begins_later_sets_the_belief_there(tmp_path: Path) -> None:
    held = fields(tmp_path)
    truth = held["q_groundTruth"].astype(float)
    truth[:, :4] = np.nan
    data = beacons.beacons([write(tmp_path, held | {"q_groundTruth": truth})], np.random.default_rng(0))
    scenario = beacons.beacons_pf(data, particles=50, initial="truth")
    assert list(scenario.beliefs) == [0, 4]
    np.testing.assert_array_equal(scenario.beliefs[4].states, np.tile(data.log.truth[4], (50, 1)))
    steps = list(run(scenario))
    assert [step.tick.dt > 0 for step in steps[:6]] == [False, True, True, True, False, True]
    assert [step.error for step in steps] == [None] * len(steps)


def refused(done: Any, words: str) -> None:
    assert (done.code, done.out) == (2, ""), done
    assert done.err.count("\n") == 1
    assert words in done.err
