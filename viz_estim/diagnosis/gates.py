"""Does a gate refuse as many readings as it says, neither nearly all nor none?

A gate of the probability g passes ν with νᵀS⁻¹ν ≤ χ²(g): of N good readings it refuses Binomial(N, 1 − g) (Bar-Shalom,
Li and Kirubarajan 2001, section 5.4; Blackman and Popoli 1999, section 6.3).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.distributions import binom, chi2
from viz_estim.diagnosis.evidence import Case, Readings, parameter
from viz_estim.diagnosis.finding import GROSS, HALF_THE_DIGITS, SHEET, Finding, judge, level
from viz_estim.diagnosis.innovations import gate_name
from viz_estim.diagnosis.outlying import outlying


def gates(case: Case) -> Iterator[Finding]:
    """A gate that refuses too many, is locked out, refuses fewer than it says, or none where there are outliers.

    Too many: surely more than the share SHEET, for to throw away so many makes a variance larger by it. An error where
    half of the readings are lost for sure, for then the variance that they leave is larger by GROSS. Locked out: so
    long a row of refusals, to the end, as comes by chance with N·qⁿ, q = 1 − g where that is known, and at least SHEET.
    """
    for name, readings in case.sensors.items():
        refused = ~readings.used
        N, count, stated = len(readings), int(refused.sum()), _stated(case, readings)
        if count:
            first, length = _longest(refused)
            q = max(1 - stated if stated else 0.0, SHEET)
            p = float(binom.sf(count - 1, N, SHEET))
            p_row = min(1.0, N * q**length) if first + length == N else 1.0
            locked = p_row < level("error", 4 * len(case.sensors))
            p_half = float(binom.sf(count - 1, N, 1 - 1 / GROSS))
            severity = judge(min(p, p_row), 4 * len(case.sensors), large=locked or p_half)
            if severity:
                start = first if locked else int(np.argmax(refused))
                steps = int(readings.step[start]), int(readings.step[np.flatnonzero(refused)[-1]])
                evidence = {"refused": count, "readings": N, "longest_row": length, "p": min(p, p_row)}
                how = f"the gate of {name} refuses {count} of {N} readings"
                yield Finding("gate", severity, name, steps, evidence, *_narrow(case, name, how, steps[0], locked, q))
                continue
        if stated:
            yield from _wide(case, readings, stated)


def _stated(case: Case, readings: Readings) -> float | None:
    """The probability with which the sensor's gate says that a good reading passes, where the scenario tells."""
    known = parameter(case.run, f"{readings.name}_gate", "gate")
    g = known[1] if known else None
    return g if isinstance(g, float) and 0 < g < 1 else None


def _narrow(case: Case, name: str, how: str, step: int, locked: bool, q: float) -> tuple[str, str]:
    gate = gate_name(case, name)
    if locked:
        return (
            f"{how}, and from step {step} on all of them: the estimate has left, and can't come back",
            f"set {gate}=none to see what is refused; raise the noises that are too small, then gate again",
        )
    if q > SHEET:
        return (
            f"{how}: it is set to pass no more than {1 - q:.2g} of the good ones",
            f"set {gate}=0.999: a gate is there for readings that the noise can't explain",
        )
    return (
        f"{how}, where 5 % would be many: it is too narrow, or S is too small",
        f"set {gate}=0.999, or none; if readings are then far off, mend the noise of {name} first",
    )


def _wide(case: Case, readings: Readings, g: float) -> Iterator[Finding]:
    """Readings that pass beyond what the gate says it refuses; outliers that it lets pass, though it refuses none; and
    fewer refusals than Binomial(N, 1 − g) has."""
    name, dof, N = readings.name, readings.dof, len(readings)
    refused, gate = int((~readings.used).sum()), gate_name(case, readings.name)
    # Of the same numbers, of which a solve may lose half of the digits, and no more.
    passed = readings.used & (readings.nis > chi2.ppf(g, dof) * (1 + HALF_THE_DIGITS))
    if passed.any():
        rows = np.flatnonzero(passed)
        yield Finding(
            "gate", "warning", name, (int(readings.step[rows[0]]), int(readings.step[rows[-1]])),
            {"passed": len(rows), "refused": refused, "readings": N, "bound": float(chi2.ppf(g, dof))},
            f"{len(rows)} readings of {name} pass though their NIS is above {chi2.ppf(g, dof):.3g}, which {gate}={g:g} "
            f"stands for with {dof} components: the gate compares something else",
            f"refuse where νᵀS⁻¹ν > χ².ppf({g:g}, {dof}): the square, with {name}'s own S and number of components",
        )  # fmt: skip
        return
    far, _, p_far = outlying(readings.nis[readings.used], dof, 2 * len(case.sensors))
    p_few = float(binom.cdf(refused, N, 1 - g))
    if severity := judge(p_far, 4 * len(case.sensors), large=False):
        rows = np.flatnonzero(readings.used)[far]
        steps = int(readings.step[rows[0]]), int(readings.step[rows[-1]])
        evidence = {"passed": len(rows), "refused": refused, "readings": N, "p": p_far}
        yield Finding(
            "gate", severity, name, steps, evidence,
            f"{len(rows)} readings of {name} that lie further off than one in a thousand pass the gate, which refuses "
            f"{refused}: it is too wide for what comes",
            f"set {gate}=0.999 (it is {g:g})",
        )  # fmt: skip
    elif severity := judge(p_few, 4 * len(case.sensors), large=False):
        yield Finding(
            "gate", severity, name, readings.steps,
            {"refused": refused, "expected": N * (1 - g), "readings": N, "p": p_few},
            f"the gate of {name} refuses {refused} of {N} readings, where {gate}={g:g} should refuse about "
            f"{N * (1 - g):.0f} good ones: S is larger than the innovations are, so that it refuses no bad ones either",
            f"lower the noise of {name}, or Q, until NIS is as large as its number of components",
        )  # fmt: skip


def _longest(flags: np.ndarray) -> tuple[int, int]:
    """Start and length of the longest row of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]))).reshape(-1, 2)
    lengths = edges[:, 1] - edges[:, 0]
    best = int(np.argmax(lengths))
    return int(edges[best, 0]), int(lengths[best])
