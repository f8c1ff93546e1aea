"""Which finding is the cause, and which follow from it."""

from __future__ import annotations

from dataclasses import replace

from viz_estim.core.distributions import chi2
from viz_estim.diagnosis.finding import SYMPTOMS, Finding, Severity, level

_SENT = ("particles_far", "particles_collapsed")  # particles go where the readings and the motion send them


def ranked(found: list[Finding]) -> list[Finding]:
    """What follows from another finding is a warning at most, so that the cause comes first.

    Symptoms follow from any cause; a cause follows from one of an earlier tier of the same sensor, or of none. What the
    truth says of a sensor's bias or lag stands in place of what innovations make of it, but not where its Jacobian, by
    which the truth is brought to it, is wrong.
    """
    wrong = {f.sensor for f in found if f.code == "jacobian"}
    found = [f for f in found if not (f.evidence.get("against") == "truth" and f.sensor in wrong and f.sensor)]
    seen = {(f.code, f.sensor) for f in found if f.evidence.get("against") == "truth"}
    found = [f for f in found if f.evidence.get("against") == "truth" or (f.code, f.sensor) not in seen]
    if any(f.severity == "error" and f.code == "biased_innovation" and "bias" in f.evidence for f in found):
        # Which sensor's bias explains the innovations is known: those of others lie off for it.
        best = next(
            f for f in found if f.code == "biased_innovation" and f.severity == "error" and "bias" in f.evidence
        )
        others = [f.code == "biased_innovation" and "bias" not in f.evidence for f in found]
        found = [_softened(f, best) if other else f for f, other in zip(found, others, strict=True)]
    found = [_of_the_noise(f, found) if f.code == "start" else f for f in found]
    found = _as_large_as_their_errors(found)
    errors = [f for f in found if f.severity == "error" and f.code != "sensor_silent"]
    first = sorted(errors, key=lambda finding: finding.tier)  # the cause at the root is what is to be mended
    return [_softened(f, next((c for c in first if _follows(f, c)), None)) for f in found]


def _as_large_as_their_errors(found: list[Finding]) -> list[Finding]:
    """What no chance is in is an error where only what follows from it is one: information from nowhere, and stages
    that do not do what their own numbers say, which may each be off by little and add up."""
    errors = [f for f in found if f.severity == "error"]
    if not errors or any(f.code not in SYMPTOMS for f in errors):
        return found
    of = {f.sensor for f in errors}

    def causes(f: Finding) -> bool:
        exact = f.code in ("prediction", "update", "jacobian") or f.evidence.get("kind") == "claims"
        shown = f.sensor in of or None in of or (exact and f.sensor is None)
        return f.severity == "warning" and (exact or f.code == "unobservable_update") and shown

    return [replace(f, severity="error") if causes(f) else f for f in found]


def _of_the_noise(start: Finding, found: list[Finding]) -> Finding:
    """A start that was made of readings is as far off as their R is too small: then that is the cause."""
    for f in found:
        factor, by_R = f.evidence.get("factor_on_R"), f.evidence.get("gain_by_R", 0.0)
        held = factor and chi2.sf(start.evidence["nees"] / factor, start.evidence["dof"]) > level("warning", 1)
        if f.code == "overconfident" and held and by_R >= f.evidence.get("gain_by_Q", 0.0):
            return _softened(start, f)
    return start


def _follows(finding: Finding, cause: Finding) -> bool:
    if finding.code in SYMPTOMS and cause.code in SYMPTOMS:
        # Errors of the state, from innovations of another size; and that these follow one another.
        size = cause.code in ("overconfident", "outliers") and "part" not in cause.evidence
        return size and ("part" in finding.evidence or finding.code == "coloured_innovation")
    if finding.code in _SENT and cause.evidence.get("against") == "truth":
        return True
    if cause.code in _SENT and finding.evidence.get("against") == "truth":
        return False
    if finding.code == "start" and cause.code == "units_or_axes" and _of_readings(cause):
        return True  # which it may be made of
    if finding.code == "process_model" and _of_the_gyro(cause):
        return True  # which moves the prediction
    if cause.code == "process_model" and _of_the_gyro(finding):
        return False
    if "by_control" in finding.evidence and cause.code == "process_model" and "map" in cause.evidence:
        return True  # which a model of readings takes too
    by_innovations = finding.code == "units_or_axes" and "against" not in finding.evidence and not _of_the_gyro(finding)
    if by_innovations and cause.code == "process_model" and "by_estimate" not in cause.evidence:
        return True  # which sends the estimate elsewhere, so that readings look as if of another unit
    if "by_estimate" in finding.evidence and _of_readings(cause):
        return True
    if "by_estimate" in cause.evidence and _of_readings(finding):
        return False
    if finding.tier <= cause.tier:
        return False
    anywhere = finding.code in SYMPTOMS or cause.code == "sensor_frozen"
    return anywhere or finding.sensor == cause.sensor or None in (finding.sensor, cause.sensor)


def _of_readings(cause: Finding) -> bool:
    """Whether a sensor is found wrong against the truth."""
    return cause.sensor is not None and cause.evidence.get("against") == "truth"


def _of_the_gyro(cause: Finding) -> bool:
    """Whether a gyro is found wrong by itself, at rest or against gravity, whatever the filter makes of it."""
    alone = "at_rest" in cause.evidence or cause.code == "units_or_axes"
    return cause.sensor == "gyro" and alone and "against" not in cause.evidence


def _softened(finding: Finding, cause: Finding | None) -> Finding:
    """A warning at most, with what to mend before it, if it follows from another."""
    if cause is None:
        return finding
    name = cause.code + (f" of {cause.sensor}" if cause.sensor else "")
    remedy = (
        finding.remedy if finding.remedy.startswith("mend ") else f"mend {name} first; if this stays: {finding.remedy}"
    )
    severity: Severity = "warning" if finding.severity == "error" else finding.severity
    return replace(finding, severity=severity, remedy=remedy)
