"""Does the prediction move the state as the truth moves? Its sign, its unit, its scale and its drift, by component."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO2, SO3, Euclidean, wrap
from viz_estim.diagnosis import clouds, directions, forces, turning
from viz_estim.diagnosis.against import slip as bound
from viz_estim.diagnosis.durations import composed, whole
from viz_estim.diagnosis.evidence import Case, once
from viz_estim.diagnosis.finding import (
    EXPLAINED,
    FEWEST,
    GROSS,
    HALF_THE_DIGITS,
    ODDS,
    SHEET,
    TINY,
    WINDOW,
    Chance,
    Finding,
    by_ratio,
    judge,
)  # fmt: skip
from viz_estim.diagnosis.fits import slope
from viz_estim.diagnosis.linear import transitions
from viz_estim.diagnosis.naming import SIGNS, likeliest, named, of_motion
from viz_estim.recording.tables import StageTable
from viz_estim.scenarios.imu_health import GRAVITY

_Told = list[tuple[float, Finding]]
_Moving = dict[int, tuple[Array, Array, np.ndarray]]  # by component: the truth's motion, the predicted one, and steps


def predictions(case: Case) -> list[Finding]:
    """What `prediction` finds, once for whoever asks."""
    return once(case, "_motion", lambda case: list(prediction(case)))


def prediction(case: Case) -> Iterator[Finding]:
    """By component of the state: Δ = c·Δ' + b·dt, with Δ the truth's motion and Δ' the one that is predicted from it.

    Δ' = Δ − w has no noise of the truth in it but what F carries, so that c is not pulled to zero. A sound prediction
    has c = 1 and b = 0: t-tests, with a variance by 20 stretches of the run (Liang and Zeger 1986).
    """
    run = case.run
    if run.labels:
        return
    if (carried := clouds.moves(case)) is not None:
        yield from _of_a_cloud(case, carried)
        return
    moves = [(table, F) for table in run.stages.values() if (F := transitions(case, table)) is not None]
    if not np.isfinite(run.truth).any():
        return
    if by_imu := [*forces.forces(case), *turning.turned(case)]:  # by an accelerometer, by a gyro, or by both
        yield replace(by_imu[0], cause="; and ".join(f.cause for f in by_imu))
        return
    moved = clouds.moves_of_means(case)
    if moved is not None and (exchanged := _exchanged(moved.truly, moved.told, moved.step)) is not None:
        yield _by_estimate(exchanged)
        return
    if len(moves) != 1:
        yield from map(_by_estimate, _elsewhere(case))
        return
    told_of, moving = _by_component(case, *moves[0])
    for name in case.space.parts:
        found, told_of = _as_a_whole(case, name, moving, told_of)
        if found is not None:
            yield found
            return
    yield from _best(told_of) if told_of else map(_by_estimate, _elsewhere(case))


def _by_component(case: Case, table: StageTable, F: Array) -> tuple[_Told, _Moving]:
    """What is wrong with a component's motion in a stage with the transitions F (M, d, d), and how much that explains;
    and the motions of components by number."""
    run, row = case.run, {int(step): k for k, step in enumerate(case.run.step)}
    by = whole(case, table)
    before, step, F = by.before, by.step, composed(F, by)
    at = np.array([row[int(k)] for k in step])
    ok = (at > 0) & (step > case.first)
    now, past = run.truth[at], run.truth[np.maximum(at - 1, 0)]
    error, after = case.space.minus(past, before), case.space.minus(now, by.after)
    size = np.abs(np.nan_to_num(F))
    needed = np.asarray((size > HALF_THE_DIGITS * size.max(2, keepdims=True)).any(0))  # to what F is known
    d = len(case.space.axes)
    told_of: list[tuple[float, Finding]] = []
    moving: _Moving = {}
    parts = [(name, i) for name, axes in case.space.axes_at.items() for i in range(axes.start, axes.stop)]
    for name, i in parts:
        known = np.asarray(np.isfinite(error[:, needed[i]]).all(1) & np.isfinite(after[:, i]) & ok)
        known &= np.isfinite(F[:, i]).all(1)
        if known.sum() < FEWEST:
            continue
        w = after[known, i] - np.einsum("td,td->t", F[known, i][:, needed[i]], error[known][:, needed[i]])
        if isinstance(case.space.parts[name], SO2):
            w = wrap(w)
        motion = case.space.minus(now, past)[known, i]
        told, dt = motion - w, run.dt[at[known]]
        slip = bound(F[known][:, i : i + 1], np.nan_to_num(error[known]), before[known], case.space)
        near = np.isfinite(slip) & (dt > 0)
        if near.sum() >= FEWEST:
            of = step[known][near]
            moving[i] = told[near] + w[near], told[near], of
            axis, unit = case.space.axes[i].rpartition(".")[2], case.space.axis_units[i]
            label = name if axis in ("", name, "angle") else f"{name} {axis}"
            told_of += _moves_as(label, unit, of, w[near], told[near], dt[near], slip[near], 2 * d, by.times)
    return told_of, moving


def _as_a_whole(case: Case, name: str, moving: _Moving, told_of: _Told) -> tuple[Finding | None, _Told]:
    """Of an attitude or a vector, what is wrong with its motion in all directions together; and what is told of each
    component, as far as it is of all."""
    run, part = case.run, case.space.parts[name]
    axes = range(case.space.axes_at[name].start, case.space.axes_at[name].stop)
    if not all(i in moving and np.array_equal(moving[i][2], moving[axes[0]][2]) for i in axes):
        return None, told_of
    truly, told = (np.stack([moving[i][k] for i in axes], axis=-1) for k in (0, 1))
    of = moving[axes[0]][2]
    if isinstance(part, SO3):
        return turning.turns_as(name, truly, told, of), told_of
    if not (isinstance(part, Euclidean) and len(set(part.axis_units)) == 1 and 2 <= len(axes) <= 3):
        return None, told_of
    headings = [case.space.at[other] for other, of_it in case.space.parts.items() if isinstance(of_it, SO2)]
    heading = run.truth[np.searchsorted(run.step, of) - 1, headings[0]][:, 0] if len(headings) == 1 else None
    heading = heading if heading is not None and np.isfinite(heading).all() else None
    own = {name if axis in ("", name) else f"{name} {axis}" for axis in part.axes}
    of_all = [
        (share, directions.of_all(f, name, truly, told) if f.evidence["component"] in own else f)
        for share, f in told_of
    ]
    return directions.turned(name, truly, told, heading, of), of_all


def _by_estimate(finding: Finding) -> Finding:
    """Marked, for the mean may be moved by what it holds too, a bias or a rate, which wrong readings have taught it."""
    return replace(finding, evidence=finding.evidence | {"by_estimate": True})


def _elsewhere(case: Case) -> Iterator[Finding]:
    """The same in the body's axes, also of an estimate that has gone far from the truth."""
    if (found := clouds.turns_of_means(case, WINDOW)) is not None:
        name, (of, truly, told), _ = found
        one, none = np.ones(len(of)), np.zeros(len(of))  # by window, which are all as long
        told_of: list[tuple[float, Finding]] = []
        for i, axis in enumerate("xyz"):
            told_of += _moves_as(f"{name} {axis}", "rad", of, truly[:, i] - told[:, i], told[:, i], one, none, 6)
        if any(list(part.axis_units) == ["rad/s"] * 3 for part in case.space.parts.values()):
            # A bias that is part of the state may have been taught by wrong readings, and drifts as it says.
            told_of = [entry for entry in told_of if "drift" not in entry[1].evidence]
        yield from _best(told_of)
    if (moved := clouds.moves_of_means(case)) is not None:
        yield from _of_a_cloud(case, moved)


def _of_a_cloud(case: Case, carried: clouds.Moves) -> Iterator[Finding]:
    """The same of a planar robot, in its body's frame."""
    dt = case.run.dt[np.searchsorted(case.run.step, carried.step)]
    rows = dt > 0
    if rows.sum() < FEWEST:
        return
    if (exchanged := _exchanged(carried.truly[rows], carried.told[rows], carried.step[rows])) is not None:
        yield exchanged
        return
    none = np.zeros(int(rows.sum()))
    told_of: list[tuple[float, Finding]] = []
    for i, label, unit in ((2, "heading", "rad"), (0, "the way ahead", "m"), (1, "the way to the left", "m")):
        if i == 1 and any(f.severity == "error" for _, f in told_of):
            continue  # it goes to the left by how it turns and how far ahead it goes
        told, truly = carried.told[rows, i], carried.truly[rows, i]
        told_of += _moves_as(label, unit, carried.step[rows], truly - told, told, dt[rows], none, 6)
    yield from _best(told_of)


def _exchanged(truly: Array, told: Array, of: np.ndarray) -> Finding | None:
    """The way ahead predicted as the turn and the turn as the way ahead, by what is left of each (M, 3)."""
    own = np.square(truly - told)[:, [0, 2]].sum(0)
    left = np.square(truly - told[:, [2, 1, 0]])[:, [0, 2]].sum(0)
    explained = float(np.mean(1 - left / np.maximum(own, TINY)))
    gain = 0.5 * len(truly) * float(np.log(own / np.maximum(left, TINY)).sum())
    if explained < EXPLAINED or judge(by_ratio(gain), 1, large=True) != "error":
        return None
    return Finding(
        "process_model", "error", None, (int(of[0]), int(of[-1])),
        {"component": "control", "map": "exchanged", "explained": explained, "against": "truth"},
        f"the prediction goes ahead by what the truth turns by, and turns by what it goes ahead ({explained:.0%} of "
        "the difference): speed and turn rate are exchanged",
        "check the order in which the prediction takes the speed and the turn rate",
    )  # fmt: skip


def _best(told_of: list[tuple[float, Finding]]) -> Iterator[Finding]:
    """One cause shows in several components: the one that it explains best is told, and of those that it explains as
    well the highest derivative, which moves the others."""
    told_of = sorted(
        told_of,
        key=lambda one: (one[1].severity != "error", -round(one[0], 2), -order(one[1].evidence.get("unit", ""))),
    )
    if told_of:
        also = [f.evidence for _, f in told_of[1:]]
        yield replace(told_of[0][1], evidence=told_of[0][1].evidence | ({"also": also} if also else {}))


def order(unit: str) -> int:
    """Which derivative a unit is of, by its seconds: of m/s² the second."""
    return 2 if unit.endswith("/s²") else 1 if unit.endswith("/s") else 0


def _moves_as(
    label: str, unit: str, of: np.ndarray, w: Array, told: Array, dt: Array, slip: Array, tests: int, times: int = 1
) -> Iterator[tuple[float, Finding]]:
    """w = (c − 1)·Δ' + b·dt: which of the two is off, if any. By rates, so that a long step counts like others. Large
    is what is more than 5 % of the motion off, for sure.

    Noise of the control pulls the slope of Δ on Δ' to zero, noise of the motion that of Δ' on Δ: the factor lies
    between the two, and where 1 does too there is none.
    """
    w, told, slip = w / dt, told / dt, slip / dt
    one, truly = np.ones_like(told), told + w
    steady, forth, aback = slope(w, one), slope(w, told), slope(-w, truly)
    drift, beta, back, left_drift, left_factor = steady.value, forth.value, aback.value, steady.left, forth.left
    ends = 1 / (1 + beta) if beta != -1 else np.inf, 1 + back
    by_factor = left_factor < left_drift
    share = 1 - min(left_factor, left_drift) / max(float((w**2).sum()), TINY)
    explains = abs(beta) * float(np.sqrt(np.mean(told**2))) if by_factor else abs(drift)
    if explains < GROSS * float(np.sqrt(np.mean(slip**2))):  # which bounds what it does to a slope (`truth.sensors`)
        return
    steps = int(of[0]), int(of[-1])
    if by_factor:
        if (ends[0] - 1) * (ends[1] - 1) <= 0:
            return
        # Of what is predicted, against what happens: the end that has a name, or the more careful one.
        told_as = of_motion(unit, float(np.median(dt)), times)
        both = (ends[0], forth.error * ends[0] ** 2), (ends[1], aback.error)
        known = [(f, error) for f, error in both if likeliest(f, told_as, error)]
        factor, error = known[0] if known else min(both, key=lambda one: abs(one[0] - 1))
        if abs(np.log(factor)) < np.log1p(SHEET) if factor > 0 else False:
            return  # as good as 1
        p, beyond = (Chance(*np.maximum(forth.p(size), aback.p(size))) for size in (0.0, SHEET))
        severity = judge(p, tests, large=beyond)
        cause = f"{label} is predicted to move by {factor:.3g}× what it does: {named(factor, told_as, error)}"
        todo = f"its sign, its unit, its calibration (divide it by {factor:.3g})"
        todo = "change its sign" if likeliest(factor, told_as, error) in SIGNS else todo
        remedy = f"look at what moves {label}, a control or a rate: {todo}"
        evidence: dict[str, object] = {"component": label, "factor": factor, "p": max(p)}
    else:
        p_drift = steady.p()
        severity = judge(p_drift, tests, large=steady.p(SHEET * float(np.abs(told).mean())))
        rate = f"{unit}²" if unit.endswith("/s") else f"{unit}/s"
        cause = (
            f"the prediction misses a steady {drift:+.3g} {rate} of {label}: what moves it, a control or a rate, has "
            "a bias, or a force is missing from the model"
        )
        if 0.5 * len(w) * np.log(left_factor / max(left_drift, TINY)) < np.log(ODDS):  # it was always told the same
            turned = likeliest(ends[0], of_motion(unit, 0.0), forth.error * ends[0] ** 2) in SIGNS
            it = "its sign is wrong" if turned else f"it moves by {ends[0]:.3g}× what it does"
            cause += f"; or {it}, which looks alike at one speed"
        remedy = f"calibrate that bias ({drift:+.3g} {rate}), or add it to the state and let the filter estimate it"
        for times, what in ((1, "not added, or added twice"), (2, "added with the wrong sign")):
            if rate == "m/s²" and abs(abs(drift) / (times * GRAVITY) - 1) < SHEET:
                cause += f"; as much as where gravity is {what}"
                remedy = f"check the sign of gravity and that it is there once: a = R·f + (0, 0, −9.81); else {remedy}"
        evidence = {"component": label, "drift": drift, "unit": rate, "p": max(p_drift)}
    if severity:
        yield share, Finding("process_model", severity, None, steps, evidence | {"against": "truth"}, cause, remedy)
