"""What an IMU's own readings tell before any filter runs: how long it lies still, and where its gyro is frozen."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import scipy

from viz_estim.core import quaternions
from viz_estim.core.distributions import chi2, norm, t
from viz_estim.core.quaternions import Array

# What a cheap IMU's data sheet leaves open (InvenSense MPU-6000/6050, product specification 3.4, sections 6.1 and 6.2):
# data, and no thresholds. A gyro's offset is ±20 °/s on each axis, an accelerometer's ±50, ±50 and ±80 mg. They move by
# 40 °/s in 125 K and by 60 mg in 70 K: as follows in 1 K, within a run, and in 4 K, as a sensor warms up at first.
_WARMING = (0.022, 0.034)  # rad/s, m/s²
_LEVEL = (0.35, 1.05)  # rad/s, m/s²: how far from 0 and from gravity a still sensor may read
DRIFT = (0.0056, 0.0084)  # rad/s, m/s²: by how much its offset moves within a run
# Of gravity: by how much a sensor is pushed without being turned; data, and the size from which a turn counts. By
# a hand: the length of what real sets read, smoothed over 0.1 s, scatters by 0.03 to 0.06 about gravity's; that a gyro
# is flat in a hand besides is what chance does not do. Of a box on a table, up to its friction, 0.2 to 0.5 of dry wood
# on wood or metal.
_PUSHES = (0.1, 0.5)

# How far is looked, which decides no rate.
_BASELINE = 0.5  # s: the prefix that later readings are held against
_SMOOTHING = 0.1  # s
_SHORTEST_FREEZE = 0.3  # s: of fewer windows of 0.1 s than three no turn is told

_SPAN = 2.5  # counts: of what stays within one of a value it is two at most, to rounding
_RATE = 1e-4  # of a run in which noise alone passes for motion, over all its samples and channels
_FREEZE = _RATE / 36  # and for a freeze, of a gyro or of an accelerometer: a check's share of a run's errors
_CHANNELS = 6
_FEWEST = 20  # readings of which von Neumann's ratio can tell the smoothest motion at that rate

GRAVITY = 9.81  # m/s²


def still_prefix(stamps: Array, gyro: Array, accel: Array) -> int:
    """The number of samples from the first on in which the sensor lies still; 0 where it moves from the start.

    gyro (T, 3) rad/s and accel (T, 3) m/s². The first half second is the baseline, where it is steady (`_wanders`);
    motion begins where the mean over 0.1 s leaves it by more than noise and drift can, and is dated back by half that
    window. A gyro that is stuck at first (`stuck_at_first`) gives its baseline after that.
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
    moved = _apart(accel[:end], accel[end:upto], _WARMING[1], 2 * _CHANNELS).any() or _wanders(accel[:end], _WARMING[1])
    jumped = _apart(gyro[:end], gyro[end:upto], _WARMING[0], 2 * _CHANNELS).any()
    return end if jumped and not moved and np.linalg.norm(stuck) > np.linalg.norm(rest) else 0


def _still(stamps: Array, gyro: Array, accel: Array) -> int:
    """`still_prefix` of a gyro that is not stuck at first."""
    if len(stamps) < 2:
        return 0
    n = max(int(np.searchsorted(stamps, stamps[0] + _BASELINE)), _FEWEST)
    if n >= len(stamps):
        return 0
    width = max(3, round(n * _SMOOTHING / _BASELINE))
    end = len(stamps)
    for values, drift in zip((gyro, accel), _WARMING, strict=True):
        base = values[:n].mean(0)
        off = abs(float(np.linalg.norm(base)) - GRAVITY) > _LEVEL[1] if values is accel else np.abs(base) > _LEVEL[0]
        if np.any(off) or _wanders(values[:n], drift):
            return 0
        # Of T means over the window, six channels, on both sides.
        bound = _bound(values[:n], width, drift, 2 * _CHANNELS * len(stamps))
        moved = (np.abs(scipy.ndimage.uniform_filter1d(values, width, axis=0, mode="nearest") - base) > bound).any(1)
        if moved.any():
            end = min(end, int(np.argmax(moved)) - width // 2)
    return end if end >= n else 0


def _bound(base: Array, count: int, drift: float, tests: int) -> Array:
    """By how much the mean of `count` readings may leave that of base (n, c): a t-test at the share of one of `tests`,
    beyond what the offset drifts; and half a count of either mean, for whole counts don't average out."""
    n = len(base)
    error = base.std(0, ddof=1) * np.sqrt(1 / count + 1 / n)
    counts = np.array([quantum(channel) for channel in base.T])
    return np.asarray(drift + counts + t.isf(_RATE / tests, n - 1) * error)


def _apart(a: Array, b: Array, drift: float, tests: int) -> np.ndarray:
    """Which means of a (n, c) and b (m, c) differ by more than noise and drift: the bound of the noisier one."""
    bound = np.maximum(_bound(a, len(b), drift, tests), _bound(b, len(a), drift, tests))
    return np.asarray(np.abs(a.mean(0) - b.mean(0)) > bound)


def _wanders(values: Array, drift: float) -> bool:
    """Whether readings (n, c) change slowly by more than an offset drifts, so that it is motion and no noise.

    Von Neumann (1941): of n white readings half the mean square of successive differences is their variance, but for a
    relative error of √((n − 2)/(n² − 1)). Smooth motion adds to the latter alone, by its own variance.
    """
    n = len(values)
    variance = values.var(0, ddof=1)
    noise = 0.5 * np.square(np.diff(values, axis=0)).mean(0)
    least = 1 - norm.isf(_RATE / _CHANNELS) * np.sqrt((n - 2) / (n**2 - 1))
    return bool(((noise < least * variance) & (variance - noise > drift**2)).any())


def frozen_gyro(stamps: Array, gyro: Array, accel: Array, bias: Array) -> np.ndarray:
    """Which samples (T,) were taken while the gyro was stuck: flat in all channels while gravity turns.

    gyro (T, 3) rad/s as read and bias (3,) its reading at rest; accel (T, 3) m/s². A stuck gyro still flickers by one
    quantum, and so does one that rests; what tells them apart is the accelerometer: gravity's direction turns by more
    than the stuck rates, noise, drift and a push account for (`_missed_turn`), or lies still throughout
    (`stuck_at_first`). A gyro that reads what it does at rest may lie on a table, one that reads more is in a hand.
    """
    frozen = np.zeros(len(stamps), bool)
    frozen[: stuck_at_first(stamps, gyro - bias, accel)] = True
    counts = np.array([quantum(channel) for channel in gyro.T])
    for first, end in flat_runs(stamps, gyro):
        rate = gyro[first:end].mean(0) - bias
        at_rest = bool((np.abs(rate) <= DRIFT[0] + counts).all())
        turn, noise = _missed_turn(stamps[first:end], rate, accel[first:end], len(stamps))
        pushed = np.arctan(_PUSHES[int(at_rest)])  # the noise has its jerks in it: the larger of the two counts
        if turn > DRIFT[0] * (stamps[end - 1] - stamps[first]) + max(noise, pushed):
            frozen[first:end] = True
    return frozen


def flat_runs(stamps: Array, values: Array) -> list[tuple[int, int]]:
    """Where all channels of values (T, c) stay within a count of one value for 0.3 s and more: first, and one past the
    last sample of each run."""
    width = round(_SHORTEST_FREEZE / max(float(np.median(np.diff(stamps))), 1e-6)) | 1  # odd: the windows are centred
    if width < 3 or width >= len(stamps):
        return []
    counts = np.array([quantum(channel) for channel in values.T])
    span = scipy.ndimage.maximum_filter1d(values, width, axis=0) - scipy.ndimage.minimum_filter1d(values, width, axis=0)
    centres = (span <= _SPAN * counts).all(1)
    # The windows at the two ends would lean on samples mirrored in; the flat runs are the union of the flat windows.
    centres[: width // 2] = centres[-(width // 2) :] = False
    flat = scipy.ndimage.maximum_filter1d(centres, width)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flat, [False]])))
    # Two flat runs may touch, where a stuck sensor comes to itself at rest: the jump between them parts them.
    jumps = np.flatnonzero((np.abs(np.diff(values, axis=0)) > _SPAN * counts).any(1)) + 1
    return [b for e in edges.reshape(-1, 2) for b in _parted(e[0], e[1], jumps)]


def frozen_accel(stamps: Array, gyro: Array, accel: Array) -> np.ndarray:
    """Which samples (T,) were taken while the accelerometer was stuck: flat in all channels while the gyro turns it.

    gyro (T, 3) rad/s; accel (T, 3). What tells a stuck one from one at rest: the gyro's rates, but for their mean,
    carry gravity by more than their noise and drift add up to, and than two counts hide.
    """
    frozen = np.zeros(len(stamps), bool)
    counts = np.array([quantum(channel) for channel in accel.T])
    for first, end in flat_runs(stamps, accel):
        down = accel[first:end].mean(0)
        length = max(float(np.linalg.norm(down)), 1e-9)
        down = down / length
        about = gyro[first : end - 1] - gyro[first : end - 1].mean(0)  # a unit or a bias that is wrong is no motion
        steps = np.diff(stamps[first:end])[:, None] * np.cross(about, down)
        carried = np.linalg.norm(np.cumsum(steps, axis=0), axis=1).max(initial=0.0)
        noise = np.diff(gyro[first:end], axis=0).std(0).max() / np.sqrt(2)
        walk = noise * (stamps[end - 1] - stamps[first]) / np.sqrt(end - first)  # what noise alone adds up to, 1σ
        hidden = 2 * float(np.linalg.norm(counts)) / length + DRIFT[0] * (stamps[end - 1] - stamps[first])
        if carried > hidden + norm.isf(_FREEZE / (4 * len(stamps))) * walk:  # the most of a walk: twice its end
            frozen[first:end] = True
    return frozen


def _parted(first: int, end: int, jumps: np.ndarray) -> list[tuple[int, int]]:
    """The run from first to before end, parted at the jumps within it."""
    cuts = [int(first), *jumps[(jumps > first) & (jumps < end)].tolist(), int(end)]
    return list(pairwise(cuts))


def quantum(channel: Array) -> float:
    """The smallest step between a channel's readings (T,) that is no rounding of theirs: one count, or next to nothing
    for a fine log."""
    steps = np.diff(np.unique(channel))
    steps = steps[steps > 8 * np.finfo(float).eps * np.abs(channel).max(initial=0.0)]
    return float(steps.min()) if len(steps) else 0.0


def _missed_turn(stamps: Array, rate: Array, accel: Array, tests: int) -> tuple[float, float]:
    """By how much (rad) gravity turned otherwise than a constant rate would carry it, and did turn; and what of that
    noise may be.

    The accelerometer is smoothed over 0.1 s, by whole windows only: those at the ends would lean to one side. Its noise
    is that of successive differences (von Neumann 1941); of two directions' errors across gravity the sum of squares is
    χ²(2), so that a share 1/tests of `_FREEZE` bounds those of all windows.
    """
    width = max(3, round(_SMOOTHING / float(np.median(np.diff(stamps)))) | 1)
    half = width // 2
    if len(stamps) <= 3 * width:
        return 0.0, 0.0
    seen = scipy.ndimage.uniform_filter1d(accel, width, axis=0)[half:-half]
    length = np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-9)
    white = np.sqrt(0.5 * np.square(np.diff(accel, axis=0)).mean(0).max() / width) / float(length.mean())
    seen = seen / length
    since = stamps[half:-half] - stamps[half]
    carried = quaternions.rotate(quaternions.exp(-since[:, None] * rate), seen[:1])
    noise = white * float(np.sqrt(2 * chi2.isf(_FREEZE / tests, 2)))  # of the first window and of a later one
    return min(_widest(seen, carried), _widest(seen, seen[:1])), noise


def _widest(a: Array, b: Array) -> float:
    """The largest angle (rad) between unit vectors (N, 3)."""
    return float(np.arccos(np.clip((a * b).sum(1), -1, 1)).max())
