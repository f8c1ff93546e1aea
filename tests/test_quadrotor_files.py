"""The quadrotor's files: what is written comes back, the course's layouts are read, and one line for bad input."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from conftest import Cli
from scipy.spatial.transform import Rotation

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.run import run
from viz_estim.errors import BadInput
from viz_estim.scenarios import quadrotor as system
from viz_estim.scenarios.quadrotor import QuadrotorData, quadrotor, quadrotor_ukf_pose, quadrotor_ukf_velocity

OWN = Path(system.__file__).parents[2] / "data" / "quadrotor"
T = 40


def read(*paths: Path) -> QuadrotorData:
    return quadrotor(list(paths), np.random.default_rng(0))


def structs(columns: dict[str, list[Any]]) -> np.ndarray:
    """A MATLAB struct array, 1×T."""
    rows = np.empty((1, len(next(iter(columns.values())))), dtype=[(name, object) for name in columns])
    for name, values in columns.items():
        rows[name][0] = np.fromiter(values, object, len(values))
    return rows


def flight() -> dict[str, Any]:
    """A flight as the course's files have it, made up: the body climbs, and turns about its z axis."""
    stamps, (roll, pitch) = 5 + 0.01 * np.arange(T), (0.1, -0.2)
    imu = {
        "is_ready": [1] * T,
        "t": list(stamps),
        "rpy": [np.zeros((3, 1))] * T,
        "omg": [np.array([[0.1], [0.2], [0.3 + 0.01 * k]]) for k in range(T)],
        "acc": [np.array([[0.0], [0.5], [9.81]])] * T,
        "img": [np.zeros((0, 0), np.uint8)] * (T - 1) + [np.zeros((4, 6), np.uint8)],
        "id": [np.zeros((1, k % 3)) for k in range(T)],
    }
    time = 4.995 + 0.01 * np.arange(T + 2)
    ones = np.ones_like(time)
    vicon = np.stack(
        [ones, 2 * ones, time, roll * ones, pitch * ones, 0.3 * time, 0 * ones, 0 * ones, ones, *[0 * time] * 3]
    )
    return {"data": structs(imu), "vicon": vicon, "time": time[None]}


def camera() -> dict[str, Any]:
    t = 5 + 0.02 * np.arange(T // 2)[:, None]
    values = {"position": np.tile([1.0, 2.0, 5.0], (T // 2, 1)), "angle": np.tile([0.1, -0.2, 0.5], (T // 2, 1))}
    velocity = np.tile([0.4, 0.2, 0.1], (T // 2, 1))
    velocity[0] = 0
    return {"time": t, **values, "linearVel": velocity, "angVel": 0 * velocity}


def write(path: Path, fields: dict[str, Any], pack: bool = True) -> Path:
    scipy.io.savemat(path, fields, do_compression=pack)
    return path


def test_what_is_simulated_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    data = quadrotor(None, np.random.default_rng(3), duration=2)
    files = system.save(data, tmp_path)
    assert [file.name for file in files] == ["studentdata1.mat", "proj2_dataset1.mat"]
    again = read(tmp_path)
    assert again.files == tuple(files)
    np.testing.assert_array_equal(again.time, data.time)
    for name in ("gyro", "accel", "pose", "velocity", "truth"):
        np.testing.assert_allclose(getattr(again, name), getattr(data, name), atol=5e-6)
    with pytest.raises(BadInput, match="is there already"):
        system.save(data, tmp_path)
    rates = scipy.io.loadmat(files[0])["vicon"][9:].T
    exact = quaternions.log(quaternions.multiply(quaternions.conjugate(data.truth[:-1, 3:7]), data.truth[1:, 3:7]))
    np.testing.assert_allclose(rates[1:], exact / np.diff(data.time)[:, None], atol=1e-5)


def test_the_project_s_own_flight_is_small_and_the_same_seed_makes_it_again(tmp_path: Path) -> None:
    assert sum(file.stat().st_size for file in OWN.iterdir()) <= 200_000
    files = system.save(quadrotor(None, np.random.default_rng(5)), tmp_path)
    for file in files:
        for name, values in scipy.io.loadmat(file).items():
            if isinstance(values, np.ndarray) and values.dtype.names is None:
                np.testing.assert_allclose(scipy.io.loadmat(OWN / file.name)[name], values, atol=2e-6)


def test_a_flight_alone_measures_its_pose_by_motion_capture(tmp_path: Path) -> None:
    fields = flight()
    fields["vicon"][:, 20:35] = np.nan  # lost for 0.15 s, which is not bridged
    fields["vicon"][:, 10] = np.nan  # one frame is
    fields["data"]["omg"][0, 3] = fields["data"]["acc"][0, 3] = np.zeros((0, 0))  # a row without a reading
    data = read(write(tmp_path / "any.mat", fields))
    assert len(data.time) == T - 1
    kept = np.delete(5 + 0.01 * np.arange(T), 3)
    np.testing.assert_allclose(data.time, kept)
    np.testing.assert_allclose(data.gyro, np.stack([0.1 + 0 * kept, 0.2 + 0 * kept, kept - 4.7], 1))
    lost = (kept > fields["time"][0, 19]) & (kept < fields["time"][0, 35])
    np.testing.assert_array_equal(np.isfinite(data.pose).all(1), ~lost)
    q = Rotation.from_euler("ZYX", np.stack([0.3 * kept, -0.2 + 0 * kept, 0.1 + 0 * kept], 1)).as_quat(
        scalar_first=True
    )
    np.testing.assert_allclose(np.abs((data.pose[:, 3:] * q).sum(1)[~lost]), 1, atol=1e-9)
    np.testing.assert_allclose(data.truth[~lost, :3], np.stack([1 + 0 * kept, 2 + 0 * kept, kept], 1)[~lost])
    assert (np.isnan(data.truth[:, 10:]).all(), np.isnan(data.velocity).all()) == (True, True)
    steps = list(run(quadrotor_ukf_pose(data)))
    assert [step.index for step in steps if "pose" in step.tick.measurements] == list(np.flatnonzero(~lost)[1:])
    with pytest.raises(BadInput, match="no camera's velocity"):
        quadrotor_ukf_velocity(data)


def test_a_flight_without_motion_capture_has_a_camera(tmp_path: Path) -> None:
    paths = [write(tmp_path / "flight.mat", {"data": flight()["data"]}), write(tmp_path / "camera.mat", camera())]
    data = read(*paths)
    assert np.isfinite(data.pose).all(1).sum() == T // 2
    assert np.isnan(data.truth).all()
    assert "nothing tells the truth" in data.notes
    assert [step.error for step in run(quadrotor_ukf_pose(data))] == [None] * T


def test_a_camera_s_readings_come_with_the_imu_s_next_sample(tmp_path: Path) -> None:
    late = camera()
    late["time"] = late["time"] + 0.004
    late["time"][-1] = 9.0  # after the last sample
    upper = {name.upper() if name != "time" else name: values for name, values in late.items()}
    write(tmp_path / "a.mat", upper)
    write(tmp_path / "b.mat", flight())
    (tmp_path / "notes.txt").write_text("not for us")
    (tmp_path / "broken.mat").write_text("not for us")
    data = read(tmp_path)
    assert [file.name for file in data.files] == ["b.mat", "a.mat"]
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(data.pose).all(1)), np.arange(1, T - 2, 2))
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(data.velocity).all(1)), np.arange(3, T - 2, 2))
    step = list(run(quadrotor_ukf_velocity(data)))[3]
    np.testing.assert_array_equal(step.tick.measurements["velocity"], [0.4, 0.2, 0.1])


def test_a_flight_that_is_first_seen_later_starts_there(tmp_path: Path) -> None:
    fields = camera()
    first = {name: values[5:] for name, values in fields.items()}
    data = read(write(tmp_path / "a.mat", first), write(tmp_path / "b.mat", flight()))
    scenario = quadrotor_ukf_pose(data)
    assert set(scenario.beliefs) == {0, 10}
    assert [len(step.tick.measurements) for step in run(scenario)][:14] == [0] * 12 + [1, 0]


def test_a_struct_of_arrays_is_read_as_a_struct_array_is(tmp_path: Path) -> None:
    fields = flight()
    t, omg, acc = (np.stack([np.ravel(value) for value in fields["data"][name][0]]) for name in ("t", "omg", "acc"))
    whole = read(write(tmp_path / "a.mat", fields))
    for name, packed in {
        "columns": {"t": t, "omg": omg, "acc": acc},
        "rows": {"t": t.T, "omg": omg.T, "acc": acc.T},
    }.items():
        data = read(write(tmp_path / f"{name}.mat", fields | {"data": packed}))
        for part in ("time", "gyro", "accel", "pose", "truth"):
            np.testing.assert_array_equal(getattr(data, part), getattr(whole, part))


@pytest.mark.parametrize("change", ["9×N", "6×N", "no rates", "no velocity"])
def test_motion_capture_without_velocities_still_has_poses(change: str, tmp_path: Path) -> None:
    fields = flight()
    whole = read(write(tmp_path / "a.mat", fields))
    vicon = fields["vicon"].copy()
    vicon[6 if change == "no velocity" else 9 :] = np.nan
    fields["vicon"] = vicon[: {"9×N": 9, "6×N": 6}.get(change, 12)]
    data = read(write(tmp_path / "b.mat", fields))
    np.testing.assert_array_equal(data.pose, whole.pose)
    known = 7 if change in ("6×N", "no velocity") else 10
    np.testing.assert_array_equal(data.truth[:, :known], whole.truth[:, :known])
    assert np.isnan(data.truth[:, known:]).all()


def test_poses_too_far_apart_are_not_taken_for_another_clock(cli: Cli, tmp_path: Path) -> None:
    fields = flight()
    sparse = write(tmp_path / "a.mat", fields | {name: fields[name][:, ::15] for name in ("vicon", "time")})
    done = cli("run", "quadrotor-ukf-pose", "--data", sparse, "--out", tmp_path / "x.rrd")
    assert (done.code, done.err.count("\n"), "0.15 s apart" in done.err) == (2, 1, True)


def spoilt(values: Array, value: float = np.nan) -> Array:
    return np.where(np.arange(values.size).reshape(values.shape) == 7, value, values)


def row(k: int, **values: Any) -> np.ndarray:
    rows = flight()["data"]
    for name, value in values.items():
        rows[name][0, k] = value
    return rows


def without(*names: str) -> np.ndarray:
    rows = flight()["data"]
    return structs({name: list(rows[name][0]) for name in rows.dtype.names if name not in names})


C, F = camera(), flight()
# fmt: off
FIELDS: dict[str, dict[str, dict[str, Any]]] = {  # by kind of file: what stands in place of its own; None: nothing
    "camera": {
        "no linearVel": {"linearVel": None}, "no time": {"time": None}, "no angle": {"angle": None},
        "3×N": {"position": C["position"].T}, "N×2": {"angle": C["angle"][:, :2]}, "short": {"angle": C["angle"][1:]},
        "NaN in position": {"position": spoilt(C["position"])}, "NaN": {"linearVel": spoilt(C["linearVel"])},
        "time goes back": {"time": -C["time"]}, "NaN in time": {"time": spoilt(C["time"])}, "text": {"angle": "abc"},
        "few": {name: values[:5] for name, values in C.items()}, "none": {name: v[:0] for name, v in C.items()},
        "a pose in 0.4 s": {"time": 20 * C["time"]},
        "nothing known": dict.fromkeys(["position", "linearVel", "angVel"]),
    },
    "flight": {
        "no data": {"data": None}, "no vicon": {"vicon": None}, "no time": {"time": None},
        "numbers": {"data": C["time"]}, "no omg": {"data": without("omg")}, "no acc, t": {"data": without("acc", "t")},
        "7×N": {"vicon": F["vicon"][:7]}, "N×12": {"vicon": F["vicon"].T}, "time too short": {"time": F["time"][:, 1:]},
        "text": {"vicon": "abc"}, "NaN in omg": {"data": row(4, omg=np.full((3, 1), np.nan))},
        "two omg": {"data": row(4, omg=np.zeros(2))}, "text in acc": {"data": row(4, acc="abc")},
        "no acc in a row": {"data": row(4, acc=np.zeros((0, 0)))}, "t goes back": {"data": row(4, t=1.0)},
        "all lost": {"vicon": F["vicon"] * np.nan}, "one row": {"data": F["data"][:, :1]},
        "another clock": {"time": F["time"] + 100}, "wrong bias": {"bias": np.zeros((3, T))},
    },
}
# fmt: on
CASES: list[tuple[str, str, Any]] = [(kind, name, new) for kind in FIELDS for name, new in FIELDS[kind].items()]
for _kind in FIELDS:
    CASES += [(_kind, f"{how} cut at {s}", s) for how in ("packed", "plain") for s in (0.05, 0.3, 0.6, 0.9)]
    CASES += [(_kind, "empty", ""), (_kind, "text file", "hello\nworld\n" * 50)]


@pytest.mark.parametrize(("kind", "name", "change"), CASES, ids=[f"{kind}: {name}" for kind, name, _ in CASES])
def test_a_bad_file_is_refused_in_one_line(cli: Cli, kind: str, name: str, change: Any, tmp_path: Path) -> None:
    bad, held = tmp_path / "bad1.mat", {"camera": C, "flight": F}[kind]
    held = held | change if isinstance(change, dict) else held
    if isinstance(change, str):
        bad.write_text(change)
    else:
        write(bad, {k: v for k, v in held.items() if v is not None}, pack=not name.startswith("plain"))
    if isinstance(change, float):
        os.truncate(bad, int(change * bad.stat().st_size))
    done = cli("run", "quadrotor-ukf-pose", "--data", bad, "--out", tmp_path / "x.rrd")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert "bad1.mat" in done.err


def test_other_bad_input_is_refused_in_one_line(cli: Cli, tmp_path: Path) -> None:
    for name in ("a.mat", "b.mat"):
        write(tmp_path / name, C)
    (tmp_path / "empty").mkdir()
    alone, out = write(tmp_path / "empty.mat", F), tmp_path / "x.rrd"
    for data, said in [
        (tmp_path, "2 camera files"),
        (tmp_path / "no.mat", "no such file"),
        (tmp_path / "empty", "no flight"),
    ]:
        done = cli("run", "quadrotor-ukf-pose", "--data", data, "--out", out)
        assert (done.code, done.err.count("\n"), said in done.err) == (2, 1, True)
    done = cli("run", "quadrotor-ukf-velocity", "--data", alone, "--out", out)
    assert (done.code, done.err.count("\n"), "no camera's velocity" in done.err) == (2, 1, True)
    for kind, setting in [
        ("pose", "gyro_noise=0"), ("pose", "position_noise=-1"), ("pose", "alpha=0"), ("pose", "kappa=-15"),
        ("pose", "gate=1"), ("pose", "attitude=xyz"), ("velocity", "velocity_noise=0"),
        ("velocity", "data.duration=-1"), ("velocity", "initial_velocity_std=0"), ("pose", "data.noise_scale=0"),
    ]:  # fmt: skip
        done = cli("run", f"quadrotor-ukf-{kind}", "--seed", 1, "--set", setting, "--out", out)
        assert (done.code, done.err.count("\n"), setting.partition("=")[0] in done.err) == (2, 1, True), setting
