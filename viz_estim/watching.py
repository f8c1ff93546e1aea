"""Other libraries' filters recorded as they run, by one line: `viz_estim.watch(kf)`.

Their `predict` and `update` are wrapped on the very objects that are given; what they return and hold stays as it is,
and whatever goes wrong in recording them is told once, and is no exception in a person's program.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from viz_estim.errors import one_line
from viz_estim.recordings import Recording
from viz_estim.told import Names, vector

_MARK = "_viz_estim_recording"


def watch(
    *filters: Any, path: str | Path | None = None, space: Names | None = None, dt: float | None = None,
    sensors: Mapping[str, Names] | None = None,
) -> Recording:  # fmt: skip
    """Records a filter of FilterPy's kind (an object with x, P, predict and update), or Stone Soup's predictor and
    updater, from here on; `close` ends the recording, or the end of the program.

    A step is a prediction with the updates after it. path: recordings/TYPE.rrd unless given; space: names, units and
    geometry of the state as in `record`; dt: seconds from one prediction to the next, of a filter that does not say;
    sensors: the readings' names and units as in `record`, by `z`, `z2`, … in the order in which they first come.
    ValueError where an object is neither, or where its methods can't be wrapped. Watched again, a filter begins a
    new recording.
    """
    from viz_estim.watched_filters import of_filterpy, of_stonesoup

    kinds = [of_filterpy(one) or of_stonesoup(one) for one in filters]
    for one, kind in zip(filters, kinds, strict=True):
        if kind is None:
            lacks = [name for name in ("x", "P", "predict", "update") if not hasattr(one, name)]
            raise ValueError(
                f"{type(one).__name__}: expected a filter with x, P, predict and update (it lacks {', '.join(lacks)}), "
                "or Stone Soup's predictor or updater; record others by viz_estim.record"
            )
    if not filters or (len(filters) > 1 and any(of_filterpy(one) for one in filters)):
        raise ValueError("watch one filter, or a predictor and its updater; another has a recording of its own")
    for one in filters:
        for name in ("predict", "update"):
            earlier = getattr(getattr(one, name, None), _MARK, None)
            if earlier is not None:
                earlier.close()
    path = Path(path) if path else Path("recordings") / f"{type(filters[0]).__name__}.rrd"
    path.parent.mkdir(parents=True, exist_ok=True)
    recording = Watched(path, space, sensors or {})
    try:
        for one, kind in zip(filters, kinds, strict=True):
            assert kind
            kind(one, recording, dt)
    except ValueError:  # of an object whose methods can't be wrapped: the others are as before
        recording.close()
        raise
    return recording


class Watched(Recording):
    """A recording that other objects' calls fill. A step ends when the next one begins."""

    made_by = "viz_estim.watch"

    def __init__(self, path: Path, space: Names | None, sensors: Mapping[str, Names]) -> None:
        super().__init__(path, space, sensors)
        self.now: float | None = None  # the time of the step that is not ended
        self.control: ArrayLike | None = None  # of that step
        self.origin: Any = None  # the first time stamp, of a library that has them
        self._undo: list[Callable[[], None]] = []
        self._known: list[Hashable] = []  # sensors, in the order in which they came
        self._gave_up = False

    def wrap(
        self, owner: Any, name: str, before: Callable[..., None], told: Callable[..., None], failed: Callable[..., None]
    ) -> None:
        """Has before(*arguments) called before each call of a method, told(result, *arguments) after it, and where it
        raised failed(*arguments)."""
        method = getattr(owner, name)

        @functools.wraps(method)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            self._failure = None  # what was raised before was caught, or it would not come here
            self._try(before, *args, **kwargs)
            try:
                result = method(*args, **kwargs)
            except Exception as error:
                self._try(failed, *args, **kwargs)
                self.fail(error, name)
                raise
            self._try(told, result, *args, **kwargs)
            return result

        setattr(wrapped, _MARK, self)
        self._undo.append(_put(owner, name, wrapped))

    def begin(self, time: float) -> None:
        """A step begins: the one before, if any, has ended."""
        if self._stages and self.now is not None:
            self.step(time=self.now, control=self.control)
        self.now, self.control = time, None

    def sensor(self, key: Hashable) -> tuple[str, str]:
        """The names of an update's stage and its sensor: the first sensor's plain, those of others numbered."""
        if key not in self._known:
            self._known.append(key)
        number = self._known.index(key) + 1
        return ("update", "z") if number == 1 else (f"update_{number}", f"z{number}")

    def reading(self, sensor: str, z: ArrayLike) -> None:
        """What a sensor read in this step, though no update tells of it."""
        self._readings[sensor] = vector(z)

    def say(self, text: str) -> None:
        """A line for the person at the terminal."""
        print(f"viz-estim: {self.path}: {text}", file=sys.stderr)

    def close(self) -> None:
        """Ends the recording and leaves the objects as they were."""
        for undo in reversed(self._undo):
            undo()
        self._undo = []
        if self._stages and self.now is not None:
            self.step(time=max(self.now, self._times[-1] if self._times else self.now), control=self.control)
        super().close()

    def _try(self, function: Callable[..., None], *args: Any, **kwargs: Any) -> None:
        """Calls it; where it raises, says so and watches no more."""
        if self._gave_up:
            return
        try:
            function(*args, **kwargs)
        except Exception as error:
            self._gave_up = True
            self.say(f"recorded up to step {max(self._count - 1, 0)} alone ({type(error).__name__}: {one_line(error)})")


def _put(owner: Any, name: str, wrapped: Any) -> Callable[[], None]:
    """Sets a method of the object, and gives what undoes it; ValueError where there is no way to."""
    kind = type(owner)
    try:
        if hasattr(owner, "__dict__"):
            own = vars(owner).get(name)
            setattr(owner, name, wrapped)
            return functools.partial(_take, owner, name, wrapped, own)
        # An object with `__slots__` has no room for it, but a class beneath its own has: same layout, and this method.
        beneath = {"__slots__": (), "__module__": kind.__module__, name: staticmethod(wrapped)}
        owner.__class__ = type(kind.__name__, (kind,), beneath)
        return functools.partial(setattr, owner, "__class__", kind)
    except (AttributeError, TypeError) as error:
        raise ValueError(
            f"{kind.__name__}: its {name} can't be wrapped ({one_line(error)}); let its class take attributes, or "
            "record it by viz_estim.record"
        ) from None


def _take(owner: Any, name: str, wrapped: Any, own: Any) -> None:
    """Takes the wrapped method away, if it is still there, and gives the object back the one that was its own."""
    if vars(owner).get(name) is wrapped:
        if own is None:
            delattr(owner, name)
        else:
            setattr(owner, name, own)
