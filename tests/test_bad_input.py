"""Bad input: exit code 2, one line that names what is wrong, nothing on stdout, and what existed is untouched."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from conftest import Cli

OUT = ["--out", "{}/out.rrd"]
RUN = ["run", "imu-ukf", *OUT]
HEADER = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z\n"


@pytest.fixture(scope="module")
def course(cli: Cli, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated IMU file and its motion capture."""
    folder = tmp_path_factory.mktemp("course")
    assert cli("simulate", "imu", "--set=duration=4", "--set=still=1", "--set=freeze=0", "--out", folder).code == 0
    return folder


def changed(**change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path, Path], None]:
    """Writes bad.mat: the IMU file with some of its fields changed."""

    def write(folder: Path, course: Path) -> None:
        fields = {k: v for k, v in scipy.io.loadmat(course / "imuRaw1.mat").items() if not k.startswith("__")}
        scipy.io.savemat(folder / "bad.mat", fields | {name: f(fields[name]) for name, f in change.items()})

    return write


def text(name: str, content: str) -> Callable[[Path, Path], None]:
    return lambda folder, course: (folder / name).write_text(content) and None


def truncated(folder: Path, course: Path) -> None:
    (folder / "bad.mat").write_bytes((course / "imuRaw1.mat").read_bytes()[:3000])


def three_sets(folder: Path, course: Path) -> None:
    for number in (1, 2, 3):
        (folder / f"imuRaw{number}.mat").write_bytes((course / "imuRaw1.mat").read_bytes())


def poked(array: np.ndarray, value: float) -> np.ndarray:
    array = array.astype(float)
    array[0, 50] = value
    return array


ROWS = "".join(f"{0.01 * k},0,0,0,0,0,9.8\n" for k in range(50))
BAD_DATA = {
    "truncated": (truncated, "bad.mat"),
    "wrong shape": (changed(vals=lambda v: v[:5]), "6×T"),
    "lengths that differ": (changed(ts=lambda t: t[:, :-1]), "must agree"),
    "no samples": (changed(vals=lambda v: v[:, :0], ts=lambda t: t[:, :0]), "bad.mat"),
    "NaN reading": (changed(vals=lambda v: poked(v, np.nan)), "vals is not a number"),
    "infinite reading": (changed(vals=lambda v: poked(v, np.inf)), "vals is not a number"),
    "NaN stamp": (changed(ts=lambda t: poked(t, np.nan)), "ts is not a number"),
    "stamps that go back": (changed(ts=lambda t: t[:, ::-1]), "ts goes back"),
    "stamps that stand still": (changed(ts=lambda t: t.astype(np.float32)), "double precision"),
    "empty file": (text("bad.mat", ""), "bad.mat"),
    "no numbers": (text("bad.csv", HEADER + "a,b,c,d,e,f,g\n"), "bad.csv"),
    "a column too few": (text("bad.csv", HEADER.replace(",accel_z", "") + ROWS), "bad.csv"),
    "a column missing": (text("bad.csv", HEADER.replace("accel_z", "other") + ROWS), "accel_z"),
    "header alone": (text("bad.csv", HEADER), "bad.csv"),
    "foreign suffix": (text("bad.dat", "hello"), "bad.dat"),
    "a text without numbers": (text("bad.txt", "hello"), "bad.txt"),
}

# Files that stand there before, a command ({} is their folder), and a word of the line that it gives.
BAD_COMMANDS: dict[str, tuple[list[str], str]] = {
    "missing data": ([*RUN, "--data", "{}/nowhere.mat"], "nowhere.mat: no such file"),
    "a folder without data": ([*RUN, "--data", "{}/empty"], "no IMU file"),
    "three sets": ([*RUN, "--data", "{}/sets"], "3 IMU files"),
    "data.* beside --data": ([*RUN, "--data", "{}/sets/imuRaw1.mat", "--set", "data.freeze=0"], "data.freeze"),
    "unknown scenario": (["run", "imu-ufk", *OUT], "did you mean imu-ukf?"),
    "unknown parameter": ([*RUN, "--set", "gyro_nose=1"], "did you mean gyro_noise?"),
    "unknown data parameter": ([*RUN, "--set", "data.duratoin=9"], "did you mean data.duration?"),
    "K without =": ([*RUN, "--set", "gyro_noise"], "NAME=VALUE"),
    "a text for a number": ([*RUN, "--set", "gyro_noise=loud"], "gyro_noise=loud: expected number"),
    "no number of ours": ([*RUN, "--set", "gyro_noise=nan"], "gyro_noise=nan: expected number"),
    "no such choice": ([*RUN, "--set", "frozen=maybe"], "ignore or reject"),
    "noise of zero": ([*RUN, "--set", "gyro_noise=0"], "gyro_noise must be a positive number"),
    "negative noise": ([*RUN, "--set", "accel_noise=-1"], "accel_noise must be a positive number"),
    "noise without bound": ([*RUN, "--set", "gyro_noise=1e300"], "gyro_noise=1e+300 is too large"),
    "negative standard deviation": ([*RUN, "--set", "initial_rate_std=-1"], "initial_rate_std"),
    "gate of one": ([*RUN, "--set", "gyro_gate=1"], "gyro_gate is a probability"),
    "gate of zero": ([*RUN, "--set", "accel_gate=0"], "accel_gate is a probability"),
    "too short a simulation": ([*RUN, "--set", "data.duration=1"], "duration"),
    "negative seed": ([*RUN, "--seed", "-1"], "--seed -1"),
    "seed beyond all": ([*RUN, "--seed", str(2**64)], "--seed 18446744073709551616"),
    "too long a simulation": ([*RUN, "--set", "data.duration=1e9", "--seed", "1"], "duration must be at most 3600"),
    "too many landmarks' readings": (["run", "landmarks-ekf", *OUT, "--seed", "1", "--set=data.rate=1e12"], "readings"),
    "too many rows": (["run", "range-ekf", *OUT, "--seed", "1", "--set=data.duration=1e12"], "at most 1e+06"),
    "too long a flight": (
        ["run", "quadrotor-ukf-pose", *OUT, "--seed", "1", "--set=data.duration=1e9"],
        "at most 3600",
    ),
    "too many steps": (["run", "underwater-bayes", *OUT, "--seed", "1", "--set=data.steps=10000000000"], "steps"),
    "too many points": (["run", "scan-icp", *OUT, "--seed", "1", "--set=data.points=10000000000"], "points"),
    "too many particles": (["run", "beacons-pf", *OUT, "--set=particles=10000000000"], "at most 1e+07"),
    "seed that is no number": ([*RUN, "--seed", "x"], "--seed"),
    "--every 0": ([*RUN, "--every", "0"], "--every 0"),
    "no such folder": (["run", "imu-ukf", "--out", "{}/nowhere/a.rrd"], "does not exist"),
    "a folder as output": (["run", "imu-ukf", "--out", "{}/folder.rrd"], "is a folder"),
    "output without .rrd": (["run", "imu-ukf", "--out", "{}/a.txt"], "must end in .rrd"),
    "calibration missing": ([*RUN, "--calibration", "{}/nowhere.json"], "nowhere.json"),
    "calibration no JSON": ([*RUN, "--calibration", "{}/text.json"], "text.json"),
    "calibration of other keys": ([*RUN, "--calibration", "{}/other.json"], "other.json"),
    "calibration of a list": ([*RUN, "--calibration", "{}/list.json"], "list.json"),
    "unknown command": (["fly"], "fly"),
    "no command": ([], "COMMAND"),
    "unknown flag": ([*RUN, "--fast"], "--fast"),
    "show: missing": (["show", "{}/nowhere.rrd"], "nowhere.rrd: no such"),
    "show: garbage": (["show", "{}/garbage.rrd"], "garbage.rrd"),
    "show: no such step": (["show", "{rec}", "--step", "9999"], "no step 9999"),
    "show: negative step": (["show", "{rec}", "--step", "-1"], "no step -1"),
    "show: no such time": (["show", "{rec}", "--time", "99"], "no step at 99"),
    "show: time that is no number": (["show", "{rec}", "--time", "nan"], "nan"),
    "show: step and time": (["show", "{rec}", "--step", "1", "--time", "1"], "not allowed"),
    "export: over its own recording": (["export", "{rec}", "--to", "csv", "-o", "{rec}"], "must end in .csv"),
    "a file that leaves": (["run", "{}/leaves.py:f", *OUT], "cannot be imported (SystemExit: 3)"),
    "no place for recordings": (["run", "parameter-ekf", "--seed", "1"], "recordings: cannot be made here"),
    "run: a calibration as data": (["run", "imu-ukf", "--data", "{}/text.json"], "expected a data file"),
    "run: no such calibration": (
        ["run", "imu-ukf", "--seed", "1", "--calibration", "{}/no.json"],
        "no such calibration",
    ),
    "snapshot: no such step": (["snapshot", "{rec}", "--step", "9999", "-o", "{}/a.png"], "no step 9999"),
    "snapshot: no such stage": (["snapshot", "{rec}", "--stage", "9999", "-o", "{}/a.png"], "no stage 9999"),
    "snapshot: no such time": (["snapshot", "{rec}", "--time", "-3", "-o", "{}/a.png"], "no step at -3"),
    "snapshot: size": (["snapshot", "{rec}", "--size", "big", "-o", "{}/a.png"], "WIDTHxHEIGHT"),
    "snapshot: size of zero": (["snapshot", "{rec}", "--size", "0x0", "-o", "{}/a.png"], "WIDTHxHEIGHT"),
    "snapshot: no PNG": (["snapshot", "{rec}", "-o", "{}/a.jpg"], "must end in .png"),
    "snapshot: no such folder": (["snapshot", "{rec}", "-o", "{}/nowhere/a.png"], "does not exist"),
    "snapshot: garbage": (["snapshot", "{}/garbage.rrd", "-o", "{}/a.png"], "garbage.rrd"),
    "export: garbage": (["export", "{}/garbage.rrd", "--to", "csv", "-o", "{}/a.csv"], "garbage.rrd"),
    "export: no such folder": (["export", "{rec}", "--to", "csv", "-o", "{}/nowhere/a.csv"], "does not exist"),
    "export: unknown format": (["export", "{rec}", "--to", "xml", "-o", "{}/a.xml"], "xml"),
    "open: missing": (["open", "{}/nowhere.rrd"], "nowhere.rrd: no such"),
    "simulate: unknown system": (["simulate", "imo", "--out", "{}/new"], "did you mean imu?"),
    "simulate: onto a file": (["simulate", "imu", "--out", "{}/text.json"], "is a file"),
    "simulate: unknown parameter": (["simulate", "imu", "--set", "freez=1", "--out", "{}/new"], "did you mean freeze?"),
    "simulate: negative seed": (["simulate", "imu", "--seed", "-1", "--out", "{}/new"], "--seed -1"),
    "calibrate: no truth": (["calibrate", "imu", "--data", "{}/sets/imuRaw1.mat"], "imuRaw1.mat"),
    "calibrate: unknown system": (["calibrate", "toaster", "--data", "{}/sets"], "toaster"),
    "calibrate: missing": (["calibrate", "imu", "--data", "{}/nowhere"], "nowhere: no such file"),
    "calibrate: no .json": (["calibrate", "imu", "--data", "{}/sets", "--out", "{}/a.txt"], "must end in .json"),
}


def contents(folder: Path) -> dict[str, bytes | None]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


def assert_refused(cli: Cli, folder: Path, arguments: list[str], words: str) -> None:
    """One line with the words and exit code 2, nothing said on stdout, and the folder as it was."""
    before = contents(folder)
    code, out, err = cli(*arguments)
    assert (code, out) == (2, ""), err
    assert err.startswith("viz-estim: ")
    assert err.endswith("\n")
    assert err.count("\n") == 1
    assert len(err) < 500 + len(str(folder))
    assert words in err
    assert "Traceback" not in err
    assert contents(folder) == before


@pytest.mark.parametrize("what", BAD_DATA)
def test_bad_data_is_refused(what: str, cli: Cli, course: Path, tmp_path: Path) -> None:
    make, words = BAD_DATA[what]
    (tmp_path / "out.rrd").write_bytes(b"precious")
    make(tmp_path, course)
    (bad,) = tmp_path.glob("bad.*")
    for command in (["run", "imu-ukf", "--out", str(tmp_path / "out.rrd")], ["calibrate", "imu"]):
        assert_refused(cli, tmp_path, [*command, "--data", str(bad)], words)


@pytest.mark.parametrize("what", BAD_COMMANDS)
@pytest.mark.usefixtures("no_display")
def test_bad_usage_is_refused(
    what: str, cli: Cli, course: Path, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments, words = BAD_COMMANDS[what]
    for folder in ("empty", "sets", "folder.rrd"):
        (tmp_path / folder).mkdir()
    three_sets(tmp_path / "sets", course)
    files = {
        "text.json": "hello",
        "other.json": '{"a": 1}',
        "list.json": "[1, 2]",
        "out.rrd": "precious",
        "leaves.py": "raise SystemExit(3)",
    }
    for name, content in {**files, "a.png": "precious", "a.csv": "precious", "garbage.rrd": "RRF2garbage"}.items():
        (tmp_path / name).write_text(content)
    given = [argument.format(tmp_path, rec=recording) for argument in arguments]
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "recordings").write_text("a file of that name")
    monkeypatch.chdir(tmp_path / "here")
    assert_refused(cli, tmp_path, given, words)


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
@pytest.mark.parametrize("command", [["run", "imu-gyro", "--seed", "1"], ["simulate", "imu"]])
def test_a_read_only_folder_is_refused(command: list[str], cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    out = "locked/a.rrd" if command[0] == "run" else "locked"
    assert_refused(cli, tmp_path, [*command, "--out", str(tmp_path / out)], "locked")
