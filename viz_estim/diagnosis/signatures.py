"""What a fault of a sensor would do to the innovations, carried through the filter's own gains: bias and lag.

Willsky and Jones (1976), the generalised likelihood ratio test. A fault δ_k of a reading leaves in the innovation
s_k = δ_k − H·g_k, where g is how far the fault has moved the estimate: g⁺ = g + K·s, g' = F·g. The innovations are
white if the filter is right, so that the fault's size is estimated by b/A, with A = Σ sᵀS⁻¹s and b = Σ sᵀS⁻¹ν, and
b/√A is N(0, 1) where there is no fault. Where innovations are coloured the sum b scatters more: by how much its parts
in 20 stretches of the run say (a cluster-robust variance; Liang and Zeger 1986), and both p count (`finding.Chance`). A
fault that the state soaks up (a constant lag while driving straight) is found by what is left of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from viz_estim.core.distributions import chi2, norm, t
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product, Space
from viz_estim.diagnosis import tuning
from viz_estim.diagnosis.evidence import Case, once, parameter, tells_gain
from viz_estim.diagnosis.finding import EXPLAINED, MOST, TINY, Chance, Finding, judge, level
from viz_estim.diagnosis.fits import in_stretches
from viz_estim.diagnosis.linear import jacobians, straight, transitions
from viz_estim.diagnosis.rounding import sound
from viz_estim.recording.tables import StageTable

# Readings over which a rate of change is taken: backwards, so that it is known before the innovation, which is white to
# it however many they are.
_BACK = 3


class Fault(NamedTuple):
    """A fault's sensor (`range/1`), what it is, its estimated size, its score, and the score by stretches with its
    degrees of freedom."""

    sensor: str
    kind: str
    size: float
    score: float
    by_stretch: float
    dof: int

    def p(self, size: float = 0.0) -> Chance:
        """The chance of such a score where the fault is of this size."""
        share = max(0.0, 1 - size / max(abs(self.size), TINY))
        return Chance(
            float(2 * norm.sf(share * abs(self.score))), float(2 * t.sf(share * abs(self.by_stretch), self.dof))
        )


def lags(case: Case) -> Iterator[Finding]:
    """A constant lag τ of a sensor: its readings are z(t − τ), off by −τ·ż. Large is more than half of a step."""
    found = _tested(case, "lag")
    for fault in found:
        tau, name = fault.size, fault.sensor
        interval = float(np.median(np.diff(case.run.time)))
        severity = judge(fault.p(), len(found), large=fault.p(0.5 * interval))
        if severity is None or abs(tau) < interval or not _likelier(case, fault):
            continue  # less than a step is how the model takes its steps
        if not _straight(case, name, tau):
            continue
        late = "late" if tau > 0 else "early"
        yield Finding(
            "lag", severity, name.partition("/")[0], case.whole,
            {"lag_s": tau, "lag_samples": tau / max(interval, 1e-12), "z": fault.score, "p": max(fault.p())},
            f"readings of {name} come {abs(tau):.3g} s {late} against the rest ({abs(tau) / max(interval, 1e-12):.1f} "
            "samples): a delay of the sensor, another clock, or an index that is one off",
            f"pair {name} by its stamps and not by index; correct its stamps by {-tau:+.3g} s",
        )  # fmt: skip


def _straight(case: Case, name: str, lag: float) -> bool:
    """Whether what a sensor is expected to read goes along a line for so long (`evidence.straight`)."""
    for table in case.run.stages.values():
        space = table.spaces.get("innovation")
        if isinstance(space, Product) and name in space.parts:
            rows = table.values["innovation.offered"][:, list(space.parts).index(name)] > 0
            time = case.run.time[np.searchsorted(case.run.step, table.step[rows])]
            return straight(space.parts[name], table.values["innovation.predicted"][rows, space.at[name]], time, lag)
    return False


def biases(case: Case) -> Iterator[Finding]:
    """A constant bias of one component of a sensor, also where the state soaks up most of it.

    Large is one that doubles the squared error with which the filter foresees the reading, as in `innovations.biased`.
    """
    found = _tested(case, "bias")
    told = set()
    for fault in sorted(found, key=lambda one: -abs(one.score)):
        name = fault.sensor.partition("/")[0]
        axis, unit = fault.kind.removeprefix("bias ").partition(" ")[::2]
        severity = judge(fault.p(), len(found), large=fault.p(_foreseen(case, name, axis)))
        if severity is None or name in told or not _likelier(case, fault):
            continue
        told.add(name)
        known = parameter(case.run, f"{name}_bias")
        remedy = (
            f"set {known[0]}=estimate"
            if known
            else f"subtract it by a calibration, or add a bias of {name} to the state"
        )
        yield Finding(
            "biased_innovation", severity, name, case.whole,
            {"component": axis, "bias": fault.size, "z": fault.score, "p": max(fault.p())},
            f"a constant bias of {fault.size:+.3g} {unit} in {fault.sensor} ({axis}) explains the innovations, which "
            "the state soaks up in part",
            remedy,
        )  # fmt: skip


def _foreseen(case: Case, name: str, axis: str) -> float:
    """√(H·P·Hᵀ) of a sensor's component, in the mean: how well the filter foresees what it would read without noise."""
    readings = case.sensors.get(name)
    if readings is None:
        return 0.0
    i = readings.space.axes.index(axis) if axis in readings.space.axes else 0
    return max(float(np.mean(readings.cov[:, i, i] - readings.noise[:, i, i])), 0.0) ** 0.5


def _likelier(case: Case, fault: Fault) -> bool:
    """Whether the fault, with S as large as what it leaves, explains the innovations better than another R or Q does
    (`tuning`), by the greater likelihood, and is the cause of what they are too large by: a model that is wrong in
    another way looks a little like each. By as much as they are too large for sure, χ²'s quantile at a warning's
    level. It chooses among causes; of false alarms it can but take some away."""
    total = sum(float(r.nis.sum()) for r in case.sensors.values())
    count = sum(r.dof * len(r) for r in case.sensors.values())
    if fault.score**2 < EXPLAINED * (total - chi2.isf(level("warning", 1), count)):
        return False
    left = max(total - fault.score**2 * max(1.0, _misfit(case)), TINY)
    gain = 0.5 * (total - count - count * np.log(left / count))
    return bool(gain >= max((one.gain for one in tuning.factors(case).values()), default=0.0))


def _tested(case: Case, kind: str) -> list[Fault]:
    return [fault for fault in once(case, "_faults", faults) if fault.kind.startswith(kind)]


def faults(case: Case) -> list[Fault]:
    """All faults that the run is tested for; none where its stages do not say how the state moves on."""
    if case.run.labels:
        return []
    moves, updates = {}, {}
    for name, table in case.run.stages.items():
        if (F := transitions(case, table)) is not None:
            moves[name] = F
        elif tells_gain(table):
            updates[name] = _Update(case, table)
        elif name != "start" and "mean" in table.values and name.startswith("predict"):
            return []
    kinds: list[tuple[str, str, Space]] = []
    for update in updates.values():
        for name, part in update.space.parts.items():
            units = part.axis_units
            kinds += [
                (name, f"bias {a if a != name else 'reading'} {u}", part) for a, u in zip(part.axes, units, strict=True)
            ]
            kinds.append((name, "lag", part))
    kinds = list({(name, kind): (name, kind, part) for name, kind, part in kinds}.values())
    column = {(name, kind): j for j, (name, kind, _) in enumerate(kinds)}
    if not kinds or len(kinds) > MOST:
        return []
    q, d = len(kinds), len(case.space.axes)
    for update in updates.values():
        update.prepare(column, q)
    g = np.zeros((d, q))
    for stage in case.sequence.stage:
        if stage is None:
            continue
        table, row = stage
        if table.name in moves:
            g = moves[table.name][row] @ g
        elif table.name in updates:
            update = updates[table.name]
            if update.sound[row]:
                s = update.left[row]
                s -= update.H[row] @ g
                g = g + update.gain[row] @ s
        else:
            g = np.zeros((d, q))
    place, A, b = (np.concatenate(of) for of in zip(*(update.told() for update in updates.values()), strict=True))
    if not np.isfinite(A).all() or not len(A):
        return []
    order, misfit, told = np.argsort(place), max(1.0, _misfit(case)), A.sum(0) > 0
    A, b = A[order][:, told], b[order][:, told]
    size = b.sum(0) / A.sum(0)
    pieces = in_stretches(b - size * A)
    spread = max(len(pieces) - 1, 1)
    error = np.sqrt([A.sum(0) * misfit, np.square(pieces).sum(0) * len(pieces) / spread])
    score = b.sum(0) / np.maximum(error, TINY)
    return [
        Fault(name, kind, float(size[j]), float(score[0, j]), float(score[1, j]), spread)
        for j, (name, kind, _) in enumerate(kind for kind, of in zip(kinds, told, strict=True) if of)
    ]


def _misfit(case: Case) -> float:
    """How much larger the innovations are than S says, in the middle: outliers don't count."""
    ratios = [float(np.median(r.nis)) / chi2.median(r.dof) for r in case.sensors.values()]
    return max(ratios, default=1.0)


class _Update:
    """One update stage's rows as arrays: H, gain, S⁻¹, residual, and what each fault at unit size leaves in the
    innovation (M, m, q): δ, from which `faults` subtracts H·g."""

    def __init__(self, case: Case, table: StageTable) -> None:
        space = table.spaces["innovation"]
        assert isinstance(space, Product)
        self.space, self.table, self.case = space, table, case
        get = table.values
        S = get["innovation.cov"]
        self.residual, self.gain = get["innovation.residual"], get["gain"]
        self.H = jacobians(case, table)
        self.sound: np.ndarray = np.isfinite(self.H).all((1, 2)) & sound(S)
        self.inverse = np.zeros_like(S)
        self.inverse[self.sound] = np.linalg.inv(S[self.sound])
        self.offered: np.ndarray = get["innovation.offered"] > 0
        whole = self.offered.all(1)
        known = [readings.step for readings in case.sensors.values()]
        self.counts: np.ndarray = whole & np.isin(table.step, np.concatenate(known) if known else [])

    def told(self) -> tuple[np.ndarray, Array, Array]:
        """Of the rows that count the place (K,), and what they add to A and to b (K, q)."""
        rows = self.sound & self.counts
        s = self.left[rows]
        w = self.inverse[rows] @ s
        return self.table.place[rows], (s * w).sum(1), (self.residual[rows][:, None] @ w)[:, 0]

    def prepare(self, column: dict[tuple[str, str], int], q: int) -> None:
        predicted = self.table.values["innovation.predicted"]
        time = self.case.run.time[np.searchsorted(self.case.run.step, self.table.step)]
        self.left = np.zeros((len(time), len(self.space.axes), q))
        for i, (name, part) in enumerate(self.space.parts.items()):
            axes, at = self.space.axes_at[name], self.space.at[name]
            for k, (axis, unit) in enumerate(zip(part.axes, part.axis_units, strict=True)):
                j = column[name, f"bias {axis if axis != name else 'reading'} {unit}"]
                self.left[:, axes.start + k, j] = self.offered[:, i]
            back = min(_BACK, len(time) - 1)
            rate = np.zeros((len(time), axes.stop - axes.start))
            if back:
                spans = np.maximum(time[back:] - time[:-back], 1e-9)[:, None]
                rate[back:] = part.minus(predicted[back:, at], predicted[:-back, at]) / spans
            self.left[:, axes, column[name, "lag"]] = -rate * self.offered[:, i, None]
