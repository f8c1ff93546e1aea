"""A person's own filter: what it yields is recorded and read back, or refused at its step in one line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import viz_estim
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.core.stages import Innovation, LinearPredict, Matches, SigmaPoints, Stage, Update
from viz_estim.recording.recorder import Recorder

PLANE = Euclidean(("x", "y"), "m")
SPACE, GPS, LIDAR, RANGE = (
    Product(position=PLANE), Product(gps=PLANE), Product(lidar=PLANE), Product(range=Euclidean(("r",), "m")),
)  # fmt: skip
STEPS = 12


@dataclass(frozen=True)
class Extra(Stage):
    extra: Any = None


def pairs(count: int) -> Matches:
    index = np.arange(count)
    return Matches(np.ones((count, 2)), np.zeros((count, 2)), np.ones(count), index, index)


def points(count: int) -> SigmaPoints:
    weights = np.full(count, 1 / count)
    return SigmaPoints(SPACE, np.ones((count, 2)), weights, weights)


class Own:
    """A plain Kalman filter as a person writes it, with one thing about it that is as the test wants it."""

    def __init__(self, part: str = "", of: Callable[[int, Any], Any] = lambda k, good: good) -> None:
        self._part, self._of = part, of

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        k = round(tick.time / 0.1)

        def odd(part: str, good: Any) -> Any:
            return self._of(k, good) if part == self._part else good

        x, P = belief.mean, belief.cov + 0.1 * np.eye(2)
        F, Q = odd("transition", np.eye(2)), odd("noise", 0.1 * np.eye(2))
        yield LinearPredict("predict", Gaussian(SPACE, x, P), F, Q)
        R, z = np.eye(2), np.array([0.1 * k, 1.0])
        S = P + R
        K = np.linalg.solve(S, P).T
        parts = {
            "space": GPS, "z": z, "predicted": x, "residual": z - x, "cov": S, "noise": R, "cross_cov": P,
            "used": np.array([True]), "offered": np.array([True]), "blind": np.zeros((2, 1)),
        }  # fmt: skip
        innovation = Innovation(**{name: odd(f"innovation.{name}", good) for name, good in parts.items()})
        after = Gaussian(SPACE, x + K @ (z - x), P - K @ S @ K.T)
        yield odd("update", Update("update", after, odd("innovation", innovation), odd("gain", K)))
        if self._part == "extra":
            yield Extra("extra", after, self._of(k, None))


def scenario(*odd: Any) -> Scenario:
    start = Gaussian(SPACE, np.zeros(2), np.eye(2))
    return Scenario(Own(*odd), {0: start}, [Tick(0.1 * k, 0.1 if k else 0.0) for k in range(STEPS)])


def recorded(own: Scenario, path: Path) -> Any:
    """The run's last step, and what its recording says."""
    with Recorder(path, own, {"scenario": "own"}) as recorder:
        for step in run(own):
            recorder.add(step)
    return step, viz_estim.load(path)


def of(space: Product, value: Innovation) -> Innovation:
    """The same as if it came from the sensors of another space."""
    m, s = len(space.axes), len(space.parts)
    return Innovation(
        space, value.z[:m], value.predicted[:m], value.residual[:m], value.cov[:m, :m], value.noise[:m, :m],
        value.cross_cov[:, :m], value.used[:s], value.offered[:s], value.blind[:, :s],
    )  # fmt: skip


# What is odd about the filter; where it ends; what it is told.
REFUSED: dict[str, tuple[Any, int, str]] = {
    "S is a number": (("innovation.cov", lambda k, S: 2.0), 0, "innovation.cov: expected (2, 2), got ()"),
    "S is a diagonal": (("innovation.cov", lambda k, S: np.diag(S)), 0, "innovation.cov: expected (2, 2), got (2,)"),
    "S changes": (("innovation.cov", lambda k, S: S if k < 7 else S[:1]), 7, "innovation.cov: expected (2, 2)"),
    "z is a column": (("innovation.z", lambda k, z: z[:, None]), 0, "innovation.z: expected (2,), got (2, 1)"),
    "used is one": (("innovation.used", lambda k, used: True), 0, "innovation.used: expected (1,), got ()"),
    "no blind": (("innovation.blind", lambda k, blind: None), 0, "innovation.blind: expected (2, 1), got NoneType"),
    "a plain space": (("innovation.space", lambda k, space: PLANE), 0, "innovation.space: expected a Product"),
    "K is cut": (("gain", lambda k, K: K[:1]), 0, "gain: expected (2, 2), got (1, 2)"),
    "F is a number": (("transition", lambda k, F: 1.0), 0, "transition: expected (2, 2), got ()"),
    "two sensors of one size": (
        ("innovation", lambda k, good: good if k % 3 else of(LIDAR, good)), 1,
        'innovation is of gps.x, gps.y here, and was of lidar.x, lidar.y before; give the stage of each sensor a name '
        'of its own, such as "update gps"',
    ),
    "two sensors of two sizes": (
        ("innovation", lambda k, good: good if k < 5 else of(RANGE, good)), 5, "was of gps.x, gps.y before",
    ),
    "no innovation": (("innovation", lambda k, good: good if k < 4 else None), 4, "expected an Innovation as before"),
    "another type": (
        ("update", lambda k, good: good if k < 3 else Stage("update", good.belief)), 3,
        "is a Stage here, and was an Update before; give it a name of its own",
    ),
    "not a stage": (("update", lambda k, good: good.belief), 0, "step() must yield stages, got Gaussian"),
    "arrays of two sizes": (("extra", lambda k, _: np.arange(1.0 + k // 6)), 6, "extra: expected (1,) as before"),
    "points of two counts": (("extra", lambda k, _: points(3 + k // 6)), 6, "extra.points: expected (3, 2) as before"),
    "complex": (("extra", lambda k, _: np.array([1j])), 0, "extra: expected an array of real numbers, got one of c"),
    "objects": (("extra", lambda k, _: np.array([None])), 0, "extra: expected an array of real numbers, got one of o"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_could_not_be_recorded_is_told_at_its_step(case: str, tmp_path: Path) -> None:
    odd, where, text = REFUSED[case]
    step, found = recorded(scenario(*odd), tmp_path / "own.rrd")
    assert step.error is not None
    assert step.error.step == where
    assert text in step.error.message
    assert found.error is not None
    assert text in found.error
    assert len(found.step) == where + 1  # what came before stands


KEPT: dict[str, tuple[Callable[[int, Any], Any], Any]] = {
    "nothing": (lambda k, _: None, None),
    "a word": (lambda k, _: "hello", None),
    "a number": (lambda k, _: 0.5 * k, lambda k: 0.5 * k),
    "whole numbers": (lambda k, _: np.array([k, k + 1]), lambda k: [k, k + 1]),
    "single precision": (lambda k, _: np.float32(k), float),
    "a matrix in Fortran's order": (lambda k, _: np.asfortranarray([[k, 1.0], [2.0, 3.0]]), lambda k: [[k, 1], [2, 3]]),
    "one in steps": (lambda k, _: np.arange(6.0)[::2] + k, lambda k: [k, k + 2, k + 4]),
    "an empty array": (lambda k, _: np.empty(0), lambda k: []),
    "now and then": (lambda k, _: None if k % 3 else np.array([k, 1.0]), lambda k: [np.nan] * 2 if k % 3 else [k, 1]),
    "first, then none": (lambda k, _: None if k else np.ones(2), lambda k: [np.nan] * 2 if k else [1, 1]),
    "none, then always": (lambda k, _: np.ones(2) if k > 4 else None, lambda k: [1, 1] if k > 4 else [np.nan] * 2),
    "always the same": (lambda k, _: np.full(3, 7.0), lambda k: [7, 7, 7]),
    "a number at times": (lambda k, _: None if k % 2 else 1.0 * k, lambda k: np.nan if k % 2 else k),
}


@pytest.mark.parametrize("case", KEPT)
def test_what_a_person_adds_is_read_back(case: str, tmp_path: Path) -> None:
    made, wanted = KEPT[case]
    step, found = recorded(scenario("extra", made), tmp_path / "own.rrd")
    assert step.error is None
    values = found.stages["extra"].values
    if wanted is None:
        assert "extra" not in values
    else:
        assert np.array_equal(values["extra"], np.array([wanted(k) for k in range(STEPS)], float), equal_nan=True)


def test_matches_may_differ_in_number(tmp_path: Path) -> None:
    step, found = recorded(scenario("extra", lambda k, _: pairs(k % 4)), tmp_path / "own.rrd")
    assert step.error is None
    assert [len(row) for row in found.stages["extra"].values["extra.distance"]] == [k % 4 for k in range(STEPS)]
