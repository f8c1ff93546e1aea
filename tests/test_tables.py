"""Tables and MATLAB files as other people write them: separators, headers, units, structs; what is not read says so."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from viz_estim import estimate_rot
from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios import SYSTEMS
from viz_estim.scenarios.imu_files import find_sets, load, of_course
from viz_estim.scenarios.reading import mat_shapes, read_mat
from viz_estim.scenarios.tables import read_table

PLAIN = "time,left,right\n0,1.5,2\n5,1.25,-2e-3\n"
TEXTS = {
    "commas": PLAIN,
    "commas and blanks": PLAIN.replace(",", " ,  "),
    "semicolons": PLAIN.replace(",", ";"),
    "decimal commas": PLAIN.replace(",", ";").replace(".", ","),
    "tabs": PLAIN.replace(",", "\t"),
    "blanks": "   " + PLAIN.replace(",", "   "),
    "blanks with units": "time [s] left [rad / s]  right(rad/s)\n0 1.5 2\n5 1.25 -2e-3\n",
    "CRLF": PLAIN.replace("\n", "\r\n"),
    "CR": PLAIN.replace("\n", "\r"),
    "BOM": "\ufeff" + PLAIN,
    "blank lines": "\n" + PLAIN.replace("\n", "\n \n") + "\n\n\n",
    "no end of line": PLAIN.rstrip(),
    "comments": "# of my robot\n" + PLAIN.replace("\n5", "\n% later\n5"),
    "a header in a comment": "# of my robot\n# " + PLAIN,
    "a header of commas in a comment, over blanks": "# time, left, right\n0 1.5 2\n5 1.25 -2e-3\n",
    "quotes": '"time","left","right"\n"0","1.5","2"\n"5","1.25","-2e-3"\n',
    "another case": PLAIN.replace("left", "LEFT").replace("time", "Time"),
    "units": PLAIN.replace("time", "time [s]").replace("left", "left (rad/s)"),
    "a comma at each end": PLAIN.replace("\n", ",\n"),
    "words in another column": PLAIN.replace("\n", ",slow\n").replace("right,slow", "right,note"),
}


def test_what_tools_write_for_a_missing_number_is_nan(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,left\n" + "".join(f"{i},{word}\n" for i, word in enumerate(["", "NaN", "NA", "n/a", "null"])))
    assert np.isnan(read_table(path).numbers("left")).all()
    path.write_text("time,left\n0,-\n")
    with pytest.raises(BadInput, match="line 2, left: '-' is not a number"):
        read_table(path).numbers("left")


@pytest.mark.parametrize("what", TEXTS)
def test_a_table_is_read_however_it_is_written(what: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(TEXTS[what].encode())
    columns = read_table(path).columns(("time", "left", "right"))
    expected = {"time": [0, 5], "left": [1.5, 1.25], "right": [2, -2e-3]}
    assert {name: values.tolist() for name, values in columns.items()} == expected


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (PLAIN.encode("utf-16"), "UTF-8"),
        (b"", "is empty"),
        (b"# nothing\n\n", "is empty"),
        (b"time,left,right\n", "column names alone"),
        (PLAIN.replace("time", "time [ms]").encode(), "time is in ms"),
        (PLAIN.replace("left", "left [deg/s]").encode(), "left is in deg/s"),
        (PLAIN.replace("left", "Right").encode(), "two columns have one name"),
        (b"time,left,right\n\n# and then\n1,2,3\n4,5\n", "line 5 has 2 cells"),
        (b"time,left,right\n\n1,2,fast\n", "line 3, right: 'fast'"),
    ],
)
def test_what_is_no_table_is_refused_with_the_line(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(content)
    with pytest.raises(BadInput, match=r"a\.csv: ") as caught:
        read_table(path).columns(("time", "left", "right"))
    assert words in str(caught.value)


def test_an_archive_s_other_arrays_are_in_nobody_s_way(tmp_path: Path) -> None:
    path, time = tmp_path / "a.npz", np.arange(4)
    np.savez(path, Time=time[:, None], x=time[None], rate=100, note="by hand", thing=np.array([{}, None], object))
    table = read_table(path)
    for values in table.columns(("time", "x")).values():
        assert values.tolist() == [0, 1, 2, 3]
    for name, words in (("thing", "Python objects"), ("note", "must be one column of numbers")):
        with pytest.raises(BadInput, match=words):
            table.numbers(name)
    with pytest.raises(BadInput, match="different lengths"):
        table.columns(("time", "rate"))


@pytest.fixture(scope="module")
def counts() -> dict[str, Array]:
    rng = np.random.default_rng(0)
    return {"vals": rng.integers(300, 600, (6, 40)).astype(np.uint16), "ts": 0.01 * np.arange(40.0)[None]}


TRUTH = {"rots": np.tile(np.eye(3, dtype=np.float32)[..., None], 40), "ts": 0.01 * np.arange(40.0)[:, None]}


@pytest.mark.parametrize("how", ["in a struct", "in a struct beside others", "in another case", "as time", "in v4"])
def test_the_course_s_fields_are_found_where_other_people_put_them(
    how: str, counts: dict[str, Array], tmp_path: Path
) -> None:
    def changed(fields: dict[str, Any]) -> dict[str, Any]:
        match how:
            case "in a struct":
                return {"data": fields}
            case "in a struct beside others":
                return {"data": {"set": {**fields, "by": "me"}}, "when": "today"}
            case "in another case":
                return {name.upper(): value for name, value in fields.items()}
            case "as time":
                return {"time" if name == "ts" else name: value for name, value in fields.items()}
        return fields

    flat = how == "in v4" and {"format": "4"}
    scipy.io.savemat(tmp_path / "imuRaw01.mat", changed(counts), **(flat or {}))
    scipy.io.savemat(tmp_path / "viconRot1.mat", changed(TRUTH))
    log = load(*find_sets([tmp_path / "imuRaw01.mat"])[0])
    np.testing.assert_array_equal(log.accel.T, counts["vals"][:3])
    np.testing.assert_array_equal(log.stamps, counts["ts"][0])
    assert log.truth.tolist() == [[1, 0, 0, 0]] * 40
    (tmp_path / "steps.csv").write_text("time,steps\n0,1\n1,2\n")
    assert find_sets([tmp_path]) == [(tmp_path / "imuRaw01.mat", tmp_path / "viconRot1.mat")]


def test_a_struct_s_fields_stand_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"kf": {"u": np.zeros((2, 5)), "y": np.ones((2, 3))}, "y": np.zeros(7)})
    assert mat_shapes(path) == {"kf": (1, 1), "u": (2, 5), "y": (1, 7)}
    assert {name: np.shape(value) for name, value in read_mat(path).items() if name in "uy"} == {
        "u": (2, 5),
        "y": (1, 7),
    }


READ_MAT = ("imu", "beacons", "camera", "diffdrive", "plaza", "quadrotor")


@pytest.mark.parametrize("system", READ_MAT)
@pytest.mark.parametrize("in_folder", [False, True])
def test_matlab_s_newest_format_is_refused_with_what_to_do(system: str, in_folder: bool, tmp_path: Path) -> None:
    path = tmp_path / "imuRaw1.mat"
    mark = b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H", 0x200) + b"IM" + bytes(384) + b"\x89HDF\r\n\x1a\n"
    path.write_bytes(mark + bytes(300))
    with pytest.raises(BadInput, match=r"imuRaw1.mat: .*v7\.3 .*save\(FILE, '-v7'\)") as caught:
        getattr(SYSTEMS[system], system)([tmp_path if in_folder else path], np.random.default_rng(0))
    assert len(str(caught.value)) < 300 + len(str(path))


def test_a_file_is_meant_by_its_path_or_its_number(
    counts: dict[str, Array], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "imu").mkdir()
    monkeypatch.chdir(tmp_path)
    path = Path("imu", "imuRaw3.mat")
    scipy.io.savemat(path, counts)
    for name in (3, np.int64(3), str(path), path, "imu/imuRaw3", tmp_path / "imu" / "imuRaw3"):
        assert of_course(name).samefile(path)
    assert [angles.shape for angles in estimate_rot(3)] == [(40,)] * 3
    with pytest.raises(BadInput, match="no such file"):
        estimate_rot(4)


def test_stamps_in_another_unit_are_refused(counts: dict[str, Array], tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "imuRaw1.mat", counts | {"ts": 1e6 * counts["ts"]})
    with pytest.raises(BadInput, match="give seconds"):
        load(tmp_path / "imuRaw1.mat", None)
