"""The unknown parameter: which sign it settles on, how honest its ±σ is, its files, and one line for bad input."""

from pathlib import Path

import numpy as np
import pytest
from conftest import Cli

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.kalman import KalmanFilter, finite_differences
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.errors import BadInput
from viz_estim.scenarios import parameter
from viz_estim.scenarios.parameter import ParameterData, parameter_ekf, simulate


def simulated(seed: int = 0, **settings: float) -> ParameterData:
    return parameter.parameter(None, np.random.default_rng(seed), **settings)


def end(scenario: Scenario) -> Gaussian:
    *_, last = run(scenario)
    assert last.error is None
    belief = last.stages[-1].belief
    assert isinstance(belief, Gaussian)
    return belief


def naive_ekf(y: Array, prior_a: float) -> tuple[Array, Array]:
    """The filter written out for two numbers, in a loop."""
    x, a, P = 1.0, prior_a, np.diag([2.0, 0.25])
    for k, reading in enumerate(y):
        if k:
            F = np.array([[a, x], [0.0, 1.0]])
            x, P = a * x, F @ P @ F.T + np.diag([1.0, 0.0])
        H = np.array([x / np.sqrt(x * x + 1), 0.0])
        K = P @ H / (H @ P @ H + 0.5)
        x, a = np.array([x, a]) + K * (reading - np.sqrt(x * x + 1))
        P = P - np.outer(K, H @ P)
    return np.array([x, a]), P


@pytest.mark.parametrize("seed", range(6))
def test_it_is_the_filter_written_out_and_the_prior_decides_the_sign(seed: int) -> None:
    data = simulated(seed)
    ends = {}
    for prior_a in (-0.5, 0.5):
        ends[prior_a] = belief = end(parameter_ekf(data, prior_a=prior_a))
        mean, cov = naive_ekf(data.y, prior_a)
        np.testing.assert_allclose(belief.mean, mean, rtol=1e-7)
        np.testing.assert_allclose(belief.cov, cov, rtol=1e-6, atol=1e-12)
    assert ends[-0.5].mean[1] == pytest.approx(-1.0, abs=0.15)
    assert ends[0.5].mean[1] == pytest.approx(-ends[-0.5].mean[1], abs=1e-9)  # the mirror, exactly as good
    np.testing.assert_allclose(np.abs(ends[0.5].mean), np.abs(ends[-0.5].mean), rtol=1e-9)


def test_from_a_prior_of_zero_it_never_moves() -> None:
    belief = end(parameter_ekf(simulated(3), prior_a=0.0))
    assert (belief.mean[1], belief.cov[1, 1]) == (0.0, 0.25)


def test_the_jacobians_are_the_derivatives() -> None:
    scenario, rng = parameter_ekf(simulated()), np.random.default_rng(1)
    estimator, space = scenario.estimator, scenario.space
    assert isinstance(estimator, KalmanFilter)
    sensor, tick = estimator.sensors["y"], Tick(1.0, 1.0)
    assert sensor.jacobian is not None
    for x in 3 * rng.standard_normal((10, 2)):
        F = finite_differences(lambda y: estimator.process(y, tick), x, space, space)
        np.testing.assert_allclose(estimator.jacobian(x, tick), F, atol=1e-8)
        np.testing.assert_allclose(
            sensor.jacobian(x), finite_differences(sensor.measure, x, space, sensor.space), atol=1e-8
        )


@pytest.mark.parametrize("prior_a", [-0.5, 0.5])
def test_the_coverage_over_200_seeds_is_that_of_200_runs(prior_a: float) -> None:
    facts = parameter_ekf(simulated(), prior_a=prior_a).facts
    ends = [naive_ekf(simulate(np.random.default_rng(seed), 100).y, prior_a) for seed in range(200)]
    a, sigma = np.array([mean[1] for mean, _ in ends]), np.sqrt([cov[1, 1] for _, cov in ends])
    assert facts["coverage_of_abs_a_200_seeds"] == (np.abs(np.abs(a) - 1) <= sigma).mean()
    assert facts["coverage_of_a_200_seeds"] == (np.abs(a + 1) <= sigma).mean()
    assert facts["negative_a_200_seeds"] == (a < 0).mean() == (prior_a < 0)
    assert facts["coverage_of_abs_a_200_seeds"] == pytest.approx(0.68, abs=0.1)  # an honest ±σ, of the size alone
    assert facts["coverage_of_a_200_seeds"] == (facts["coverage_of_abs_a_200_seeds"] if prior_a < 0 else 0.0)


def test_the_simulation_draws_from_the_model() -> None:
    sims = [simulate(np.random.default_rng(seed), 40, -0.9) for seed in range(2000)]
    x, y = np.stack([one.truth[:, 0] for one in sims]), np.stack([one.y for one in sims])
    assert (x[:, 0].mean(), x[:, 0].var()) == (pytest.approx(1, abs=0.1), pytest.approx(2, abs=0.2))
    steps, noise = x[:, 1:] + 0.9 * x[:, :-1], y - np.sqrt(x**2 + 1)
    assert (steps.mean(), steps.var()) == (pytest.approx(0, abs=0.02), pytest.approx(1, abs=0.02))
    assert (noise.mean(), noise.var()) == (pytest.approx(0, abs=0.02), pytest.approx(0.5, abs=0.01))


def test_files_come_back_as_they_were_saved_and_need_no_truth(tmp_path: Path) -> None:
    data = simulated(4)
    (path,) = parameter.save(data, tmp_path)
    for source in ([path], [tmp_path]):
        again = parameter.parameter(source, np.random.default_rng())
        np.testing.assert_array_equal(again.y, data.y)
        np.testing.assert_array_equal(again.truth, data.truth)
        assert again.files == (path,)
    with pytest.raises(BadInput, match="is there already"):
        parameter.save(data, tmp_path)
    np.savez(tmp_path / "bare.npz", Y=data.y)
    bare = parameter.parameter([tmp_path / "bare.npz"], np.random.default_rng())
    assert np.isnan(bare.truth).all()
    np.testing.assert_array_equal(end(parameter_ekf(bare)).mean, end(parameter_ekf(data)).mean)
    (tmp_path / "track.csv").write_text("t,x,y\n0,1,2\n1,2,3\n")  # somebody else's y
    (tmp_path / "bare.npz").unlink()
    assert parameter.parameter([tmp_path], np.random.default_rng()).files == (path,)


BAD_FILES = {
    "no y": ("bad.csv", "x,a\n1,-1\n2,-1\n", "missing y (columns: x, a)"),
    "NaN": ("bad.csv", "y\n1\nnan\n3\n", "y is not a number at sample 1"),
    "an empty cell": ("bad.csv", "y,x\n1,2\n,2\n", "y is not a number at sample 1"),
    "a word": ("bad.csv", "y\n1\ntwo\n", "line 3, y: 'two'"),
    "a short line": ("bad.csv", "y,x,a\n1,2,-1\n1,2\n", "line 3 has 2 cells"),
    "header alone": ("bad.csv", "y,x,a\n", "is empty"),
    "empty": ("bad.csv", "", "bad.csv"),
    "foreign suffix": ("bad.txt", "y\n1\n", "expected a .csv or .npz"),
    "no archive": ("bad.npz", "hello", "cannot be read"),
}


@pytest.mark.parametrize("what", BAD_FILES)
def test_a_bad_file_is_refused_in_one_line(what: str, cli: Cli, tmp_path: Path) -> None:
    name, text, words = BAD_FILES[what]
    (tmp_path / name).write_text(text)
    code, out, err = cli("run", "parameter-ekf", "--data", tmp_path / name, "--out", tmp_path / "out.rrd")
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert words in err
    assert name in err
    assert not (tmp_path / "out.rrd").exists()


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("measurement_noise=0", "measurement_noise must be a positive number"),
        ("process_noise=-1", "process_noise must be a positive number"),
        ("prior_a_std=0", "prior_a_std must be a positive number"),
        ("data.observations=1", "2 to 100000 observations"),
        ("data.a=2", "a in [−1, 1]"),
        ("prior_b=1", "no parameter prior_b"),
    ],
)
def test_a_bad_setting_is_refused_in_one_line(setting: str, words: str, cli: Cli, tmp_path: Path) -> None:
    done = cli("run", "parameter-ekf", "--seed", 1, "--set", setting, "--out", tmp_path / "out.rrd")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1), done.err
    assert words in done.err


def test_paths_without_one_log_are_refused(cli: Cli, tmp_path: Path) -> None:
    for path, words in ((tmp_path, "no log of the system parameter"), (tmp_path / "gone.csv", "no such file")):
        done = cli("run", "parameter-ekf", "--data", path, "--out", tmp_path / "out.rrd")
        assert (done.code, done.err.count("\n")) == (2, 1)
        assert words in done.err
    for name in ("one.csv", "two.csv"):
        (tmp_path / name).write_text("y\n1\n2\n")
    done = cli("run", "parameter-ekf", "--data", tmp_path, "--out", tmp_path / "out.rrd")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "one.csv, two.csv" in done.err
