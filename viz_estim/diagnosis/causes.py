"""What would explain that a sensor's readings miss the truth: a bias, a lag, a lever arm, a scale, a unit, other axes.

Each is fitted to what the readings miss the truth by, and says how much of it it explains, for how many parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Euclidean
from viz_estim.diagnosis.axes import TRIED, explains, inverses
from viz_estim.diagnosis.finding import TINY, WINDOW, Chance, by_ratio, level
from viz_estim.diagnosis.fits import Against, Fitted, fitted, white
from viz_estim.diagnosis.linear import straight
from viz_estim.diagnosis.naming import SIGNS, likeliest, named, of_reading

_SQUARE = "squares"


class Cause(NamedTuple):
    """What would explain r: its gain in log-likelihood for k parameters, its p, whether it is large or the p of that
    (`finding.judge`), its size in σ, and how to say it."""

    code: str
    gain: float
    k: int
    p: float | Chance
    large: bool | float | Chance
    size: float
    explained: float
    evidence: dict[str, object]
    cause: str
    remedy: str
    known: bool = False  # a map of the list, without a number that was fitted

    def score(self, readings: int) -> float:
        """Its gain less ½·k·log M (Schwarz 1978)."""
        return self.gain - 0.5 * self.k * float(np.log(readings))


def bias(one: Against) -> Iterator[Cause]:
    """A constant."""
    m = one.r.shape[1]
    fit = fitted(one, np.broadcast_to(np.eye(m), (len(one.r), m, m)))
    size = np.abs(fit.coefficients) / _std(one)
    worst = min(range(m), key=lambda i: (fit.p(i), -size[i]))
    axis, unit, label = one.space.axes[worst], one.space.axis_units[worst], one.axis(worst)
    value = float(fit.coefficients[worst])
    yield Cause(
        "biased_innovation", fit.gain, m, fit.p(worst),
        fit.p(worst, float(np.sqrt(np.mean(one.foreseen[:, worst])))), float(size[worst]), fit.explained,
        {"component": f"{one.part}.{axis}" if one.part else axis, "bias": value, "mean_sigma": float(size[worst])},
        f"against the truth, readings of {label} are {value:+.3g} {unit} off on the average: the sensor has a bias "
        "that the filter does not know of",
        f"subtract {value:+.3g} {unit} from {label}, or add a bias of {one.name} to the state, to be estimated",
    )  # fmt: skip


def lever_arm(one: Against) -> Iterator[Cause]:
    """r = R·l: the place that is read is not the one that is estimated, but lies off it in the body's axes."""
    place = set(one.space.axis_units) == {"m"} and isinstance(one.space, Euclidean)
    if one.attitude is None or not place or one.attitude.shape[-1] != one.r.shape[1]:
        return
    known = np.isfinite(one.attitude).all((1, 2))
    if not known.all():
        return
    fit = fitted(one, one.attitude)
    size = np.abs(fit.coefficients) / _std(one)
    worst = int(np.argmax(size))
    along = [(i, float(v)) for i, v in enumerate(fit.coefficients) if max(fit.p(i)) < level("warning", 1)]
    words = [f"{abs(v):.2g} m {_WAYS[i][int(v < 0)]}" for i, v in along]
    yield Cause(
        "biased_innovation", fit.gain, len(fit.coefficients), fit.p(worst),
        fit.p(worst, float(np.sqrt(np.mean(one.foreseen)))), float(size[worst]), fit.explained,
        {"lever_arm": fit.coefficients.tolist()},
        f"against the truth, readings of {one.label} are those of a place {' and '.join(words)} of the one that is "
        "estimated, which turns with the body: a lever arm that the model lacks",
        f"write h(x) = p + R·l with the place l of {one.name} in the body's axes, about "
        f"({', '.join(f'{v:.2g}' for v in fit.coefficients)}) m",
    )  # fmt: skip


_WAYS = (("ahead", "behind"), ("to the left", "to the right"), ("above", "below"))


def lag(one: Against, interval: float) -> Iterator[Cause]:
    """r = −τ·ż + constant, ż the rate of what the truth would give, by central differences."""
    if len(one.time) < 3 or (np.diff(one.time) <= 0).any():
        return
    k = min(max(1, round(0.5 * WINDOW / float(np.median(np.diff(one.time))))), (len(one.time) - 1) // 2)
    span = (one.time[2 * k :] - one.time[: -2 * k])[:, None]
    rate = one.space.minus(one.true[2 * k :], one.true[: -2 * k]) / span
    middle = one.pick(slice(k, -k))
    m = rate.shape[1]
    design = np.concatenate([-rate[..., None], np.broadcast_to(np.eye(m), (len(rate), m, m))], axis=-1)
    both, alone = fitted(middle, design), fitted(middle, design[..., :1])
    # A constant beside it costs power where the way is straight; it is fitted only where there is one for sure.
    fit = both if min(max(both.p(i + 1)) for i in range(m)) < level("warning", m) else alone
    p, tau = fit.p(0), float(fit.coefficients[0])
    shift = float(np.sqrt(np.mean(white(middle, tau * rate) ** 2)))
    if abs(tau) < 0.5 * interval or not straight(one.space, one.true, one.time, tau):
        return
    late = "late" if tau > 0 else "early"
    place = set(one.space.axis_units) == {"m"} and len(one.space.axes) > 1
    where = "behind" if tau > 0 else "ahead of"
    alike = f"; or it sits {where} what moves, which looks alike at one speed" if place else ""
    readings = float(np.median(np.diff(one.time)))
    yield Cause(
        "lag", alone.gain, 1, p, fit.p(0, 0.5 * interval), shift, alone.explained,
        {"lag_s": tau, "lag_samples": tau / readings},
        f"against the truth, readings of {one.name} come {abs(tau):.3g} s {late} ({abs(tau) / readings:.1f} of its "
        f"samples): a delay of the sensor or of the truth, another clock, or an index that is one off{alike}",
        f"pair {one.name} by its stamps and not by index; correct its stamps by {-tau:+.3g} s",
    )  # fmt: skip


def mapped(one: Against) -> Iterator[Cause]:
    """The best signed permutation or unit of the list (`axes.maps`)."""
    if not isinstance(one.space, Euclidean) or not 1 <= len(one.space.axes) <= 3:
        return
    m, best, what = one.r.shape[1], np.inf, ""
    tried = [(title, one.true @ back) for title, back in inverses(m, one.space.axis_units[0])]
    for title, should in [*tried, (_SQUARE, one.true**2)]:  # in the reading's own unit, whose noise stays as it is
        left = float((white(one, one.z - should) ** 2).sum())
        if left < best:
            best, what = left, title
    if (found := listed(one, best, explained=_explained(one, best), what=what)) is None:
        return
    axes = one.space.axes
    if what == "axes +y +x" and axes != ("x", "y"):
        yield found._replace(
            cause=f"the readings of {one.axis(0)} and {one.axis(1)} are exchanged: each as the other would explain "
            f"{found.explained:.0%} of what they and the truth disagree on",
            remedy=f"check which reading is whose: exchange {axes[0]} and {axes[1]} of {one.name}",
        )  # fmt: skip
        return
    if what == _SQUARE:
        yield found._replace(
            cause=f"readings of {one.label} are the squares of what the truth would give ({found.explained:.0%} of "
            "what they disagree on): a root is missing",
            remedy=f"take the square root of {one.label}, or leave the root out of h(x) too and adapt its noise",
        )
        return
    words = f"the readings as {what}" if what.startswith("axes") else f"a factor ({what})"
    yield found._replace(
        cause=f"{words} would explain {found.explained:.0%} of what {one.label} and the truth disagree on",
        remedy=f"check the order, the signs and the unit of {one.label}: the best map is `{what}`",
    )  # fmt: skip


def listed(one: Against, left: float, what: str, explained: float) -> Cause | None:
    """A map without a number that is fitted, by the sum of squares that it leaves: of as many as are TRIED at most."""
    own, (M, m) = float((white(one, one.r) ** 2).sum()), one.r.shape
    gain = 0.5 * M * m * float(np.log(own / max(left, TINY)))
    nothing = float((white(one, one.z[:, :m]) ** 2).sum())
    if not explains(what, own, left, nothing, M * m):
        return None
    return Cause(
        "units_or_axes", gain, 1, TRIED * by_ratio(gain), True,
        float(np.sqrt(max(own - left, 0.0) / (M * m))), explained,
        {"map": what, "log_likelihood_gain": gain}, "", "", True,
    )  # fmt: skip


def _explained(one: Against, left: float) -> float:
    return 1 - left / max(float((white(one, one.r) ** 2).sum()), TINY)


def scaled(one: Against) -> Iterator[Cause]:
    """r = (c − 1)·true: a plain factor, of all components."""
    if not isinstance(one.space, Euclidean) or not 1 <= len(one.space.axes) <= 3:
        return
    fit: Fitted = fitted(one, one.true[..., None])
    factor = 1 + float(fit.coefficients[0])
    unit_size = float(np.sqrt(np.mean(white(one, one.true) ** 2)))
    foreseen = float(np.sqrt(np.mean(one.foreseen / np.diagonal(one.noise, axis1=1, axis2=2))))
    known, error = of_reading(one.space.axis_units[0]), float(fit.error[:, 0].max())
    sign = likeliest(factor, known, error) in SIGNS
    yield Cause(
        "units_or_axes", fit.gain, 1, fit.p(0), fit.p(0, foreseen / max(unit_size, TINY)),
        abs(factor - 1) * unit_size, fit.explained, {"map": f"a factor of {factor:.4g}", "factor": factor},
        f"readings of {one.label} are {factor:.4g}× what the truth would give: "
        f"{named(factor, known, error)}",
        f"change the sign of {one.label}" if sign else f"divide the readings of {one.label} by {factor:.4g}, or "
        "calibrate its scale",
    )  # fmt: skip


def _std(one: Against) -> Array:
    return np.asarray(np.sqrt(np.median(np.diagonal(one.noise, axis1=1, axis2=2), axis=0)))
