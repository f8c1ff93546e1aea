"""A differential drive with GPS: the data, and an extended Kalman filter over it.

The drive is steered by a speed and a turn rate, each noisy; the GPS comes at a tenth of their rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from viz_estim.core.beliefs import Gaussian
from viz_estim.core.consistency import rms, squared_distance
from viz_estim.core.distributions import chi2
from viz_estim.core.kalman import KalmanFilter, linear_sensor
from viz_estim.core.measurement import transposed
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.scenery import Box
from viz_estim.core.scenery import Path as Line
from viz_estim.core.spaces import Euclidean
from viz_estim.errors import BadInput
from viz_estim.scenarios import diffdrive_calibration, diffdrive_files
from viz_estim.scenarios.checks import positive, probability
from viz_estim.scenarios.diffdrive_calibration import DOCUMENTED, Calibration
from viz_estim.scenarios.diffdrive_files import PERIOD, DriveLog
from viz_estim.scenarios.diffdrive_model import SPACE, effect, moved, path, transition

Initial = Literal["auto", "course", "gps", "truth"]

# The course's assignment gives the start in words, not in its files.
_COURSE_START = np.array([0.355, -1.590, 0.682])
_COURSE_COV = np.diag([25.0, 25.0, 0.154])
_START_LENGTH = 10.0  # m: over a shorter way the GPS tells no heading
_SPEED, _TURN, _PIECE = 5.0, np.pi / 4, 2.0  # of the course's drive: m/s, rad/s, s for which they are held
_EVERY = 10  # steps from one GPS reading to the next
_BODY = Box((0.9, 0.6, 0.2))


@dataclass(frozen=True)
class DriveData:
    """A drive's log, and the covariances of its noises; notes say where these are from."""

    log: DriveLog
    noise: Calibration
    notes: str


def diffdrive(
    source: list[Path] | None,
    rng: np.random.Generator,
    *,
    calibration: Path | None = None,
    duration: float = 25.0,
    noise_scale: float = 1.0,
) -> DriveData:
    """A drive's log from a file, or a simulated one of `duration` s whose noises are the documented ones, scaled."""
    noise = DOCUMENTED if calibration is None else diffdrive_calibration.load(calibration)
    where = "documented by the course" if calibration is None else f"from {calibration.name}"
    if source is not None:
        files = diffdrive_files.find(source)
        if len(files) > 1:
            names = ", ".join(str(file.name) for file in files)
            raise BadInput(f"{len(files)} files of a differential drive found, a run takes one: name one of {names}")
        log = diffdrive_files.load(files[0])
    else:
        positive(noise_scale=noise_scale)
        if not _PIECE <= duration <= 3600:
            raise BadInput(f"a simulation needs a duration of {_PIECE:g} to 3600 s, got {duration:g}")
        log = simulate(rng, duration, noise_scale)
    return DriveData(log, noise, f"{len(log.inputs)} inputs, {len(log.gps)} GPS readings; noises {where}")


def save(data: DriveData, folder: Path) -> list[Path]:
    """Writes simulated data in the course's format."""
    return diffdrive_files.save(folder, "diffdrive.mat", data.log)


def calibrate(paths: list[Path]) -> diffdrive_calibration.Fit:
    """The noises' covariances, from the truth of all files among the paths."""
    return diffdrive_calibration.fit([diffdrive_files.load(file) for file in diffdrive_files.find(paths)])


def simulate(rng: np.random.Generator, duration: float, noise_scale: float = 1.0) -> DriveLog:
    """A drive of straights and turns, as the course's, from a start drawn around the course's own."""
    count = round(duration / PERIOD)
    piece = np.arange(count) * PERIOD // _PIECE
    turns = _TURN * rng.choice([-1.0, 1.0], int(piece[-1]) + 1)
    inputs = np.stack([np.full(count, _SPEED), np.where(piece % 2 == 1, turns[piece.astype(int)], 0.0)], axis=-1)
    start = _COURSE_START + np.linalg.cholesky(_COURSE_COV) @ rng.standard_normal(3)
    input_noise = rng.standard_normal((count, 2)) @ np.linalg.cholesky(DOCUMENTED.input_cov).T
    truth = path(start, inputs + noise_scale * input_noise, np.full(count, PERIOD))
    step = np.arange(_EVERY - 1, count + 1, _EVERY)
    gps_noise = rng.standard_normal((len(step), 2)) @ np.linalg.cholesky(DOCUMENTED.gps_cov).T
    gps = truth[step, :2] + noise_scale * gps_noise
    return DriveLog(PERIOD * np.arange(count + 1, dtype=float), inputs, gps, step, truth)


def diffdrive_ekf(
    data: DriveData,
    *,
    initial: Initial = "auto",
    gps_noise: float | None = None,
    speed_noise: float | None = None,
    turn_noise: float | None = None,
    gate: float | None = None,
    initial_position_std: float = 5.0,
    initial_heading_std: float = 0.3924,
) -> Scenario:
    """An EKF on position and heading: noisy speed and turn rate drive it, GPS corrects it at every tenth step.

    Noises are standard deviations in m, m/s and rad/s at each step; none: the covariances of the calibration, or the
    documented ones. initial: `course` starts where the course's assignment says, `gps` where the first readings lie
    along the driven way, `auto` at the course's start unless the readings contradict it. A gate is the probability with
    which a good reading passes.
    """
    positive(gps_noise=gps_noise, speed_noise=speed_noise, turn_noise=turn_noise)
    positive(initial_position_std=initial_position_std, initial_heading_std=initial_heading_std)
    log = data.log
    V = _with_std(data.noise.input_cov, (speed_noise, turn_noise))
    W = _with_std(data.noise.gps_cov, (gps_noise, gps_noise))
    gps = linear_sensor(Euclidean(("x", "y"), "m"), np.eye(2, 3), W, probability("gate", gate))
    cov = np.diag([initial_position_std**2, initial_position_std**2, initial_heading_std**2])
    beliefs, begins = _beliefs(log, initial, cov)
    at = dict(zip(log.gps_step.tolist(), log.gps, strict=True))
    ticks = [
        Tick(
            float(time),
            float(time - log.time[k - 1]) if k and k not in beliefs else 0.0,
            log.inputs[k - 1] if k else None,
            {"gps": at[k]} if k in at else {},
        )
        for k, time in enumerate(log.time)
    ]
    dead_reckoning = path(beliefs[0].mean, log.inputs, np.diff(log.time))[:, :2]
    off = log.gps - log.truth[log.gps_step, :2]
    known = np.isfinite(off).all(1)
    notes = (
        "Speed and turn rate are integrated, the GPS corrects them at every tenth step. Between readings the ellipse "
        "grows, most of all across the way, where the heading's error goes. **No reading shows the heading**: it is "
        "learnt from where the positions lead, so in the first second or two its error is large and a reading moves "
        "it most. The line that leaves the truth's is dead reckoning: the inputs alone, from the same start.\n\n"
        f"**This data:** {data.notes}; starts {begins}."
    )
    return Scenario(
        KalmanFilter(_driven, _jacobian, lambda x, tick: _process_noise(x, tick, V), {"gps": gps}),
        beliefs,
        ticks,
        log.truth,
        {"body": _BODY, "dead_reckoning": Line(dead_reckoning)},
        notes,
        {"gps_rmse_m": rms(off[known])} if known.any() else {},
    )


def _driven(x: Array, tick: Tick) -> Array:
    return moved(x, _inputs(tick), tick.dt)


def _jacobian(x: Array, tick: Tick) -> Array:
    return transition(x, _inputs(tick), tick.dt)


def _process_noise(x: Array, tick: Tick, V: Array) -> Array:
    """Q = G·V·Gᵀ: the inputs' noise, as it shows in the state."""
    G = effect(x, tick.dt)
    return G @ V @ transposed(G)


def _inputs(tick: Tick) -> Array:
    assert tick.control is not None
    return tick.control


def _with_std(cov: Array, stds: tuple[float | None, float | None]) -> Array:
    """The covariance with other standard deviations where they are given, and the same correlation."""
    own = np.sqrt(np.diagonal(cov))
    scale = np.array([1.0 if std is None else std / held for std, held in zip(stds, own, strict=True)])
    return scale[:, None] * cov * scale


def _beliefs(log: DriveLog, initial: Initial, cov: Array) -> tuple[dict[int, Gaussian], str]:
    """The start by step, and in words. A truth that begins later sets the belief there."""
    course, seen = Gaussian(SPACE, _COURSE_START, cov), Gaussian(SPACE, _seen_start(log), cov)
    if initial == "truth":
        known = np.isfinite(log.truth).all(1)
        if not known.any():
            raise BadInput("initial=truth needs `q_groundTruth`, and this data has none: use initial=gps")
        first = int(np.argmax(known))
        start = Gaussian(SPACE, log.truth[first], cov)
        return ({0: start} if first == 0 else {0: seen, first: start}), "at the truth"
    far = squared_distance(SPACE.minus(seen.mean, course.mean), cov) > chi2.ppf(0.9999, 3)
    if initial == "gps" or (initial == "auto" and far):
        return {0: seen}, "where the first GPS readings fit the driven way best"
    return {0: course}, "where the course's assignment says"


def _seen_start(log: DriveLog) -> Array:
    """The pose (3,) at step 0 from which the inputs lead closest to the first readings, by least squares.

    With points of the plane as complex numbers, the turn that takes path p to readings z is arg Σ (p − p̄)*·(z − z̄).
    """
    dt = np.diff(log.time)
    way = np.concatenate([[0.0], np.cumsum(np.abs(log.inputs[:, 0]) * dt)])[log.gps_step]
    first = max(2, int(np.searchsorted(way, way[0] + _START_LENGTH)))
    relative = path(np.zeros(3), log.inputs, dt)[log.gps_step[:first]]
    p, z = relative[:, 0] + 1j * relative[:, 1], log.gps[:first, 0] + 1j * log.gps[:first, 1]
    heading = np.angle(np.sum((p - p.mean()).conj() * (z - z.mean())))
    at = z.mean() - p.mean() * np.exp(1j * heading)
    return np.array([at.real, at.imag, heading])
