"""An IMU's constants fitted to motion capture, over one or several sets at once: what `calibrate imu` does."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array, conjugate, multiply
from viz_estim.core.robust import by_second, solve, typical
from viz_estim.errors import BadInput
from viz_estim.files import sha256
from viz_estim.scenarios.imu_calibration import ACCEL_SIGNS, DOCUMENTED, MV_PER_COUNT, Calibration
from viz_estim.scenarios.imu_data import ImuData, evened, prepare, resting_gyro, truth_at
from viz_estim.scenarios.imu_files import ImuLog
from viz_estim.scenarios.imu_health import GRAVITY
from viz_estim.scenarios.imu_series import Series, series

_WINDOW = 0.25  # s: over a shorter one the reference's noise is large beside the rotation
_FEWEST_WINDOWS = 20  # in a set: 5 s
_LONGEST_STEP = 0.1  # s: over a longer one between two samples nobody knows how the body turned
_LARGEST_OFFSET = 0.1  # s, between the two clocks
_LEAST_RATE = 0.03  # rad/s rms about an axis, over all sets: below, there is nothing but the reference's noise
_LEAST_SWING = 0.05  # of gravity, from the 5th to the 95th percentile of what a channel sees over all sets
_LARGEST_RATIO = 2.0  # of a sensitivity to the documented one: beyond, it is another sensor, or another row
_LARGEST_ERROR = 0.05  # of a sensitivity: with less certainty it is not worth having


@dataclass(frozen=True)
class SetFit:
    """One set's share of a fit.

    time_offset_s is positive where the truth's stamps are late: the attitude at IMU stamp t is the reference's at
    t + time_offset_s. Both fits leave out the samples `without_truth`, the gyro's those `frozen` too; `windows` are the
    gyro's. resting_gyro_counts: what the gyro reads while the sensor lies still, None where it never does.
    """

    log: ImuLog
    time_offset_s: float
    time_offset_se: float
    samples: int
    frozen: int
    without_truth: int
    windows: int
    resting_gyro_counts: list[float] | None

    def used(self, constants: Calibration) -> Calibration:
        """The constants as a run takes them for this set: with the gyro's bias off its own rest, where it has one."""
        rest = self.resting_gyro_counts
        return constants if rest is None else constants.with_gyro_bias(np.array(rest))

    def to_json(self) -> dict[str, Any]:
        files = [{"name": f.name, "sha256": sha256(f)} for f in self.log.files]
        return {"files": files} | {name: value for name, value in vars(self).items() if name != "log"}


@dataclass(frozen=True)
class Fit:
    """The constants, and their standard errors in the same fields and units.

    residuals: `accel_mps2` (per sample) and `gyro_deg` (rotation over a window), each `before` and `after`, each `rms`
    and `typical` (1.48 × the median size: the reference's jumps don't reach it), x, y, z. Before: the
    documented constants, as a run takes them without a calibration, and clocks that agree.
    """

    calibration: Calibration
    standard_errors: Calibration
    residuals: dict[str, dict[str, dict[str, list[float]]]]
    sets: tuple[SetFit, ...]

    def to_json(self) -> dict[str, Any]:
        """What `imu_calibration.load` reads, how sure it is, and what it was made from."""
        documented, values, errors = (c.by_sensor() for c in (DOCUMENTED, self.calibration, self.standard_errors))
        for sensor, found in values.items():
            found |= {f"{name.split('_')[0]}_se": error for name, error in errors[sensor].items()}
        return {
            "system": "imu",
            "model": "value = sign * (counts - bias) * 3300 / 1023 / sensitivity; body x forward, y left, z up",
            **values,
            "documented": documented,
            "residuals": self.residuals,
            "time_offset": "s; positive: the motion capture's stamps are late",
            "sets": [one.to_json() for one in self.sets],
        }

    def pictures(self) -> list[tuple[str, Series, Series]]:
        """Each set's name, and its series as a run has them without this calibration, and with it."""
        pairs = []
        for number, one in enumerate(self.sets, 1):
            before, after = one.used(DOCUMENTED), one.used(self.calibration)
            name = one.log.files[0].stem if one.log.files else f"set {number}"
            pairs.append((name, series(one.log, before), series(one.log, after, one.time_offset_s)))
        return pairs


def fit(logs: list[ImuLog]) -> Fit:
    """Biases and sensitivities of all six channels, and each set's clock offset, by robust least squares.

    Gyro: the reference's rotation over windows of 0.25 s against the gyro's, integrated. The reference is the response,
    so that its noise widens the residual and leaves the gain alone; a regression on its differentiated attitude would
    pull the gain down (errors in variables; Fuller 1987, ch. 1). Accelerometer: counts against gravity in body axes as
    the reference has it; the hand's own accelerations average out. Standard errors: `robust.solve`.
    Raises BadInput where a set is not in counts or has no motion capture, or all move too little to tell the constants.
    """
    sets, names = [_Set.of(log) for log in logs], ", ".join(map(_name, logs))
    if not sets:
        raise BadInput("a calibration needs at least one set: an IMU file and its motion capture")
    seen = np.concatenate([one.gravity(0.0) for one in sets])
    flat = np.ptp(np.nanpercentile(seen, [5, 95], axis=0), axis=0) < _LEAST_SWING * GRAVITY
    if flat.any():
        raise BadInput(f"{names}: gravity hardly varies along {_axes(flat)}; add a set that tilts more")
    (gyro_bias, gyro_sensitivity, offsets), gyro_se = _fit_gyro(sets, names)
    for log, offset in zip(logs, offsets, strict=True):
        if abs(offset) > _LARGEST_OFFSET:
            raise BadInput(
                f"{_name(log)}: its clock and its motion capture's differ by more than {_LARGEST_OFFSET} s, or the two "
                "don't belong together; give the file that does, or shift its stamps"
            )
    (accel_bias, accel_sensitivity), accel_se = _fit_accel(sets, offsets)
    for sensor, value, error, documented in (
        ("gyro", gyro_sensitivity, gyro_se[1], DOCUMENTED.gyro_sensitivity),
        ("accel", accel_sensitivity, accel_se[1], DOCUMENTED.accel_sensitivity),
    ):
        vague = ~(error < _LARGEST_ERROR * np.abs(value))
        if vague.any():
            raise BadInput(
                f"{names}: the {sensor}'s sensitivity along {_axes(vague)} stays unsure ({value[vague][0]:.3g} ± "
                f"{error[vague][0]:.2g}): too little motion, or not the files of one set; add a set that turns more"
            )
        foreign = ~(np.abs(np.log(np.maximum(value / documented, 1e-300))) < np.log(_LARGEST_RATIO))
        if foreign.any():
            raise BadInput(
                f"{names}: the {sensor}'s sensitivity along {_axes(foreign)} comes out as {value[foreign][0]:.3g}, "
                f"{documented[foreign][0]:.3g} is documented: are the rows ax, ay, az, wz, wx, wy, in counts, with the "
                "course's signs?"
            )
    after = Calibration(accel_bias, accel_sensitivity, gyro_sensitivity, gyro_bias)
    residuals: dict[str, dict[str, dict[str, list[float]]]] = {"accel_mps2": {}, "gyro_deg": {}}
    for stage, used in (("before", [(s.before, 0.0) for s in sets]), ("after", [(after, float(o)) for o in offsets])):
        pairs = [(one, *u) for one, u in zip(sets, used, strict=True)]
        residuals["accel_mps2"][stage] = _summary([c.accel(one.data.log.accel) - one.gravity(o) for one, c, o in pairs])
        residuals["gyro_deg"][stage] = _summary([np.degrees(one.turn_error(c, o)) for one, c, o in pairs])
    shares = []
    for log, one, offset, error in zip(logs, sets, offsets, gyro_se[2], strict=True):
        still = resting_gyro(log, one.data.still, one.data.stuck).tolist() if one.data.still else None
        frozen, unseen = int(one.data.frozen.sum()), int(np.isnan(one.gravity(offset)[:, 0]).sum())
        counts = (len(log.stamps), frozen, unseen, len(one.begin))
        shares.append(SetFit(log, float(offset), float(error), *counts, still))
    return Fit(after, Calibration(accel_se[0], accel_se[1], gyro_se[1], gyro_se[0]), residuals, tuple(shares))


@dataclass(frozen=True)
class _Set:
    """A set cut into windows. begin, end (W,): stamps of their ends, s from the IMU's first; dt (W, n) s and counts
    (W, n, 3) of the steps between, the counts the mean of the samples at a step's two ends. log: the truth, stamps s
    from the IMU's first too (Unix seconds resolve 0.2 µs) and evened.
    """

    data: ImuData
    log: ImuLog
    before: Calibration
    begin: Array
    end: Array
    dt: Array
    counts: Array

    @classmethod
    def of(cls, log: ImuLog) -> _Set:
        if not log.in_counts:
            raise BadInput(f"{_name(log)}: is in SI units; a calibration is fitted to raw counts (imuRaw*.mat)")
        if len(log.truth_stamps) < 2:
            raise BadInput(f"{_name(log)}: no motion capture; give its viconRot*.mat too, or put it beside")
        data = prepare(log, None)
        bias = resting_gyro(log, data.still, data.stuck) if data.still else DOCUMENTED.gyro_bias
        near = replace(log, stamps=data.time, truth_stamps=evened(log.truth_stamps - log.stamps[0]))
        # The offset is not known yet: the truth must be there over all that it may be.
        shifts = (-_LARGEST_OFFSET, 0.0, _LARGEST_OFFSET)
        good = ~data.frozen & np.all([np.isfinite(truth_at(data.time, near, s)).all(1) for s in shifts], axis=0)
        dt = np.diff(data.time)
        size = int(np.ceil(_WINDOW / max(float(np.median(dt)), 1e-6)))
        # Row w: the samples from window w's beginning to its end, where the next one begins.
        index = np.arange(len(dt) // size)[:, None] * size + np.arange(size + 1)
        index = index[good[index].all(1) & (dt[index[:, :-1]] <= _LONGEST_STEP).all(1)]
        if len(index) < _FEWEST_WINDOWS:
            raise BadInput(
                f"{_name(log)}: {len(index)} stretches of {_WINDOW} s with motion capture and no freeze, "
                f"{_FEWEST_WINDOWS} are needed; is it the motion capture of this set?"
            )
        counts = 0.5 * (log.gyro[index[:, 1:]] + log.gyro[index[:, :-1]])
        begin, end = data.time[index[:, 0]], data.time[index[:, -1]]
        return cls(data, near, DOCUMENTED.with_gyro_bias(bias), begin, end, dt[index[:, :-1]], counts)

    def turn_error(self, constants: Calibration, offset: float) -> Array:
        """What the truth turned by beyond the gyro over each window: Log((∏ Exp(ω·dt))⁻¹·q_begin⁻¹·q_end) (W, 3)."""
        return _between(self.turned(constants), self.true_turn(offset))

    def turned(self, constants: Calibration) -> Array:
        """How the body turned over each window by the gyro: ∏ Exp(ω·dt) (W, 4)."""
        turns = quaternions.exp(constants.gyro(self.counts) * self.dt[..., None])
        turned = turns[:, 0]
        for step in range(1, turns.shape[1]):
            turned = multiply(turned, turns[:, step])
        return turned

    def true_turn(self, offset: float) -> Array:
        """How it turned by the truth: q_begin⁻¹·q_end (W, 4)."""
        begin, end = (
            quaternions.slerp(t + offset, self.log.truth_stamps, self.log.truth) for t in (self.begin, self.end)
        )
        return multiply(conjugate(begin), end)

    def gravity(self, offset: float) -> Array:
        """What the accelerometer would read at rest, by the truth (T, 3), m/s²; NaN where there is none."""
        return quaternions.rotate(conjugate(truth_at(self.log.stamps, self.log, offset)), np.array([0.0, 0.0, GRAVITY]))


def _between(turned: Array, true: Array) -> Array:
    """What a true turn (W, 4) goes beyond another (W, 4) by, as a rotation vector (W, 3)."""
    return quaternions.log(multiply(conjugate(turned), true))


def _fit_gyro(sets: list[_Set], names: str) -> tuple[list[Array], list[Array]]:
    """Biases (3,), sensitivities (3,) and offsets (S,), and their standard errors."""
    resting = replace(DOCUMENTED, gyro_bias=np.zeros(3), gyro_sensitivity=np.full(3, np.inf))
    turned = np.concatenate([one.turn_error(resting, 0.0) for one in sets])
    slow = np.sqrt(np.mean((turned / _WINDOW) ** 2, axis=0)) < _LEAST_RATE
    if slow.any():
        raise BadInput(f"{names}: too little motion: hardly any turn about {_axes(slow)}; add a set that has some")

    def constants(x: Array) -> Calibration:
        return replace(DOCUMENTED, gyro_bias=x[:3], gyro_sensitivity=x[3:6])

    def residual(x: Array) -> Array:
        errors = [one.turn_error(constants(x), offset) for one, offset in zip(sets, x[6:], strict=True)]
        return np.concatenate(errors).ravel()

    # The step in an offset is wide: over a narrow one the reference's noise would drown how its attitude changes.
    steps, shift = np.repeat([0.01, 0.1], 3), 0.02

    def jacobian(x: Array) -> Array:
        # By central differences, of which each works out anew only what it moves: the gyro's turn or the truth's.
        rows = []
        for i, (one, offset) in enumerate(zip(sets, x[6:], strict=True)):
            J = np.zeros((one.begin.size, 3, len(x)))
            true = one.true_turn(offset)
            for column, h in enumerate(np.diag(steps)):
                after, before = (_between(one.turned(constants(x[:6] + s * h)), true) for s in (1, -1))
                J[..., column] = (after - before) / (2 * steps[column])
            turned = one.turned(constants(x))
            after, before = (_between(turned, one.true_turn(offset + s * shift)) for s in (1, -1))
            J[..., 6 + i] = (after - before) / (2 * shift)
            rows.append(J.reshape(-1, len(x)))
        return np.concatenate(rows)

    start = np.concatenate([DOCUMENTED.gyro_bias, DOCUMENTED.gyro_sensitivity, np.zeros(len(sets))])
    x, errors = solve(residual, jacobian, start, np.repeat(by_second([one.begin for one in sets]), 3))
    if np.abs(residual(x)).mean() > 0.5 * np.abs(turned).mean():
        raise BadInput(
            f"{names}: the gyro's readings stay unsure: they don't explain how the body turned; other files?"
        )
    return np.split(x, [3, 6]), np.split(errors, [3, 6])


def _fit_accel(sets: list[_Set], offsets: Array) -> tuple[Array, Array]:
    """Biases and sensitivities (2, 3), and their errors: counts = bias + sign·gravity·sensitivity·1023/3300."""
    gravity = np.concatenate([one.gravity(offset) for one, offset in zip(sets, offsets, strict=True)])
    known = np.isfinite(gravity[:, 0])
    counts = np.concatenate([one.data.log.accel for one in sets])[known]
    blocks = by_second([one.data.time for one in sets])[known]
    pushes, starts = (
        ACCEL_SIGNS * gravity[known] / MV_PER_COUNT,
        zip(DOCUMENTED.accel_bias, DOCUMENTED.accel_sensitivity, strict=True),
    )
    fits = [_fit_line(*channel, blocks) for channel in zip(pushes.T, counts.T, starts, strict=True)]
    return np.stack([value for value, _ in fits], axis=1), np.stack([error for _, error in fits], axis=1)


def _fit_line(regressor: Array, response: Array, start: tuple[float, float], blocks: np.ndarray) -> tuple[Array, Array]:
    A = np.stack([np.ones_like(regressor), regressor], axis=1)
    return solve(lambda x: A @ x - response, lambda x: A, np.array(start), blocks)


def _summary(errors: list[Array]) -> dict[str, list[float]]:
    e = np.concatenate(errors)
    e = e[np.isfinite(e).all(1)]
    return {"rms": np.sqrt((e * e).mean(0)).tolist(), "typical": [typical(channel) for channel in e.T]}


def _axes(which: np.ndarray) -> str:
    return ", ".join(axis for axis, chosen in zip("xyz", which, strict=True) if chosen)


def _name(log: ImuLog) -> str:
    return str(log.files[0]) if log.files else "the log"
