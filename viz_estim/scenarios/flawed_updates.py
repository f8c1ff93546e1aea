"""Filters whose update does not do what its own numbers say, and whose prediction turns about other axes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.kalman import KalmanFilter
from viz_estim.core.measurement import transposed
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.stages import Stage, Update
from viz_estim.scenarios import diffdrive, imu, landmarks
from viz_estim.scenarios.diffdrive import DriveData
from viz_estim.scenarios.flawed_entries import broken, flaw
from viz_estim.scenarios.imu_data import ImuData
from viz_estim.scenarios.landmarks import LandmarksData


@dataclass(frozen=True)
class Updating:
    """Updates in another way: change(belief before, update) makes the update that is carried on."""

    filter: KalmanFilter
    change: Callable[[Gaussian, Update], Update]

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        for stage in self.filter.step(belief, tick, rng):
            made = self.change(belief, stage) if isinstance(stage, Update) else stage
            yield made
            belief = made.belief


@flaw("update", landmarks)
def residual_reversed(data: LandmarksData) -> Scenario:
    """The residual is h(x) − z."""

    def change(before: Gaussian, made: Update) -> Update:
        residual = -made.innovation.residual
        mean = before.space.plus(before.mean, made.gain @ residual)
        innovation = replace(made.innovation, residual=residual)
        return replace(made, belief=replace(made.belief, mean=mean), innovation=innovation)

    return broken(landmarks.landmarks_ekf(data), lambda f: Updating(f, change))


@flaw("update", landmarks)
def covariance_kept(data: LandmarksData) -> Scenario:
    """The covariance after the update is never assigned."""

    def change(before: Gaussian, made: Update) -> Update:
        return replace(made, belief=replace(made.belief, cov=before.cov))

    return broken(landmarks.landmarks_ekf(data), lambda f: Updating(f, change))


@flaw("update", diffdrive)
def no_noise_in_s(data: DriveData) -> Scenario:
    """S is H·P·Hᵀ: the noise of the reading is forgotten, so that the gain follows each one."""

    def change(before: Gaussian, made: Update) -> Update:
        innovation, C = made.innovation, made.innovation.cross_cov
        S = innovation.cov - innovation.noise + 1e-9 * np.eye(len(innovation.cov))
        K = C @ np.linalg.inv(S)
        after = Gaussian(before.space, before.space.plus(before.mean, K @ innovation.residual), before.cov)
        after = replace(after, cov=before.cov - K @ transposed(C) + 1e-6 * np.eye(len(C)))
        return replace(made, belief=after, gain=K, innovation=replace(innovation, cov=S))

    return broken(diffdrive.diffdrive_ekf(data), lambda f: Updating(f, change))


@flaw("process_model", imu)
def turns_in_the_world(data: ImuData) -> Scenario:
    """The body's rates turn the attitude from the left, about the world's axes: Exp(ω·dt)·q for q·Exp(ω·dt)."""

    def process(x: Array, tick: Tick) -> Array:
        assert tick.control is not None
        return quaternions.multiply(quaternions.exp(tick.control * tick.dt), x)

    return broken(imu.imu_ukf_gyro(data), lambda f: replace(f, process=process))
