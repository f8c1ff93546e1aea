"""Do the sensors themselves work? Read from what they gave, before any filter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from viz_estim.core.distributions import binom, chi2, norm, t
from viz_estim.core.quaternions import Array
from viz_estim.diagnosis.finding import FEWEST, GROSS, SHEET, TINY, Finding, judge, level
from viz_estim.diagnosis.stamps import MISSING
from viz_estim.recording.reader import Run
from viz_estim.scenarios.imu_health import DRIFT, GRAVITY, frozen_accel, frozen_gyro, quantum, still_prefix

# Of the time within two counts of an extreme that a smooth signal spends within one: its way there is a parabola's. The
# same of a regular sensor's intervals beyond 1.5 medians, had it Poisson's: (1/2)^1.5.
_AT_THE_END, _LATE = 0.5**0.5, 0.5**MISSING


class Given(NamedTuple):
    """A sensor's readings (M, n) and the rows (M,) of the run at which they came; raw ones where there are any."""

    rows: np.ndarray
    values: Array


def given(run: Run) -> dict[str, Given]:
    """By sensor what it gave; raw counts rather than what was made of them."""
    found = {}
    for kind in ("z.", "raw."):
        for name, values in run.inputs.items():
            if name.startswith(kind):
                rows = np.flatnonzero(np.isfinite(values).all(1))
                if len(rows):
                    found[name.removeprefix(kind)] = Given(rows, values[rows])
    return found


class Imu(NamedTuple):
    """rate (T, 3) rad/s as the filter reads it, force (T, 3) m/s² or its direction times g; rows (T,) of the run."""

    rows: np.ndarray
    rate: Array
    force: Array


def imu(run: Run) -> Imu | None:
    """The run's gyro and accelerometer, where both are read; the gyro may drive the prediction as its control."""
    force, rate = run.inputs.get("z.accel"), run.inputs.get("z.gyro")
    if rate is None and "raw.gyro" in run.inputs:
        rate = _driving(run)
    if force is None or rate is None or force.shape[1:] != (3,) or rate.shape[1:] != (3,):
        return None
    rows = np.flatnonzero(np.isfinite(force).all(1) & np.isfinite(rate).all(1))
    if len(rows) < FEWEST:
        return None
    length = np.median(np.linalg.norm(force[rows], axis=1))
    return Imu(rows, rate[rows], force[rows] * (GRAVITY if abs(length - 1) < SHEET else 1.0))


def _driving(run: Run) -> Array | None:
    """The gyro's rates, where they are the control: also where the filter took another rate for them."""
    rate, raw = run.inputs.get("control"), run.inputs["raw.gyro"]
    if rate is None or rate.shape != raw.shape:
        return None
    known = np.isfinite(rate).all(1) & np.isfinite(raw).all(1) & (rate != 0).all(1)
    if known.sum() < 2:
        return None
    found = [np.polyfit(raw[known, i], rate[known, i], 1) for i in range(rate.shape[1])]
    return np.stack([np.polyval(fit, raw[:, i]) for i, fit in enumerate(found)], axis=1)


def frozen(run: Run) -> Iterator[Finding]:
    """A gyro that is flat while gravity turns (`imu_health.frozen_gyro`), and any sensor whose readings repeat.

    Of a sensor as fine as a float, by how seldom so many come in a row (`held`).
    """
    both = imu(run)
    if both is not None:
        flags = frozen_gyro(run.time[both.rows], both.rate, both.force, np.zeros(3))
        for first, last in runs(flags):
            yield _stuck(run, "gyro", both.rows[first], both.rows[last], {"level": both.rate[first : last + 1].mean(0)})
        for first, last in runs(frozen_accel(run.time[both.rows], both.rate, both.force) & ~flags):
            level_of = both.force[first : last + 1].mean(0)
            yield _stuck(run, "accel", both.rows[first], both.rows[last], {"level": level_of})
    sensors = given(run)
    for name, (rows, values) in sensors.items():
        if not continuous(values) or (both is not None and name in ("gyro", "accel")):
            continue
        same = (np.diff(values, axis=0) == 0).all(1)
        for first, last in held(same, len(sensors)):
            yield _stuck(run, name, rows[first], rows[last + 1], {"level": values[first]})


def held(same: np.ndarray, sensors: int) -> list[tuple[int, int]]:
    """The runs of equal neighbours (first, last) in flags (M − 1,) that are too long for chance, of so many sensors: n
    equal readings come with N·qⁿ⁻¹, q the share of equal neighbours elsewhere, at least 1/N."""
    found = []
    for first, last in runs(same):
        n = last - first + 2
        elsewhere = max((same.sum() - (n - 1)) / len(same), 1 / len(same))
        if len(same) * elsewhere ** (n - 1) < level("error", sensors):
            found.append((first, last))
    return found


def _stuck(run: Run, name: str, first: int, last: int, evidence: dict[str, Array]) -> Finding:
    steps, span = (int(run.step[first]), int(run.step[last])), float(run.time[last] - run.time[first])
    left_out = _left_out(run, name, steps)
    begin, end = float(run.time[first]), float(run.time[last])
    what = f"the {name} sticks at one value for {span:.2f} s (from {begin:.2f} to {end:.2f} s) while the body moves"
    remedy = (
        "the filter leaves it out already; look whether its uncertainty grows meanwhile"
        if left_out
        else "leave it out in that time (`frozen=reject` where the scenario has it), or read a stand-in of large noise"
    )
    shown = {"level": [float(v) for v in evidence["level"]], "from_s": begin, "to_s": end, "left_out": left_out}
    return Finding("sensor_frozen", "note" if left_out else "error", name, steps, shown, what, remedy)


def _left_out(run: Run, name: str, steps: tuple[int, int]) -> bool:
    """Whether the filter took no reading of the sensor for good in most of these steps."""
    for table in run.stages.values():
        if name in getattr(table.spaces.get("innovation"), "parts", ()):
            i = list(table.spaces["innovation"].parts).index(name)  # type: ignore[attr-defined]
            rows = (table.step >= steps[0]) & (table.step <= steps[1])
            return bool((table.values["innovation.offered"][rows, i] == 0).mean() > 0.5) if rows.any() else False
    control = run.inputs.get("control")
    rows = (run.step >= steps[0]) & (run.step <= steps[1])
    return control is not None and bool((control[rows] == 0).all())


def silent(run: Run) -> Iterator[Finding]:
    """A pause in a sensor's readings that is too long for chance. An error where it lasts to the end, and is too long
    even for arrivals that are as irregular as can be.

    Of regular readings (fewer intervals beyond 1.5 medians than a Poisson process has, for sure) each is lost with the
    share q that is lost elsewhere, at least 1/N: k in a row with N·qᵏ at most. Else arrivals are taken as a Poisson
    process, whose longest of N pauses of mean μ exceeds g with 1 − (1 − e^(−g/μ))ᴺ.
    """
    sensors = given(run)
    for name, (rows, _) in sensors.items():
        if len(rows) < FEWEST:
            continue
        gaps = np.diff(np.append(rows, len(run.step)))  # up to the run's end: there it is silent for good
        usual, N = float(np.median(gaps)), len(gaps)
        regular = binom.cdf((gaps > MISSING * usual).sum(), N, _LATE) < level("warning", len(sensors))
        longest = int(np.argmax(gaps))
        irregular = -np.expm1(N * np.log1p(-np.exp(-gaps / gaps.mean())))
        if regular:
            lost = np.ceil(gaps / gaps[gaps <= MISSING * usual].max()) - 1  # at least
            q = np.maximum(lost.sum() - lost, 1) / (N + lost.sum() - lost)
            p = np.where((lost > 0) & (gaps > usual + 2), np.minimum(N * q**lost, 1.0), 1.0)
            found = np.flatnonzero(p < level("warning", len(sensors)))
        else:
            found = np.array([longest]) if judge(irregular[longest], len(sensors), large=False) else np.array([], int)
        for k in found[:20]:  # as many as are told
            first, end = int(rows[k]) + 1, int(rows[k]) + int(gaps[k])
            last = min(end, len(run.step)) - 1
            for_good = end >= len(run.step)
            span = float(run.time[last] - run.time[rows[k]])
            steps = int(run.step[first]), int(run.step[last])
            evidence = {"pause_s": span, "usual_steps": usual, "for_good": for_good}
            yield Finding(
                "sensor_silent", judge(irregular[k], len(sensors), large=for_good) or "warning", name, steps, evidence,
                f"the {name} gives no reading for {span:.3g} s"
                + (", to the end of the run" if for_good else f", {gaps[k] / usual:.0f} of its usual intervals"),
                "check the log and the wiring for lost messages; look whether the covariance grows meanwhile",
            )  # fmt: skip


def saturated(run: Run, without: Sequence[tuple[int, int]] = ()) -> Iterator[Finding]:
    """Readings that pile up at a component's largest or smallest value: more of them than at the next value inside.

    without: intervals of steps (first, last) to leave out. Binomial: of the readings at the extreme and within one
    quantum of it, a smooth signal has at most √½ there. Large is more than SHEET of all readings for sure, by a
    binomial test too.
    """
    sensors = {name: _left_of(run, one, without) for name, one in given(run).items()}
    tests = 2 * sum(values.shape[1] for _, values in sensors.values())
    for name, (rows, values) in sensors.items():
        for i in range(values.shape[1]):
            for sign, end in ((1, "largest"), (-1, "smallest")):
                x = sign * values[:, i]
                distinct = np.unique(x)
                if len(distinct) < FEWEST:
                    continue
                top = x == distinct[-1]
                near = (x >= distinct[-1] - quantum(distinct) * MISSING) | top
                count, around = int(top.sum()), int(near.sum())
                moving = (np.diff(x, prepend=np.nan) != 0) | (np.diff(x, append=np.nan) != 0)
                p = float(binom.sf(count - 1, around, _AT_THE_END))
                severity = judge(p, tests, large=float(binom.sf(count - 1, len(x), SHEET)))
                if severity and moving[top].any():
                    at = rows[np.flatnonzero(top)]
                    steps = int(run.step[at[0]]), int(run.step[at[-1]])
                    value = float(values[np.flatnonzero(top)[0], i])
                    evidence = {"component": i, "value": value, "readings": count, "p": p}
                    yield Finding(
                        "sensor_saturated", severity, name, steps, evidence,
                        f"{count} readings of {name} (component {i}) are exactly {value:g}, its {end}: the sensor is "
                        "at the end of its range and clips what lies beyond",
                        "take a wider range, or leave those readings out: a clipped reading is no reading with noise",
                    )  # fmt: skip


def _left_of(run: Run, one: Given, without: Sequence[tuple[int, int]]) -> Given:
    """The readings outside intervals of steps (first, last)."""
    step = run.step[one.rows]
    fine = ~np.any([(step >= first) & (step <= last + 2) for first, last in without] or [np.zeros(len(step), bool)], 0)
    return Given(one.rows[fine], one.values[fine])


def biased_at_rest(run: Run) -> Iterator[Finding]:
    """A gyro that reads a rate while it lies still: its mean over the prefix's first half, by a t-test. Large is more
    than the noise of one reading.

    Only where its readings are white, as those of a body at rest are: each axis's first autocorrelation, N(0, 1/n), by
    half of the check's share. What an offset does not drift by since it was subtracted may be a slow turn, unless
    gravity belies that.
    """
    both = imu(run)
    if both is None:
        return
    still = still_prefix(run.time[both.rows], both.rate, both.force) // 2
    if still < FEWEST:
        return
    rest = both.rate[:still]
    about = rest - rest.mean(0)
    rho = (about[1:] * about[:-1]).sum(0) / np.maximum((about**2).sum(0), TINY)
    fast = np.abs(rest.mean(0)).max() > DRIFT[0] and not _belied(both, rest.mean(0), run, still)
    if (np.abs(rho) > norm.isf(level("warning", 6)) / np.sqrt(still)).any() or fast:
        return  # readings that follow one another, or too large: it turns, however slowly
    error = rest.std(0, ddof=1) / np.sqrt(still)
    score = rest.mean(0) / np.where(error > 0, error, np.inf)
    worst = int(np.argmax(np.abs(score)))
    p = float(2 * t.sf(abs(score[worst]), still - 1))
    beyond = max(abs(float(rest.mean(0)[worst])) - float(rest.std(0, ddof=1)[worst]), 0.0) / float(error[worst])
    severity = judge(p, 3, large=float(2 * t.sf(beyond, still - 1)))
    if severity:
        value, axis = float(rest.mean(0)[worst]), "xyz"[worst]
        steps = int(run.step[both.rows[0]]), int(run.step[both.rows[still - 1]])
        evidence = {"component": axis, "bias": value, "z": float(score[worst]), "p": p, "at_rest": True}
        yield Finding(
            "biased_innovation", severity, "gyro", steps, evidence,
            f"lying still, the gyro's {axis} reads {value:+.2g} rad/s ({np.degrees(value) * 30:+.1f}° in 30 s): its "
            "bias is not what was subtracted, as when it is read off by the median of whole counts",
            "subtract the mean of the still prefix, not the median, and no constant from another day",
        )  # fmt: skip


def _belied(both: Imu, rate: Array, run: Run, still: int) -> bool:
    """Whether gravity turned, from the first half of `still` readings to the second, by less than 1/GROSS of what a
    rate (3,) would have made it, for sure: what noise adds to that is χ²(3) at most, at the check's share."""
    force = both.force[:still] / np.linalg.norm(both.force[:still], axis=1, keepdims=True)
    first, last = force[: still // 2], force[still // 2 :]
    span = float(run.time[both.rows[still - 1]] - run.time[both.rows[0]])
    would = float(np.linalg.norm(np.cross(rate, force.mean(0)))) * 0.5 * span
    error = float(np.sqrt(first.var(0, ddof=1).max() / len(first) + last.var(0, ddof=1).max() / len(last)))
    bound = float(np.sqrt(chi2.isf(level("warning", 3), 3))) * error
    return would > GROSS * (float(np.linalg.norm(last.mean(0) - first.mean(0))) + bound)


def runs(flags: np.ndarray) -> list[tuple[int, int]]:
    """The runs of True in flags (T,), as first and last index, both inclusive."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]))).reshape(-1, 2)
    return [(int(first), int(end) - 1) for first, end in edges]


def continuous(values: Array) -> bool:
    """Whether readings (M, n) are so fine that none is met twice by chance: their steps are no multiples of one."""
    for x in values.T:
        distinct = np.unique(x)
        count = quantum(distinct)
        if count and len(distinct) >= FEWEST:
            steps = np.diff(distinct) / count
            if np.abs(steps - np.round(steps)).mean() > 0.125:  # nearer to a quarter, as without a grid, than to none
                return True
    return False
