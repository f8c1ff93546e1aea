"""Commands that go well, in process: what they print, as JSON and for a person, and the files they write."""

import csv
import json
import shlex
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from conftest import Cli, strict
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import viz_estim
from viz_estim.scenarios import SCENARIOS, imu_files

RESULT = {"scenario", "recording", "steps", "stages", "duration_s", "wall_s", "params", "seed", "error", "metrics"}


def assert_between(value: Iterable[float], low: float, high: float) -> None:
    assert np.all(np.asarray(value) >= low)
    assert np.all(np.asarray(value) <= high)


def test_list_has_every_scenario_with_its_parameters(cli: Cli) -> None:
    listed = strict(cli("list", "--json"))["scenarios"]
    assert [one["name"] for one in listed] == list(SCENARIOS)
    text = cli("list").out
    for one in listed:
        assert one["description"]
        assert f"{one['name']}: {one['description']}" in text
        assert all({"default", "type"} <= set(p) for p in one["parameters"].values())
    ukf = next(one for one in listed if one["name"] == "imu-ukf")
    assert {"gyro_noise", "accel_noise", "initial", "frozen", "data.freeze"} <= set(ukf["parameters"])
    assert ukf["parameters"]["frozen"] == {"default": "ignore", "type": "ignore|reject"}


def test_run_prints_its_result_and_the_command_that_opens_it(
    cli: Cli, short: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = cli("run", "imu-gyro", *short)
    assert (done.code, done.err) == (0, "")
    (path,) = (tmp_path / "recordings").iterdir()
    assert path.name.startswith("imu-gyro")
    assert done.out.splitlines()[-1] == f"viz-estim open recordings/{path.name}"
    assert viz_estim.load(path).complete


def test_run_s_figures_are_those_of_its_numbers(cli: Cli, short: list[str], tmp_path: Path) -> None:
    out = tmp_path / "a.rrd"
    result = strict(cli("run", "imu-ukf", *short, "--set", "accel_noise=0.5", "--out", out, "--json"))
    assert set(result) == {*RESULT, "nis", "nees"}
    assert (result["scenario"], result["recording"], result["seed"]) == ("imu-ukf", str(out), 3)
    assert {result["params"][k] for k in ("accel_noise", "data.still")} == {0.5, 1.0}
    assert result["error"] is None
    assert set(result["wall_s"]) == {"estimate", "record"}
    run = viz_estim.load(out)
    assert (result["steps"], result["stages"]) == (len(run.step), sum(len(t.step) for t in run.stages.values()))
    assert result["duration_s"] == pytest.approx(run.time[-1] - run.time[0], abs=2e-9)
    assert_between([result["duration_s"]], 5.5, 6.1)
    known = np.isfinite(run.truth[:, 0])
    one, other = (Rotation.from_quat(q[known][:, [1, 2, 3, 0]]) for q in (run.mean, run.truth))
    angle = np.degrees((one.inv() * other).magnitude())
    assert result["metrics"]["attitude_rmse_deg"] == pytest.approx(np.sqrt((angle**2).mean()))
    values = run.stages["update"].values
    for i, sensor in enumerate(("accel", "gyro")):
        at, offered = slice(3 * i, 3 * i + 3), values["innovation.offered"][:, i] == 1
        residual, S = values["innovation.residual"][offered, at], values["innovation.cov"][offered, at, at]
        nis = np.einsum("ti,tij,tj->t", residual, np.linalg.inv(S), residual)
        low, high = chi2.ppf([0.025, 0.975], 3 * len(nis)) / len(nis)
        assert result["nis"][sensor] == pytest.approx({"mean": nis.mean(), "dof": 3, "low": low, "high": high})
    error = (other.inv() * one).as_rotvec()
    nees = np.einsum("ti,tij,tj->t", error, np.linalg.inv(run.cov[known][:, :3, :3]), error)
    low, high = chi2.ppf([0.025, 0.975], 3)
    inside = ((nees >= low) & (nees <= high)).mean()
    assert result["nees"] == pytest.approx({"mean": nees.mean(), "dof": 3, "inside": inside})
    shown = strict(cli("show", out, "--json"))
    assert {key: shown[key] for key in ("metrics", "nis", "nees", "params", "seed", "error")} == {
        key: result[key] for key in ("metrics", "nis", "nees", "params", "seed", "error")
    }


def test_show_has_a_step_by_number_and_by_time(cli: Cli, recording: Path) -> None:
    run = viz_estim.load(recording)
    step = strict(cli("show", recording, "--step", 200, "--json"))
    assert step == strict(cli("show", recording, "--time", repr(float(run.time[200])), "--json"))
    assert {"step", "time", "stages", "truth", "error"} <= set(step)
    assert (step["step"], step["time"], step["error"]) == (200, run.time[200], None)
    assert [stage["name"] for stage in step["stages"]] == ["predict", "update"]
    assert step["stages"][-1]["belief"] == {"mean": run.mean[200].tolist(), "cov": run.cov[200].tolist()}
    assert step["truth"][:4] == run.truth[200, :4].tolist()
    assert step["truth"][4:] == [None] * 3  # nobody measured the rate
    text = cli("show", recording, "--step", 200).out
    for words in ("predict", "update", "attitude.qw=", "rad/s", "innovation.residual", "truth"):
        assert words in text
    assert cli("show", recording).out.splitlines()[-1].startswith("viz-estim show ")


def test_export_holds_what_was_recorded(cli: Cli, recording: Path, tmp_path: Path) -> None:
    run = viz_estim.load(recording)
    out = tmp_path / "a.tum"
    assert cli("export", recording, "--to", "tum", "-o", out) == (0, f"{out}\n{tmp_path / 'a.truth.tum'}\n", "")
    tum = np.loadtxt(out)
    np.testing.assert_allclose(tum[:, 0], run.time, atol=1e-9)
    np.testing.assert_array_equal(tum[:, 1:4], 0)
    np.testing.assert_allclose(tum[:, 4:], run.mean[:, [1, 2, 3, 0]], atol=1e-9)  # qx qy qz qw
    known = np.isfinite(run.truth[:, 0])
    true = np.loadtxt(tmp_path / "a.truth.tum")
    np.testing.assert_allclose(true[:, 4:], run.truth[known][:, [1, 2, 3, 0]], atol=1e-9)
    assert cli("export", recording, "--to", "csv", "-o", tmp_path / "a.csv").code == 0
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for i, name in enumerate(run.space.names):
        np.testing.assert_array_equal([float(row[name]) for row in rows], run.mean[:, i])
    assert [int(row["step"]) for row in rows] == run.step.tolist()
    assert {"nis.accel", "nis.gyro", "nees", "residual.gyro.x", "error.attitude.x"} <= set(rows[0])
    assert cli("export", recording, "--to", "npz", "-o", tmp_path / "a.npz").code == 0
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        for name in ("step", "time", "dt", "mean", "cov", "truth"):
            np.testing.assert_array_equal(arrays[name], getattr(run, name))
        for table in run.stages.values():
            for name, values in table.values.items():
                np.testing.assert_array_equal(arrays[f"stages/{table.name}/{name}"], values)


def test_matches_of_another_number_each_time_are_exported_as_plain_numbers(cli: Cli, tmp_path: Path) -> None:
    assert cli("run", "scan-icp", "--out", tmp_path / "a.rrd").code == 0
    assert cli("export", tmp_path / "a.rrd", "--to", "npz", "-o", tmp_path / "a.npz").code == 0
    matches = viz_estim.load(tmp_path / "a.rrd").stages["match"].values
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        held = dict(arrays)
    for name in ("matches.source", "matches.source_index"):
        count = held[f"stages/match/{name}.count"]
        parts = np.split(held[f"stages/match/{name}"], np.cumsum(count)[:-1])
        assert len(set(count)) > 1
        for part, row in zip(parts, matches[name], strict=True):
            np.testing.assert_array_equal(part, row)


def test_labels_are_exported_beside_their_probabilities(cli: Cli, tmp_path: Path) -> None:
    assert cli("run", "underwater-bayes", "--out", tmp_path / "a.rrd").code == 0
    assert cli("export", tmp_path / "a.rrd", "--to", "npz", "-o", tmp_path / "a.npz").code == 0
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert tuple(arrays["labels"]) == viz_estim.load(tmp_path / "a.rrd").labels


def test_a_trajectory_has_the_heading_of_a_planar_robot(cli: Cli, tmp_path: Path) -> None:
    assert cli("run", "diffdrive-ekf", "--seed", 2, "--set", "data.duration=2", "--out", tmp_path / "a.rrd").code == 0
    assert cli("export", tmp_path / "a.rrd", "--to", "tum", "-o", tmp_path / "a.tum").code == 0
    run = viz_estim.load(tmp_path / "a.rrd")
    for file, states in (("a.tum", run.mean), ("a.truth.tum", run.truth)):
        tum = np.loadtxt(tmp_path / file)
        np.testing.assert_allclose(tum[:, 1:4], np.c_[states[:, :2], np.zeros(len(tum))], atol=1e-9)
        yaw = Rotation.from_quat(tum[:, 4:]).as_rotvec()
        np.testing.assert_allclose(yaw, states[:, 2:] * [0, 0, 1], atol=1e-8)


def test_the_commands_that_are_printed_can_be_pasted(cli: Cli, short: list[str], tmp_path: Path) -> None:
    folder = tmp_path / "it's my folder"
    folder.mkdir()
    a, b = folder / "a run.rrd", folder / "both.rrd"
    ran = cli("run", "imu-gyro", *short, "--out", a)
    assert shlex.split(ran.out.splitlines()[-1]) == ["viz-estim", "open", str(a)]
    told = cli("compare", a, a, "--out", b)
    assert shlex.split(told.out.splitlines()[-1]) == ["viz-estim", "open", str(b)]
    last = shlex.split(cli("show", a).out.splitlines()[-1])
    assert cli(*last[1:]).code == 0
    assert last[:3] == ["viz-estim", "show", str(a)]


def test_simulated_files_calibrate_and_run(cli: Cli, tmp_path: Path) -> None:
    folder, options = tmp_path / "sim", ["--set=duration=8", "--set=still=2", "--set=freeze=0", "--seed", "2"]
    done = cli("simulate", "imu", *options, "--out", folder)
    assert (done.code, done.err) == (0, "")
    files = [Path(line) for line in done.out.splitlines()]
    assert sorted(folder.iterdir()) == sorted(files)
    ((imu, truth),) = imu_files.find_sets([folder])
    assert len(imu_files.load(imu, truth).truth) > 700
    before = imu.read_bytes()
    again = cli("simulate", "imu", *options, "--out", folder)
    assert (again.code, again.out, again.err.count("\n")) == (2, "", 1)
    assert imu.read_bytes() == before
    constants = tmp_path / "cal.json"
    fitted = strict(cli("calibrate", "imu", "--data", folder, "--out", constants, "--json"))
    assert {"accel", "gyro", "sets"} <= set(fitted)
    assert json.loads(constants.read_text())["gyro"] == fitted["gyro"]
    assert (tmp_path / "cal.rrd").is_file()
    out = tmp_path / "run.rrd"
    given = ["--data", folder, "--out", out, "--json"]
    plain = strict(cli("run", "imu-ukf", *given))
    fitted_run = strict(cli("run", "imu-ukf", *given, "--calibration", constants))
    for result in (plain, fitted_run):
        assert_between([result["metrics"]["attitude_rmse_deg"]], 0, 10)
    assert plain["metrics"] != fitted_run["metrics"]
    facts = viz_estim.load(out).properties
    assert [len(one["sha256"]) for one in facts["data"]] == [64] * 3  # the calibration is an input too
    angles = viz_estim.estimate_rot(imu)
    assert [a.shape for a in angles] == [(plain["steps"],)] * 3
    assert_between(angles, -np.pi, np.pi)
    twice = strict(cli("run", "imu-gyro", "--data", folder, "--data", imu, "--out", out, "--json"))
    assert twice["steps"] == plain["steps"]


@pytest.mark.draws
def test_snapshot_has_the_asked_size(cli: Cli, recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.png"
    assert cli("snapshot", recording, "--time", "2.5", "--size", "640x480", "-o", out) == (0, f"{out}\n", "")
    assert struct.unpack(">II", out.read_bytes()[16:24]) == (640, 480)


@pytest.mark.usefixtures("no_display")
def test_open_without_a_display_names_what_works(cli: Cli, recording: Path) -> None:
    done = cli("open", recording)
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert "--web" in done.err
    assert "snapshot" in done.err


@pytest.mark.parametrize(("particles", "options"), [(300, []), (300, ["--every", "7"]), (5000, [])])
def test_show_tells_how_many_particles_there_are_and_what_they_are_worth(
    particles: int, options: list[str], cli: Cli, tmp_path: Path
) -> None:
    """Also where the cloud was thinned (beyond 4000), or is kept at every N-th step only."""
    out = tmp_path / "a.rrd"
    settings = [f"--set={text}" for text in (f"particles={particles}", "resample_below=0.5", "data.duration=1")]
    done = cli("run", "beacons-pf", *settings, "--seed", 2, *options, "--out", out)
    assert (done.code, done.err) == (0, "")
    weighed = float(particles)
    for number in range(viz_estim.load(out).step[-1] + 1):
        for stage in strict(cli("show", out, "--step", number, "--json"))["stages"]:
            weighed = {"weigh": stage.get("ess"), "resample": particles}.get(stage["name"], weighed)
            assert set(stage["belief"]) == {"particles", "ess", "mean", "cov"}
            assert stage["belief"]["particles"] == particles
            assert stage["belief"]["ess"] == pytest.approx(weighed)
    assert f"{particles}, ESS " in cli("show", out, "--step", 3).out


def test_stages_are_there_where_nothing_of_them_is_kept(cli: Cli, tmp_path: Path) -> None:
    """The problem has five steps: of `predict`, `--every 5` keeps no cloud at all."""
    shown = []
    for every in (1, 5):
        out = tmp_path / f"{every}.rrd"
        strict(cli("run", "se2-pf", "--every", every, "--out", out, "--json"))
        shown.append([strict(cli("show", out, "--step", step, "--json"))["stages"] for step in range(5)])
        assert viz_estim.load(out).properties["every"] == every
    whole, thinned = shown
    assert [[stage["name"] for stage in stages] for stages in thinned] == [
        [stage["name"] for stage in stages] for stages in whole
    ]
    for name in ("mean", "cov"):
        assert thinned[4][-1]["belief"][name] == whole[4][-1]["belief"][name]


def test_a_belief_over_labels_has_no_trajectory(cli: Cli, tmp_path: Path) -> None:
    sample = Path(__file__).parents[1] / "recordings" / "underwater-bayes-sample.rrd"
    done = cli("export", sample, "--to", "tum", "-o", tmp_path / "a.tum")
    assert (done.code, done.out, done.err.count("\n"), list(tmp_path.iterdir())) == (2, "", 1, [])
    assert "use --to csv" in done.err
