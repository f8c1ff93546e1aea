"""Readings and controls of another frame, another convention, another place or another sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario
from viz_estim.scenarios import beacons, diffdrive, landmarks, quadrotor
from viz_estim.scenarios.beacons import BeaconData
from viz_estim.scenarios.diffdrive import DriveData
from viz_estim.scenarios.flawed_data import fed, shifted
from viz_estim.scenarios.flawed_entries import flaw
from viz_estim.scenarios.landmarks import LandmarksData
from viz_estim.scenarios.quadrotor_data import QuadrotorData


@flaw("units_or_axes", landmarks)
def exchanged_ranges(data: LandmarksData) -> Scenario:
    """The range to one landmark is taken for that to the other."""
    return landmarks.landmarks_ekf(replace(data, ranges=data.ranges[:, ::-1]))


@flaw("units_or_axes", landmarks)
def doubled_ranges(data: LandmarksData) -> Scenario:
    """The way there and back is taken for the range."""
    return landmarks.landmarks_ekf(replace(data, ranges=2 * data.ranges))


@flaw("units_or_axes", beacons)
def exchanged_beacons(data: BeaconData) -> Scenario:
    """The particles' range to one beacon is taken for that to the other."""
    return beacons.beacons_pf(replace(data, log=replace(data.log, ranges=data.log.ranges[:, ::-1])), particles=400)


@flaw("units_or_axes", beacons)
def misplaced_beacon(data: BeaconData) -> Scenario:
    """The second beacon stands 4 m beside the place that the filter has."""
    known, true = data.log.truth[:, :2], beacons.BEACONS[1] - [4.0, 0.0]
    off = np.linalg.norm(known - true, axis=1) - np.linalg.norm(known - beacons.BEACONS[1], axis=1)
    ranges = np.stack([data.log.ranges[:, 0], data.log.ranges[:, 1] + off], axis=-1)
    return beacons.beacons_pf(replace(data, log=replace(data.log, ranges=ranges)), particles=400)


@flaw("lag", beacons)
def late_ranges(data: BeaconData) -> Scenario:
    """The ranges come half a second late."""
    return shifted(beacons.beacons_pf(data, particles=400), 5)


@flaw("biased_innovation", beacons)
def long_ranges(data: BeaconData) -> Scenario:
    """The first beacon's ranges are 2 m too long."""
    return beacons.beacons_pf(
        replace(data, log=replace(data.log, ranges=data.log.ranges + np.array([2.0, 0.0]))), particles=400
    )


@flaw("process_model", diffdrive)
def exchanged_control(data: DriveData) -> Scenario:
    """Speed and turn rate change places."""
    return diffdrive.diffdrive_ekf(replace(data, log=replace(data.log, inputs=data.log.inputs[:, ::-1])))


@flaw("units_or_axes", diffdrive)
def turned_map(data: DriveData) -> Scenario:
    """The GPS is in a map that is turned by a third of a right angle."""
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    return diffdrive.diffdrive_ekf(
        replace(data, log=replace(data.log, gps=data.log.gps @ np.array([[c, s], [-s, c]]))), initial="course"
    )


@flaw("biased_innovation", diffdrive)
def antenna_beside(data: DriveData) -> Scenario:
    """The antenna stands 2 m to the left of the place that is estimated, and the model does not know."""
    heading = data.log.truth[data.log.gps_step, 2]
    beside = 2.0 * np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    return diffdrive.diffdrive_ekf(replace(data, log=replace(data.log, gps=data.log.gps + beside)))


@flaw("units_or_axes", quadrotor)
def camera_turned(data: QuadrotorData) -> Scenario:
    """The camera is turned by 45° about its own axis, and the model does not know."""
    turn = quaternions.exp(np.array([0.0, 0.0, np.pi / 4]))
    return quadrotor.quadrotor_ukf_velocity(replace(data, velocity=quaternions.rotate(turn, data.velocity)))


def _attitudes(data: QuadrotorData, change: np.ndarray | list[int] | None) -> Scenario:
    def read(k: int, z: dict[str, Array]) -> dict[str, Array]:
        q = {name: quaternions.conjugate(v[3:]) if change is None else v[3:][change] for name, v in z.items()}
        return {name: np.concatenate([v[:3], q[name]]) for name, v in z.items()}

    return fed(quadrotor.quadrotor_ukf_pose(data), read)


@flaw("units_or_axes", quadrotor)
def inverse_attitude(data: QuadrotorData) -> Scenario:
    """The measured attitude is that of the world in the body."""
    return _attitudes(data, None)


@flaw("units_or_axes", quadrotor)
def real_part_last(data: QuadrotorData) -> Scenario:
    """The measured quaternion is x, y, z, w, and is read as w, x, y, z."""
    return _attitudes(data, [1, 2, 3, 0])
