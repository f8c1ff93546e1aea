"""Do particles weigh readings by the noise that these have? By the likelihoods' own variance, against the truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from viz_estim.core.consistency import squared_distance
from viz_estim.diagnosis.against import against
from viz_estim.diagnosis.confidence import size
from viz_estim.diagnosis.evidence import Case
from viz_estim.diagnosis.finding import Finding, judge
from viz_estim.diagnosis.naming import likeliest


def noises(case: Case) -> Iterator[Finding]:
    """The sum of (r − r̄)²/R over a sensor's readings, which is χ² if its noise is what the likelihood takes it for.

    Of particles alone, for other filters' innovations tell it without a truth. Told where R is too small: a larger one
    is what particles need where they are few. Large is GROSS, as of any variance (`confidence.size`).
    """
    if case.run.properties.get("belief") != "Particles":
        return
    by_name: dict[str, list[np.ndarray]] = {}
    variance: dict[str, list[float]] = {}
    steps: dict[str, tuple[int, int]] = {}
    dof: dict[str, int] = {}
    for one in against(case):
        name = one.name.partition("/")[0]
        apart = one.r - one.r.mean(0)  # a bias is no noise, and is told for itself
        by_name.setdefault(name, []).append(squared_distance(apart, one.noise))
        variance.setdefault(name, []).append(float(np.trace(one.noise[0]) / len(one.noise[0])))
        steps[name], dof[name] = (int(one.step[0]), int(one.step[-1])), one.r.shape[1]
    for name, found in by_name.items():
        factor, p, p_gross = size(np.concatenate(found), dof[name], len(by_name))
        severity = judge(p, len(by_name), large=p_gross) if factor > 1 else None
        if severity:
            R, n = float(np.mean(variance[name])), sum(map(len, found)) * dof[name]
            as_if = likeliest(factor, _mistakes(R), factor * float(np.sqrt(2 / n)))
            yield Finding(
                "overconfident", severity, name, steps[name],
                {"factor_on_R": factor, "sigma": R**0.5, "p": p, "against": "truth"},
                f"the likelihood takes the noise of {name} for σ = {R**0.5:.3g}, and against the truth it is "
                f"{(R * factor) ** 0.5:.3g}" + (f": as where {', or '.join(as_if)}" if as_if else ""),
                f"weigh {name} by exp(−r²/2σ²) once, with σ of about {(R * factor) ** 0.5:.2g}",
            )  # fmt: skip


def _mistakes(R: float) -> dict[str, float]:
    """The factors by which R is too small if it is the likelihood of another number."""
    return {
        "the likelihood is multiplied twice": 2.0,
        "σ² stands where σ belongs": R**-0.5,
        "σ stands where σ² belongs": R,
    }
