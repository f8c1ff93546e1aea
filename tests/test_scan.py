"""Scans: the real clouds' figures, files of every kind, the simulation's truth, and one line for bad input."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli, strict

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.registration import SPACES, moved, to_state
from viz_estim.core.run import Step, run
from viz_estim.core.scenery import Cloud
from viz_estim.errors import BadInput
from viz_estim.scenarios.scan import save, scan, scan_icp
from viz_estim.scenarios.scan_files import ScanData

OWN = Path(__file__).parents[1] / "data" / "scan"
RNG = np.random.default_rng(0)


def steps_of(data: ScanData, **settings: Any) -> tuple[list[Step], dict[str, float]]:
    scenario = scan_icp(data, **settings)
    assert scenario.figures is not None
    steps = list(run(scenario))
    return steps, scenario.figures(steps[-1])


def test_the_course_s_clouds_give_the_course_s_figures(real_data: Path) -> None:
    folder = real_data / "eece5550"
    data = scan([folder / "pclX.txt", folder / "pclY.txt"], RNG)
    assert scan([folder], RNG).files == data.files
    steps, figures = steps_of(data, iterations=30)
    assert [step.index for step in steps] == list(range(31))
    assert [steps[k].stages[-1].count for k in (1, 2, 3, 5, 30)] == [3299, 5384, 5710, 5750, 5750]
    assert figures == {
        "registration_rmse": pytest.approx(0.0089506, abs=1e-7),
        "matches": 5750,
        "iterations": 30,
        "converged": 0,
    }
    np.testing.assert_allclose(steps[-1].stages[-1].belief.mean[:3], [0.49661, -0.29393, 0.29645], atol=5e-6)
    steps, figures = steps_of(data)
    assert (figures["registration_rmse"], figures["converged"]) == (pytest.approx(0.0074117, abs=1e-7), 1)
    assert (figures["iterations"], len(steps)) == (44, 45)
    np.testing.assert_allclose(steps[-1].stages[-1].belief.mean[:3], [0.49969, -0.30002, 0.30057], atol=5e-6)


def test_with_too_small_a_distance_the_course_s_clouds_crawl(real_data: Path) -> None:
    data = scan([real_data / "eece5550"], RNG)
    steps, figures = steps_of(data, max_distance=0.05)
    assert (steps[150].stages[-1].count, steps[151].stages[-1].count) == (4702, 4716)
    assert steps[150].stages[-1].rmse == pytest.approx(0.0256, abs=1e-4)
    assert (figures["iterations"], figures["converged"]) == (189, 1)
    assert figures["registration_rmse"] == pytest.approx(0.0074117, abs=1e-7)


def test_the_car_s_scans_come_within_their_bounds_of_the_truth_beside_them(real_data: Path) -> None:
    folder = real_data / "libpointmatcher"
    data = scan([folder / "car_cloud401.csv", folder / "car_cloud400.csv"], RNG)
    assert [file.name for file in data.files] == ["car_cloud401.csv", "car_cloud400.csv", "carCloudList.csv"]
    assert (data.X.shape, data.Y.shape) == ((25193, 3), (24989, 3))
    steps, figures = steps_of(data, max_distance=1.0)
    assert figures["converged"] == 1
    assert figures["final_attitude_error_deg"] < 0.2
    assert data.truth is not None
    assert np.linalg.norm(steps[-1].stages[-1].belief.mean[:3] - data.truth[:3]) < 0.06
    with pytest.raises(BadInput, match="4 clouds found"):
        scan([folder], RNG)


def test_the_scans_in_the_plane_register_both_ways(real_data: Path) -> None:
    one, two = (real_data / "libpointmatcher" / f"2D_{name}.csv" for name in ("oneBox", "twoBoxes"))
    there, back = scan([two, one], RNG), scan([one, two], RNG)
    assert (there.X.shape, there.truth, there.files) == ((361, 2), None, (two, one))
    np.testing.assert_array_equal(there.X, back.Y)
    ends = [steps_of(data, max_distance=1.0)[0][-1].stages[-1].belief.mean for data in (there, back)]
    both = moved(ends[1], moved(ends[0], there.X))
    assert np.linalg.norm(both - there.X, axis=1).max() < 0.25  # they saw different boxes
    assert steps_of(there)[1]["registration_rmse"] == pytest.approx(0.0520, abs=1e-4)


@pytest.mark.parametrize("planar", [False, True])
def test_simulated_scans_are_put_together_again(planar: bool) -> None:
    d = 2 if planar else 3
    for seed in range(12):
        data = scan(None, np.random.default_rng(seed), planar=planar)
        assert data.X.shape == data.Y.shape == (1500, d)
        steps, figures = steps_of(data)
        assert data.truth is not None
        error = SPACES[d].minus(steps[-1].stages[-1].belief.mean, data.truth)
        assert figures["converged"] == 1
        assert np.linalg.norm(error[:d]) < 0.03, seed
        assert np.linalg.norm(error[d:]) < 0.03, seed
        name, unit = ("final_heading_error_rad", 1.0) if planar else ("final_attitude_error_deg", 180 / np.pi)
        assert figures[name] == pytest.approx(np.linalg.norm(error[d:]) * unit)
        assert 1200 < figures["matches"] < 1500  # the hidden corners have no match
    again = scan(None, np.random.default_rng(11), planar=planar)
    np.testing.assert_array_equal(again.X, data.X)


def test_the_truth_of_a_simulation_takes_x_on_to_the_walls_of_y() -> None:
    data = scan(None, np.random.default_rng(3), noise=0.0, points=4000)
    assert data.truth is not None
    X = moved(data.truth, data.X) + np.array([1.5, 1.2, 0.8])
    on = np.stack([X[:, 0], X[:, 0] - 3, X[:, 1], X[:, 1] - 2.4, X[:, 2], X[:, 2] - 0.7])
    boxed = (X[:, 0] > 0.6) & (X[:, 0] < 1.8) & (X[:, 1] > 1.2) & (X[:, 1] < 2.2)
    assert (np.abs(on).min(0)[~boxed] < 2e-4).all()
    assert np.linalg.norm(X[:, :2], axis=1).min() > 0.799


def test_a_scenario_holds_what_is_drawn_and_known() -> None:
    data = scan(None, np.random.default_rng(4))
    scenario = scan_icp(data, iterations=3)
    X, Y = scenario.scenery["X"], scenario.scenery["Y"]
    assert isinstance(X, Cloud)
    assert isinstance(Y, Cloud)
    assert (X.points is data.X, X.moves, Y.points is data.Y, Y.moves) == (True, True, True, False)
    assert [(tick.time, tick.dt) for tick in scenario.ticks] == [(0, 0), (1, 1), (2, 1), (3, 1)]
    steps = list(run(scenario))
    assert [stage.name for stage in steps[0].stages] == ["start"]
    np.testing.assert_array_equal([step.truth for step in steps], [data.truth] * 4)
    assert "3 iterations were prescribed" in scenario.notes
    assert "matches repeat" in scan_icp(data).notes
    assert scan_icp(ScanData(data.X, data.Y, None)).truth is None


def test_a_run_that_fails_has_figures_too() -> None:
    X = RNG.standard_normal((10, 3))
    steps, figures = steps_of(ScanData(X, X + 5, None))
    assert steps[-1].error is not None
    assert figures == {"iterations": 0, "converged": 0}


def cloud(d: int = 3, count: int = 9) -> Array:
    return np.random.default_rng(count).integers(-99, 99, (count, d)) / 8


def text(points: Array, separator: str = ",", header: str = "", more: str = "") -> str:
    rows = [separator.join(f"{value:g}" for value in point) + more for point in points]
    return "\n".join([*([header] if header else []), *rows, ""])


TEXTS: dict[str, Callable[[], tuple[str, int]]] = {
    "blanks": lambda: (text(cloud(), "   "), 3),
    "tabs and leading blanks": lambda: (text(cloud(), "\t").replace("\n", "\n  "), 3),
    "commas and blanks": lambda: (text(cloud(), " , "), 3),
    "more columns": lambda: (text(cloud(), ",", more=" , 0.5,0.25,1"), 3),
    "header": lambda: (text(cloud(), ",", "x,y,z,nx", more=",1"), 3),
    "header of capitals, quoted": lambda: (text(cloud(), ",", '"X", "Y", "Z"'), 3),
    "header of a comment": lambda: ("# made by hand\n" + text(cloud(), " ", "//X Y Z"), 3),
    "header with units": lambda: (text(cloud(), ",", "x [m], y (m), z [m]"), 3),
    "semicolons": lambda: (text(cloud(), ";", "x;y;z"), 3),
    "semicolons and decimal commas": lambda: (text(cloud(), ";").replace(".", ","), 3),
    "how many there are": lambda: (f"{len(cloud())}\n" + text(cloud(), " "), 3),
    "comments of MATLAB": lambda: ("% made by hand\n" + text(cloud(), " "), 3),
    "header in another order": lambda: (text(cloud()[:, [2, 0, 1]], ",", "time,z,x,y").replace("\n", "\n7,", 9), 3),
    "comments": lambda: ("# made by hand\n" + text(cloud(), " ") + "\n# the end\n", 3),
    "byte order mark and CR": lambda: ("\ufeff" + text(cloud(), ",", "x,y,z").replace("\n", "\r\n"), 3),
    "plane": lambda: (text(cloud(2), " "), 2),
    "plane by its header": lambda: (text(cloud(2), ",", "x,y,intensity", more=",40"), 2),
}


@pytest.mark.parametrize("what", TEXTS)
def test_text_of_other_people_is_read(what: str, tmp_path: Path) -> None:
    content, d = TEXTS[what]()
    (tmp_path / "a.asc").write_bytes(content.encode())
    (tmp_path / "b.asc").write_text(text(cloud(d, 5)))
    data = scan([tmp_path / "a.asc", tmp_path / "b.asc"], RNG)
    np.testing.assert_array_equal(data.X, cloud(d))
    np.testing.assert_array_equal(data.Y, cloud(d, 5))


def ply(points: Array, form: str, kind: str = "float", extra: bool = True, before: str = "") -> bytes:
    """A PLY file by hand: a colour between y and z, normals, a camera before the vertices, faces after them."""
    code = {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8", "short": "i2", "int32": "i4"}[kind]
    names = ["x", "y", "red", "z", "nx"] if extra else ["x", "y", "z"]
    kinds = {name: "uchar" if name == "red" else kind for name in names}
    order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    rows = np.zeros(len(points), [(k, order + ("u1" if k == "red" else code)) for k in names])
    for name, column in zip("xyz", points.T, strict=True):
        rows[name] = column
    header = [
        *["ply", f"format {form} 1.0", "comment by hand", "obj_info none", before.split("|")[0]],
        *[f"element vertex {len(points)}", *(f"property {kinds[name]} {name}" for name in names)],
        *["element face 1", "property list uchar int vertex_indices", "end_header", ""],
    ]
    head = "\n".join(line for i, line in enumerate(header) if line or i == len(header) - 1).encode()
    if form == "ascii":
        lines = [" ".join(str(value) for value in row.tolist()) for row in rows]
        return head + "\n".join([*before.split("|")[1:], *lines, "3 0 1 2", ""]).encode()
    camera = np.array([1.5, 2.5], order + "f8").tobytes() if before else b""
    return head + camera + rows.tobytes() + b"\x03" + np.array([0, 1, 2], order + "i4").tobytes()


CAMERA = "element camera 1\nproperty double f\nproperty double g|1.5 2.5"


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["float", "double", "float64", "short", "int32"])
@pytest.mark.parametrize("before", ["", CAMERA])
def test_ply_of_every_form_is_read(form: str, kind: str, before: str, tmp_path: Path) -> None:
    points = cloud().round() if kind in ("short", "int32") else cloud()
    (tmp_path / "a.ply").write_bytes(ply(points, form, kind, before=before))
    (tmp_path / "b.ply").write_bytes(ply(cloud(3, 5), form, "double", extra=False))
    data = scan([tmp_path], RNG)
    np.testing.assert_array_equal(data.X, points)
    np.testing.assert_array_equal(data.Y, cloud(3, 5))
    assert data.X.dtype == np.float64


def test_ply_with_dos_line_ends_and_in_the_plane(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply(cloud(), "ascii").replace(b"\n", b"\r\n"))
    (tmp_path / "b.ply").write_bytes(ply(cloud(), "binary_little_endian", extra=False))
    np.testing.assert_array_equal(scan([tmp_path], RNG).X, cloud())
    for name in "ab":
        content = ply(cloud(), "ascii", extra=False).replace(b"property float z", b"property float height")
        (tmp_path / f"{name}.ply").write_bytes(content)
    np.testing.assert_array_equal(scan([tmp_path], RNG).X, cloud()[:, :2])


@pytest.mark.parametrize("planar", [False, True])
def test_a_simulation_comes_back_as_it_was_saved(planar: bool, tmp_path: Path) -> None:
    data = scan(None, np.random.default_rng(5), planar=planar, points=300)
    X, Y, poses = save(data, tmp_path)
    (tmp_path / "notes.csv").write_text("time,flow\n0,1\n")
    for source in ([tmp_path], [X, Y], [X, Y, poses], [poses, X, Y]):
        again = scan(source, RNG)
        assert again.files == (X, Y, poses)
        np.testing.assert_array_equal(again.X, data.X)
        np.testing.assert_array_equal(again.Y, data.Y)
        np.testing.assert_allclose(again.truth, data.truth, atol=1e-12)
    turned = scan([Y, X], RNG)
    assert turned.truth is not None
    assert data.truth is not None
    np.testing.assert_allclose(moved(turned.truth, moved(data.truth, data.X)), data.X, atol=1e-12)
    with pytest.raises(BadInput, match="there already"):
        save(data, tmp_path)
    X.rename(tmp_path / "other.csv")
    assert scan([tmp_path / "other.csv", Y], RNG).truth is None  # the list beside does not name it


def test_the_truth_is_between_the_two_poses_of_a_list(tmp_path: Path) -> None:
    """libpointmatcher's lists: any frame, few digits, names with folders, columns of their own."""
    rng = np.random.default_rng(6)
    R = quaternions.to_matrix(quaternions.exp(rng.standard_normal((2, 3))))
    t = rng.standard_normal((2, 3))
    world = rng.standard_normal((40, 3))
    lines = ["reading, config, " + ", ".join(f"gT{i}{j}" for i in range(4) for j in range(4))]
    for name, rotation, shift in zip("ab", R, t, strict=True):
        (tmp_path / f"{name}.txt").write_text(text(((world - shift) @ rotation).round(6), " "))
        matrix = np.vstack([np.column_stack([rotation, shift]), [0, 0, 0, 1]])
        lines.append(f"scans/{name}.txt, none, " + ", ".join(f"{value:.6g}" for value in matrix.ravel()))
    (tmp_path / "list.csv").write_text("\n".join(lines))
    data = scan([tmp_path / "b.txt", tmp_path / "a.txt"], RNG)
    want = to_state(R[0].T @ R[1], R[0].T @ (t[1] - t[0]))
    np.testing.assert_allclose(data.truth, want, atol=1e-5)
    assert data.truth is not None
    np.testing.assert_allclose(moved(data.truth, data.X), data.Y, atol=1e-4)


GOOD = text(cloud(), ",", "x,y,z")
POSES = "reading," + ",".join(f"gT{i}{j}" for i in range(4) for j in range(4)) + "\n"
EYE = ",1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n"
BINARY = ply(cloud(), "binary_little_endian")
BAD_FILES: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "is empty"),
    "header alone": ("x,y,z\n", "holds column names alone"),
    "no coordinates": ("time,gyro_x\n1,2\n", "neither a cloud (x, y[, z]) nor poses (reading, gT00 …): time, gyro_x"),
    "one column": ("1\n2\n3\n", "neither a cloud"),
    "truncated in a row": (GOOD + "1,2", "line 11 has 2 cells, the first line 3"),
    "a text for a number": (GOOD + "1,two,3\n", "line 11 is no point: '1,two,3'"),
    "an empty cell": (GOOD + "1,,3\n", "line 11 is no point"),
    "NaN": (GOOD + "1,nan,3\n", "y of point 9 is nan"),
    "infinity": (text(cloud(), " ") + "1 2 -inf\n", "z of point 9 is -inf"),
    "a coordinate a line": (
        text(np.tile(cloud().T, 5), " "),
        "3 lines of 45 numbers, expected one point a line",
    ),
    "two points": ("1 2 3\n4 5 6\n", "holds 2 points"),
    "another dimension": (text(cloud(2)), "they must agree"),
    "no text": (b"\x93NUMPY\x01\x00\xff\xfe\n" * 9, "neither text in UTF-8 nor PLY"),
    "poses": (POSES + "a" + EYE, "1 clouds found"),
    "ply: header alone": (BINARY[:60], "header has no end"),
    "ply: truncated": (BINARY[:-60], "holds 6 of the 9 vertices that its header announces; it is truncated"),
    "ply: truncated text": (b"\n".join(ply(cloud(), "ascii").split(b"\n")[:-5]), "holds 6 of the 9 vertices"),
    "ply: no vertices": (BINARY.replace(b"element vertex", b"element point"), "no element vertex (elements: point"),
    "ply: no x": (BINARY.replace(b"float x", b"float u"), "vertices lack x or y (properties: u, y, red, z, nx)"),
    "ply: a list": (BINARY.replace(b"float nx", b"list uchar int n"), "its vertices hold a list"),
    "ply: a list before": (
        BINARY.replace(b"element vertex", b"element a 1\nproperty list uchar int b\nelement vertex"),
        "lists before its vertices",
    ),
    "ply: an unknown type": (BINARY.replace(b"float x", b"half x"), "a line of no known form: 'property half x'"),
    "ply: no number": (BINARY.replace(b"vertex 9", b"vertex many"), "'element vertex many'"),
    "ply: less than none": (ply(cloud(), "ascii").replace(b"vertex 9", b"vertex -9"), "'element vertex -9'"),
    "ply: NaN": (ply(cloud() * np.nan, "binary_big_endian"), "x of point 0 is nan"),
    "ply: a word": (ply(cloud(), "ascii").replace(b"\n3 0 1 2", b" 1\n3 0 1 2"), "vertex 8 has 6 numbers"),
}


def refused(cli: Cli, *source: Path) -> str:
    data = [word for path in source for word in ("--data", str(path))]
    code, out, err = cli("run", "scan-icp", *data, "--out", source[0].parent / "out.rrd")
    assert (code, out) == (2, ""), err
    assert err.startswith("viz-estim: ")
    assert err.count("\n") == 1
    assert len(err) < 600 + 4 * len(str(source[0]))
    assert not (source[0].parent / "out.rrd").exists()
    return err


@pytest.mark.parametrize("what", BAD_FILES)
def test_a_bad_file_is_refused_in_one_line(what: str, cli: Cli, tmp_path: Path) -> None:
    content, words = BAD_FILES[what]
    good, bad = tmp_path / "good.csv", tmp_path / "bad.csv"
    good.write_text(GOOD)
    bad.write_bytes(content if isinstance(content, bytes) else content.encode())
    told = refused(cli, good, bad)
    assert words in told
    assert str(bad) in told or "clouds found" in told


BAD_POSES: dict[str, tuple[str, str]] = {
    "no pose of one": (POSES + "a.csv" + EYE, "has no pose of b.csv (readings: a.csv)"),
    "no rotation": (POSES + "a.csv" + EYE + "b.csv" + EYE.replace(",1,0", ",2,0", 1), "pose of b.csv is no rotation"),
    "mirrored": (POSES + "a.csv" + EYE + "b.csv" + EYE.replace(",1,0", ",-1,0", 1), "pose of b.csv is no rotation"),
    "NaN": (POSES + "a.csv" + EYE + "b.csv" + EYE.replace(",1,0", ",nan,0", 1), "pose of b.csv is no rotation"),
    "a word": (POSES + "a.csv" + EYE.replace(",1,0", ",one,0", 1) + "b.csv" + EYE, "pose of a.csv is not made of numb"),
    "truncated": (POSES + "a.csv" + EYE + "b.csv,1,0,0", "has no pose of b.csv"),
    "of the plane": ("reading,gT00,gT01,gT02\na.csv,1,0,0\nb.csv,1,0,0\n", "expected poses 4×4"),
}


@pytest.mark.parametrize("what", BAD_POSES)
def test_bad_poses_are_refused_in_one_line(what: str, cli: Cli, tmp_path: Path) -> None:
    content, words = BAD_POSES[what]
    a, b, poses = (tmp_path / name for name in ("a.csv", "b.csv", "list.csv"))
    a.write_text(GOOD)
    b.write_text(GOOD)
    poses.write_text(content)
    told = refused(cli, a, b, poses)
    assert words in told
    assert str(poses) in told


def test_what_is_not_two_clouds_is_refused(cli: Cli, tmp_path: Path) -> None:
    a = tmp_path / "a.csv"
    a.write_text(GOOD)
    assert "no such file" in refused(cli, a, tmp_path / "nowhere.csv")
    assert "1 clouds found, a registration takes two: name first the moved one" in refused(cli, a)
    assert "3 clouds found" in refused(cli, a, a, a)
    data = scan([a, a], RNG)  # one cloud on itself is there already
    _, figures = steps_of(data)
    assert (figures["iterations"], figures["registration_rmse"]) == (1, pytest.approx(0, abs=1e-12))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["max_distance=0"], "max_distance must be a positive number"),
        (["iterations=-1"], "iterations must be a whole number from 0 on"),
        (["iterations=2.5"], "iterations=2.5: expected whole number"),
        (["data.points=2"], "points ≥ 3"),
        (["data.noise=-1"], "noise ≥ 0"),
    ],
)
def test_bad_parameters_are_refused(settings: list[str], words: str, cli: Cli, tmp_path: Path) -> None:
    options = [word for setting in settings for word in ("--set", setting)]
    code, out, err = cli("run", "scan-icp", "--seed", "1", *options, "--out", tmp_path / "out.rrd")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert words in err


def test_a_registration_is_judged_where_it_ends(cli: Cli, tmp_path: Path) -> None:
    data = scan([OWN], RNG)
    end = steps_of(data)[0][-1].stages[-1].belief
    error = SPACES[3].minus(end.mean, data.truth)
    nees = float(error @ np.linalg.solve(end.cov, error))
    out = tmp_path / "out.rrd"
    told = strict(cli("run", "scan-icp", "--data", OWN, "--out", out, "--json"))
    assert told["nees"] == {"mean": pytest.approx(nees), "dof": 6, "inside": 0.0}
    assert told["metrics"]["position_rmse_m"] == told["metrics"]["final_position_error_m"]
    shown = strict(cli("show", out, "--json"))
    assert (shown["nees"], shown["metrics"]) == (told["nees"], told["metrics"])
    assert "(expected 6; at the end; 95 % interval 1.24 to 14.4: above: its covariance is too small)" in cli(
        "show", out
    ).out  # fmt: skip


def test_the_own_files_are_what_simulate_writes_and_run(cli: Cli, tmp_path: Path) -> None:
    done = cli("simulate", "scan", "--seed", "2", "--out", tmp_path)
    assert (done.code, done.err) == (0, "")
    made, kept = scan([tmp_path], RNG), scan([OWN], RNG)
    for one, other in ((made.X, kept.X), (made.Y, kept.Y), (made.truth, kept.truth)):
        np.testing.assert_allclose(one, other, atol=1.01e-4 if one is not made.truth else 1e-12)  # whatever the machine
    assert sum(path.stat().st_size for path in OWN.iterdir()) < 200_000
    _, figures = steps_of(scan([OWN], RNG))
    assert (figures["iterations"], figures["matches"], figures["converged"]) == (17, 1361, 1)
    assert figures["registration_rmse"] == pytest.approx(0.07577, abs=1e-5)


def test_matches_that_were_not_kept_are_no_lack_of_them(cli: Cli, tmp_path: Path) -> None:
    options = ["--seed", 1, "--set", "data.points=300", "--every", 7]
    strict(cli("run", "scan-icp", *options, "--out", tmp_path / "a.rrd", "--json"))
    codes = {finding["code"] for finding in json.loads(cli("diagnose", tmp_path / "a.rrd", "--json").out)["findings"]}
    assert "icp_few_matches" not in codes
