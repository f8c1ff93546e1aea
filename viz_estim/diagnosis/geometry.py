"""Angles, quaternions, units and axes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.distributions import norm
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO2, SO3, Euclidean, Product, Space, wrap
from viz_estim.diagnosis.axes import explains, finding_of, inverses, units
from viz_estim.diagnosis.evidence import Case, Readings, tells_reading
from viz_estim.diagnosis.finding import FEWEST, GROSS, HALF_THE_DIGITS, SHEET, TINY, Finding, level
from viz_estim.diagnosis.fits import slope
from viz_estim.diagnosis.kinematics import imu_axes, scale
from viz_estim.diagnosis.naming import FAR
from viz_estim.diagnosis.rounding import epsilon
from viz_estim.recording.layout import leaves

_TURNS = {"rad": 2 * np.pi, "deg": 360.0, "°": 360.0, "": None}  # by unit; unknown where none is told


def wraps(case: Case) -> Iterator[Finding]:
    """Innovations beyond a half turn, which no wrapped difference is; or an expected angle that is the plain mean of
    sigma points on both sides of ±π (`_astride`). Neither can be by chance."""
    for name, readings in case.sensors.items():
        for i, unit in enumerate(readings.space.axis_units):
            if unit not in _TURNS or isinstance(readings.space, SO3):
                continue
            axis = readings.space.axes[i]
            turn = _TURNS[unit]
            steps = _by_a_turn(readings, i) if turn is None else set(
                readings.step[np.abs(readings.residual[:, i]) > turn / 2].tolist()
            )  # fmt: skip
            steps |= _astride(case, name, i) if unit == "rad" else set()
            if steps:
                yield Finding(
                    "angle_wrap", "error", name, (min(steps), max(steps)), {"component": axis, "count": len(steps)},
                    f"innovations of {name} ({axis}) jump by a turn, first at step {min(steps)}: the difference of two "
                    "angles is not wrapped",
                    "wrap the residual to [−π, π), by SO2().minus, not z − h(x)",
                )  # fmt: skip
                break


def _by_a_turn(readings: Readings, i: int) -> set[int]:
    """The steps at which innovations of a component of unknown unit are a full turn, in radians or degrees, to within
    what S allows, while reading and expectation are both angles of the first turn: a jump that no noise makes."""
    if not isinstance(readings.space, Euclidean) or readings.z.shape != readings.residual.shape:
        return set()
    jump = np.abs(readings.residual[:, i])
    noise = norm.isf(level("error", len(jump))) * np.sqrt(readings.cov[:, i, i])  # none is larger, at an error's share
    for turn in (2 * np.pi, 360.0):
        half = 0.5 * turn + noise
        angles = (np.abs(readings.z[:, i]) < half) & (np.abs(readings.predicted[:, i]) < half)
        rows = (np.abs(jump - turn) < noise) & (4 * noise < turn) & angles
        if rows.any() and (np.abs(readings.z[:, i]).max() < half.max()):
            return set(readings.step[rows].tolist())
    return set()


def _astride(case: Case, sensor: str, i: int) -> set[int]:
    """The steps at which a sensor's sigma points lie on both sides of ±π, by what the mean of this angle is.

    As numbers they span more than a half turn and on the circle less, all but its largest arc without a point (Mardia
    and Jupp 2000, section 2.3); and the mean lies further from the middle of their arc than the arc is long, while that
    of wrapped angles lies inside.
    """
    steps: set[int] = set()
    for table in case.run.stages.values():
        space, points = table.spaces.get("innovation"), table.values.get("mapped.points")
        if not isinstance(space, Product) or points is None or points.shape[-1] != len(space.names):
            continue
        for name, part in space.parts.items():
            k = _number(part, i) if name.partition("/")[0] == sensor and i < len(part.axes) else None
            if k is None:
                continue
            k += space.at[name].start
            start, arc = _arc(points[..., k])
            apart = np.abs(wrap(table.values["innovation.predicted"][:, k] - start - 0.5 * arc)) > arc
            steps |= set(table.step[(np.ptp(points[..., k], axis=1) > np.pi) & (arc < np.pi) & apart].tolist())
    return steps


def _number(part: Space, i: int) -> int | None:
    """Which number of a space is its direction i; None where it is no plain angle."""
    axis = 0
    for _, leaf, at in leaves(part) if isinstance(part, Product) else [("", part, slice(0, len(part.names)))]:
        if i < axis + len(leaf.axes):
            return at.start + i - axis if isinstance(leaf, SO2 | Euclidean) else None
        axis += len(leaf.axes)
    return None


def _arc(angles: Array) -> tuple[Array, Array]:
    """Where the shortest arc begins that holds angles (M, N), and how long it is (M,), in rad."""
    x = np.sort(wrap(angles), axis=1)
    gaps = np.diff(x, axis=1, append=x[:, :1] + 2 * np.pi)
    last, row = np.argmax(gaps, axis=1), np.arange(len(x))
    return x[row, (last + 1) % x.shape[1]], 2 * np.pi - gaps[row, last]


def quaternion_norms(case: Case) -> Iterator[Finding]:
    """Quaternions off the unit sphere by more than rounding, and estimates that change their sign from step to step.

    A product of unit quaternions is off by 4ε at most, a turn by an angle by as much again; of N steps without any
    normalising, by 8·N·ε, with ε that of the numbers held (`covariance.epsilon`). It can't be by chance.
    """
    run = case.run
    parts = [(name, at) for name, part, at in leaves(case.space) if isinstance(part, SO3)]
    for name, at in parts:
        off: list[tuple[int, float, str]] = []
        for stage, table in run.stages.items():
            q = table.values["mean"][:, at] if "mean" in table.values else np.empty((0, 4))
            error = np.abs(np.linalg.norm(q, axis=1) - 1)
            rows = np.flatnonzero(error > 8 * len(run.step) * epsilon(q))
            off += [(int(table.step[row]), float(error[row]), stage) for row in rows]
        if off:
            steps = min(off)[0], max(off)[0]
            evidence = {"kind": "norm", "part": name, "stage": max(off, key=lambda o: o[1])[2], "count": len(off)}
            yield Finding(
                "angle_wrap", "error", None, steps, evidence | {"worst": max(o[1] for o in off)},
                f"the quaternion of {name} is off the unit sphere by up to {max(o[1] for o in off):.2g}: it is "
                "averaged or moved as four plain numbers",
                "average attitudes on the manifold (SO3().mean), and move them by SO3().plus",
            )  # fmt: skip
        q = run.mean[:, at]
        flips = np.flatnonzero(((q[1:] * q[:-1]).sum(1) < 0) & (run.step[1:] > case.first)) + 1
        turned = np.linalg.norm(SO3().minus(q[1:], q[:-1]), axis=1)
        flips = flips[turned[flips - 1] < np.pi / 2]  # by a half turn either sign is as near
        if len(flips) and (np.nanmin(q, 0) < -HALF_THE_DIGITS).all():  # else kept in a half of the sphere, as by q₀ ≥ 0
            yield Finding(
                "angle_wrap", "warning", None, (int(run.step[flips[0]]), int(run.step[flips[-1]])),
                {"kind": "sign", "part": name, "count": len(flips)},
                f"the quaternion of {name} changes its sign {len(flips)} times: q and −q are one attitude, but four "
                "plain numbers jump",
                "keep it in one hemisphere (quaternions.continuous) before numbers are averaged or plotted",
            )  # fmt: skip


def units_or_axes(case: Case) -> Iterator[Finding]:
    """Readings that a map M would bring to what was expected: the gain in log-likelihood, ½Σ(|ν|² − |z − M⁻¹·ẑ|²) in S.

    If the innovations are N(0, S), a gain above log(1/α) has at most the probability α, for any one map (Markov's
    inequality on a likelihood ratio; Ville 1939).
    """
    told = set()
    for finding in list(imu_axes(case)) or list(scale(case)):
        told.add(finding.sensor)
        yield finding
    for name, readings in case.sensors.items():
        space = readings.space
        if not tells_reading(readings.predicted):
            continue
        if told or not isinstance(space, Euclidean) or not 1 <= len(space.axes) <= 3 or len(readings) < FEWEST:
            continue
        own = float(np.nansum(readings.nis))
        sound = np.isfinite(readings.nis) & np.isfinite(readings.z).all(1) & np.isfinite(readings.predicted).all(1)
        z, predicted, precision = readings.z[sound], readings.predicted[sound], np.linalg.inv(readings.cov[sound])
        best, what = np.inf, ""
        unit = space.axis_units[0]
        tried = inverses(len(space.axes), unit)
        for title, back in tried:
            off = z - predicted @ back
            value = float(np.einsum("ti,tij,tj->", off, precision, off))
            if value < best:
                best, what = value, title
        gain, explained = 0.5 * (own - best), 1 - best / max(own, TINY)
        nothing = float(np.einsum("ti,tij,tj->", z, precision, z))
        sure = gain > -np.log(level("error", len(tried) * len(case.sensors)))
        if (
            sure
            and explains(what, own, best, nothing, z.size)
            and singled_out(z, predicted, np.asarray(precision, float), what, unit)
        ):
            yield finding_of(name, readings.steps, what, explained, gain)


def singled_out(z: Array, predicted: Array, precision: Array, what: str, unit: str) -> bool:
    """Whether of all factors known, and none, the map alone brings what was expected (M, m) to the readings (M, m). The
    factor lies between the slope of the one on the other and that of the other on the one, each with its error. Of an
    estimate that has gone elsewhere, that is far: then readings tell nothing of their unit."""
    back = dict(inverses(z.shape[1], unit))[what]
    if not (np.linalg.eigvalsh(precision)[:, 0] > 0).all():
        return False
    L = np.linalg.cholesky(precision)
    y, x = (np.einsum("tji,tj->ti", L, v).ravel() for v in (z, predicted @ back))
    forth, aback = slope(y, x), slope(x, y)
    if forth.value <= 0 or aback.value <= 0:
        return False
    low, high = sorted((np.log(forth.value), -np.log(aback.value)))
    wide = FAR * max(forth.error / forth.value, aback.error / aback.value) + SHEET
    scale = 1.0 if what.startswith("axes") else units(unit)[what]
    others = [0.0 if what.startswith("axes") else np.log(scale), *(np.log(scale / f) for f in units(unit).values())]
    known = wide < np.log(GROSS) and low - wide < 0 < high + wide
    return bool(known and not any(low - wide < off < high + wide for off in others if abs(off) > SHEET))
