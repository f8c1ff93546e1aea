"""What is wrong with a filter, since when, on what evidence, and what to try: from its recording alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from viz_estim.diagnosis import (
    clocks,
    confidence,
    copies,
    covariance,
    durations,
    errors,
    gates,
    geometry,
    icp,
    innovations,
    kinematics,
    mirrored,
    models,
    motion,
    particles,
    places,
    predictions,
    repeats,
    sensors,
    signatures,
    stamps,
    truth,
    updates,
    weighing,
    weights,
)  # fmt: skip
from viz_estim.diagnosis.evidence import Case, case
from viz_estim.diagnosis.finding import CODES, SYMPTOMS, Finding
from viz_estim.diagnosis.ranking import ranked
from viz_estim.errors import one_line
from viz_estim.recording import schema
from viz_estim.recording.links import link
from viz_estim.recording.marks import Mark
from viz_estim.recording.reader import Run

OF_SENSORS: tuple[Callable[[Run], Iterator[Finding]], ...] = (
    sensors.frozen,
    sensors.silent,
    repeats.used_twice,
    repeats.one_for_two,
    sensors.biased_at_rest,
    stamps.stamps,
)
OF_FILTERS: tuple[Callable[[Case], Iterator[Finding]], ...] = (
    innovations.biased,
    innovations.coloured,
    innovations.outliers,
    gates.gates,
    innovations.diverged,
    innovations.lost,
    signatures.lags,
    signatures.biases,
    errors.untested,
    errors.start,
    truth.sensors,
    weighing.noises,
    places.exchanged,
    errors.by_part,
    covariance.broken,
    updates.updates,
    predictions.predictions,
    covariance.claims,
    covariance.bounds,
    covariance.unobservable,
    models.measured,
    models.predicted,
    geometry.wraps,
    geometry.quaternion_norms,
    geometry.units_or_axes,
    clocks.clock,
    durations.carried,
    copies.together,
    copies.weighed_again,
    weights.forgotten,
    weights.drawn,
    particles.collapsed,
    particles.clamped,
    particles.far,
    particles.several_modes,
    icp.not_converged,
    icp.few_matches,
    icp.rising,
    icp.settled,
    mirrored.mirrored,
)


_TIMES = 3  # the tier of what is off in time: of what is no matter of a noise


def diagnose(run: Run) -> list[Finding]:
    """The findings of a run, errors first, then by their first step.

    Steps at which a sensor is found frozen are left out of what is said of the filter.
    """
    with np.errstate(all="ignore"):
        found = [finding for check in OF_SENSORS for finding in check(run)]
        found = _without_a_wrong_gyro_s(run, found)
        faulty = [f.steps for f in found if f.code == "sensor_frozen"]
        found += sensors.saturated(run, faulty)
        found += _failure(run)
        under_test = case(run, faulty)
        for check in OF_FILTERS:
            found += check(under_test)
        odd = (*SYMPTOMS, "biased_innovation", "particles_far", "particles_collapsed")
        if any(f.severity != "note" and f.code in odd for f in found) or not errors.has_covariance(under_test):
            found += motion.predictions(under_test)  # else the filter knows how wrong it is
        # Noises are tuned once nothing else is wrong: until then a factor on them would only hide it.
        causes = [f for f in ranked(found) if f.severity == "error" and f.tier <= _TIMES and f.code != "start"]
        found += confidence.by_sensor(under_test, tune=not causes)
    return sorted(_once(ranked(found)), key=lambda finding: finding.order)


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


def _without_a_wrong_gyro_s(run: Run, found: list[Finding]) -> list[Finding]:
    """Without an accelerometer's freeze that a gyro of wrong units or axes made look like one."""
    stuck = [f for f in found if (f.code, f.sensor) == ("sensor_frozen", "accel")]
    if stuck and any(f.sensor == "gyro" for f in kinematics.imu_axes(case(run))):
        return [f for f in found if f not in stuck]
    return found


def _failure(run: Run) -> list[Finding]:
    if run.error is None:
        return _no_number(run)
    step = int(run.step[-1])
    return [
        Finding(
            "failed",
            "error",
            None,
            (step, step),
            {"message": run.error},
            f"the filter raised at {one_line(run.error)}",
            f"`viz-estim debug FILE` opens at step {step}, with the stages that came before the failure",
        )
    ]


def _no_number(run: Run) -> list[Finding]:
    """A belief that was recorded as NaN or infinity, by a loop that went on nevertheless."""
    if run.labels or "particles" in run.properties:
        return []
    told = run.properties.get("covariance", True)  # else it is NaN throughout
    lost = np.flatnonzero(~(np.isfinite(run.mean).all(1) & (np.isfinite(run.cov).all((1, 2)) | (not told))))
    if not len(lost):
        return []
    step, last = int(run.step[lost[0]]), int(run.step[lost[-1]])
    stage = next(
        table.name for table, row in run.at(step) if not np.isfinite([*table.mean[row], *table.cov[row].flat]).all()
    )
    return [
        Finding(
            "failed",
            "error",
            None,
            (step, last),
            {"stage": stage, "steps": len(lost)},
            f"from step {step} on, after {stage}, the belief is no number (NaN or infinity)",
            f"go to step {step}: what the stages before it hold tells what was divided by zero, overflowed, or had no "
            "Cholesky factor",
        )
    ]


def _once(found: list[Finding]) -> Iterator[Finding]:
    """One finding per code, sensor and interval: the most severe, with the evidence of the others under `also`."""
    alike: dict[tuple[Any, ...], list[Finding]] = {}
    for finding in sorted(found, key=lambda finding: finding.order):
        alike.setdefault((finding.code, finding.sensor, finding.steps), []).append(finding)
    for first, *others in alike.values():
        also = {"also": [other.evidence for other in others]} if others else {}
        yield Finding(**(vars(first) | {"evidence": first.evidence | also}))
