"""The IMU's calibration: known constants found again, with honest errors; the real sets; the picture; bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from viz_estim.core import quaternions
from viz_estim.errors import BadInput
from viz_estim.recording import calibration_picture
from viz_estim.scenarios import imu_calibration, imu_files, imu_fit, imu_series, imu_simulation
from viz_estim.scenarios.imu_calibration import MV_PER_COUNT, Calibration
from viz_estim.scenarios.imu_data import truth_at
from viz_estim.scenarios.imu_files import ImuLog

REAL = Path(__file__).parents[2] / "shared" / "data" / "ese650"
CHANNELS = ("accel_bias", "accel_sensitivity", "gyro_bias", "gyro_sensitivity")
# Counts, mV/(m/s²), counts, mV/(rad/s): four to five standard errors of one set of 25 s.
BOUNDS = {"accel_bias": 1.0, "accel_sensitivity": 1.5, "gyro_bias": 0.2, "gyro_sensitivity": 1.0}


@pytest.fixture(scope="module")
def simulated() -> list[tuple[ImuLog, Calibration]]:
    return [
        imu_simulation.simulate(np.random.default_rng(seed), duration=25.0, still=2.0, freeze=1.5, noise_scale=1.0)
        for seed in range(6)
    ]


@pytest.fixture(scope="module")
def fits(simulated: list[tuple[ImuLog, Calibration]]) -> list[imu_fit.Fit]:
    return [imu_fit.fit([log]) for log, _ in simulated]


@pytest.fixture(scope="module")
def real() -> tuple[list[ImuLog], imu_fit.Fit]:
    if not REAL.is_dir():
        pytest.skip("the course's files are not here")
    logs = [imu_files.load(REAL / f"imuRaw{i}.mat", REAL / f"viconRot{i}.mat") for i in (1, 2, 3)]
    return logs, imu_fit.fit(logs)


def test_known_constants_are_found_again(simulated, fits):
    for (_, constants), fit in zip(simulated, fits, strict=True):
        for name in CHANNELS:
            np.testing.assert_allclose(
                getattr(fit.calibration, name), getattr(constants, name), atol=BOUNDS[name], err_msg=name
            )


def test_standard_errors_are_the_size_of_the_errors(simulated, fits):
    z = {
        name: np.array(
            [
                (getattr(fit.calibration, name) - getattr(constants, name)) / getattr(fit.standard_errors, name)
                for (_, constants), fit in zip(simulated, fits, strict=True)
            ]
        )
        for name in CHANNELS
    }
    for sensor in ("accel", "gyro"):
        rms = np.sqrt(np.mean(np.stack([z[f"{sensor}_bias"], z[f"{sensor}_sensitivity"]]) ** 2))
        # The simulated hand pushes in sines, which cancel over the blocks better than chance would.
        assert (0.2 if sensor == "accel" else 0.5) < rms < 2.0, sensor
    assert 0.5 < np.sqrt(np.mean(np.stack(list(z.values())) ** 2)) < 2.0


def test_two_sets_at_once_are_surer_than_one(simulated, fits):
    log, constants = simulated[0]
    # The same sensor again: another motion, its counts brought to the first one's constants.
    other, its = simulated[1]
    gyro = constants.gyro_bias + (other.gyro - its.gyro_bias) * constants.gyro_sensitivity / its.gyro_sensitivity
    accel = constants.accel_bias + (other.accel - its.accel_bias) * constants.accel_sensitivity / its.accel_sensitivity
    both = imu_fit.fit([log, replace(other, gyro=gyro, accel=accel)])
    assert len(both.sets) == 2
    for name in CHANNELS:
        pooled, first, second = (getattr(f.standard_errors, name).mean() for f in (both, *fits[:2]))
        assert pooled < max(first, second), name
        np.testing.assert_allclose(getattr(both.calibration, name), getattr(constants, name), atol=BOUNDS[name])


@pytest.mark.parametrize("late", [0.02, -0.02])
def test_the_clocks_offset_is_found(simulated, fits, late):
    log, _ = simulated[2]
    shifted = imu_fit.fit([replace(log, truth_stamps=log.truth_stamps + late)])
    moved = shifted.sets[0].time_offset_s - fits[2].sets[0].time_offset_s
    assert moved == pytest.approx(late, abs=5e-4)  # positive: the truth's stamps are late
    np.testing.assert_allclose(shifted.calibration.gyro_sensitivity, fits[2].calibration.gyro_sensitivity, atol=0.3)
    for one in (shifted.sets[0], *(fit.sets[0] for fit in fits)):
        known = late if one is shifted.sets[0] else 0.0
        assert abs(one.time_offset_s - known) < 3.5 * one.time_offset_se


def test_noise_in_the_reference_does_not_pull_the_gain(simulated):
    """Five times the reference's noise; a regression of the gyro on differentiated attitudes loses 10 % and more."""
    gains, naive = [], []
    for seed in (0, 1, 2):
        log, constants = simulated[seed]
        wobble = 0.003 * np.sqrt(24) * np.random.default_rng(seed).standard_normal((len(log.truth), 3))
        log = replace(log, truth=quaternions.multiply(log.truth, quaternions.exp(wobble)))
        fit = imu_fit.fit([log])
        gains.append(constants.gyro_sensitivity / fit.calibration.gyro_sensitivity - 1)
        np.testing.assert_array_less(np.abs(gains[-1]), 5 * fit.standard_errors.gyro_sensitivity / 200)
        naive.append(_naive_sensitivity(log) / constants.gyro_sensitivity - 1)
    assert np.abs(np.mean(gains)) < 0.01
    assert np.mean(naive) < -0.1


def _naive_sensitivity(log: ImuLog) -> np.ndarray:
    """Counts regressed on the reference's rate over ±20 ms, mV/(rad/s): the trap."""
    before, after = (truth_at(log.stamps, log, shift) for shift in (-0.02, 0.02))
    rate = quaternions.log(quaternions.multiply(quaternions.conjugate(before), after)) / 0.04
    good = np.isfinite(rate).all(1) & (np.abs(log.gyro - [382, 383, 384]) > 1.5).any(1)
    return np.array([np.polyfit(rate[good, i], log.gyro[good, i], 1)[0] for i in range(3)]) * MV_PER_COUNT


def test_a_freeze_is_left_out():
    rng = np.random.default_rng(3)
    whole, _ = imu_simulation.simulate(rng, duration=25.0, still=2.0, freeze=0.0, noise_scale=1.0)
    stuck = (whole.stamps > whole.stamps[0] + 12.0) & (whole.stamps < whole.stamps[0] + 13.5)
    frozen = replace(whole, gyro=np.where(stuck[:, None], [382.0, 383.0, 384.0], whole.gyro))
    without, with_it = imu_fit.fit([whole]), imu_fit.fit([frozen])
    assert without.sets[0].frozen == 0
    assert abs(with_it.sets[0].frozen - stuck.sum()) <= 3
    assert with_it.sets[0].windows < without.sets[0].windows
    for name in ("gyro_bias", "gyro_sensitivity"):
        difference = getattr(with_it.calibration, name) - getattr(without.calibration, name)
        np.testing.assert_array_less(np.abs(difference), 1.5 * getattr(without.standard_errors, name))


def test_the_json_is_read_back(simulated, fits, tmp_path):
    files = imu_files.save_course(tmp_path, 1, simulated[0][0])
    fit = replace(fits[0], sets=(replace(fits[0].sets[0], log=imu_files.load(*files)),))
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(fit.to_json()))
    read = imu_calibration.load(path)
    for name in CHANNELS:
        np.testing.assert_array_equal(getattr(read, name), getattr(fit.calibration, name))
    values = json.loads(path.read_text())
    assert [file["name"] for file in values["sets"][0]["files"]] == ["imuRaw1.mat", "viconRot1.mat"]
    assert all(len(file["sha256"]) == 64 for file in values["sets"][0]["files"])
    assert len(values["gyro"]["bias_se"]) == len(values["accel"]["sensitivity_se"]) == 3


def test_the_residuals_fall(fits):
    for fit in fits:
        after, before = (np.array(fit.residuals["gyro_deg"][stage]["rms"]) for stage in ("after", "before"))
        assert after.sum() < before.sum()


def test_series_integrate_as_a_loop_does(simulated):
    log, constants = simulated[0]
    shown = imu_series.series(log, constants)
    truth = truth_at(log.stamps, log)
    first = int(np.argmax(np.isfinite(truth).all(1)))
    q, dt = truth[first], np.diff(log.stamps)
    for k in range(first + 1, first + 400):
        q = quaternions.multiply(q, quaternions.exp(constants.gyro(log.gyro[k]) * dt[k - 1]))
    np.testing.assert_allclose(shown.gyro_deg[first + 399], np.degrees(quaternions.to_euler(q)), atol=1e-9)
    assert np.isnan(shown.gyro_deg[:first]).all()
    assert shown.gyro_error_deg[first] == pytest.approx(0.0, abs=1e-5)


def test_the_picture_holds_every_sample_and_no_partial_file(simulated, fits, tmp_path):
    path = tmp_path / "calibration.rrd"
    calibration_picture.write(path, fits[0].pictures(), fits[0].to_json())
    assert list(tmp_path.iterdir()) == [path]
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    plots = {f"/set_1/gravity/{p}" for p in ("roll", "pitch", "error")}
    plots |= {f"/set_1/gyro/{p}" for p in ("roll", "pitch", "yaw", "error")}
    assert {entity: n for entity, n in rows.items() if entity in plots} == dict.fromkeys(
        plots, len(simulated[0][0].stamps)
    )


def test_bad_input_is_one_line(simulated):
    log = simulated[0][0]
    still = log.stamps < log.stamps[0] + 2.0
    rest = {
        "accel": np.resize(log.accel[still], log.accel.shape),
        "gyro": np.resize(log.gyro[still], log.gyro.shape),
    }
    mirrored = log.gyro * [1.0, 1.0, -1.0] + [0.0, 0.0, 2 * 370.0]
    cases = {
        "at least one set": [],
        "the gyro's sensitivity along z comes out as": [replace(log, gyro=mirrored)],
        "the accel's sensitivity along x comes out as -": [replace(log, accel=log.accel * [-1, 1, 1] + [1023, 0, 0])],
        "SI units": [replace(log, in_counts=False)],
        "no motion capture": [log, replace(log, truth_stamps=np.empty(0), truth=np.empty((0, 4)))],
        "of this set": [replace(log, truth_stamps=log.truth_stamps + 1000.0)],
        "gravity hardly": [replace(log, **rest, truth=np.repeat(log.truth[:1], len(log.truth), axis=0))],
        "clock": [replace(log, truth_stamps=log.truth_stamps + 0.3)],
        "gravity hardly varies along x, y, z": [_turned_in_place(log)],
        "unsure": [replace(log, gyro=np.random.default_rng(0).normal(374, 40, log.gyro.shape))],
    }
    for text, logs in cases.items():
        with pytest.raises(BadInput, match=text) as caught:
            imu_fit.fit(logs)
        assert "\n" not in str(caught.value)


def _turned_in_place(log: ImuLog) -> ImuLog:
    """A reference that turns about all axes, and never far from level."""
    t = log.truth_stamps - log.truth_stamps[0]
    angles = 0.02 * np.sin(2 * np.pi * 0.5 * t[:, None] + np.arange(3))
    return replace(log, truth=quaternions.from_euler(angles * [1.0, 1.0, 20.0]))


def test_the_real_sets(real):
    _, fit = real
    documented = {
        "accel_bias": ([511.5, 500.5, 502.5], 0.5),
        "accel_sensitivity": ([34.3, 34.2, 33.8], 0.2),
        "gyro_bias": ([373.5, 375.4, 369.6], 0.1),
        "gyro_sensitivity": ([208.0, 201.0, 184.0], 1.5),
    }
    for name, (values, tolerance) in documented.items():
        np.testing.assert_allclose(getattr(fit.calibration, name), values, atol=tolerance, err_msg=name)
    np.testing.assert_allclose([one.time_offset_s for one in fit.sets], [0.025, 0.025, 0.007], atol=0.002)
    assert [one.frozen > 0 for one in fit.sets] == [True, True, False]
    for one in fit.sets:  # what the rest says, the motion says, but for what the bias wanders from set to set
        np.testing.assert_allclose(one.resting_gyro_counts, fit.calibration.gyro_bias, atol=0.15)
    before, after = ([np.sqrt(np.nanmean(pair[i].gyro_error_deg ** 2)) for pair in fit.pictures()] for i in (1, 2))
    np.testing.assert_allclose(before, [18.8, 24.9, 1.35], atol=0.5)
    np.testing.assert_allclose(after, [18.8, 24.9, 1.35], atol=0.5)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_each_real_set_alone(real, number):
    fit = imu_fit.fit([real[0][number - 1]])
    for name, tolerance in {"accel_bias": 2.0, "accel_sensitivity": 1.0, "gyro_bias": 0.2}.items():
        np.testing.assert_allclose(getattr(fit.calibration, name), getattr(real[1].calibration, name), atol=tolerance)
