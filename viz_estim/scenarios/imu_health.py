"""What an IMU's own readings tell before any filter runs: how long it lies still, and where its gyro is frozen."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from viz_estim.core import quaternions
from viz_estim.core.distributions import norm
from viz_estim.core.quaternions import Array

_BASELINE = 0.5  # s: the shortest prefix that counts as lying still
_SMOOTHING = 0.1  # s
_STILL = (0.02, 0.15)  # rad/s, m/s²: a change of the smoothed reading that is motion
_STEADY = (0.1, 0.5)  # rad/s, m/s²: more scatter than this within the baseline is motion, whatever the sensor
_LEVEL = (0.25, 1.0)  # rad/s, m/s²: how far from 0 and from gravity a still sensor may read; beyond, it turns steadily
_SHORTEST_FREEZE = 0.3  # s
_UNEXPLAINED = (0.1, 0.5)  # rad: gravity's turn that the gyro must have missed; off its rest level, and on it
_BIAS_LEFT = 0.005  # rad/s: what may be left of the gyro's bias, and adds up to a turn

_RATE = 1e-4  # of a run in which noise alone passes for motion, over all its samples and channels

GRAVITY = 9.81  # m/s²


def still_prefix(stamps: Array, gyro: Array, accel: Array) -> int:
    """The number of samples from the first on in which the sensor lies still; 0 where it moves from the start.

    gyro (T, 3) rad/s and accel (T, 3) m/s². The first half second is the baseline; motion begins where the mean over
    0.1 s leaves it by more than noise can, and is dated back by half that window. A gyro that is stuck at first
    (`stuck_at_first`) gives its baseline after that.
    """
    stuck = stuck_at_first(stamps, gyro, accel)
    return stuck + _still(stamps[stuck:], gyro[stuck:], accel[stuck:])


def stuck_at_first(stamps: Array, gyro: Array, accel: Array) -> int:
    """The number of samples from the first on in which the gyro is stuck while the sensor lies still; mostly 0.

    gyro (T, 3) rad/s, accel (T, 3) m/s². Nothing turns that it could miss, but it jumps to its level at rest, in one
    sample, while the accelerometer goes on as before. Of the two levels the one nearer to 0 is that at rest.
    """
    begin, end = next(iter(flat_runs(stamps, gyro)), (1, 1))
    if begin > 0 or not _still(stamps[end:], gyro[end:], accel[end:]):
        return 0
    upto = int(np.searchsorted(stamps, stamps[end] + _BASELINE))
    stuck, rest = gyro[:end].mean(0), gyro[end:upto].mean(0)
    quiet = accel[end:upto].std(0) + accel[:end].std(0)
    moved = np.abs(accel[:end].mean(0) - accel[end:upto].mean(0)) > np.maximum(_STILL[1], quiet)
    jumped = float(np.linalg.norm(stuck - rest)) > _STILL[0] and np.linalg.norm(stuck) > np.linalg.norm(rest)
    return end if jumped and not moved.any() and quiet.max() < 2 * _STEADY[1] else 0


def _still(stamps: Array, gyro: Array, accel: Array) -> int:
    """`still_prefix` of a gyro that is not stuck at first."""
    if len(stamps) < 2:
        return 0
    n = int(np.searchsorted(stamps, stamps[0] + _BASELINE))
    if n < 5 or n >= len(stamps):
        return 0
    width = max(3, round(n * _SMOOTHING / _BASELINE))
    end = len(stamps)
    for values, floor, steady, level in zip((gyro, accel), _STILL, _STEADY, _LEVEL, strict=True):
        base, scatter = values[:n].mean(0), values[:n].std(0)
        at_rest = GRAVITY if values is accel else 0.0
        if scatter.max() > steady or abs(float(np.linalg.norm(base)) - at_rest) > level:
            return 0
        # White noise: of T means over the window, three channels each of two sensors, on both sides.
        bound = np.maximum(floor, norm.isf(_RATE / (12 * len(stamps))) * scatter * np.sqrt(1 / width + 1 / n))
        moved = (np.abs(uniform_filter1d(values, width, axis=0, mode="nearest") - base) > bound).any(1)
        if moved.any():
            end = min(end, int(np.argmax(moved)) - width // 2)
    return end if end >= n else 0


def frozen_gyro(stamps: Array, gyro: Array, accel: Array, bias: Array) -> np.ndarray:
    """Which samples (T,) were taken while the gyro was stuck: flat in all channels while gravity turns.

    gyro (T, 3) rad/s as read and bias (3,) its reading at rest; accel (T, 3) m/s². A stuck gyro still flickers by one
    quantum, and so does one that rests; what tells them apart is the accelerometer: gravity's direction turns by more
    than the stuck rates account for, or lies still throughout (`stuck_at_first`).
    """
    frozen = np.zeros(len(stamps), bool)
    frozen[: stuck_at_first(stamps, gyro - bias, accel)] = True
    quantum = np.array([_quantum(channel) for channel in gyro.T])
    for first, end in flat_runs(stamps, gyro):
        rate = gyro[first:end].mean(0) - bias
        off_rest = bool((np.abs(rate) > 3 * quantum).any())
        explained = _UNEXPLAINED[0 if off_rest else 1] + _BIAS_LEFT * (stamps[end - 1] - stamps[first])
        if _missed_turn(stamps[first:end], rate, accel[first:end]) > explained:
            frozen[first:end] = True
    return frozen


def flat_runs(stamps: Array, values: Array) -> list[tuple[int, int]]:
    """Where all channels of values (T, c) stay within a count of one value for 0.3 s and more: first, and one past the
    last sample of each run."""
    width = round(_SHORTEST_FREEZE / max(float(np.median(np.diff(stamps))), 1e-6)) | 1  # odd: the windows are centred
    if width < 3 or width >= len(stamps):
        return []
    quantum = np.array([_quantum(channel) for channel in values.T])
    span = maximum_filter1d(values, width, axis=0) - minimum_filter1d(values, width, axis=0)
    centres = (span <= 2.01 * quantum).all(1)
    # The windows at the two ends would lean on samples mirrored in; the flat runs are the union of the flat windows.
    centres[: width // 2] = centres[-(width // 2) :] = False
    flat = maximum_filter1d(centres, width)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flat, [False]])))
    # Two flat runs may touch, where a stuck sensor comes to itself at rest: the jump between them parts them.
    jumps = np.flatnonzero((np.abs(np.diff(values, axis=0)) > 2.01 * quantum).any(1)) + 1
    return [b for e in edges.reshape(-1, 2) for b in _parted(e[0], e[1], jumps)]


def frozen_accel(stamps: Array, gyro: Array, accel: Array) -> np.ndarray:
    """Which samples (T,) were taken while the accelerometer was stuck: flat in all channels while the gyro turns it.

    gyro (T, 3) rad/s; accel (T, 3). What tells a stuck one from one at rest: the gyro's rates, but for their mean,
    carry gravity by more than their noise adds up to.
    """
    frozen = np.zeros(len(stamps), bool)
    for first, end in flat_runs(stamps, accel):
        down = accel[first:end].mean(0)
        down = down / max(float(np.linalg.norm(down)), 1e-9)
        about = gyro[first : end - 1] - gyro[first : end - 1].mean(0)  # a unit or a bias that is wrong is no motion
        steps = np.diff(stamps[first:end])[:, None] * np.cross(about, down)
        carried = np.linalg.norm(np.cumsum(steps, axis=0), axis=1).max(initial=0.0)
        noise = np.diff(gyro[first:end], axis=0).std(0).max() / np.sqrt(2)
        walk = noise * (stamps[end - 1] - stamps[first]) / np.sqrt(end - first)  # what noise alone adds up to, 1σ
        if carried > _UNEXPLAINED[0] + norm.isf(_RATE / (4 * len(stamps))) * walk:  # the most of a walk: twice its end
            frozen[first:end] = True
    return frozen


def _parted(first: int, end: int, jumps: np.ndarray) -> list[tuple[int, int]]:
    """The run from first to before end, parted at the jumps within it."""
    cuts = [int(first), *jumps[(jumps > first) & (jumps < end)].tolist(), int(end)]
    return list(pairwise(cuts))


def _quantum(channel: Array) -> float:
    """The smallest step between a channel's readings: one count, or next to nothing for a fine log."""
    steps = np.diff(np.unique(channel))
    steps = steps[steps > 1e-6 * max(np.ptp(channel), 1e-12)]
    return float(steps.min()) if len(steps) else 0.0


def _missed_turn(stamps: Array, rate: Array, accel: Array) -> float:
    """By how much (rad) gravity turned otherwise than a constant rate would carry it, at most, and did turn.

    The accelerometer is smoothed over 0.1 s, by whole windows only: those at the ends would lean to one side.
    """
    width = max(3, round(_SMOOTHING / float(np.median(np.diff(stamps)))) | 1)
    half = width // 2
    if len(stamps) <= 3 * width:
        return 0.0
    seen = uniform_filter1d(accel, width, axis=0)[half:-half]
    seen = seen / np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-9)
    since = stamps[half:-half] - stamps[half]
    carried = quaternions.rotate(quaternions.exp(-since[:, None] * rate), seen[:1])
    return min(_widest(seen, carried), _widest(seen, seen[:1]))


def _widest(a: Array, b: Array) -> float:
    """The largest angle (rad) between unit vectors (N, 3)."""
    return float(np.arccos(np.clip((a * b).sum(1), -1, 1)).max())
