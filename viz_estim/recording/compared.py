"""One run among those that are compared: its name, its colour, and its rows on the first run's clock."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import rerun as rr

from viz_estim.core.descriptions import describe
from viz_estim.core.spaces import Product
from viz_estim.recording import schema
from viz_estim.recording.columns import Times
from viz_estim.recording.layout import as_product
from viz_estim.recording.reader import Run
from viz_estim.recording.tables import StageTable

# One colour a run, apart from each other and from the truth's white and the bounds' grey; the first has the estimate's.
COLOURS: dict[str, schema.Colour] = {
    "amber": schema.ESTIMATE,
    "blue": (90, 150, 255),
    "magenta": (240, 80, 180),
    "green": (95, 210, 110),
    "red": (255, 85, 50),
    "lilac": (195, 160, 255),
}


@dataclass(frozen=True)
class Compared:
    """A run, its place among the compared, and the name it has there. of_first: it ran on the first run's data."""

    run: Run
    place: int
    name: str
    of_first: bool

    @property
    def hue(self) -> str:
        return list(COLOURS)[self.place]

    @property
    def colour(self) -> schema.Colour:
        return COLOURS[self.hue]

    @property
    def title(self) -> str:
        """The name and the colour's, for headings."""
        return f"{self.name} ({self.hue})"

    @property
    def path(self) -> str:
        """Where its scene is kept."""
        return f"/runs/{self.part}"

    @property
    def part(self) -> str:
        """Its name as a part of an entity's path."""
        return rr.escape_entity_path_part(self.name)

    @property
    def space(self) -> Product:
        return as_product(self.run.space)

    @cached_property
    def starts(self) -> np.ndarray:
        """The place (N,) on the stage timeline at which each step begins; a step without stages takes one place."""
        run = self.run
        found = np.full(len(run.step), np.iinfo(np.int64).max)
        for table in run.stages.values():
            at = np.searchsorted(run.step, table.step)
            inside = at < len(run.step)
            np.minimum.at(found, at[inside], table.place[inside])
        found = np.minimum.accumulate(found[::-1])[::-1]
        return np.where(found < np.iinfo(np.int64).max, found, self._last + 1)

    @property
    def ends(self) -> np.ndarray:
        """The last place (N,) of each step."""
        return np.maximum(np.append(self.starts[1:] - 1, self._last), self.starts)

    @property
    def _last(self) -> int:
        return max((int(table.place.max()) for table in self.run.stages.values() if len(table.place)), default=-1)


class Alone(Compared):
    """A run that is compared with none: its entities stand where it recorded them."""

    @property
    def path(self) -> str:
        return ""


class Clock:
    """Puts another run's rows on the first run's steps and places, by their stamps, so that one cursor moves both."""

    def __init__(self, first: Compared, other: Compared) -> None:
        a, b = first.run, other.run
        self._starts = other.starts
        self._time = b.time
        self._rows = b.step
        usual = float(np.median(np.diff(a.time))) if len(a.time) > 1 else 0.0
        row = np.searchsorted(a.time, b.time + 5e-10, side="right") - 1
        inside = np.clip(row, 0, len(a.time) - 1)
        beyond = np.where(row < 0, b.time - a.time[0], np.maximum(b.time - a.time[-1], 0))
        extra = np.floor(beyond / usual).astype(np.int64) if usual > 0 else np.zeros(len(row), np.int64)
        extra = np.where((row < 0) | (row == len(a.time) - 1), extra, 0)
        self._step = a.step[inside] + extra
        # Beyond its ends the first run would go on as it did: a step there takes as many places as its last.
        width = first.ends[-1] - first.starts[-1] + 1
        self._place = first.starts[inside] + extra * width
        self._room = first.ends[inside] - first.starts[inside]
        self.same = bool(
            np.array_equal(self._step, b.step) and np.array_equal(self._place, other.starts)
            and (self._room >= other.ends - other.starts).all()
        )  # fmt: skip

    def steps_and_places(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """For places (M,) on the other's stage timeline, the first run's steps and places at that moment."""
        row = np.clip(np.searchsorted(self._starts, place, side="right") - 1, 0, None)
        return self._step[row], self._place[row] + np.minimum(place - self._starts[row], self._room[row])

    def times(self, place: np.ndarray, step: np.ndarray) -> Times:
        """The three timelines of rows of the other, by their places and their own steps (M,)."""
        steps, places = self.steps_and_places(place)
        return Times(steps, self._time[np.searchsorted(self._rows, step)], places)


def light(run: Run) -> Run:
    """The run with what a comparison needs alone: beliefs, residuals, their covariances and gains, single numbers, and
    the readings that may be of a part of the state itself."""
    tables = {
        name: StageTable(name, t.step, t.place, {k: v for k, v in t.values.items() if _needed(k, v)}, t.spaces)
        for name, t in run.stages.items()
    }
    inputs = {k: v for k, v in run.inputs.items() if k.startswith("z.") and v.shape[1] <= len(run.space.names)}
    return dataclasses.replace(run, stages=tables, inputs=inputs)


def _needed(name: str, values: np.ndarray) -> bool:
    tail = name.rpartition(".")[2]
    return tail in ("mean", "cov", "log_probabilities", "residual", "offered", "gain") or is_figure(name, values)


def is_figure(name: str, values: np.ndarray) -> bool:
    """Whether it is a single number a row."""
    return values.ndim == 1 and values.dtype != object and "." not in name


def shared_parts(first: Compared | Product, other: Compared | Product) -> list[str]:
    """The parts of the state that two runs have in common: by name, and by what they are."""
    a, b = (one if isinstance(one, Product) else one.space for one in (first, other))
    return [name for name, part in a.parts.items() if name in b.parts and describe(b.parts[name]) == describe(part)]
