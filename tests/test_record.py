"""Code that is no scenario, recorded: a person's own loop, FilterPy's filters, Stone Soup's predictor and updater."""

import datetime
import io
import json
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli
from filterpy.kalman import (  # type: ignore[import-untyped]
    ExtendedKalmanFilter,
    KalmanFilter,
    MerweScaledSigmaPoints,
    UnscentedKalmanFilter,
)
from PIL import Image
from rerun.chunk import RrdReader
from scipy.sparse import csr_array

import viz_estim
from viz_estim import told
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO2, SO3, Euclidean, Product
from viz_estim.diagnose import diagnose

F = np.array([[1.0, 0.1], [0.0, 1.0]])
Names = dict[str, str]
STATE: Names = {"x": "m", "v": "m/s"}


def readings(count: int = 60, seed: int = 0) -> tuple[Array, Array]:
    """The true states (T, 2) of something that moves evenly, and noisy readings (T, 1) of where it is."""
    rng = np.random.default_rng(seed)
    truth = np.stack([0.1 * np.arange(count), np.ones(count)], axis=1)
    return truth, truth[:, :1] + 0.5 * rng.standard_normal((count, 1))


def own_loop(
    path: Path, *, every: int = 1, fails: int | None = None, start: float = 0.0
) -> tuple[list[Array], list[Array]]:
    """A Kalman filter as a person writes it, in place; returns the beliefs at the end of each step."""
    truth, z = readings()
    x, P = np.zeros((2, 1)), np.eye(2)
    means, covs = [], []
    with viz_estim.record(path, STATE, sensors={"gps": {"x": "m"}}) as rec:
        for k in range(60):
            if k:
                x[:] = F @ x
                P[:] = F @ P @ F.T + 0.01 * np.eye(2)
                rec.stage("predict", mean=x, cov=P)
            if k == fails:
                np.linalg.cholesky(-P)
            if k % every == 0:
                y, S = z[k] - x[0], P[:1, :1] + 0.25
                K = P[:, :1] / S
                x += K @ y[:, None]
                P -= K @ S @ K.T
                rec.stage("update", mean=x, cov=P, residual=y, residual_cov=S, gain=K, sensor="gps", z=z[k], noise=0.25)
            rec.step(time=start + 0.1 * k, truth=truth[k])
            means.append(x[:, 0].copy())
            covs.append(P.copy())
    return means, covs


def test_what_is_told_is_kept_to_the_bit(tmp_path: Path) -> None:
    means, covs = own_loop(tmp_path / "own.rrd", every=3)
    run = viz_estim.load(tmp_path / "own.rrd")
    assert run.complete
    np.testing.assert_array_equal(run.mean, means)
    np.testing.assert_array_equal(run.cov, covs)
    np.testing.assert_array_equal(run.truth, readings()[0])
    assert {name: len(table.step) for name, table in run.stages.items()} == {"predict": 59, "update": 20}
    assert (run.space.names, run.space.units) == (("x", "v"), ("m", "m/s"))
    nis = run.summary()["nis"]["gps"]
    assert nis["dof"] == 1
    residual, S = (run.stages["update"].values[f"innovation.{k}"] for k in ("residual", "cov"))
    assert nis["mean"] == pytest.approx((residual[:, 0] ** 2 / S[:, 0, 0]).mean())
    assert 0 < run.summary()["metrics"]["state_rmse_m"] < 2 if "state_rmse_m" in run.summary()["metrics"] else True
    np.testing.assert_array_equal(run.stages["update"].values["innovation.z"][:, 0], readings()[1][::3, 0])


def test_it_opens_shows_compares_and_debugs_like_any_other(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    own_loop(tmp_path / "a.rrd")
    own_loop(tmp_path / "b.rrd", every=2)
    shown = json.loads(cli("show", "a.rrd", "--step", 9, "--json").out)
    assert [stage["name"] for stage in shown["stages"]] == ["predict", "update"]
    assert "moved" in shown["stages"][1]
    assert "NIS gps" in cli("show", "a.rrd").out
    same, other = cli("compare", "a.rrd", "a.rrd", "--json"), cli("compare", "a.rrd", "b.rrd", "--json")
    assert (same.code, other.code) == (0, 1)
    assert cli("diagnose", "a.rrd", "--json").code in (0, 1)
    assert cli("export", "a.rrd", "--to", "csv", "-o", "a.csv").code == 0
    monkeypatch.setattr("sys.stdin", io.StringIO("break nis.gps > 1\nc\nwhy\nprint mean.x\nset q=1\nstage back\nwhy\n"))
    done = cli("debug", "a.rrd", "--no-viewer")
    assert (done.code, done.err) == (0, "")
    assert "gps.x  ν" in done.out
    assert "mean.x = " in done.out
    assert "error: a.rrd: recorded by viz_estim.record: there is no scenario" in done.out
    forked = cli("fork", "a.rrd", "--at", 3, "--set", "q=1")
    assert (forked.code, forked.err.count("\n")) == (2, 1)


def test_runs_by_other_clocks_are_said_to_be_so(cli: Cli, tmp_path: Path) -> None:
    own_loop(tmp_path / "a.rrd")
    own_loop(tmp_path / "b.rrd", start=1.7e9)
    done = cli("compare", tmp_path / "a.rrd", tmp_path / "b.rrd", "--json")
    assert done.code == 1
    reason = json.loads(done.out)["reason"]
    assert "from 1700000000 to 1700000005.9 s, the first from 0 to 5.9 s" in reason


def cloud(path: Path) -> Array:
    """A particle filter of 50 points as a person writes it; the weighted means at the end of each step."""
    rng, (truth, z) = np.random.default_rng(0), readings()
    x, means = rng.normal(0, 1, (50, 2)), []
    with viz_estim.record(path, Product(position=Euclidean(("x", "y"), "m"))) as rec:
        for k in range(20):
            x += 0.1 * rng.standard_normal(x.shape)
            rec.stage("predict", states=x)
            likelihoods = -2 * (z[k] - x[:, 0]) ** 2
            w = np.exp(likelihoods)
            rec.stage("weigh", states=x, weights=w, log_likelihoods=likelihoods, z=z[k], sensor="gps")
            ancestors = np.sort(rng.choice(50, 50, p=w / w.sum()))
            x[:] = x[ancestors]
            rec.stage("resample", states=x, log_weights=np.full(50, -3.0), ancestors=ancestors)
            rec.step(time=0.1 * k, truth=truth[k])
            means.append(x.mean(0))
    return np.array(means)


def labels(path: Path) -> Array:
    """A Bayes filter over labels as a person writes it; the probabilities at the end of each step."""
    p, T, ended = np.ones(3) / 3, 0.85 * np.eye(3) + 0.05, []
    with viz_estim.record(path, ["calm", "warm", "cold"]) as rec:
        for k in range(20):
            p = p @ T
            rec.stage("predict", probabilities=p, transition=T)
            likelihoods = np.array([[0.7, 0.2, 0.1], [0.3, 0.5, 0.2]][k % 2])
            p = p * likelihoods
            told = dict(zip(("cold", "warm", "calm"), p[::-1], strict=True))
            rec.stage("update", probabilities=told, log_likelihoods=np.log(likelihoods), z=k % 2, sensor="heat")
            p /= p.sum()
            rec.step(time=k, truth="calm" if k < 9 else "warm")
            ended.append(p)
    return np.array(ended)


def joint(path: Path) -> Array:
    """A filter with one update of two sensors, that tells all there is; the means at the end of each step."""
    nav = Product(gps=Euclidean(["x"], "m"), odometer=Euclidean(["v"], "m/s"))
    rng, (truth, _) = np.random.default_rng(0), readings()
    x, P, R, means = np.zeros(2), np.eye(2), np.diag([0.25, 0.1]), []
    with viz_estim.record(path, STATE, sensors={"nav": nav}) as rec:
        for k in range(60):
            drawn = x + rng.standard_normal((5, 2))
            x, P = F @ x, F @ P @ F.T + 0.01 * np.eye(2)
            rec.stage(
                "predict", mean=x, cov=P, transition=F, noise=0.01 * np.eye(2), drawn=drawn, propagated=drawn @ F.T
            )
            z, expected, used = truth[k] + np.sqrt(np.diag(R)) * rng.standard_normal(2), x, k % 7 > 0
            S = P + R
            K = used * P @ np.linalg.inv(S)
            x, P = x + K @ (z - x), P - K @ S @ K.T
            rec.stage(
                "update", mean=x, cov=P, residual=z - expected, residual_cov=S, gain=K, sensor="nav", noise=R,
                predicted=expected, used=used, sigma=drawn, mapped=drawn, speed=x[1],
            )  # fmt: skip
            rec.step(time=0.1 * k, truth=truth[k])
            means.append(x)
    return np.array(means)


def test_particles_are_told_like_gaussians(tmp_path: Path) -> None:
    means = cloud(tmp_path / "a.rrd")
    run = viz_estim.load(tmp_path / "a.rrd")
    np.testing.assert_allclose(run.mean, means, atol=1e-12)
    weigh, resample = run.stages["weigh"].values, run.stages["resample"].values
    np.testing.assert_allclose(np.exp(weigh["log_weights"]).sum(1), 1)
    np.testing.assert_allclose(weigh["evidence"], np.log(np.exp(weigh["log_likelihoods"]).mean(1)))
    np.testing.assert_allclose(weigh["ess"], 1 / (np.exp(weigh["log_weights"]) ** 2).sum(1))
    np.testing.assert_array_equal(resample["ess"], weigh["ess"])
    before = run.stages["weigh"].values["states"]
    for row, ancestors in enumerate(resample["ancestors"].astype(int)):
        np.testing.assert_array_equal(resample["states"][row], before[row][ancestors])
        assert resample["distinct"][row] == len(set(ancestors.tolist()))


def test_labels_are_told_like_gaussians(tmp_path: Path) -> None:
    ended = labels(tmp_path / "a.rrd")
    run = viz_estim.load(tmp_path / "a.rrd")
    assert run.labels == ("calm", "warm", "cold")
    np.testing.assert_allclose(np.exp(run.ends["log_probabilities"]), ended, atol=1e-12)
    assert run.truth[:, 0].tolist() == [0] * 9 + [1] * 11
    assert 0 < run.summary()["metrics"]["accuracy"] < 1


def test_an_update_tells_all_that_a_scenario_s_does(tmp_path: Path) -> None:
    means = joint(tmp_path / "a.rrd")
    run = viz_estim.load(tmp_path / "a.rrd")
    np.testing.assert_array_equal(run.mean, means)
    values = run.stages["update"].values
    np.testing.assert_array_equal(values["innovation.used"].all(1), np.arange(60) % 7 > 0)
    np.testing.assert_array_equal(values["innovation.predicted"], run.stages["predict"].mean)
    np.testing.assert_allclose(values["innovation.z"], values["innovation.predicted"] + values["innovation.residual"])
    np.testing.assert_array_equal(values["speed"], means[:, 1])
    assert {"sigma.points", "mapped.points"} <= values.keys()
    assert {"transition", "noise", "drawn.points"} <= run.stages["predict"].values.keys()
    assert run.summary()["nis"].keys() == {"gps", "odometer"}


KINDS: dict[str, tuple[Callable[[Path], Array], str, str]] = {
    "particles": (
        cloud,
        "break ess < 30\nc\nwhy\nstage back\nwhy\nprint before.std\nprint states[0]\n",
        "weigh took no",
    ),
    "labels": (labels, "break probability[0] > .9\nc\nwhy\nprint log_likelihoods\n", "the readings' log-likelihoods"),
    "joint": (joint, "break nis.odometer > 2\nc\nwhy\nprint speed\nprint sigma[0]\n", "odometer.v  ν "),
}


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_is_shown_compared_diagnosed_debugged_and_exported(
    kind: str, cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make, script, words = KINDS[kind]
    monkeypatch.chdir(tmp_path)
    make(tmp_path / "a.rrd")
    for line in ("show a.rrd", "show a.rrd --step 9", "compare a.rrd a.rrd", "export a.rrd --to csv -o a.csv",
                 "export a.rrd --to npz -o a.npz"):  # fmt: skip
        done = cli(*line.split())
        assert (done.code, done.err) == (0, ""), done.err
    tum = cli("export", "a.rrd", "--to", "tum", "-o", "a.tum")
    assert tum.code == (0 if kind == "particles" else 2), tum.err
    diagnosed = cli("diagnose", "a.rrd", "--json")
    assert (diagnosed.code in (0, 1), diagnosed.err) == (True, "")
    codes = {one["code"] for one in json.loads(diagnosed.out)["findings"] if one["severity"] == "error"}
    assert not codes - {"overconfident", "particles_collapsed"}, codes
    monkeypatch.setattr("sys.stdin", io.StringIO(script + "break finding\ngoto 0\nc\nnames\nset q=1\n"))
    done = cli("debug", "a.rrd", "--no-viewer")
    assert (done.code, done.err) == (0, "")
    assert words in done.out
    assert done.out.count("error: ") == 1  # that of set
    assert "  \n" not in done.out


def test_a_cloud_without_a_weight_is_kept_as_it_is(cli: Cli, tmp_path: Path) -> None:
    """The commonest end of a particle filter: no particle explains the reading."""
    with viz_estim.record(tmp_path / "a.rrd") as rec:
        for k in range(4):
            rec.stage("weigh", states=np.arange(5.0), weights=np.full(5, float(k < 3)))
            rec.step(time=k)
    run = viz_estim.load(tmp_path / "a.rrd")
    assert np.isfinite(run.mean[:3]).all()
    assert np.isnan(run.mean[3]).all()
    for arguments in (["show", tmp_path / "a.rrd", "--step", 3], ["diagnose", tmp_path / "a.rrd"]):
        assert cli(*arguments).code in (0, 1)


@pytest.mark.parametrize(
    ("names", "parts"),
    [
        ({"x": "m", "y": "m"}, {"position": 2}),
        ({"x": "m", "y": "m", "z": "m", "vx": "m/s"}, {"position": 3, "state": 1}),
        ({"x": "m", "y": "m", "theta": "rad", "v": "m/s", "w": "rad/s"}, {"position": 2, "heading": 1, "state": 2}),
        ({"x": "m", "y": "m", "theta": "deg"}, {"position": 2, "state": 1}),
        ({"x": "m", "v": "m/s"}, None),
        ({"x": "px", "y": "px"}, None),
        (["x", "y"], None),
    ],
)
def test_a_place_and_a_heading_are_known_by_name_and_unit(names: Any, parts: dict[str, int] | None) -> None:
    space: Any = told.state_of(names)
    assert (len(space.names), len(space.axes)) == (len(names), len(names))
    if parts is None:
        assert isinstance(space, Euclidean)
    else:
        assert {name: len(part.names) for name, part in space.parts.items()} == parts
    assert list(space.units) == (list(names.values()) if isinstance(names, dict) else [""] * len(names))


@pytest.mark.draws
def test_the_view_frames_a_run_of_which_only_the_start_was_known(cli: Cli, tmp_path: Path) -> None:
    """Far from where it began: the way so far is in the picture, and no speck of it."""
    with viz_estim.record(tmp_path / "a.rrd", {"x": "m", "y": "m", "theta": "rad"}) as rec:
        for k in range(60):
            x = np.array([40 * np.cos(k / 9), 40 * np.sin(k / 9), k / 9])
            rec.stage("predict", mean=x, cov=np.eye(3))
            rec.step(time=k, truth=1.1 * x if k > 9 else [np.nan] * 3)
    done = cli("snapshot", tmp_path / "a.rrd", "--step", 59, "--size", "600x500", "-o", tmp_path / "a.png")
    assert (done.code, done.err) == (0, "")
    pixels = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)[70:300, 10:230]
    rows, columns = np.nonzero((pixels[..., 0] > 150) & (pixels[..., 2] < 80))  # amber
    assert min(np.ptp(rows), np.ptp(columns)) > 70


@pytest.mark.draws
def test_it_draws(cli: Cli, tmp_path: Path) -> None:
    space = Product(position=Euclidean(("x", "y"), "m"), heading=SO2())
    with viz_estim.record(tmp_path / "a.rrd", space, sensors={"gps": Euclidean(("x", "y"), "m")}) as rec:
        for k in range(30):
            x, P = np.array([np.cos(k / 9), np.sin(k / 9), k / 9]), 0.1 * np.eye(3)
            rec.stage("predict", mean=x, cov=P)
            rec.stage("update", mean=x, cov=P, residual=[0.1, -0.1], residual_cov=np.eye(2), sensor="gps")
            rec.step(time=k, truth=x + 0.1 if k > 5 else [np.nan] * 3)
    done = cli("snapshot", tmp_path / "a.rrd", "--step", 20, "--size", "500x400", "-o", tmp_path / "a.png")
    assert (done.code, done.err) == (0, "")
    run = viz_estim.load(tmp_path / "a.rrd")
    assert np.isnan(run.truth[:6]).all()
    assert np.isfinite(run.truth[6:]).all()


def gps_drawn(path: Path) -> list[list[list[float]]]:
    """The places of the stage `update`'s readings by `gps` as drawn, row by row, where a row has any."""
    return [
        row
        for chunk in RrdReader(path).stream()
        if chunk.entity_path == "/world/update/gps" and not chunk.is_static
        for row in chunk.to_record_batch().column("Points3D:positions").to_pylist()
        if row
    ]


@pytest.mark.parametrize("told_of", ["residual", "z", "predicted"])
@pytest.mark.parametrize("kind", ["gaussian", "particles"])
def test_a_reading_of_a_place_is_drawn_where_it_was_told_alone(kind: str, told_of: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    names = {"x": "m", "y": "m"}
    with viz_estim.record(tmp_path / "a.rrd", names, sensors={"gps": names}) as rec:
        for k in range(20):
            x, ν = np.array([10.0 + k, 5.0]), np.array([0.1, -0.2])
            known = {"z": {"z": x + ν}, "predicted": {"predicted": x}}.get(told_of, {})
            belief: dict[str, Any] = (
                {"mean": x, "cov": np.eye(2)} if kind == "gaussian" else {"states": x + rng.normal(size=(30, 2))}
            )
            rec.stage("update", **belief, residual=ν, residual_cov=np.eye(2), sensor="gps", **known)
            rec.step(time=k)
    drawn = [place for row in gps_drawn(tmp_path / "a.rrd") for place in row]
    expected = [] if told_of == "residual" else [[10.1 + k, 4.8, 0.0] for k in range(20)]
    np.testing.assert_allclose(drawn, expected, atol=1e-5)
    plotted = [
        value
        for chunk in RrdReader(tmp_path / "a.rrd").stream()
        if chunk.entity_path == "/plots/state/position.x/reading" and not chunk.is_static
        for value in chunk.to_record_batch().column("Measurements:values").flatten().to_pylist()
    ]
    np.testing.assert_allclose(plotted, [x for x, _, _ in expected], atol=1e-9)


def test_a_reading_that_was_expected_at_the_origin_is_drawn(tmp_path: Path) -> None:
    names = {"x": "m", "y": "m"}
    with viz_estim.record(tmp_path / "a.rrd", names, sensors={"gps": names}) as rec:
        for k in range(3):
            rec.stage("predict", mean=[0.0, 0.0], cov=np.eye(2))
            rec.stage("update", mean=[0.5, 0.5], cov=np.eye(2), residual=[1, 1], residual_cov=np.eye(2), sensor="gps")
            rec.step(time=k)
    assert gps_drawn(tmp_path / "a.rrd") == [[[1.0, 1.0, 0.0]]] * 3


def test_a_group_s_state_has_more_numbers_than_directions(tmp_path: Path) -> None:
    with viz_estim.record(tmp_path / "a.rrd", Product(attitude=SO3())) as rec:
        rec.stage("predict", mean=[1, 0, 0, 0], cov=np.eye(3))
        rec.step(time=0, truth=[1, 0, 0, 0])
    assert viz_estim.load(tmp_path / "a.rrd").summary()["metrics"]["attitude_rmse_deg"] == 0.0


def test_a_recording_that_was_closed_is_not_begun_anew(tmp_path: Path) -> None:
    """As in a notebook, where the loop's cell is run again without the one that began the recording."""
    with viz_estim.record(tmp_path / "a.rrd") as rec:
        for k in range(5):
            rec.stage("predict", mean=[0.0], cov=[[1.0]])
            rec.step(time=k)
    kept = (tmp_path / "a.rrd").read_bytes()
    with pytest.raises(ValueError, match="is closed"):
        rec.stage("predict", mean=[0.0], cov=[[1.0]])
    with pytest.raises(ValueError, match="is closed"):
        rec.step(time=9)
    rec.close()
    assert (tmp_path / "a.rrd").read_bytes() == kept


def test_without_names_components_are_counted(tmp_path: Path) -> None:
    with viz_estim.record(tmp_path / "a.rrd") as rec:
        rec.stage("update", mean=3.0, cov=1.0, residual=0.5, residual_cov=2.0, gain=0.3)
        rec.step(time=0)
    run = viz_estim.load(tmp_path / "a.rrd")
    assert run.space.names == ("x0",)
    assert run.stages["update"].spaces["innovation"].names == ("z.z",)


def test_an_exception_is_the_run_s_failure(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.rrd"
    with pytest.raises(np.linalg.LinAlgError):
        own_loop(path, fails=20)
    run = viz_estim.load(path)
    assert len(run.step) == 21
    assert run.properties["result"]["error"] | {"message": ""} == {"step": 20, "stage": "after predict", "message": ""}
    monkeypatch.setattr("sys.stdin", io.StringIO("back\n"))
    told = cli("debug", path, "--no-viewer").out.splitlines()
    assert told[0].startswith("step 20  predict")
    assert told[1].startswith("FAILED after predict: LinAlgError")


BAD: dict[str, tuple[Callable[[Any], object], str]] = {
    "a mean of another length": (lambda rec: rec.stage("p", mean=[1, 2, 3], cov=np.eye(2)), "mean: expected"),
    "a cov of another shape": (lambda rec: rec.stage("p", mean=[1, 2], cov=np.eye(3)), "cov: expected"),
    "a residual alone": (lambda rec: rec.stage("p", mean=[1, 2], cov=np.eye(2), residual=[1]), "together"),
    "no belief": (lambda rec: rec.stage("p"), "give mean and cov, or states"),
    "two beliefs": (lambda rec: rec.stage("p", mean=[1, 2], cov=np.eye(2), states=np.eye(2)), "give mean and cov, or"),
    "a belief of another kind": (lambda rec: rec.stage("p", states=np.eye(2)), "of another kind than before"),
    "a number of another shape": (
        lambda rec: [rec.stage("p", mean=[1, 2], cov=np.eye(2), one=[1]), rec.stage("p", mean=[1, 2], cov=np.eye(2))],
        "one was of shape (1,) when the stage first came, now none",
    ),
    "a number that is a belief": (lambda rec: rec.stage("p", mean=[1, 2], cov=np.eye(2), belief=1), "cannot be a"),
    "a gain that does not fit": (
        lambda rec: rec.stage("p", mean=[1, 2], cov=np.eye(2), residual=[1], residual_cov=1, gain=np.eye(3)),
        "gain: expected the shape (2, 1), got (3, 3)",
    ),
    "a stage that is no name": (lambda rec: rec.stage("a b", mean=[1, 2], cov=np.eye(2)), "a stage's name is of"),
    "a step without a stage": (lambda rec: rec.step(time=3), "tell of a stage"),
    "a step in the past": (
        lambda rec: [rec.stage("p", mean=[1, 2], cov=np.eye(2)), rec.step(time=-1)],
        "time -1 is not after",
    ),
    "a time in nanoseconds": (
        lambda rec: [rec.stage("p", mean=[1, 2], cov=np.eye(2)), rec.step(time=1_700_000_000_000_000_000)],
        "is none in seconds; divide ns by 1e9",
    ),
    "a truth that comes late": (
        lambda rec: [rec.stage("p", mean=[1, 2], cov=np.eye(2)), rec.step(time=1, truth=[1, 2])],
        "step 1: a truth, but the first step had none; give that one of NaN",
    ),
    "a reading of another length": (
        lambda rec: rec.stage("p", mean=[1, 2], cov=np.eye(2), residual=[1], residual_cov=1, z=[1, 2]),
        "z: expected the shape (1,), got (2,)",
    ),
    "a misspelt number": (
        lambda rec: rec.stage("p", mean=[1, 2], cov=np.eye(2), residuals=[1]), "residuals: did you mean residual?"
    ),
    "a complex covariance": (
        lambda rec: rec.stage("p", mean=[1, 2], cov=1j * np.eye(2)), "stage p: cov: expected real numbers, got complex"
    ),
    "a state that grows": (
        lambda rec: rec.stage("p", mean=[1, 2, 3], cov=np.eye(3)), "a state keeps its size: give what is not there yet"
    ),
    "a truth of another length": (
        lambda rec: [rec.stage("p", mean=[1, 2], cov=np.eye(2)), rec.step(time=1, truth=[1])],
        "truth: expected",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_what_does_not_fit_is_refused(what: str, tmp_path: Path) -> None:
    wrong, words = BAD[what]
    with viz_estim.record(tmp_path / "a.rrd", STATE) as rec:
        rec.stage("predict", mean=[0, 1], cov=np.eye(2))
        rec.step(time=0)
        with pytest.raises(ValueError, match=words.replace("(", r"\(").replace(")", r"\)")):
            wrong(rec)


def linear() -> Any:
    kf = KalmanFilter(2, 1)
    kf.F, kf.H, kf.R, kf.Q = F.copy(), np.array([[1.0, 0.0]]), np.array([[0.25]]), 0.01 * np.eye(2)
    return kf


def extended() -> Any:
    kf = ExtendedKalmanFilter(2, 1)
    kf.F, kf.R, kf.Q = F.copy(), np.array([[0.25]]), 0.01 * np.eye(2)
    return kf


def unscented() -> Any:
    points = MerweScaledSigmaPoints(2, 0.5, 2.0, 1.0)
    kf = UnscentedKalmanFilter(2, 1, 0.1, hx=lambda x: x[:1], fx=lambda x, dt: F @ x, points=points)
    kf.R, kf.Q = np.array([[0.25]]), 0.01 * np.eye(2)
    return kf


FILTERS: dict[str, tuple[Callable[[], Any], tuple[Any, ...]]] = {
    "linear": (linear, ()),
    "extended": (extended, (lambda x: np.array([[1.0, 0.0]]), lambda x: x[:1])),
    "unscented": (unscented, ()),
}


def drive(kf: Any, more: tuple[Any, ...]) -> list[tuple[Array, Array]]:
    """A person's loop: a reading at every third prediction, another at every ninth, none where there is none."""
    _, z = readings()
    ended = []
    for k in range(60):
        kf.predict()
        if k % 3 == 0:
            kf.update(z[k].reshape(kf.y.shape) if k else z[k], *more)
        if k % 9 == 0 and k:
            ended.append((np.array(kf.x).ravel(), np.array(kf.P)))
            kf.predict()  # whose sigma points an unscented filter's second update would lack
            kf.update(z[k] + 0.1, *more, R=0.5)
        if k == 10:
            kf.update(None, *more)
        ended.append((np.array(kf.x).ravel(), np.array(kf.P)))
    return ended


@pytest.mark.parametrize("kind", FILTERS)
def test_filterpy_s_filters_are_watched_and_not_changed(kind: str, tmp_path: Path) -> None:
    make, more = FILTERS[kind]
    alone, watched = make(), make()
    rec = viz_estim.watch(watched, path=tmp_path / "a.rrd", space=STATE, dt=0.1)
    told, plain = drive(watched, more), drive(alone, more)
    rec.close()
    for (x, P), (y, Q) in zip(told, plain, strict=True):
        assert (x.tobytes(), P.tobytes()) == (y.tobytes(), Q.tobytes())
    assert "predict" not in vars(watched)
    run = viz_estim.load(tmp_path / "a.rrd")
    np.testing.assert_array_equal(run.mean[1:], [x for x, _ in told])
    np.testing.assert_array_equal(run.cov[1:], [P for _, P in told])
    np.testing.assert_allclose(run.time, 0.1 * np.arange(67), atol=1e-9)
    stages = {name: len(table.step) for name, table in run.stages.items()}
    assert stages == {"start": 1, "predict": 66, "update": 20 + 6}
    values = run.stages["update"].values
    assert set(values["innovation.noise"].ravel()) == {0.25, 0.5}
    assert 0.2 < run.summary()["nis"]["z"]["mean"] < 3
    # What moved the estimate is the gain times the residual.
    before = np.stack([t.mean[i] for t, i in (run.before(run.stages["update"], row) for row in range(26))])  # type: ignore[misc]
    moved = (values["gain"] @ values["innovation.residual"][..., None])[..., 0]
    np.testing.assert_allclose(run.stages["update"].mean - before, moved, atol=1e-9)


def test_readings_of_another_size_are_another_sensor_s(tmp_path: Path) -> None:
    kf = linear()
    rec = viz_estim.watch(kf, path=tmp_path / "a.rrd")
    for k in range(12):
        kf.predict()
        kf.update(1.0)
        if k % 4 == 0:
            kf.update(np.array([[1.0], [2.0]]), R=np.eye(2), H=np.eye(2))
    rec.close()
    run = viz_estim.load(tmp_path / "a.rrd")
    assert {name: len(table.step) for name, table in run.stages.items()} == {
        "start": 1, "predict": 12, "update": 12, "update_2": 3
    }  # fmt: skip
    assert run.summary()["nis"]["z2"]["dof"] == 2


@pytest.mark.parametrize("method", ["update", "predict"])
def test_a_filter_that_raises_is_post_mortem(
    method: str, cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kf = linear()
    rec = viz_estim.watch(kf, path=tmp_path / "a.rrd")
    kf.predict()
    kf.update(1.0)
    if method == "update":
        kf.predict()
        kf.R = kf.R[:, :0]
    else:
        kf.F = kf.F[:, :0]
    with pytest.raises(ValueError, match=r"square|shapes|aligned"):
        getattr(kf, method)(*([7.0] if method == "update" else []))
    rec.close()
    error = viz_estim.load(tmp_path / "a.rrd").properties["result"]["error"]
    assert (error["step"], error["stage"]) == (2, method)
    assert len(viz_estim.load(tmp_path / "a.rrd").step) == 3
    monkeypatch.setattr("sys.stdin", io.StringIO("where\nback\nstep\n"))
    told = cli("debug", tmp_path / "a.rrd", "--no-viewer").out.splitlines()
    assert told[0].startswith("step 2  ")
    assert told[1].startswith(f"FAILED in {method}: ")
    assert ("  z.z: 7" in told) == (method == "update")
    assert any(line.startswith("the last good belief, step ") for line in told)


def others() -> dict[str, Any]:
    """FilterPy's filters beyond the three, by class, each of two components and one reading."""
    from filterpy.kalman import (
        CubatureKalmanFilter,
        EnsembleKalmanFilter,
        FadingKalmanFilter,
        IMMEstimator,
        InformationFilter,
        MMAEFilterBank,
        SquareRootKalmanFilter,
    )

    np.random.seed(0)  # noqa: NPY002 - the ensemble draws from it
    made: dict[str, Any] = {
        "square root": SquareRootKalmanFilter(2, 1), "fading": FadingKalmanFilter(1.01, 2, 1),
        "cubature": CubatureKalmanFilter(2, 1, 0.1, hx=lambda x: x[:1], fx=lambda x, dt: F @ x),
        "ensemble": EnsembleKalmanFilter(np.zeros(2), np.eye(2), 1, 0.1, 20, lambda x: x[:1], lambda x, dt: F @ x),
        "models": IMMEstimator([linear(), linear()], [0.5, 0.5], np.array([[0.9, 0.1], [0.1, 0.9]])),
        "bank": MMAEFilterBank([linear(), linear()], [0.5, 0.5], 2, H=np.array([[1.0, 0.0]])),
    }  # fmt: skip
    made["information"] = InformationFilter(2, 1)
    made["information"].R_inv, made["information"].Q = np.array([[4.0]]), 0.01 * np.eye(2)
    for name in ("square root", "fading", "information"):
        made[name].F, made[name].H = F.copy(), np.array([[1.0, 0.0]])
    for kf in list(made.values())[:4]:
        kf.Q, kf.R = 0.01 * np.eye(2), np.array([[0.25]])
    return made


@pytest.mark.parametrize("kind", ["square root", "fading", "cubature", "ensemble", "models", "bank", "information"])
def test_other_filters_of_filterpy_are_watched(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    alone, watched = others()[kind], others()[kind]
    told = []
    for kf in (alone, watched):
        rec = viz_estim.watch(kf, path=tmp_path / "a.rrd", space=STATE) if kf is watched else None
        np.random.seed(1)  # noqa: NPY002
        for k in range(12):
            kf.predict()
            if k % 3 == 0:
                kf.update(np.array([0.1 * k]))
            told.append((np.array(kf.x, float).ravel(), np.array(kf.P)))
        if rec:
            rec.close()
    run = viz_estim.load(tmp_path / "a.rrd")
    for row in range(12):
        assert told[row][0].tobytes() == told[12 + row][0].tobytes() == run.mean[1 + row].tobytes()
        np.testing.assert_array_equal(run.cov[1 + row], told[row][1])
    keeps = kind in ("square root", "fading", "cubature")
    assert (run.summary()["nis"].keys() == {"z"}) == keeps
    assert capsys.readouterr().err.count("keeps no residual") == (not keeps)
    wanted = {"models": "mu", "bank": "p", "ensemble": "sigma.points", "cubature": "mapped.points"}
    assert wanted.get(kind, "gain" if keeps else "mean") in run.stages["update"].values


def test_sensors_are_told_apart_by_what_they_read(tmp_path: Path) -> None:
    kf, un = linear(), unscented()
    rec = viz_estim.watch(kf, path=tmp_path / "a.rrd")
    other = viz_estim.watch(un, path=tmp_path / "b.rrd")
    for k in range(12):
        kf.predict()
        un.predict(dt=0.5)
        kf.update(1.0)
        un.update(1.0)
        if k % 4 == 0:  # of one component too, at another rate: a speed
            kf.update(1.0, H=np.array([[0.0, 1.0 + k]]))
            un.update(1.0, hx=lambda x: x[1:])
    kf.batch_filter([1.0, 2.0])
    rec.close()
    other.close()
    for name, more in (("a", 2), ("b", 0)):
        run = viz_estim.load(tmp_path / f"{name}.rrd")
        stages = {stage: len(table.step) for stage, table in run.stages.items()}
        assert stages == {"start": 1, "predict": 12 + more, "update": 12 + more, "update_2": 3}
        assert run.summary()["nis"].keys() == {"z", "z2"}
    assert run.time[-1] == pytest.approx(6.0)
    assert {"sigma.points", "mapped.points"} <= run.stages["update"].values.keys()


def test_watching_costs_no_program_its_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kf = linear()
    first = viz_estim.watch(kf, path=tmp_path / "a.rrd")
    kf.predict()
    rec = viz_estim.watch(kf, path=tmp_path / "b.rrd")  # as in a notebook: the first has ended
    kf.predict()
    kf.x = np.zeros(3)  # of another size: no recording could hold it
    kf.P, kf.F, kf.Q = np.eye(3), np.eye(3), np.eye(3)
    kf.predict()
    kf.predict()
    rec.close()
    first.close()
    assert capsys.readouterr().err.count("\n") == 1
    assert len(viz_estim.load(tmp_path / "a.rrd").step) == 2
    assert viz_estim.load(tmp_path / "b.rrd").complete
    assert "predict" not in vars(kf)


def test_a_watched_filter_s_model_and_control_are_recorded(tmp_path: Path) -> None:
    kf = linear()
    kf.B, kf.Q = np.array([[0.0], [0.1]]), 1.0 * np.eye(2)  # a hundred times too much
    rec = viz_estim.watch(kf, path=tmp_path / "a.rrd", space=STATE, dt=0.1, sensors={"z": {"place": "m"}})
    rng, true = np.random.default_rng(0), np.zeros(2)
    for k in range(300):
        u = np.sin(0.1 * k)
        true = F @ true + kf.B[:, 0] * u + 0.1 * rng.standard_normal(2)
        kf.predict(u=np.array([[u]]))
        kf.update(true[:1] + 0.5 * rng.standard_normal(1))
    rec.close()
    run = viz_estim.load(tmp_path / "a.rrd")
    np.testing.assert_array_equal(run.stages["predict"].values["transition"][0], F)
    np.testing.assert_allclose(run.inputs["control"][1:, 0], np.sin(0.1 * np.arange(300)))
    assert run.stages["update"].spaces["innovation"].names == ("z.place",)
    (first, *_) = [f for f in diagnose(run) if f.code == "underconfident"]
    assert "multiply Q by about 0.0" in first.remedy


def test_one_line_is_all_that_a_person_s_program_needs(tmp_path: Path) -> None:
    program = """
from filterpy.kalman import KalmanFilter
import viz_estim
kf = KalmanFilter(1, 1)
kf.H[:] = 1
viz_estim.watch(kf)
beside = viz_estim.record("beside.rrd")
for z in range(50):
    kf.predict()
    kf.update(z)
    beside.stage("copy", mean=kf.x, cov=kf.P)
    beside.step(time=z)
"""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    for name, steps in (("recordings/KalmanFilter.rrd", 51), ("beside.rrd", 50)):  # though nobody closes them
        run = viz_estim.load(tmp_path / name)
        assert run.complete
        assert len(run.step) == steps


def test_what_cannot_be_watched_is_refused(tmp_path: Path) -> None:
    from filterpy.gh import GHFilter  # type: ignore[import-untyped]
    from filterpy.kalman import FixedLagSmoother

    for wrong, words in (
        ([object()], "it lacks x, P, predict, update"), ([GHFilter(0, 0, 1, 0.1, 0.1)], "it lacks P, predict"),
        ([FixedLagSmoother(2, 1)], "it lacks predict, update"), ([], "watch one filter"),
        ([linear(), linear()], "watch one filter"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            viz_estim.watch(*wrong, path=tmp_path / "a.rrd")
    assert not list(tmp_path.iterdir())


def test_stone_soup_s_predictor_and_updater_are_watched(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from stonesoup.models.measurement.linear import LinearGaussian  # type: ignore[import-untyped]
        from stonesoup.models.transition.linear import (  # type: ignore[import-untyped]
            CombinedLinearGaussianTransitionModel,
            ConstantVelocity,
        )
        from stonesoup.predictor.kalman import KalmanPredictor  # type: ignore[import-untyped]
        from stonesoup.types.detection import Detection  # type: ignore[import-untyped]
        from stonesoup.types.hypothesis import SingleHypothesis  # type: ignore[import-untyped]
        from stonesoup.types.state import GaussianState  # type: ignore[import-untyped]
        from stonesoup.updater.kalman import KalmanUpdater  # type: ignore[import-untyped]
    start = datetime.datetime(2024, 1, 1)
    model = LinearGaussian(4, (0, 2), 0.5 * np.eye(2))

    def track(watched: bool) -> list[Array]:
        predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(0.05)] * 2))
        updater = KalmanUpdater(model)
        if watched:
            names = {"x": "m", "vx": "m/s", "y": "m", "vy": "m/s"}
            rec = viz_estim.watch(predictor, updater, path=tmp_path / "a.rrd", space=names)
        rng, ended = np.random.default_rng(0), []
        state = GaussianState([[0], [1], [0], [1]], np.diag([1.5, 0.5, 1.5, 0.5]), timestamp=start)
        for k in range(1, 40):
            stamp = start + datetime.timedelta(seconds=0.5 * k)
            state = predictor.predict(state, timestamp=stamp)
            if k % 2:
                z = Detection(k * 0.5 + rng.standard_normal((2, 1)), timestamp=stamp, measurement_model=model)
                state = updater.update(SingleHypothesis(state, z))
            ended.append(np.array(state.state_vector, float).ravel())
        if watched:
            rec.close()
        return ended

    told, plain = track(watched=True), track(watched=False)
    np.testing.assert_array_equal(told, plain)
    run = viz_estim.load(tmp_path / "a.rrd")
    np.testing.assert_array_equal(run.mean, told)
    np.testing.assert_allclose(run.time, 0.5 * np.arange(39), atol=1e-9)
    assert {name: len(table.step) for name, table in run.stages.items()} == {"predict": 39, "update": 20}
    assert run.summary()["nis"]["z"]["dof"] == 2
    values = run.stages["update"].values
    before = np.stack([t.mean[i] for t, i in (run.before(run.stages["update"], row) for row in range(20))])  # type: ignore[misc]
    moved = (values["gain"] @ values["innovation.residual"][..., None])[..., 0]
    np.testing.assert_allclose(run.stages["update"].mean - before, moved, atol=1e-9)


@pytest.mark.parametrize("kind", ["particles", "unscented"])
def test_stone_soup_s_other_filters_are_watched(kind: str, tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from stonesoup.models.measurement.nonlinear import (  # type: ignore[import-untyped]
            CartesianToBearingRange,
        )
        from stonesoup.models.transition.linear import (
            CombinedLinearGaussianTransitionModel,
            ConstantVelocity,
        )
        from stonesoup.predictor.kalman import UnscentedKalmanPredictor
        from stonesoup.predictor.particle import ParticlePredictor  # type: ignore[import-untyped]
        from stonesoup.resampler.particle import SystematicResampler  # type: ignore[import-untyped]
        from stonesoup.types.array import StateVectors  # type: ignore[import-untyped]
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis
        from stonesoup.types.state import GaussianState, ParticleState
        from stonesoup.updater.kalman import UnscentedKalmanUpdater
        from stonesoup.updater.particle import ParticleUpdater  # type: ignore[import-untyped]
    start, rng = datetime.datetime(2024, 1, 1), np.random.default_rng(0)
    model = CartesianToBearingRange(4, (0, 2), np.diag([0.01, 0.1]))
    moves = CombinedLinearGaussianTransitionModel([ConstantVelocity(0.05)] * 2)
    state: Any
    if kind == "particles":
        predictor, updater = ParticlePredictor(moves), ParticleUpdater(model, resampler=SystematicResampler())
        drawn = np.array([[5.0], [1], [5], [1]]) + rng.standard_normal((4, 60))
        state = ParticleState(StateVectors(drawn), weight=np.full(60, 1 / 60), timestamp=start)
    else:
        predictor, updater = UnscentedKalmanPredictor(moves), UnscentedKalmanUpdater(model)
        state = GaussianState([[5], [1], [5], [1]], np.eye(4), timestamp=start)
    rec = viz_estim.watch(predictor, updater, path=tmp_path / "a.rrd", space={"x": "m", "vx": "", "y": "m", "vy": ""})
    ended = []
    for k in range(1, 10):
        stamp = start + datetime.timedelta(seconds=0.5 * k)
        state = predictor.predict(state, timestamp=stamp)
        z = model.function(GaussianState([[5 + k / 2], [1], [5 + k / 2], [1]], np.eye(4)), noise=True)
        detection = Detection(z, timestamp=stamp, measurement_model=model)
        state = updater.update(SingleHypothesis(state, detection))
        ended.append(np.array(state.mean, float).ravel())
    with pytest.raises(AttributeError):
        updater.update(None)
    rec.close()
    run = viz_estim.load(tmp_path / "a.rrd")
    np.testing.assert_allclose(run.mean, ended, atol=1e-9)
    assert {name: len(table.step) for name, table in run.stages.items()} == {"predict": 9, "update": 9}
    assert run.properties["result"]["error"]["stage"] == "update"
    if kind == "unscented":
        assert run.summary()["nis"]["z"]["dof"] == 2
    else:
        assert run.inputs["z.z"].shape == (9, 2)


@pytest.mark.parametrize("where", ["mean", "cov"])
def test_a_loop_that_goes_on_with_nan_is_no_healthy_one(where: str, tmp_path: Path) -> None:
    with viz_estim.record(tmp_path / "a.rrd", STATE) as rec:
        for k in range(20):
            mean, cov = np.zeros(2), np.eye(2)
            if k >= 12:
                {"mean": mean, "cov": cov}[where][:] = np.nan
            rec.stage("predict", mean=mean, cov=cov)
            rec.step(time=0.1 * k)
    first = diagnose(viz_estim.load(tmp_path / "a.rrd"))[0]
    assert (first.code, first.severity, first.steps) == ("failed", "error", (12, 19))
    assert "after predict" in first.cause


def test_names_that_are_not_told_apart_are_refused(tmp_path: Path) -> None:
    for space, words in ((["x", "x"], "x is there twice"), (5, "expected names"), ([1, 2], "expected names")):
        with pytest.raises(ValueError, match=words):
            viz_estim.record(tmp_path / "a.rrd", space)  # type: ignore[arg-type]
    with viz_estim.record(tmp_path / "a.rrd", np.array(["x", "v"])) as rec:  # type: ignore[arg-type]
        rec.stage("predict", mean=[0, 1], cov=csr_array(np.eye(2)))
        rec.step(time=0)
    run = viz_estim.load(tmp_path / "a.rrd")
    assert run.space.names == ("x", "v")
    np.testing.assert_array_equal(run.cov, [np.eye(2)])


def test_a_truth_that_knows_some_components_alone_is_kept_by_parts(tmp_path: Path) -> None:
    with viz_estim.record(tmp_path / "a.rrd", STATE) as rec:
        rec.stage("predict", mean=[0, 1], cov=np.eye(2))
        with pytest.raises(ValueError, match=r"step 0: truth: x is known and v is not.*space=Product\("):
            rec.step(time=0, truth=[1, np.nan])
    space = Product(place=Euclidean(["x"], "m"), speed=Euclidean(["v"], "m/s"))
    with viz_estim.record(tmp_path / "a.rrd", space) as rec:
        rec.stage("predict", mean=[0, 1], cov=np.eye(2))
        rec.step(time=0, truth=[1, np.nan])
    run = viz_estim.load(tmp_path / "a.rrd")
    np.testing.assert_array_equal(run.truth, [[1, np.nan]])
    assert run.summary()["nees"]["mean"] == 1.0
