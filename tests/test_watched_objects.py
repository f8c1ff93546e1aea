"""What `watch` does to the objects that it is given, of whatever make they are."""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter  # type: ignore[import-untyped]

import viz_estim


class Slotted:
    """A person's filter whose objects have no room for a wrapped method."""

    __slots__ = ("P", "x")

    def __init__(self) -> None:
        self.x, self.P = np.zeros(1), np.eye(1)

    def predict(self) -> None:
        self.P = self.P + 0.1

    def update(self, z: float) -> None:
        self.x, self.P = self.x + 0.5 * (z - self.x), 0.5 * self.P


@dataclass(frozen=True)
class Frozen:
    x: float = 0.0
    P: float = 1.0

    def predict(self) -> None: ...

    def update(self, z: float) -> None: ...


def test_a_filter_with_slots_is_watched_and_left_as_it_was(tmp_path: Path) -> None:
    kf, other = Slotted(), Slotted()
    for name in ("a", "b"):  # and once more
        rec = viz_estim.watch(kf, path=tmp_path / f"{name}.rrd")
        assert isinstance(kf, Slotted)
        for z in (1.0, 2.0):
            kf.predict()
            kf.update(z)
            other.predict()
        rec.close()
        assert list(viz_estim.load(tmp_path / f"{name}.rrd").stages) == ["start", "predict", "update"]
    assert type(kf) is type(other) is Slotted
    assert kf.x[0] == 0.5 * (2 + 0.5 * (1 + 0.5 * (2 + 0.5)))


def test_a_filter_whose_methods_cannot_be_wrapped_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"Frozen: its predict can't be wrapped .*record it by viz_estim\.record"):
        viz_estim.watch(Frozen(), path=tmp_path / "a.rrd")
    assert not list(tmp_path.iterdir())


def test_a_method_of_the_object_s_own_is_there_again_afterwards(tmp_path: Path) -> None:
    kf = KalmanFilter(1, 1)
    kf.predict = own = functools.partial(kf.predict, u=None)
    viz_estim.watch(kf, path=tmp_path / "a.rrd").close()
    assert kf.predict is own
