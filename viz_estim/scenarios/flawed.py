"""The gallery: filters broken on purpose, each wrapping a healthy one by a mistake that people make.

`viz-estim run flawed:NAME` runs one, `viz-estim diagnose` should name its code. Its data are those of the healthy
system.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from viz_estim.core.measurement import Sensor
from viz_estim.core.run import Scenario
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.scenarios import beacons, diffdrive, flawed_data, flawed_filters, imu, landmarks, plaza, quadrotor, scan
from viz_estim.scenarios.beacons import BeaconData
from viz_estim.scenarios.diffdrive import DriveData
from viz_estim.scenarios.flawed_entries import FLAWED, broken, flaw
from viz_estim.scenarios.imu_data import ImuData
from viz_estim.scenarios.landmarks import LandmarksData
from viz_estim.scenarios.plaza_data import PlazaData
from viz_estim.scenarios.quadrotor_data import QuadrotorData
from viz_estim.scenarios.quadrotor_model import Model
from viz_estim.scenarios.scan_files import ScanData


@flaw("noisy_prediction", landmarks)
def noise_in_prediction(data: LandmarksData) -> Scenario:
    """A sample of the process noise is added to the predicted mean."""
    return broken(landmarks.landmarks_ekf(data), flawed_filters.Sampling)


@flaw("jacobian", landmarks)
def transposed_jacobian(data: LandmarksData) -> Scenario:
    """The measurement's Jacobian has rows and columns swapped."""
    change = flawed_filters.transposed_block
    return broken(landmarks.landmarks_ekf(data), lambda f: flawed_filters.with_sensors(f, change))


@flaw("overconfident", landmarks)
def noise_too_small(data: LandmarksData) -> Scenario:
    """R is ten times too small."""
    change: Callable[[Sensor], Sensor] = lambda sensor: replace(sensor, noise=0.1 * sensor.noise)  # noqa: E731
    return broken(landmarks.landmarks_ekf(data), lambda f: flawed_filters.with_sensors(f, change))


@flaw("underconfident", landmarks)
def noise_too_large(data: LandmarksData) -> Scenario:
    """R is ten times too large."""
    change: Callable[[Sensor], Sensor] = lambda sensor: replace(sensor, noise=10 * sensor.noise)  # noqa: E731
    return broken(landmarks.landmarks_ekf(data), lambda f: flawed_filters.with_sensors(f, change))


@flaw("overconfident", landmarks)
def process_noise_too_small(data: LandmarksData) -> Scenario:
    """Q is ten thousand times too small: the filter takes the point to go straight on."""
    return broken(landmarks.landmarks_ekf(data), lambda f: flawed_filters.with_process_noise(f, 1e-4))


@flaw("used_twice", landmarks)
def updates_twice(data: LandmarksData) -> Scenario:
    """Every reading is taken in twice."""
    return broken(landmarks.landmarks_ekf(data), flawed_filters.Repeating)


@flaw("used_twice", landmarks)
def holds_readings(data: LandmarksData) -> Scenario:
    """A sensor at half the rate: its last reading is given again in between."""
    return flawed_data.held(landmarks.landmarks_ekf(data))


@flaw("outliers", landmarks)
def glitches(data: LandmarksData) -> Scenario:
    """Three of a hundred readings are metres off, and there is no gate."""
    return flawed_data.with_glitches(landmarks.landmarks_ekf(data), 0.03, 4.0)


@flaw("gate", landmarks)
def narrow_gate(data: LandmarksData) -> Scenario:
    """The gate is so narrow that it refuses most readings."""
    return landmarks.landmarks_ekf(data, gate=0.3)


@flaw("sensor_silent", landmarks)
def silence(data: LandmarksData) -> Scenario:
    """The sensor gives nothing for a tenth of the run."""
    return flawed_data.silenced(landmarks.landmarks_ekf(data), 0.5, 0.6)


@flaw("sensor_saturated", landmarks)
def clipped_ranges(data: LandmarksData) -> Scenario:
    """The sensor's range ends below what it should read."""
    return flawed_data.clipped(landmarks.landmarks_ekf(data), 0.15)


@flaw("stamps", landmarks)
def fixed_dt(data: LandmarksData) -> Scenario:
    """Every fourth sample is lost, and the filter takes one dt for all."""
    return flawed_data.with_fixed_dt(landmarks.landmarks_ekf(data))


@flaw("diverged", landmarks)
def mirrored_start(data: LandmarksData) -> Scenario:
    """The filter starts on the wrong side of the landmarks, where the ranges are the same."""
    return landmarks.landmarks_ekf(data, side="right")


@flaw("covariance", landmarks)
def forgotten_transpose(data: LandmarksData) -> Scenario:
    """The covariance is predicted as F·P + Q."""
    return broken(landmarks.landmarks_ekf(data), flawed_filters.Untransposed)


@flaw("covariance", landmarks)
def subtracts_too_much(data: LandmarksData) -> Scenario:
    """The update takes three times from the covariance what a reading tells."""
    return broken(landmarks.landmarks_ekf(data), flawed_filters.Greedy)


@flaw("units_or_axes", imu)
def unflipped_axes(data: ImuData) -> Scenario:
    """The signs of the accelerometer's x and y are not turned."""
    return imu.imu_ukf(replace(data, accel=data.accel * [-1.0, -1.0, 1.0]))


@flaw("units_or_axes", imu)
def gyro_rows_as_xyz(data: ImuData) -> Scenario:
    """The file's gyro rows z, x, y are taken for x, y, z."""
    return imu.imu_ukf(replace(data, gyro=data.gyro[:, [2, 0, 1]]))


@flaw("units_or_axes", imu)
def degrees_as_radians(data: ImuData) -> Scenario:
    """The gyro's rates are in degrees, the filter takes them for radians."""
    return imu.imu_ukf_gyro(replace(data, gyro=np.degrees(data.gyro)))


@flaw("units_or_axes", imu)
def g_as_mps2(data: ImuData) -> Scenario:
    """The accelerometer reads in g, the filter expects m/s²."""
    return imu.imu_ukf(replace(data, accel=data.accel / 9.81))


@flaw("biased_innovation", imu)
def bias_by_median(data: ImuData) -> Scenario:
    """The gyro's bias is the median of whole counts, not their mean."""
    return imu.imu_ukf(flawed_data.by_median(data))


@flaw("sensor_frozen", imu)
def gyro_freeze(data: ImuData) -> Scenario:
    """The gyro sticks for a second and a half, and the filter believes it."""
    return imu.imu_ukf(flawed_data.frozen(data))


@flaw("angle_wrap", imu)
def arithmetic_quaternion_mean(data: ImuData) -> Scenario:
    """The sigma points' attitudes are averaged as four plain numbers."""
    healthy = imu.imu_ukf(data)
    mean = flawed_filters.PlainMean()
    return replace(healthy, beliefs={k: flawed_filters.in_space(b, mean) for k, b in healthy.beliefs.items()})


@flaw("unobservable_update", imu)
def heading_by_gravity(data: ImuData) -> Scenario:
    """The model of the accelerometer leans to a level axis of the world, and so reads a heading from gravity."""
    return broken(imu.imu_ukf(data), flawed_filters.seeing_heading)


@flaw("unobservable_update", imu)
def covariance_left_behind(data: ImuData) -> Scenario:
    """The covariance is not carried to the new mean, so that the heading's uncertainty leaks away."""
    healthy = imu.imu_ukf_gyro(data, initial_attitude_std=0.3)
    space = flawed_filters.Uncarried()
    return replace(healthy, beliefs={k: flawed_filters.in_space(b, space) for k, b in healthy.beliefs.items()})


@flaw("lag", imu)
def delay_of_50_ms(data: ImuData) -> Scenario:
    """The accelerometer's readings come 50 ms late."""
    late = np.searchsorted(data.time, data.time - 0.05)
    return imu.imu_ukf(replace(data, accel=data.accel[late]))


@flaw("lag", quadrotor)
def one_index_off(data: QuadrotorData) -> Scenario:
    """The camera's pose k is taken for pose k + 1: an index counted from 1 in place of 0."""
    return flawed_data.shifted(quadrotor.quadrotor_ukf_pose(data), 1)


@flaw("lag", diffdrive)
def gps_one_late(data: DriveData) -> Scenario:
    """Each position is taken for that of the next one's moment: an index that is one off."""
    return flawed_data.shifted(diffdrive.diffdrive_ekf(data), 1)


@flaw("angle_wrap", quadrotor)
def angles_not_wrapped(data: QuadrotorData) -> Scenario:
    """The difference of two headings is not wrapped, and the flight looks back over the half turn."""
    headings = np.unwrap(Model("zxy").of(data.pose[np.isfinite(data.pose).all(1)])[:, 5])
    yaw = 0.5 * (headings.min() + headings.max())
    healthy = quadrotor.quadrotor_ukf_pose(flawed_data.turned_about(data, np.pi - yaw), attitude="zxy")

    def plain(filter: Any) -> Any:
        space = Product(position=Euclidean(("x", "y", "z"), "m"), attitude=Euclidean(("roll", "pitch", "yaw"), "rad"))
        return replace(filter, sensors={k: replace(s, space=space) for k, s in filter.sensors.items()})

    return broken(healthy, plain)


@flaw("biased_innovation", plaza)
def no_bias_state(data: PlazaData) -> Scenario:
    """The ranges are too long, and nothing in the state says so."""
    return plaza.range_ekf(data, range_bias="none", gate=None)


@flaw("particles_clamped", beacons)
def clamped_particles(data: BeaconData) -> Scenario:
    """Particles that leave the area are put back on its edge."""
    low, high = np.array([0.0, 0.0, -np.inf]), np.array([*beacons.BEACONS[1] - [3.0, 0.0], np.inf])
    return broken(beacons.beacons_pf(data, particles=400), lambda f: flawed_filters.Clamping(f, low, high))


@flaw("particles_collapsed", beacons)
def noise_too_small_for_particles(data: BeaconData) -> Scenario:
    """The true noises, and 300 particles all over the area: hardly one of them is where the readings are."""
    return beacons.beacons_pf(data, particles=300, range_noise=0.1, speed_noise=0.105, turn_noise=0.09)


@flaw("process_model", beacons)
def turns_the_wrong_way(data: BeaconData) -> Scenario:
    """The sign of the turn rate that drives the particles is wrong."""
    healthy = beacons.beacons_pf(data)
    ticks = [replace(t, control=None if t.control is None else t.control * [1.0, -1.0]) for t in healthy.ticks]
    return replace(healthy, ticks=ticks)


@flaw("icp_few_matches", scan)
def max_distance_too_small(data: ScanData) -> Scenario:
    """Points further apart than a five centimetres are no match, and the clouds are."""
    return scan.scan_icp(data, max_distance=0.05)


@flaw("icp_not_converged", scan)
def stopped_early(data: ScanData) -> Scenario:
    """Three iterations, settled or not."""
    return scan.scan_icp(data, iterations=3)


# The others enter themselves.
from viz_estim.scenarios import flawed_habits, flawed_readings, flawed_updates  # noqa: E402, F401

__all__ = ["FLAWED"]
