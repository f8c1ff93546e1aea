"""IMU files: what is read and paired, the truth at its stamps, still prefixes, freezes, and one line for bad input."""

import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.errors import BadInput
from viz_estim.scenarios import imu
from viz_estim.scenarios.imu_data import intervals, prepare, truth_at
from viz_estim.scenarios.imu_files import ImuLog, find_sets, load, save_course
from viz_estim.scenarios.imu_health import frozen_gyro, still_prefix
from viz_estim.scenarios.imu_simulation import simulate

REAL = Path(__file__).parents[2] / "shared" / "data" / "ese650"
HEADER, T = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z", 40


def simulated(seed: int = 1, duration: float = 6, still: float = 1, freeze: float = 1) -> ImuLog:
    return simulate(np.random.default_rng(seed), duration=duration, still=still, freeze=freeze, noise_scale=1)[0]


def test_the_course_s_format_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    log, imu_file, truth_file = simulated(), tmp_path / "imuRaw7.mat", tmp_path / "viconRot7.mat"
    assert save_course(tmp_path, 7, log) == [imu_file, truth_file]
    again = load(*find_sets([tmp_path])[0])
    assert (again.in_counts, again.files) == (True, (imu_file, truth_file))
    for name in ("stamps", "accel", "gyro", "truth_stamps"):
        np.testing.assert_array_equal(getattr(again, name), getattr(log, name), strict=True)
    off = quaternions.log(quaternions.multiply(quaternions.conjugate(log.truth), again.truth))
    np.testing.assert_allclose(off, 0, atol=1e-6)
    vals = np.array([*log.accel.T, *log.gyro[:, [2, 0, 1]].T], np.uint16)
    np.testing.assert_array_equal(scipy.io.loadmat(imu_file)["vals"], vals, strict=True)
    assert len(load(imu_file, None).truth) == 0


def test_counts_are_no_longer_unsigned_when_a_bias_is_subtracted(tmp_path: Path) -> None:
    vals = np.tile(np.array([[521], [491], [606], [360], [384], [365]], np.uint16), 30)  # x, z below their biases
    scipy.io.savemat(tmp_path / "imuRaw1.mat", {"vals": vals, "ts": 0.01 * np.arange(30)[None]})
    data = prepare(load(tmp_path / "imuRaw1.mat", None), None)  # too short to lie still: the typical bias is taken
    np.testing.assert_allclose(data.gyro[0], np.array([10.5, -10.4, -9.6]) * 3300 / 1023 / [208, 201, 184])
    np.testing.assert_allclose(data.accel[0], np.array([-9.5, 9.5, 103.5]) * 3300 / 1023 / [34.3, 34.2, 33.8])


def test_files_are_paired_by_role_and_number_wherever_they_lie(tmp_path: Path) -> None:
    for folder in (tmp_path / "imu", tmp_path / "vicon"):
        folder.mkdir()
    one, two, twelve = (tuple(save_course(tmp_path / "imu", n, simulated(freeze=0))) for n in (1, 2, 12))
    scipy.io.savemat(tmp_path / "imu" / "cam1.mat", {"cam": np.zeros((2, 2))})
    (tmp_path / "imu" / "broken.mat").write_text("not for us")
    assert sorted(find_sets([tmp_path / "imu"])) == sorted([one, two, twelve])
    assert find_sets([two[1], two[0]]) == [two]  # the motion capture first
    assert find_sets([one[0]]) == [one]
    assert sorted(find_sets([twelve[1], one[0], twelve[0], one[1]])) == sorted([one, twelve])
    moved = two[1].rename(tmp_path / "vicon" / two[1].name)
    assert find_sets([two[0]]) == [(two[0], moved)]
    assert (two[0], moved) in find_sets([tmp_path / "imu"])
    alone = one[0].rename(tmp_path / "walk.mat")
    assert find_sets([alone]) == [(alone, None)]
    assert find_sets([alone, one[1]]) == [(alone, one[1])]  # one of each belong together whatever their names


def table(rng: np.random.Generator, truth: bool) -> dict[str, Array]:
    columns = {"time": 5 + np.cumsum(rng.uniform(0.006, 0.014, T))}
    columns |= {name: rng.standard_normal(T) for name in HEADER.split(",")[1:]}
    if truth:
        q = quaternions.exp(np.linspace(0, 1, T)[:, None] * np.array([0.3, 0.2, -2.0]))
        q[10:15] = np.nan
        columns |= dict(zip(("qw", "qx", "qy", "qz"), q.T, strict=True))
    return columns


def write(path: Path, columns: dict[str, Any], pack: bool = True) -> Path:
    if path.suffix == ".npz":
        (np.savez_compressed if pack else np.savez)(path, **columns)
    elif path.suffix == ".mat":
        scipy.io.savemat(path, columns, do_compression=pack)
    else:
        np.savetxt(path, np.stack([*columns.values()], 1), "%.17g", ",", header=", ".join(columns), comments="")
    return path


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".npz"])
@pytest.mark.parametrize("truth", [False, True])
def test_a_plain_log_is_read_in_si_units_with_and_without_truth(tmp_path: Path, suffix: str, truth: bool) -> None:
    columns = table(np.random.default_rng(2), truth)
    path = write(tmp_path / f"log{suffix}", dict(sorted(columns.items(), reverse=True)) | {"extra": np.arange(T)})
    assert find_sets([path]) == find_sets([tmp_path]) == [(path, None)]
    one = load(path, None)
    np.testing.assert_array_equal(one.stamps, columns["time"])
    np.testing.assert_array_equal(one.gyro, np.stack([columns[f"gyro_{a}"] for a in "xyz"], 1))
    np.testing.assert_array_equal(one.accel, np.stack([columns[f"accel_{a}"] for a in "xyz"], 1))
    found = truth_at(one.stamps, one)
    assert (one.in_counts, len(one.truth_stamps)) == (False, T - 5 if truth else 0)
    assert np.isfinite(found).all() == np.isfinite(found).any() == truth  # 0.06 s of NaN are bridged
    if truth:
        np.testing.assert_allclose(found[:10], np.stack([columns[f"q{c}"] for c in "wxyz"], 1)[:10])
        imu_file, other = save_course(tmp_path, 3, simulated(freeze=0))
        np.testing.assert_array_equal(load(path, other).truth_stamps, load(imu_file, other).truth_stamps)


def test_truth_is_interpolated_on_the_sphere_and_never_guessed(tmp_path: Path) -> None:
    rate, stamps = np.array([0.5, -1.0, 2.0]), np.arange(0.0, 3.0, 0.02)
    rots = np.moveaxis(quaternions.to_matrix(quaternions.exp(stamps[:, None] * rate)), 0, -1)
    rots[:, :, 20] = np.nan  # one lost frame: 0.04 s are bridged
    rots[:, :, 30:40] = np.nan  # 0.22 s are not
    rots[:, :, 60:68] = 0.0  # no rotations
    rots[:, :, 100:108] *= np.array([1.0, 1.0, -1.0])[:, None, None]  # mirrored
    write(tmp_path / "viconRot1.mat", {"rots": rots, "ts": stamps[None]})
    write(tmp_path / "imuRaw1.mat", {"vals": np.full((6, 500), 400), "ts": np.linspace(-0.5, 3.5, 500)[None]})
    one = load(tmp_path / "imuRaw1.mat", tmp_path / "viconRot1.mat")
    found, t = truth_at(one.stamps, one), one.stamps
    gaps = [(stamps[a - 1], stamps[b]) for a, b in ((30, 40), (60, 68), (100, 108))]
    inside = (t >= 0) & (t <= stamps[-1]) & ~np.any([(t > a) & (t < b) for a, b in gaps], axis=0)
    np.testing.assert_array_equal(np.isfinite(found).all(1), inside)
    off = quaternions.multiply(quaternions.conjugate(quaternions.exp(t[:, None] * rate)), found)[inside]
    np.testing.assert_allclose(quaternions.log(off), 0, atol=1e-12)
    np.testing.assert_allclose(truth_at(t, one, 0.4), truth_at(t + 0.4, one), atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_the_still_prefix_and_the_freeze_of_a_simulation_are_found(seed: int) -> None:
    still = 1.0 + 0.5 * seed
    log = simulated(seed, duration=9 + still, still=still, freeze=1.3)
    stuck = (np.abs(log.gyro - [382, 383, 384]) <= 1).all(1)
    longest = max(intervals(stuck), key=lambda run: run[1] - run[0])
    data = prepare(log, None)
    np.testing.assert_allclose(intervals(data.frozen), [longest], atol=2)
    assert data.time[data.still - 1] == pytest.approx(still, abs=0.3)
    assert not prepare(simulated(seed, duration=9 + still, still=still, freeze=0), None).frozen.any()


@pytest.mark.parametrize("seed", range(3))
def test_a_gyro_that_is_stuck_at_first_says_nothing_of_its_rest(seed: int) -> None:
    log = simulated(seed, duration=10, still=4, freeze=0)
    stuck = log.stamps < log.stamps[0] + 1.5
    gyro = np.where(stuck[:, None], [382.0, 383.0, 384.0], log.gyro)
    whole, data = prepare(log, None), prepare(replace(log, gyro=gyro), None)
    np.testing.assert_array_equal(data.frozen, stuck)
    assert data.still == pytest.approx(whole.still, abs=3)
    np.testing.assert_allclose(data.gyro[~stuck], whole.gyro[~stuck], atol=3e-3)
    # One that gets stuck after half a second has shown its rest before.
    late = replace(log, gyro=np.where(stuck[:, None] & (log.stamps > log.stamps[0] + 0.8)[:, None], gyro, log.gyro))
    assert prepare(late, None).stuck == 0
    np.testing.assert_allclose(prepare(late, None).gyro[~stuck], whole.gyro[~stuck], atol=3e-3)


def turning(rate: Array, seconds: float) -> tuple[Array, Array, Array]:
    rng, stamps = np.random.default_rng(4), np.arange(0, seconds, 0.01)
    gravity = quaternions.rotate(quaternions.exp(-stamps[:, None] * rate), np.array([0.0, 0.0, 9.81]))
    return (
        stamps,
        rate + rng.integers(-1, 2, (len(stamps), 3)) * 0.01,
        gravity + 0.04 * rng.standard_normal(gravity.shape),
    )


@pytest.mark.parametrize("rate", [[0, 0, 0], [0.05, 0, 0], [0, 0.1, 0], [0.1, -0.1, 0.3], [0, 0, 2.0], [0.8, 0, 0]])
@pytest.mark.parametrize("seconds", [4, 60])
def test_a_still_sensor_and_a_steady_turn_are_no_freeze(rate: list[float], seconds: int) -> None:
    stamps, gyro, accel = turning(np.array(rate), seconds)
    assert not frozen_gyro(stamps, gyro, accel, np.zeros(3)).any()
    assert still_prefix(stamps, gyro, accel) > 0 or rate != [0, 0, 0]
    if np.hypot(*rate[:2]) * seconds > 1:  # the same turn with a gyro that is stuck at its rest level
        assert frozen_gyro(stamps, gyro - rate, accel, np.zeros(3)).all()


@pytest.mark.skipif(not REAL.is_dir(), reason="the course's files are not here")
@pytest.mark.parametrize(("number", "freezes"), [(1, [(8.57, 9.83)]), (2, [(8.55, 10.07)]), (3, [])])
def test_the_real_sets_freeze_and_lie_still_when_they_do(number: int, freezes: list[tuple[float, float]]) -> None:
    data = imu.imu([REAL / f"imuRaw{number}.mat"], np.random.default_rng(0))
    found = [(data.time[a], data.time[b]) for a, b in intervals(data.frozen)]
    np.testing.assert_allclose(found, freezes, atol=0.05)
    assert 5.5 <= data.time[data.still - 1] <= 8.3


def spoilt(values: Array, value: float = np.nan) -> Array:
    return np.where(np.arange(values.size).reshape(values.shape) == 7, value, values)


C, S, ROTS = np.full((6, T), 400.0), 0.01 * np.arange(1, T + 1)[None], np.tile(np.eye(3)[..., None], T)
LINES, LOG = "".join(f"{k},1,2,3,4,5,6\n" for k in range(9)), table(np.random.default_rng(0), truth=True)
IMU, VICON = {"vals": C.astype(np.uint16), "ts": S}, {"rots": ROTS, "ts": S}
KINDS = {"imu": ("bad1.mat", IMU), "vicon": ("bad1.mat", VICON), "log": ("bad1.npz", LOG), "csv": ("bad1.csv", {})}
# fmt: off
FIELDS: dict[str, dict[str, dict[str, Any]]] = {  # by kind of file: what stands in place of its own; None: nothing
    "imu": {
        "5×T": {"vals": C[:5]}, "T×6": {"vals": C.T}, "no vals": {"vals": None}, "no ts": {"ts": None},
        "ts too short": {"ts": S[:, 1:]}, "NaN in vals": {"vals": spoilt(C)}, "NaN in ts": {"ts": spoilt(S)},
        "ts goes back": {"ts": spoilt(S, 0)}, "one sample": {"vals": C[:, :1], "ts": S[:, :1]},
        "no sample": {"vals": C[:, :0], "ts": S[:, :0]}, "text in vals": {"vals": "abcdef"},
        "cells in vals": {"vals": np.array([[1, "a"]] * 6, object)}, "complex vals": {"vals": C * 1j},
    },
    "vicon": {
        "T×3×3": {"rots": np.moveaxis(ROTS, 2, 0)}, "9×T": {"rots": ROTS.reshape(9, T)}, "no ts": {"ts": None},
        "ts too short": {"ts": S[:, 1:]}, "NaN in ts": {"ts": spoilt(S)}, "text in rots": {"rots": "abc"},
        "ts goes back": {"ts": spoilt(S, 0)}, "one frame": {"rots": ROTS[..., :1], "ts": S[:, :1]},
    },
    "log": {
        "no accel_z": {"accel_z": None}, "no qz": {"qz": None}, "no time": {"time": None}, "goes back": {"time": -S[0]},
        "infinity": {"gyro_x": spoilt(S[0], np.inf)}, "words": {"gyro_x": ["a"] * T}, "short": {"gyro_x": S[0, 1:]},
        "not unit quaternions": {"qw": 1 + S[0], "qx": 1 + S[0]}, "tables": {"gyro_x": np.zeros((T, 2))},
        "time is one number": {"gyro_x": S[0], "time": 1.0}, "no sample": dict.fromkeys(LOG, S[0, :0]),
    },
}
H, ONE = HEADER + "\n", "3,1,2"
TEXTS = [  # of a log
    "", "\x00\x01\n" * 9, HEADER, H + LINES[:14], HEADER[:-8] + "\n" + LINES.replace(",6", ""), H + LINES + "9,1,2\n",
    H.replace("time", "stamp") + LINES, H + LINES.replace("\n", ",7\n"), H + LINES.replace(ONE, "3,one,2"),
    H + LINES.replace(ONE, "noon,1,2"), H + LINES.replace(ONE, "3,,2"), H + LINES + LINES,
    HEADER + ",qw,qx,qy,qz\n" + LINES.replace("6\n", "6,one,0,0,0\n"),
]
# fmt: on
CASES: list[tuple[str, str, Any]] = [(kind, name, new) for kind in FIELDS for name, new in FIELDS[kind].items()]
for _kind in FIELDS:
    CASES += [(_kind, f"{how} cut at {s}", s) for how in ("packed", "plain") for s in (0.05, 0.3, 0.6, 0.9, 0.99)]
    CASES += [(_kind, "empty", ""), (_kind, "text", "hello\nworld\n" * 50)]
CASES += [("csv", f"text {i}", text) for i, text in enumerate(TEXTS)]


def refused(bad: Path, *good: Path) -> None:
    """Holds that the file is refused in one line that names it, with no warning beside it."""
    with warnings.catch_warnings(record=True) as heard, pytest.raises(BadInput) as caught:
        imu.imu([bad, *good], np.random.default_rng(0))
    assert (bad.name in str(caught.value), "\n" in str(caught.value)) == (True, False)
    assert [str(one.message) for one in heard if one.category is not ResourceWarning] == []


@pytest.mark.parametrize(("kind", "name", "change"), CASES, ids=[f"{kind}: {name}" for kind, name, _ in CASES])
def test_a_bad_file_is_refused_in_one_line(kind: str, name: str, change: Any, tmp_path: Path) -> None:
    file, fields = KINDS[kind]
    held, bad = fields | change if isinstance(change, dict) else fields, tmp_path / file
    if isinstance(change, str):
        bad.write_text(change)
    else:
        write(bad, {k: v for k, v in held.items() if v is not None}, pack=not name.startswith("plain"))
    if isinstance(change, float):
        os.truncate(bad, int(change * bad.stat().st_size))
    refused(bad, *([write(tmp_path / "good1.mat", IMU)] if kind == "vicon" else []))


def test_paths_without_an_imu_file_are_refused_in_one_line(tmp_path: Path) -> None:
    refused(tmp_path / "missing1.mat")
    refused(tmp_path)
    (tmp_path / "notes.txt").write_text("x\n1\n")
    refused(tmp_path / "notes.txt")
    np.save(tmp_path / "array.npy", np.zeros(3))
    refused((tmp_path / "array.npy").rename(tmp_path / "array.npz"))
    refused(write(tmp_path / "alone.mat", VICON))


class Unpickled:
    def __reduce__(self) -> tuple[Any, ...]:
        return pytest.fail, ("it was unpickled",)


def test_nothing_is_unpickled_from_an_npz(tmp_path: Path) -> None:
    refused(write(tmp_path / "bad1.npz", {"time": np.array([Unpickled()], object)}))


def test_a_freeze_that_ends_at_rest_is_parted_from_the_rest() -> None:
    rng, stamps = np.random.default_rng(5), np.arange(0.0, 4.0, 0.01)
    stuck = (stamps >= 1.0) & (stamps < 2.0)
    tilt = np.minimum(np.maximum(stamps - 1.0, 0.0), 1.0)[:, None] * [0.8, 0.0, 0.0]  # it turns while it is stuck
    accel = quaternions.rotate(quaternions.exp(-tilt), np.array([0.0, 0.0, 9.81]))
    gyro = np.where(stuck[:, None], 0.15, 0.0) + 0.01 * rng.integers(-1, 2, (len(stamps), 3))
    assert intervals(frozen_gyro(stamps, gyro, accel, np.zeros(3))) == [(100, 199)]
