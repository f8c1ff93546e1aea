"""Some steps at once, as arrays: each quantity is gathered once, whoever wants it."""

from __future__ import annotations

from functools import cached_property
from itertools import chain, islice
from operator import attrgetter, is_, itemgetter
from typing import Any

import numpy as np

from viz_estim.core.beliefs import Particles
from viz_estim.core.modes import moments
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Step, Tick
from viz_estim.core.stages import Stage
from viz_estim.recording.columns import Times, stacked


class StageRows:
    """All rows of one stage in a batch: its records, their times, their steps' rows, which began and which ended their
    step, and the stage before each (None at the run's first)."""

    def __init__(
        self, name: str, stages: list[Stage], at: Times, rows: np.ndarray, first: np.ndarray, last: np.ndarray,
        before: list[Stage | None],
    ) -> None:  # fmt: skip
        self.name, self.stages, self.at, self.rows = name, stages, at, rows
        self.first, self.last, self.before = first, last, before
        self._objects: dict[str, list[Any]] = {}
        self._gathered: dict[str, Any] = {}

    def objects(self, path: str) -> list[Any]:
        """A quantity of each record by its attribute path, such as `innovation.residual`."""
        if path not in self._objects:
            self._objects[path] = list(map(attrgetter(path), self.stages))
        return self._objects[path]

    def values(self, path: str) -> Array | list[Array]:
        """The same as one array (M, …), or as a list where shapes differ."""
        if path not in self._gathered:
            self._gathered[path] = stacked(self.objects(path))
        gathered: Array | list[Array] = self._gathered[path]
        return gathered

    def array(self, path: str) -> Array:
        """The same, of a quantity that has one shape in all rows."""
        return np.asarray(self.values(path), float)

    def some(self, path: str, rows: np.ndarray) -> Array:
        """The same in some of the rows, in order: all of them are not copied."""
        values = self.array(path)
        return values if len(rows) == len(values) else values[rows]

    def prior(self, path: str) -> Array:
        """A quantity of the belief before the stage, such as `cov` (M, …); for rows that have one (`has_prior`)."""
        key = f"prior.{path}"
        if key not in self._gathered:
            read = attrgetter(f"belief.{path}")
            self._gathered[key] = stacked([read(stage) for stage in self.before if stage is not None])
        return np.asarray(self._gathered[key])

    @cached_property
    def has_prior(self) -> np.ndarray:
        """Which rows had a stage before them."""
        return np.array([stage is not None for stage in self.before])

    def shared(self, field: str, stage: str, earlier: str) -> np.ndarray:
        """Which rows hold in a field the very object that the stage before in the same step, if it is that one, holds
        in `earlier`."""
        key = f"shared.{field}.{stage}.{earlier}"
        if key not in self._gathered:
            read = attrgetter(earlier)
            theirs = [read(before) if before and before.name == stage else None for before in self.before]
            same = np.fromiter(map(is_, self.objects(field), theirs), bool, len(theirs))
            self._gathered[key] = same & ~self.first
        found: np.ndarray = self._gathered[key]
        return found

    @cached_property
    def equal_weights(self) -> np.ndarray:
        """Which rows' particles weigh all the same."""
        found = self.objects("belief.log_weights")
        alike = {id(one): bool((one == one[0]).all()) for one in {id(one): one for one in found}.values()}
        return np.array([alike[id(one)] for one in found])

    def copied(self, stage: str) -> np.ndarray:
        """Which rows hold the particles that their `ancestors` name of the stage before, to the bit, if it is that one
        in the same step."""
        key = f"copied.{stage}"
        if key not in self._gathered:
            copies = zip(self.stages, self.before, self.first.tolist(), strict=True)
            self._gathered[key] = np.array([not first and _copied(one, before, stage) for one, before, first in copies])
        found: np.ndarray = self._gathered[key]
        return found


class Batch:
    """Steps, with `times` of their first stages, and `stages` as rows by name.

    first: the place on the stage timeline of the first step; `end` is the next batch's. before: the stage that ended
    the step before. What steps have in common is found once: `kind` (N,) says by its place in `kinds` which stages a
    step has; `tick_kind` (N,) by its place in `ticks`, examples, whose sensors and faults are its tick's.
    """

    def __init__(self, steps: list[Step], first: int, before: Stage | None = None) -> None:
        self.steps = steps
        self._stages = list(map(_STAGES, steps))
        names, sizes = map(_NAME, chain.from_iterable(self._stages)), list(map(len, self._stages))
        same = sizes[0] if len(set(sizes)) == 1 else 0  # as is usual: several times as fast
        self.kind, self.kinds, _ = kinds_of(
            list(zip(*[names] * same, strict=True)) if same else [tuple(islice(names, size)) for size in sizes]
        )
        ticks = list(map(_TICK, steps))
        self.tick_kind, _, examples = kinds_of(_sensors(ticks))
        self.ticks = [ticks[row] for row in examples]
        # A step without any stage (it failed at once) still takes a place on the stage timeline.
        counts = np.array([max(1, len(names)) for names in self.kinds])[self.kind]
        places = first + np.concatenate([[0], np.cumsum(counts)])
        self.end = int(places[-1])
        self.times = Times(np.array(list(map(_INDEX, steps))), np.array(list(map(_TIME, ticks))), places[:-1])
        self._ended: list[Stage | None] = []  # by step, the stage that ended the step before
        for stages in self._stages:
            self._ended.append(before)
            before = stages[-1] if stages else before
        self.last = before
        found: dict[str, list[tuple[np.ndarray, int, bool]]] = {}
        for code, names in enumerate(self.kinds):
            members = np.flatnonzero(self.kind == code)
            for i, name in enumerate(names):
                found.setdefault(name, []).append((members, i, i == len(names) - 1))
        self.stages = [self._rows_of(name, groups) for name, groups in found.items()]

    def ended(self, row: int) -> Stage | None:
        """The stage that ended the step before a step of the batch."""
        return self._ended[row]

    def _rows_of(self, name: str, groups: list[tuple[np.ndarray, int, bool]]) -> StageRows:
        """The rows of a stage, which stands at one place in the steps of each group, and ends them or not."""
        rows = np.concatenate([members for members, _, _ in groups])
        offsets = np.concatenate([np.full(len(members), i) for members, i, _ in groups])
        last = np.concatenate([np.full(len(members), ends) for members, _, ends in groups])
        stages: list[Stage] = []
        before: list[Stage | None] = []
        for members, i, _ in groups:
            of, ended = self._stages, self._ended
            if len(members) < len(of):
                few = members.tolist()
                of, ended = [of[row] for row in few], [ended[row] for row in few]
            stages += map(itemgetter(i), of)
            before += map(itemgetter(i - 1), of) if i else ended
        places = self.times.stage[rows] + offsets
        if len(groups) > 1:
            order = np.argsort(places)
            rows, offsets, last, places = rows[order], offsets[order], last[order], places[order]
            stages, before = [stages[i] for i in order.tolist()], [before[i] for i in order.tolist()]
        everywhere = len(rows) == len(self.times) and not offsets.any()
        at = self.times if everywhere else Times(self.times.step[rows], self.times.time[rows], places)
        return StageRows(name, stages, at, rows, offsets == 0, last, before)

    @cached_property
    def _order(self) -> np.ndarray:
        return np.argsort(np.concatenate([rows.at.stage for rows in self.stages]))

    @cached_property
    def in_order(self) -> np.ndarray:
        """Which stage each of all is, in order: its place in `stages`."""
        return np.repeat(np.arange(len(self.stages)), [len(rows.stages) for rows in self.stages])[self._order]

    @cached_property
    def at(self) -> Times:
        """The times of all stages, in order."""
        columns = [np.concatenate([getattr(rows.at, name) for rows in self.stages]) for name in _TIMELINES]
        return Times(*(column[self._order] for column in columns))

    @cached_property
    def ends(self) -> np.ndarray:
        """Which of all stages, in order, ended their step."""
        return np.flatnonzero(np.concatenate([rows.last for rows in self.stages])[self._order])

    @cached_property
    def end_rows(self) -> np.ndarray:
        """The steps' rows of these."""
        return np.concatenate([rows.rows for rows in self.stages])[self._order][self.ends]

    def beliefs(self, path: str) -> Array:
        """A quantity of the belief after each of all stages, in order, such as `mean` (M, n)."""
        parts = [rows.array(f"belief.{path}") for rows in self.stages]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)[self._order]

    @cached_property
    def end_moments(self) -> tuple[Array, Array]:
        """Mean (N, n) and covariance (N, d, d) at the end of each step; of clouds, many at once."""
        if self.stages and isinstance(self.stages[0].stages[0].belief, Particles):
            ended = [self.steps[row].stages[-1].belief for row in self.end_rows.tolist()]
            space, size = ended[0].space, max(1, 10_000 // len(ended[0].log_weights))
            groups = [ended[i : i + size] for i in range(0, len(ended), size)]
            found = [moments(space, _states(group), _log_weights(group)) for group in groups]
            return np.concatenate([mean for mean, _ in found]), np.concatenate([cov for _, cov in found])
        enders = [rows for rows in self.stages if rows.last.any()]
        if len(enders) == 1 and enders[0].last.all():  # as is usual: nothing to put in order
            return enders[0].array("belief.mean"), enders[0].array("belief.cov")
        return self.beliefs("mean")[self.ends], self.beliefs("cov")[self.ends]

    @cached_property
    def truth(self) -> Array:
        """The truth (N, n), NaN where there is none; of a run that has one."""
        size = next((len(step.truth) for step in self.steps if step.truth is not None), 0)
        nothing = np.full(size, np.nan)
        return np.asarray(stacked([nothing if step.truth is None else step.truth for step in self.steps]))


def _states(beliefs: list[Particles]) -> Array:
    """Those of clouds of one size (M, N, n), with each component in one piece, as `moments` wants them."""
    N, n = beliefs[0].states.shape
    states = np.empty((n, len(beliefs), N))
    for i, belief in enumerate(beliefs):
        states[:, i] = belief.states.T
    return np.moveaxis(states, 0, -1)


def _log_weights(beliefs: list[Particles]) -> Array:
    """Those of clouds of one size (M, N); one number spread over all, where all share an array of one number."""
    first = beliefs[0].log_weights
    if all(belief.log_weights is first for belief in beliefs) and (first == first[0]).all():
        return np.broadcast_to(first[:1], (len(beliefs), len(first)))
    return np.stack([belief.log_weights for belief in beliefs])


_TIMELINES = ("step", "time", "stage")


def _copied(stage: Any, before: Any, name: str) -> bool:
    """Whether the particles of a stage are copies of those before it: a thinned cloud's are not, nor are those that
    were moved too."""
    if before is None or before.name != name:
        return False
    states, ancestors = before.belief.states, stage.ancestors
    try:
        return np.array_equal(stage.belief.states, states.take(ancestors, axis=0))
    except IndexError:  # a person's own ancestors may name none of them
        return False


_STAGES, _NAME, _INDEX, _TICK = map(attrgetter, ("stages", "name", "index", "tick"))
_TIME, _MEASUREMENTS, _RAW, _FAULTS = map(attrgetter, ("time", "measurements", "raw", "faults"))


def kinds_of(keys: list[Any]) -> tuple[np.ndarray, list[Any], list[int]]:
    """The number of each key (N,) among the different ones, these, and the first row of each."""
    first: dict[Any, int] = {}
    found = list(map(first.setdefault, keys, range(len(keys))))
    if len(first) == 1:
        return np.zeros(len(keys), int), list(first), [0]
    rows, number = np.unique(found, return_inverse=True)
    return number, list(first), rows.tolist()


def _sensors(ticks: list[Tick]) -> list[Any]:
    """What ticks have in common: which sensors they have readings of, and what is wrong with these."""
    read, raw = (list(map(tuple, map(of, ticks))) for of in (_MEASUREMENTS, _RAW))
    faults = list(map(_FAULTS, ticks))
    if len(set(raw)) == 1 and not any(faults):
        return read
    found: list[Any] = list(zip(read, raw, strict=True))
    for row, faulty in enumerate(faults):
        if faulty:
            found[row] = (*found[row], *faulty.items(), *ticks[row].stand_ins)
    return found
