"""What a recording holds, learnt from the scenario and the steps themselves: the belief's kind, stages, their fields'
spaces, sensors, where the scene is.

The view is a function of this, and the reader gives arrays their shapes by it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from operator import attrgetter
from typing import Any

import numpy as np

from viz_estim.core.beliefs import Particles
from viz_estim.core.descriptions import describe
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario
from viz_estim.core.scenery import Camera, Cloud, Landmarks, Path
from viz_estim.core.spaces import SE2, SO2, SO3, Euclidean, Product, Space
from viz_estim.core.stages import Innovation, Matches, SigmaPoints
from viz_estim.recording.batch import Batch, StageRows, kinds_of
from viz_estim.recording.ranges import Ranges

KEPT = 4000  # particles of a cloud at most: more are thinned by weight


class Layout:
    """space: the state's, as a product (of nothing, where the belief is over labels); inputs: the sensors on ticks;
    duration: in s, as far as it is known so far.

    stages: per stage the shape (as JSON: a list) or the space of each field; sensors: the spaces of those that
    innovations came from; reach: about how long their readings are; silent: by sensor the steps at which a reading was
    due and none came; true_parts: the parts of the state that have a truth; gapless: those of them that have it at
    every step; particles: how many the belief has; matched: clouds are matched, a registration. position, heading,
    attitude: the parts that say where and how the body is, if any. ranges: of the plots' axes. explained: the scenario
    says itself what to look at.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.labels: tuple[str, ...] = getattr(scenario.beliefs[0], "labels", ())
        self.space = as_product(scenario.space)
        truth = np.empty((0, len(self.space.names))) if scenario.truth is None or self.labels else scenario.truth
        known = {name: np.isfinite(truth[:, at]).all(1) for name, at in self.space.at.items()}
        self.true_parts = [name for name, rows in known.items() if rows.any()]
        self.gapless = {name for name in self.true_parts if known[name].all()}
        self.duration = scenario.ticks[-1].time - scenario.ticks[0].time
        self.explained = bool(scenario.notes)
        parts = self.space.parts.items()
        self.position = next((name for name, part in parts if is_position(part) or isinstance(part, SE2)), None)
        self.heading = next((name for name, part in parts if isinstance(part, (SO2, SE2))), None)
        self.attitude = next((name for name, part in parts if isinstance(part, SO3)), None)
        self.scenery = scenario.scenery
        self.matched = any(isinstance(thing, Cloud) and thing.moves for thing in scenario.scenery.values())
        self.camera = next((thing for thing in self.scenery.values() if isinstance(thing, Camera)), None)
        self._box = self._known_places(scenario, truth) if self.position else None
        self.silent = _silences(scenario)
        first = scenario.beliefs[0]
        self.particles = len(first.log_weights) if isinstance(first, Particles) else 0
        self.stages: dict[str, dict[str, Any]] = {}
        self._unknown: dict[str, list[str]] = {}  # by stage: the fields that were None so far
        self.inputs: list[str] = []
        self.sensors: dict[str, Space] = {}
        self.reach: dict[str, float] = {}
        self.ranges = Ranges(fixed=False)

    @property
    def planar(self) -> bool:
        """Whether the position is in the plane."""
        return self.position is not None and len(place_of(self.space.parts[self.position], np.empty(3))) == 2

    @property
    def extent(self) -> tuple[Array, float] | None:
        """The centre (3,) and the half width in m of what is known so far to be in the scene."""
        if self._box is None:
            return None
        low, high = self._box
        return 0.5 * (low + high), max(0.5, float(0.5 * np.abs(high - low).max()))

    @property
    def half_sizes(self) -> Array:
        """The half sizes (3,) in m of the box about what is known so far to be in the scene."""
        assert self._box is not None
        return 0.5 * (self._box[1] - self._box[0])

    def _known_places(self, scenario: Scenario, truth: Array) -> Array:
        """The box (2, 3) about the places that are known beforehand."""
        assert self.position
        part, at = self.space.parts[self.position], self.space.at[self.position]
        first = scenario.beliefs[0]
        start = first.states if isinstance(first, Particles) else first.mean[None]
        seen = [place_of(part, start[:, at])]
        if self.position in self.true_parts:
            seen.append(place_of(part, truth[np.isfinite(truth[:, at]).all(1), at]))
        seen += [thing.positions for thing in scenario.scenery.values() if isinstance(thing, (Landmarks, Path))]
        seen += [thing.points for thing in scenario.scenery.values() if isinstance(thing, Cloud)]
        points = np.concatenate([flat3(np.asarray(place, float)) for place in seen])
        return np.stack([points.min(0), points.max(0)])

    def _widen(self, batch: Batch) -> None:
        """Makes room for where steps ended: by their truth, or else by the estimate without its wildest hundredth."""
        if self._box is None or self.position in self.gapless or not batch.stages or self.matched:
            return
        assert self.position
        part, at = self.space.parts[self.position], self.space.at[self.position]
        box = self._box
        for values, wild in ((batch.truth, 0.0), (batch.end_moments[0], 0.01)):
            place = flat3(place_of(part, values[:, at])) if values.size else np.empty((0, 3))
            place = place[np.isfinite(place).all(1)]
            if len(place):
                low, high = np.quantile(place, [wild, 1 - wild], axis=0)
                self._box = np.stack([np.minimum(box[0], low), np.maximum(box[1], high)])
                return

    def learn(self, batch: Batch) -> bool:
        """Takes in what is new; True where anything is."""
        self._widen(batch)
        self.duration = max(self.duration, float(batch.times.time[-1]))
        new = False
        for rows in batch.stages:
            if self._unknown.get(rows.name, True):
                new |= self._learn(rows)
        for rows in batch.stages:  # all stages are known now: one may hold what another drew
            if self.particles and "belief.states" not in self.stages[rows.name]:
                new |= self._learn_states(rows)
            new |= self._learn_sources(rows)
        seen = dict.fromkeys(self.inputs)
        for tick in batch.ticks:
            seen |= dict.fromkeys([*tick.measurements, *tick.raw])
        new |= len(seen) > len(self.inputs)
        self.inputs = list(seen)
        return new

    def _learn(self, rows: StageRows) -> bool:
        """Learns the fields of a stage, each from the first record that has it; True where there is anything new."""
        new = rows.name not in self.stages
        fields = self.stages.setdefault(rows.name, {})
        names = [field.name for field in dataclasses.fields(rows.stages[0])[2:]]
        unknown = self._unknown.setdefault(rows.name, names)
        for name in list(unknown):
            value = next((value for value in rows.objects(name) if value is not None), None)
            if value is not None:
                unknown.remove(name)
                new = True
                self._learn_field(fields, name, value)
        return new

    def _learn_field(self, fields: dict[str, Any], field: str, value: Any) -> None:
        if isinstance(value, SigmaPoints):
            fields[field] = {"points": describe(value.space), "count": int(value.points.shape[-2])}
        elif isinstance(value, Innovation):
            fields[field] = {"innovation": describe(value.space)}
            self.sensors |= value.space.parts
            for sensor, at in value.space.at.items():
                size = float(np.linalg.norm(value.z[at]))
                self.reach[sensor] = size if size > 0.1 else 1.0
        elif isinstance(value, Matches):
            fields[field] = {"matches": value.source.shape[-1]}
        elif isinstance(value, (np.ndarray, np.number, float, int)):
            shape = list(np.shape(value))
            cloud = bool(self.particles) and shape[:1] == [min(self.particles, KEPT)]
            fields[field] = {"shape": shape} | ({"cloud": True} if cloud else {})
        elif isinstance(value, tuple) and all(isinstance(one, str) for one in value):
            fields[field] = {"names": list(value)}

    def _learn_states(self, rows: StageRows) -> bool:
        """Finds the particles that are those of the stage before, or copies of them: they are kept once."""
        before = rows.before[-1]
        if before is None or rows.first[-1]:
            return False
        fields, same = self.stages[rows.name], [before.name, "belief.states"]
        if rows.shared("belief.states", *same)[-1]:
            fields["belief.states"] = {"same_as": same}
        elif "ancestors" in fields and rows.copied(before.name)[-1]:
            fields["belief.states"] = {"same_as": same, "by": "ancestors"}
        return "belief.states" in fields

    def _learn_sources(self, rows: StageRows) -> bool:
        """Finds the points that are those of the stage before (Kraft's filter maps its prediction's own): they are
        kept once."""
        new = False
        last, before = rows.stages[-1], rows.before[-1]
        for field, what in self.stages[rows.name].items():
            if before is not None and not rows.first[-1] and "points" in what and "same_as" not in what:
                for earlier, of in self.stages.get(before.name, {}).items():
                    if "points" in of and getattr(before, earlier) is getattr(last, field):
                        what["same_as"] = [before.name, earlier]
                        new = True
        return new

    def place(self, sensor: str) -> int:
        """Where the sensor stands among all: its colour."""
        return [*self.inputs, *(name for name in self.sensors if name not in self.inputs)].index(sensor)

    def as_json(self) -> dict[str, Any]:
        found: dict[str, Any] = {"stages": self.stages, "inputs": self.inputs}
        return found | (
            {"particles": {"count": self.particles, "kept": min(self.particles, KEPT)}} if self.particles else {}
        )


def _silences(scenario: Scenario) -> dict[str, set[int]]:
    """By sensor, the steps before its first reading, and within a gap of more than five times its usual interval."""
    readings, raw = (kinds_of(list(map(tuple, map(attrgetter(of), scenario.ticks)))) for of in ("measurements", "raw"))
    silent = {}
    for sensor in dict.fromkeys(name for _, kinds, _ in (readings, raw) for names in kinds for name in names):
        there = (np.array([sensor in names for names in kinds])[kind] for kind, kinds, _ in (readings, raw))
        came = np.flatnonzero(np.logical_or(*there))
        usual = float(np.median(np.diff(came))) if len(came) > 1 else 1.0
        ends = np.concatenate([[-1], came, [len(scenario.ticks)]])
        gaps = np.flatnonzero((np.diff(ends) > 5 * usual) | (ends[:-1] < 0))
        silent[sensor] = {step for gap in gaps for step in range(ends[gap] + 1, ends[gap + 1])}
    return silent


def as_product(space: Space | None) -> Product:
    """The space itself, or a product of it alone under the name `state`; of nothing where there is none."""
    if space is None:
        return Product()
    return space if isinstance(space, Product) else Product(state=space)


def leaves(space: Product, start: int = 0) -> Iterator[tuple[str, Space, slice]]:
    """The parts that are no products themselves, with their names and where they stand in the whole's numbers."""
    for name, part in space.parts.items():
        at = space.at[name]
        if isinstance(part, Product):
            yield from leaves(part, start + at.start)
        else:
            yield name, part, slice(start + at.start, start + at.stop)


def is_position(space: Space) -> bool:
    """Whether it is a place in the plane or in space: x, y and perhaps z, in metres."""
    return isinstance(space, Euclidean) and space.names in (("x", "y"), ("x", "y", "z")) and set(space.units) == {"m"}


def place_of(space: Space, x: Array) -> Array:
    """The position in a part's values (*, n): all of them, or the first two of a planar pose."""
    return x[..., :2] if isinstance(space, SE2) else x[..., : len(space.names)]


def flat3(points: Array) -> Array:
    """Points (*, 2) or (*, 3) as (*, 3): the plane is z = 0."""
    return points if points.shape[-1] == 3 else np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1)
