"""What is wrong with a filter, since when, on what evidence, and what to try: from its recording alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from viz_estim.diagnosis import (
    confidence,
    covariance,
    geometry,
    icp,
    innovations,
    models,
    particles,
    sensors,
    signatures,
    stamps,
)  # fmt: skip
from viz_estim.diagnosis.evidence import Case, case
from viz_estim.diagnosis.finding import CODES, Finding
from viz_estim.recording import schema
from viz_estim.recording.links import link
from viz_estim.recording.marks import Mark
from viz_estim.recording.reader import Run

OF_SENSORS: tuple[Callable[[Run], Iterator[Finding]], ...] = (
    sensors.frozen,
    sensors.silent,
    sensors.used_twice,
    sensors.biased_at_rest,
    stamps.stamps,
)
OF_FILTERS: tuple[Callable[[Case], Iterator[Finding]], ...] = (
    confidence.by_sensor,
    confidence.by_part,
    innovations.biased,
    innovations.coloured,
    innovations.outliers,
    innovations.gates,
    innovations.diverged,
    innovations.lost,
    signatures.lags,
    signatures.biases,
    covariance.broken,
    covariance.bounds,
    covariance.unobservable,
    models.measured,
    models.predicted,
    geometry.wraps,
    geometry.quaternion_norms,
    geometry.units_or_axes,
    particles.collapsed,
    particles.clamped,
    particles.several_modes,
    icp.not_converged,
    icp.few_matches,
    icp.rising,
)
# What only says how well a model fits: while a sensor is at fault, that fault comes first.
_OF_MODELS = {
    "overconfident",
    "underconfident",
    "biased_innovation",
    "coloured_innovation",
    "outliers",
    "diverged",
    "lag",
}
_OF_MODELS |= {"gate", "units_or_axes"}


def diagnose(run: Run) -> list[Finding]:
    """The findings of a run, errors first, then by their first step.

    Steps at which a sensor is found frozen are left out of what is said of the filter; while a sensor is at fault,
    what only tells of the models is a warning at most.
    """
    with np.errstate(all="ignore"):
        found = [finding for check in OF_SENSORS for finding in check(run)]
        faulty = [f.steps for f in found if f.code == "sensor_frozen"]
        found += sensors.saturated(run, faulty)
        at_fault = any(f.code == "sensor_frozen" and f.severity == "error" for f in found)
        found += _failure(run)
        under_test = case(run, faulty)
        for check in OF_FILTERS:
            found += [_softened(finding) if at_fault else finding for finding in check(under_test)]
    return sorted(_once(found), key=lambda finding: finding.order)


def to_json(findings: list[Finding]) -> dict[str, Any]:
    """What `diagnose --json` prints. Healthy is a run without errors and warnings."""
    return {
        "findings": [finding.to_json() for finding in findings],
        "healthy": not any(finding.severity != "note" for finding in findings),
    }


def text(findings: list[Finding]) -> str:
    """The findings as a person reads them."""
    if not findings:
        return "healthy: nothing found"
    lines = []
    for finding in findings:
        first, last = finding.steps
        about = f" {finding.sensor}" if finding.sensor else ""
        lines.append(f"{finding.severity.upper():7} {finding.code}{about}, steps {first}–{last}")
        lines.append(f"        {finding.cause}")
        lines.append(f"        → {finding.remedy}")
    counts = {kind: sum(f.severity == kind for f in findings) for kind in ("error", "warning", "note")}
    return "\n".join([*lines, ", ".join(f"{n} {kind}{'s' * (n != 1)}" for kind, n in counts.items())])


def marks_of(findings: list[Finding]) -> list[Mark]:
    """The findings as they are drawn into a recording, numbered as they are told."""
    return [
        Mark("_".join([f"{i:02}", finding.code, *([finding.sensor] if finding.sensor else [])]), finding.severity,
             finding.steps, f"{_title(i, finding)}: {finding.cause}")
        for i, finding in enumerate(findings, 1)
    ]  # fmt: skip


def markdown(run: Run, findings: list[Finding]) -> str:
    """The findings as the text panel shows them; each one's steps are a link there."""
    if not findings:
        return "**Healthy:** nothing found."
    pieces = []
    for i, (finding, mark) in enumerate(zip(findings, marks_of(findings), strict=True), 1):
        first, last = finding.steps
        begin, end = (float(run.time[run.row(step=step)]) for step in finding.steps)
        when = link(f"steps {first}–{last}, {begin:.2f}–{end:.2f} s", schema.lane(mark.name), begin)
        pieces.append(
            f"**{_title(i, finding)}** ({finding.severity}), {when}\n\n{finding.cause}.\n\n*Try:* {finding.remedy}."
        )
    return "\n\n---\n\n".join(pieces)


def _title(i: int, finding: Finding) -> str:
    return f"{i}. {finding.code}" + (f" {finding.sensor}" if finding.sensor else "")


def codes_text() -> str:
    """Every code and what it means."""
    width = max(map(len, CODES))
    return "\n".join(f"{code:{width}}  {meaning}" for code, meaning in CODES.items())


def _failure(run: Run) -> list[Finding]:
    if run.error is None:
        return []
    step = int(run.step[-1])
    return [
        Finding(
            "failed",
            "error",
            None,
            (step, step),
            {"message": run.error},
            f"the filter raised at {run.error}",
            f"open the recording at step {step}: the stages before the failure are there",
        )
    ]


def _softened(finding: Finding) -> Finding:
    if finding.code in _OF_MODELS and finding.severity == "error":
        return Finding(**(vars(finding) | {"severity": "warning"}))
    return finding


def _once(found: list[Finding]) -> Iterator[Finding]:
    """One finding per code, sensor and interval: the most severe, with the evidence of the others under `also`."""
    alike: dict[tuple[Any, ...], list[Finding]] = {}
    for finding in sorted(found, key=lambda finding: finding.order):
        alike.setdefault((finding.code, finding.sensor, finding.steps), []).append(finding)
    for first, *others in alike.values():
        also = {"also": [other.evidence for other in others]} if others else {}
        yield Finding(**(vars(first) | {"evidence": first.evidence | also}))
