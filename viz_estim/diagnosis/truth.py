"""Sensors and the prediction against the truth, where it is known: what is wrong with them, whatever the gains are.

With e the error before an update, a reading is off the truth's own by r = ν − H·e, which is N(0, R) and white if the
sensor is what the filter takes it for; the prediction from the truth is off by w = e' − F·e, which is N(0, Q). This is
right to first order in e. By how much it is off is told from how H and F change along the run: what is not larger than
that is no finding.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Euclidean, Product, Space
from viz_estim.diagnosis.axes import explains, maps, units
from viz_estim.diagnosis.evidence import Case, jacobians, parameter, tells_gain, tells_reading
from viz_estim.diagnosis.finding import GROSS, Finding, judge
from viz_estim.diagnosis.fits import Against, fitted, white

FEWEST = 30
_TURNED = 0.1  # rad
SURELY = 0.95  # of the misfit explained: no error of a linearisation looks like that
_SMALL = 0.1  # of R's standard deviation: what a hundred readings would tell
_NEAR = 0.1  # a factor is that of a known unit, or −1, within a tenth


class Cause(NamedTuple):
    """What would explain r: its gain in log-likelihood for k parameters, its p, whether it is large or the p of that
    (`finding.judge`), its size in σ, and how to say it."""

    code: str
    gain: float
    k: int
    p: float
    large: bool | float
    size: float
    explained: float
    evidence: dict[str, object]
    cause: str
    remedy: str
    known: bool = False  # a map of the list, without a number that was fitted


def sensors(case: Case) -> Iterator[Finding]:
    """Of each sensor the one cause that explains its readings' misfit to the truth best: axes or unit, bias, or lag.

    Each is fitted to r by least squares in R; of those that are significant the one with the largest gain in
    log-likelihood less ½·k·log M is told (Schwarz 1978). p is of the t-test of the worst coefficient with a variance
    by 20 stretches of the run (Liang and Zeger 1986), so that truth and noise may be coloured. Large is a bias or a
    factor that doubles the squared error with which the filter foresees the reading, and a lag beyond half of a step.
    """
    against = list(_against(case))
    tests = sum(len(one.space.axes) + 2 for one in against)
    told: set[str] = set()
    for one in against:
        name = one.name.partition("/")[0]
        causes = [c for c in (*_maps(one), _bias(one), _lag(case, one)) if c is not None]
        found = [(c, judge(c.p, tests, large=c.large)) for c in causes]
        slip = 2 * float(np.median(one.slip))
        found = [(c, s) for c, s in found if s and c.size > max(slip, _SMALL)]
        if not found or name in told:
            continue
        best, severity = max(found, key=lambda entry: entry[0].gain - 0.5 * entry[0].k * np.log(len(one.step)))
        if best.explained < 0.2:
            continue
        assert severity
        told.add(name)
        steps = int(one.step[0]), int(one.step[-1])
        evidence = best.evidence | {"p": best.p, "explained": best.explained, "against": "truth"}
        known = parameter(case.run, f"{name}_bias")
        estimated = f"set {known[0]}=estimate; or " if known and known[1] != "estimate" and not best.known else ""
        yield Finding(best.code, severity, name, steps, evidence, best.cause, estimated + best.remedy)


def _against(case: Case) -> Iterator[Against]:
    run = case.run
    if run.labels or not np.isfinite(run.truth).any():
        return
    row = {int(step): k for k, step in enumerate(run.step)}
    for table in run.stages.values():
        if not tells_gain(table) or not tells_reading(table.values["innovation.predicted"]):
            continue
        space = table.spaces["innovation"]
        assert isinstance(space, Product)
        mean, cov = case.sequence.before(table)
        at = np.array([row[int(step)] for step in table.step])
        error = case.space.minus(run.truth[at], mean)
        H = jacobians(cov, table.values["innovation.cross_cov"])
        seen = (np.abs(np.nan_to_num(H)) > 1e-9 * np.nan_to_num(np.abs(H)).max()).any((0, 1))
        error[:, ~seen] = 0.0  # what no reading sees need not be known
        used = {int(step) for r in case.sensors.values() for step in r.step}
        counts = np.array([int(step) in used for step in table.step]) & np.isfinite(error).all(1)
        for i, (name, part) in enumerate(space.parts.items()):
            axes, place = space.axes_at[name], space.at[name]
            R = table.values["innovation.noise"][:, axes, axes]
            rows = counts & (table.values["innovation.offered"][:, i] > 0) & np.isfinite(H[:, axes]).all((1, 2))
            rows &= np.isfinite(table.values["innovation.residual"][:, axes]).all(1)
            rows[rows] &= np.linalg.eigvalsh(R[rows])[:, 0] > 0
            if rows.sum() < FEWEST:
                continue
            expected = (H[rows][:, axes] @ error[rows][..., None])[..., 0]
            r = table.values["innovation.residual"][rows][:, axes] - expected
            scale = np.linalg.inv(np.linalg.cholesky(R[rows]))
            off = slip(scale @ H[rows][:, axes], error[rows], mean[rows], case.space)
            near, true = np.isfinite(off), part.plus(table.values["innovation.predicted"][rows][:, place], expected)
            if near.sum() >= FEWEST:
                yield Against(
                    name, part, table.step[rows][near], run.time[at[rows]][near],
                    table.values["innovation.z"][rows][:, place][near], true[near], r[near], R[rows][near],
                    _spread(H[rows][:, axes], cov[rows])[near], off[near],
                )  # fmt: skip


def _spread(H: Array, P: Array) -> Array:
    """(H·P·Hᵀ)ᵢᵢ (M, m) of H (M, m, d) and P (M, d, d)."""
    return np.asarray(np.maximum(np.einsum("tmi,tij,tmj->tm", H, P, H), 0.0))


def slip(J: Array, error: Array, mean: Array, space: Space) -> Array:
    """By how much J·e may be wrong (M,), for a Jacobian J (M, m, d) at the estimate; 0 where it is constant.

    Where it turns with an angle, an error of that angle (rad) changes it by as large a share; infinite beyond 0.1 rad.
    Else ½·L·|e|², with L from its changes between neighbouring rows, over the directions that it sees.
    """
    seen = (np.abs(J).max((0, 1)) > 1e-9 * np.abs(J).max()) & (error**2).any(0)
    bends = seen & (np.abs(J - J[:1]).max((0, 1)) > 1e-6 * np.abs(J).max())
    if not bends.any():
        return np.zeros(len(J))
    angles = np.array([unit == "rad" for unit in space.axis_units]) & seen
    if angles.any():
        wide = np.abs(error[:, angles]).max(1)
        told = np.linalg.norm(J[..., bends] @ error[:, bends, None], axis=(1, 2))
        return np.asarray(np.where(wide > _TURNED, np.inf, wide * told))
    J, e, step = J[..., seen], error[:, seen], space.minus(mean[1:], mean[:-1])[:, seen]
    size = np.sqrt(np.mean(e**2, axis=0))
    moved = np.linalg.norm(step / size, axis=1)
    change = np.linalg.norm((J[1:] - J[:-1]) * size, axis=(1, 2))
    far = moved > 1e-9
    L = float(np.quantile(change[far] / moved[far], 0.9)) if far.any() else 0.0
    return np.asarray(0.5 * L * (e**2 / size**2).sum(1))


def _bias(one: Against) -> Cause | None:
    m = one.r.shape[1]
    fit = fitted(one, np.broadcast_to(np.eye(m), (len(one.r), m, m)))
    size = np.abs(fit.coefficients) / np.sqrt(np.median(np.diagonal(one.noise, axis1=1, axis2=2), axis=0))
    worst = int(np.argmax(-fit.p + 1e-9 * size))
    name, axis, unit = one.name, one.space.axes[worst], one.space.axis_units[worst]
    label = name if axis in ("", name.partition("/")[0]) else f"{name} {axis}"
    value = float(fit.coefficients[worst])
    return Cause(
        "biased_innovation", fit.gain, m, float(fit.p[worst]),
        fit.p_beyond(worst, float(np.sqrt(np.mean(one.foreseen[:, worst])))), float(size[worst]), fit.explained,
        {"component": axis, "bias": value, "mean_sigma": float(size[worst])},
        f"against the truth, readings of {label} are {value:+.3g} {unit} off on the average: the sensor has a bias "
        "that the filter does not know of",
        f"subtract {value:+.3g} {unit} from {label}, or add a bias of {name} to the state, to be estimated",
    )  # fmt: skip


def _lag(case: Case, one: Against) -> Cause | None:
    """r = −τ·ż + constant, ż the rate of what the truth would give, by central differences."""
    if len(one.time) < 3 or (np.diff(one.time) <= 0).any():
        return None
    span = (one.time[2:] - one.time[:-2])[:, None]
    rate = one.space.minus(one.true[2:], one.true[:-2]) / span
    middle = Against(*(v[1:-1] if isinstance(v, np.ndarray) else v for v in one))  # type: ignore[arg-type]
    m = rate.shape[1]
    design = np.concatenate([-rate[..., None], np.broadcast_to(np.eye(m), (len(rate), m, m))], axis=-1)
    both, alone = fitted(middle, design), fitted(middle, design[..., :1])
    # A constant beside it costs power where the way is straight; it is fitted only where there is one.
    fit = both if both.p[1:].min() < 0.05 else alone
    p, tau = float(fit.p[0]), float(fit.coefficients[0])
    interval = float(np.median(np.diff(case.run.time)))
    shift = float(np.sqrt(np.mean(white(middle, tau * rate) ** 2)))
    if abs(tau) < 0.5 * interval:
        return None
    late = "late" if tau > 0 else "early"
    place = set(one.space.axis_units) == {"m"} and len(one.space.axes) > 1
    where = "behind" if tau > 0 else "ahead of"
    alike = f"; or it sits {where} what moves, which looks alike at one speed" if place else ""
    readings = float(np.median(np.diff(one.time)))
    if abs(tau) > 0.1 * (one.time[-1] - one.time[0]):
        return None  # so long a lag is no matter of a rate
    return Cause(
        "lag", alone.gain, 1, p, fit.p_beyond(0, 0.5 * interval), shift, alone.explained,
        {"lag_s": tau, "lag_samples": tau / readings},
        f"against the truth, readings of {one.name} come {abs(tau):.3g} s {late} ({abs(tau) / readings:.1f} of its "
        f"samples): a delay of the sensor or of the truth, another clock, or an index that is one off{alike}",
        f"pair {one.name} by its stamps and not by index; correct its stamps by {-tau:+.3g} s",
    )  # fmt: skip


def _maps(one: Against) -> Iterator[Cause]:
    """The best signed permutation or unit, and the best plain factor."""
    if not isinstance(one.space, Euclidean) or not 1 <= len(one.space.axes) <= 3:
        return
    precision = np.asarray(np.linalg.inv(one.noise), float)
    own, (M, m) = _squares(one.r, precision), one.r.shape
    best, what = np.inf, ""
    for title, A in maps(m, one.space.axis_units[0]):
        left = _squares(one.z @ A.T - one.true, precision) / max(1.0, abs(np.linalg.det(A)) ** (2 / m))
        if left < best:
            best, what = left, title
    gain, explained = 0.5 * M * m * np.log(own / max(best, 1e-300)), 1 - best / max(own, 1e-300)
    if explains(what, explained) and own > GROSS * best:
        words = f"the readings as {what}" if what.startswith("axes") else f"a factor ({what})"
        yield Cause(
            "units_or_axes", gain, 1, float(np.exp(-min(gain, 700.0))) * 60, True, float(np.sqrt(own / (M * m))),
            explained,
            {"map": what, "log_likelihood_gain": gain},
            f"{words} would explain {explained:.0%} of what {one.name} and the truth disagree on",
            f"check the order, the signs and the unit of {one.name}: the best map is `{what}`", True,
        )  # fmt: skip
    fit = fitted(one, one.true[..., None])
    factor = 1 + float(fit.coefficients[0])
    unit_size = float(np.sqrt(np.mean(white(one, one.true) ** 2)))
    size = abs(factor - 1) * unit_size
    foreseen = float(np.sqrt(np.mean(one.foreseen / np.diagonal(one.noise, axis1=1, axis2=2))))
    yield Cause(
        "units_or_axes", fit.gain, 1, float(fit.p[0]), fit.p_beyond(0, foreseen / max(unit_size, 1e-300)), size,
        fit.explained, {"map": f"a factor of {factor:.4g}"},
        f"readings of {one.name} are {factor:.4g}× what the truth would give: {named(factor, one.space.axis_units[0])}",
        f"divide the readings of {one.name} by {factor:.4g}, or calibrate its scale",
    )  # fmt: skip


def _squares(off: Array, precision: Array) -> float:
    """Σ vᵀ·R⁻¹·v of v (M, m)."""
    return float(np.einsum("ti,tij,tj->", off, precision, off))


def named(factor: float, unit: str) -> str:
    """What a factor of a reading may come from."""
    if abs(factor / 2 - 1) < _NEAR:
        return "twice, as a round trip taken for the way there"
    known = [title for title, value in units(unit).items() if abs(factor * value - 1) < _NEAR]
    if known:
        return known[0]
    return "a sign" if abs(factor + 1) < _NEAR else "a scale factor that is not 1"
