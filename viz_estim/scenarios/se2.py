"""A differential drive in the plane, its pose propagated by the exponential map of SE(2).

Long, Wolfe, Mashner and Chirikjian, *The banana distribution is Gaussian* (2012): noise on the wheels bends the cloud
of places along a circle, and in the group's own coordinates it is a plain ellipse.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from viz_estim.core import scenery as things
from viz_estim.core.particle import ParticleFilter, equal
from viz_estim.core.quaternions import Array
from viz_estim.core.resampling import Method
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.scenery import Box, Scenery
from viz_estim.core.spaces import SE2, Product
from viz_estim.errors import BadInput
from viz_estim.scenarios import se2_files
from viz_estim.scenarios.checks import at_most, positive
from viz_estim.scenarios.se2_files import Drive, speed_and_turn

SPACE = Product(pose=SE2())
_BODY = Box((0.5, 0.4, 0.2))
_SAME_TIME = 1e-9  # s


def se2(source: list[Path] | None, rng: np.random.Generator) -> Drive:
    """A drive from a file, or the course's problem: the same for every seed, since only particles are drawn."""
    return se2_files.problem() if source is None else se2_files.load(se2_files.find(source))


def save(data: Drive, folder: Path) -> list[Path]:
    """Writes the problem as a CSV file."""
    return se2_files.save(folder / "se2.csv", data)


def se2_pf(
    data: Drive,
    *,
    particles: int = 1000,
    measure: bool = True,
    times: str | None = None,
    wheel_noise: float | None = None,
    gps_noise: float = 0.1,
    resampling: Method = "systematic",
    resample_below: float = 1.0,
) -> Scenario:
    """A particle filter on SE(2): noisy wheels drive it, positions correct it; with measure=no dead reckoning.

    times: the moments in s that the belief is asked for, such as 5,10,15,20; none: all stamps of the data. Between two
    of them each particle's wheel noise (rad/s) is drawn once and held; none: 0.05, for a log 0.4. gps_noise is that of
    a position in m. Resampled where the effective sample size is below the fraction resample_below of the particles; at
    1 always.
    """
    positive(wheel_noise=wheel_noise, gps_noise=gps_noise)
    if particles < 1:
        raise BadInput(f"particles must be at least 1, got {particles}")
    at_most(1e7, particles=particles)
    if not 0 < resample_below <= 1:
        raise BadInput(f"resample_below is a fraction above 0 and up to 1, got {resample_below:g}")
    drive = data if times is None else _asked(data, times)
    std = data.wheel_noise if wheel_noise is None else wheel_noise

    def propagate(states: Array, tick: Tick, rng: np.random.Generator) -> Array:
        assert tick.control is not None
        noise = std * rng.standard_normal((*states.shape[:-1], 2))
        return moved(states, tick.control + noise, tick.dt)

    def log_likelihood(states: Array, tick: Tick) -> Array:
        off = (states[..., :2] - tick.measurements["gps"]) / gps_noise
        return -0.5 * (off * off).sum(-1) - 2 * np.log(gps_noise * np.sqrt(2 * np.pi))

    known = np.asarray(np.isfinite(drive.truth).all(1))
    first = int(np.argmax(known)) if known.any() else 0
    starts = {0, first}
    read = np.asarray(np.isfinite(drive.positions).all(1) & measure)
    ticks = [
        Tick(
            float(time),
            0.0 if k in starts else float(time - drive.time[k - 1]),
            None if k in starts else drive.rates[k],
            {"gps": drive.positions[k]} if read[k] else {},
        )
        for k, time in enumerate(drive.time)
    ]
    beliefs = {k: equal(SPACE, np.tile(drive.truth[k] if known[k] else np.zeros(3), (particles, 1))) for k in starts}
    estimator = ParticleFilter(propagate, log_likelihood, resampling, resample_below)
    truth = drive.truth if known.any() else None
    scenery: dict[str, Scenery] = {"body": _BODY} if known.any() else {"body": _BODY, "without_noise": _way(drive)}
    return Scenario(estimator, beliefs, ticks, truth, scenery, _notes(bool(read.any()), bool(known.any())))


def moved(poses: Array, rates: Array, dt: float) -> Array:
    """Poses (*, 3) after dt s at wheel rates (*, 2) in rad/s: x·Exp(dt·(v, 0, ω))."""
    v, w = speed_and_turn(rates)
    return SPACE.plus(poses, dt * np.stack([v, np.zeros_like(v), w], axis=-1))


def _way(drive: Drive) -> things.Path:
    """Where the drive would go without noise: its arcs, one an interval."""
    pose = np.zeros(3)
    pieces = [pose[None]]
    for k in range(1, len(drive.time)):
        share = np.linspace(0, 1, 21)[:, None] * (drive.time[k] - drive.time[k - 1])
        arc = moved(pose, share * drive.rates[k], 1.0)
        pieces.append(arc)
        pose = arc[-1]
    return things.Path(np.concatenate(pieces)[:, :2])


def _asked(data: Drive, times: str) -> Drive:
    """The drive at the asked times alone, whose wheel rates must not change in between."""
    try:
        ends = np.array([float(text) for text in times.split(",")])
    except ValueError:
        raise BadInput(f"times={times}: expected seconds with commas between, such as 5,10,15,20") from None
    stamps = np.concatenate([[0.0], ends])
    if not (np.isfinite(ends).all() and (np.diff(stamps) > 0).all()):
        raise BadInput(f"times={times}: expected seconds above 0 that increase")
    if ends[-1] > data.time[-1] + _SAME_TIME:
        raise BadInput(f"times={times}: the data lasts {data.time[-1]:g} s; ask for earlier times")
    # Row k's rates act over (time[k-1], time[k]].
    low = np.searchsorted(data.time, stamps[:-1] + _SAME_TIME)
    high = np.searchsorted(data.time, stamps[1:] - _SAME_TIME)
    for k in range(len(ends)):
        if (data.rates[low[k] : high[k] + 1] != data.rates[low[k]]).any():
            span = f"{stamps[k]:g} and {stamps[k + 1]:g} s"
            raise BadInput(f"times={times}: the wheels' rates change between {span}; leave times out")
    at = np.concatenate([[0], high])
    same = (np.abs(data.time[at] - stamps) <= _SAME_TIME)[:, None]
    positions, truth = np.where(same, data.positions[at], np.nan), np.where(same, data.truth[at], np.nan)
    return Drive(stamps, data.rates[at], positions, truth, data.wheel_noise, data.files)


def _notes(measured: bool, known: bool) -> str:
    text = (
        "The drive knows where it starts. Each particle draws its own wheel noise for every interval and holds it, so "
        "that each runs along an arc of its own: **predict** bends the cloud into a banana, whose Gaussian ellipse "
        "is straight and covers places where no particle is. "
    )
    if measured:
        text += (
            "**weigh** gives weight to the particles that the position's reading explains, **resample** copies those: "
            "the cloud shrinks to the reading's size, and ESS and distinct ancestors say how few it comes from. With "
            "`measure=no` it grows to the end."
        )
    else:
        text += "No position is read: this is dead reckoning, and the cloud only grows."
    if known:
        return text + (
            "\n\n**Against the truth:** the odometry has a scale error of its own beside the noise that the cloud "
            "stands for. See whether the truth stays in the cloud."
        )
    return text + (
        " With `times=10` one draw of the noise is held for 10 s, and spreads the cloud further than two draws of 5 s."
    )
