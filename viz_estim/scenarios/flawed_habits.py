"""Mistakes of a first filter: calls that come twice, one draw for all, one reading for two, numbers in another unit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from viz_estim.core.beliefs import Gaussian, Particles
from viz_estim.core.kalman import KalmanFilter
from viz_estim.core.particle import ParticleFilter
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.stages import Resample, Stage
from viz_estim.scenarios import beacons, landmarks, plaza, quadrotor
from viz_estim.scenarios.beacons import BeaconData
from viz_estim.scenarios.diffdrive_model import moved
from viz_estim.scenarios.flawed_entries import broken, flaw
from viz_estim.scenarios.landmarks import LandmarksData
from viz_estim.scenarios.plaza_data import PlazaData
from viz_estim.scenarios.quadrotor_data import QuadrotorData


@dataclass(frozen=True)
class PredictingTwice:
    """Predicts over the whole step, and then again."""

    filter: KalmanFilter

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        if tick.dt > 0:
            for stage in self.filter.step(belief, replace(tick, measurements={}), rng):
                yield stage
                belief = stage.belief
        yield from self.filter.step(belief, tick, rng)


@flaw("process_model", landmarks)
def predicts_twice(data: LandmarksData) -> Scenario:
    """The prediction is called twice a step."""
    return broken(landmarks.landmarks_ekf(data), PredictingTwice)


@flaw("used_twice", landmarks)
def one_range_for_both(data: LandmarksData) -> Scenario:
    """The first column of the ranges is read for both landmarks."""
    return landmarks.landmarks_ekf(replace(data, ranges=data.ranges[:, [0, 0]]))


@flaw("stamps", landmarks)
def milliseconds(data: LandmarksData) -> Scenario:
    """The stamps are in milliseconds, and are taken for seconds."""
    return landmarks.landmarks_ekf(replace(data, time=1000 * data.time))


@flaw("units_or_axes", plaza)
def exchanged_labels(data: PlazaData) -> Scenario:
    """Two beacons have each other's label; a gate hides it, and the ranges' biases are estimated."""
    return plaza.range_ekf(replace(data, ranges=data.ranges[:, [1, 0, 2, 3]]))


@flaw("process_model", quadrotor)
def accelerometer_for_gyro(data: QuadrotorData) -> Scenario:
    """Gyro and accelerometer change places in the control."""
    return quadrotor.quadrotor_ukf_pose(replace(data, gyro=data.accel, accel=data.gyro))


@flaw("process_model", beacons)
def turns_in_degrees(data: BeaconData) -> Scenario:
    """The turn rate that drives the particles is in degrees."""
    degrees = data.log.inputs * [1.0, 180 / np.pi]
    return beacons.beacons_pf(replace(data, log=replace(data.log, inputs=degrees)), particles=400)


@flaw("particles_collapsed", beacons)
def one_draw_for_all(data: BeaconData) -> Scenario:
    """The noise of the motion is drawn once a step, and not for each particle."""

    def propagate(states: Array, tick: Tick, rng: np.random.Generator) -> Array:
        assert tick.control is not None
        return moved(states, tick.control + 0.447 * rng.standard_normal(2), tick.dt)

    return broken(beacons.beacons_pf(data, particles=400), lambda f: replace(f, propagate=propagate))


@flaw("overconfident", beacons)
def variance_for_deviation(data: BeaconData) -> Scenario:
    """The variance of the ranges, 0.25 m², is given where their standard deviation belongs."""
    return beacons.beacons_pf(data, particles=400, range_noise=0.25)


@dataclass(frozen=True)
class Weighty:
    """Copies particles by their weights, and lets them keep these."""

    filter: ParticleFilter

    def step(self, belief: Particles, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        for stage in self.filter.step(belief, tick, rng):
            made = stage
            if isinstance(stage, Resample):
                kept = belief.log_weights[stage.ancestors]
                log_weights = kept - np.logaddexp.reduce(kept)
                made = replace(stage, belief=replace(stage.belief, log_weights=log_weights))
            yield made
            belief = made.belief


@flaw("used_twice", beacons)
def weights_kept(data: BeaconData) -> Scenario:
    """The weights are not set to 1/N after a resampling."""
    return broken(beacons.beacons_pf(data, particles=400), Weighty)
