"""A finding, the codes there are, and how the rate of false alarms is shared among all that a run is tested for.

A run has so many sensors, components and checks that one of them would always look odd. Each statistical check
therefore states the probability p that data of the filter's own model look as odd as this, and p is held to an equal
share of the run's budget (Bonferroni): of 10⁻⁴ for an error, of 0.05 for a warning. A check of what cannot be (an
asymmetric covariance) costs nothing.

An error must be large besides, for with enough data every filter is wrong by a little. One yardstick serves all: a
variance that is wrong by the factor `GROSS`, 2, which is a standard deviation wrong by 1.4, a bias as large as the
standard deviation it hides in, or readings of which each second one tells nothing. Where an effect is estimated, an
error is no matter of the estimate but of a test against that size (a minimum-effect test; Murphy and Myors 1999): the p
of data in which the effect *is* that large must be below the error's share too. So errors keep to 10⁻⁴ a run not only
where a filter's model is exact, but wherever it is wrong by less than that.

Noise that is coloured, which no filter's model has, makes means and slopes scatter more than white noise does. What is
fitted is held against both (`Chance`): warnings keep to their share in either, errors to theirs where noise is white,
and to that of warnings where it is coloured.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

Severity = Literal["error", "warning", "note"]

CODES = {
    "failed": "the run ended by an exception of the filter",
    "sensor_frozen": "a sensor's readings stick at one value while another sensor shows motion",
    "sensor_silent": "a sensor stops giving readings, or pauses for far longer than its interval",
    "sensor_saturated": "readings pile up at the end of the sensor's range",
    "used_twice": "one reading is taken in as two",
    "overconfident": "innovations (NIS) or errors (NEES) are larger than the covariance says",
    "underconfident": "innovations (NIS) or errors (NEES) are smaller than the covariance says",
    "biased_innovation": "innovations lie off zero on one side",
    "coloured_innovation": "an innovation tells of the next one: something systematic is left in them",
    "outliers": "more readings lie far off than the noise allows",
    "gate": "a gate refuses too many readings, is locked out, or lets pass what it should refuse",
    "diverged": "error or NIS leaves its bounds and does not come back",
    "stamps": "gaps, duplicates or steps back in time; a dt that is not the stamps' difference",
    "lag": "a sensor's readings are constantly late or early against the state",
    "covariance": "a covariance that is not symmetric, not positive definite, ill-conditioned, collapsed or boundless",
    "unobservable_update": "an update gains information on a direction that its sensor cannot see",
    "angle_wrap": "innovations near a full turn, quaternions off the sphere, or sign flips",
    "units_or_axes": "swapped axes, a sign or another unit would explain the readings",
    "process_model": "the prediction does not move the state as the truth moves: a factor, a sign or a drift",
    "update": "an update does not do what its own numbers say: residual, S, gain, mean or covariance",
    "prediction": "a prediction does not do what its own numbers say: its covariance is not F·P·Fᵀ + Q",
    "start": "the first belief is further from the truth than its covariance says",
    "jacobian": "a Jacobian is not the derivative of the model that it stands for",
    "noisy_prediction": "the prediction moves the mean at random: a sample of the noise was added to it",
    "weights": "particles' weights do not follow from what they are made of, or copies not from the weights",
    "particles_collapsed": "hardly any distinct particles or weights are left",
    "particles_far": "no particle is where the readings are",
    "particles_clamped": "particles are held at a bound",
    "several_modes": "the particles form several clouds, between which the mean lies",
    "untested": "nothing that is recorded tells whether the filter is right",
    "icp_not_converged": "the iterations ended before the matches repeated",
    "icp_few_matches": "hardly any points have a match",
    "icp_rmse_rises": "the matches' RMSE rises while their number does not",
}
# What may follow from what: an error of one tier makes those of later ones follow from it. First what the sensors, the
# stamps and the filter's own numbers are; then what the models take them for; what is refused; what is off in time, and
# on the average; last what all of these do to innovations and errors.
_LATER = (
    {"units_or_axes", "process_model", "start"},
    {"gate"},
    {"lag"},
    {"biased_innovation"},
    {"overconfident", "underconfident", "coloured_innovation", "outliers", "diverged"},
)
SYMPTOMS = _LATER[-1]
_ORDER: tuple[Severity, ...] = ("error", "warning", "note")

_BUDGET: dict[Severity, float] = {"error": 1e-4, "warning": 0.05}  # false alarms a run
GROSS = 2.0  # the factor on a variance from which on it is an error
EXPLAINED = 1 - 1 / GROSS  # of a misfit, by its cause: without that the squares are wrong by less than GROSS
SHEET = 0.05  # of a factor: what a gyro's or a wheel's data sheet leaves to a calibration
HALF_THE_DIGITS = float(np.sqrt(np.finfo(float).eps))  # what is beyond is no rounding that piled up
SOLVABLE = SHEET / (8 * float(np.finfo(float).eps))  # the condition κ by which a solve loses 8·ε·κ (Higham 2002, 7.2)
ODDS = 20.0  # by which one cause must be likelier than another to be named alone: strong (Kass and Raftery 1995)
_FAMILIES = 36  # checks that may warn by chance: each has an equal share, and shares it out among what it tests
# Readings: as many as the plainest test, that of signs, needs for an error's share, 2⁻ⁿ. Of fewer no test tells much;
# it silences checks, and no alarm comes of it.
FEWEST = int(np.ceil(np.log2(_FAMILIES / _BUDGET["error"])))
REPEATED = 3  # times that something without chance in it must be seen, so that a single odd one is not the middle
MOST = 40  # parts of one sensor, or faults at once, that are looked at: of more it costs much and tells the same
# s over which a rate of motion is taken at least: in a shorter time noise of the truth or of an IMU would hide it, in a
# longer one a hand turns round. It decides no rate: windows are held against how they scatter themselves.
WINDOW = 0.1
TINY = 1e-300  # stands for 0 below a line, and is no threshold: its ratio to any number can still be told
LARGEST = float(np.log(np.finfo(float).max))  # logarithm of which there is a number


def at_steps(count: int) -> str:
    return f"at {count} step{'s' * (count != 1)}"


def times(factor: float) -> str:
    """A factor in words: with three digits near 1, where two would say 1×."""
    return f"{factor:.3g}×" if 0.9 < factor < 1.1 else f"{factor:.2g}×"


@dataclass(frozen=True)
class Finding:
    """steps: first and last, inclusive. evidence: numbers by name. cause and remedy speak to a student."""

    code: str
    severity: Severity
    sensor: str | None
    steps: tuple[int, int]
    evidence: dict[str, Any]
    cause: str
    remedy: str

    def to_json(self) -> dict[str, Any]:
        return asdict(self) | {"steps": list(self.steps)}

    @property
    def tier(self) -> int:
        """How far down the chain of causes it stands, from 0."""
        return next((i for i, codes in enumerate(_LATER, 1) if self.code in codes), 0)

    @property
    def order(self) -> tuple[int, int, int]:
        """Errors first, then by when it began; of one step, causes before what follows from them."""
        return _ORDER.index(self.severity), self.steps[0], self.tier


def level(severity: Severity, tests: int) -> float:
    """The p below which one of a check's `tests` in this run is a finding of the severity."""
    return _BUDGET[severity] / _FAMILIES / max(1, tests)


def by_ratio(gain: float) -> float:
    """A bound on the p of a gain in log-likelihood: a ratio beyond 1/α comes with the chance α at most (Ville 1939)."""
    return float(np.exp(-max(gain, 0.0)))


class Chance(NamedTuple):
    """A p by a noise that is white, as the filter takes it to be, and one that holds where it is coloured too."""

    white: float
    coloured: float


def judge(p: float | Chance, tests: int, *, large: bool | float | Chance) -> Severity | None:
    """What a test's p makes it, of `tests` in this run: an error only where the effect is large too.

    large: whether it is, or the p of data in which it is just as large as an error's. Of a `Chance` errors keep to
    their share where noise is white, and where it is coloured to that of warnings, as warnings do in both.
    """
    if not np.max(p) < level("warning", tests):  # also NaN
        return None
    sure = large if isinstance(large, bool | np.bool_) else _sure(large, tests)
    return "error" if sure and _sure(p, tests) else "warning"


def _sure(p: float | Chance, tests: int) -> bool:
    white, coloured = p if isinstance(p, Chance) else (p, 0.0)
    return bool(white < level("error", tests) and coloured < level("warning", tests))
