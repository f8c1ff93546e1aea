"""The Bayes filter over labels against Bayes' rule written out with dictionaries, and what holds for any numbers."""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from viz_estim.core.beliefs import Categorical, Gaussian
from viz_estim.core.discrete import (
    LOG_ZERO,
    DiscreteFilter,
    categorical,
    categorical_metrics,
    logarithms,
    normalised,
    predict,
    redrawn,
    update,
)
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.core.spaces import Euclidean
from viz_estim.core.stages import DiscretePredict, DiscreteUpdate, Stage

LABELS = ("a", "b", "c", "d")
K = len(LABELS)


def naive_update(p: dict[str, float], readings: dict[str, int], yes: dict[str, dict[str, float]]) -> dict[str, float]:
    """Bayes' rule, reading by reading."""
    for sensor, z in readings.items():
        p = {j: p[j] * (yes[sensor][j] if z else 1 - yes[sensor][j]) for j in p}
        p = {j: p[j] / sum(p.values()) for j in p}
    return p


def naive_predict(p: dict[str, float], T: dict[str, dict[str, float]]) -> dict[str, float]:
    return {j: sum(p[i] * T[i][j] for i in p) for j in p}


def named(row: Array) -> dict[str, float]:
    return dict(zip(LABELS, map(float, row), strict=True))


def model(rng: np.random.Generator) -> tuple[Array, Array, dict[str, Array]]:
    """A prior, a transition and three sensors."""
    sensors = {name: rng.uniform(0.01, 0.99, K) for name in ("s", "t", "u")}
    return rng.dirichlet(np.ones(K)), rng.dirichlet(np.ones(K), K), sensors


@pytest.mark.parametrize("seed", range(5))
def test_the_filter_is_bayes_rule(seed: int) -> None:
    rng = np.random.default_rng(seed)
    prior, T, sensors = model(rng)
    z = rng.integers(0, 2, (60, 3))
    given = rng.random((60, 3)) < 0.7  # sensors at their own rates
    ticks = [
        Tick(float(k), float(k > 0), measurements={s: z[k, i : i + 1] for i, s in enumerate(sensors) if given[k, i]})
        for k in range(60)
    ]
    p, rows, yes = (
        named(prior),
        {i: named(T[n]) for n, i in enumerate(LABELS)},
        {s: named(y) for s, y in sensors.items()},
    )
    for step in run(Scenario(DiscreteFilter(T, sensors), {0: categorical(LABELS, prior)}, ticks)):
        assert step.error is None
        stages = {stage.name: stage for stage in step.stages}
        assert list(stages) == ["start"] * (step.index == 0) + ["predict"] * (step.index > 0) + ["update"] * any(
            given[step.index]
        )
        if "predict" in stages:
            p = naive_predict(p, rows)
            assert named(stages["predict"].belief.probabilities) == pytest.approx(p)
        p = naive_update(p, {s: z[step.index, i] for i, s in enumerate(sensors) if given[step.index, i]}, yes)
        assert named(step.stages[-1].belief.probabilities) == pytest.approx(p)


def test_an_update_says_which_reading_moved_which_label() -> None:
    prior, _, sensors = model(np.random.default_rng(6))
    before = categorical(LABELS, prior)
    stage = update(before, {"u": np.ones(1), "s": np.zeros(1)}, sensors)
    assert (stage.name, stage.sensors) == ("update", ("s", "t", "u"))
    assert (stage.reading.tolist(), stage.offered.tolist()) == ([0, 0, 1], [True, False, True])
    want = np.log([1 - sensors["s"], np.ones(K), sensors["u"]])
    np.testing.assert_allclose(stage.log_likelihoods, want)
    moved = stage.belief.log_probabilities - before.log_probabilities - want.sum(0)
    np.testing.assert_allclose(moved, moved[0])  # the constant that is left


def test_neither_the_order_of_readings_nor_one_by_one_matters() -> None:
    prior, _, sensors = model(np.random.default_rng(7))
    readings = {s: np.array([float(i % 2)]) for i, s in enumerate(sensors)}
    at_once = update(categorical(LABELS, prior), readings, sensors).belief.log_probabilities
    for order in itertools.permutations(sensors):
        belief = categorical(LABELS, prior)
        for sensor in order:
            belief = update(belief, {sensor: readings[sensor]}, sensors).belief
        np.testing.assert_allclose(belief.log_probabilities, at_once)
        shuffled = update(categorical(LABELS, prior), readings, {s: sensors[s] for s in order}).belief
        np.testing.assert_allclose(shuffled.log_probabilities, at_once)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
def test_batches_are_their_members(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(8)
    _, T, sensors = model(rng)
    prior = rng.dirichlet(np.ones(K), batch)
    readings = {s: rng.integers(0, 2, (*batch, 1)).astype(float) for s in ("s", "u")}
    moved = predict(categorical(LABELS, prior), T).belief
    stage = update(moved, readings, sensors)
    assert stage.log_likelihoods.shape == (*batch, 3, K)
    assert stage.reading.shape == stage.offered.shape == (*batch, 3)
    assert stage.belief.log_probabilities.shape == (*batch, K)
    for i in np.ndindex(batch):
        alone = update(
            predict(categorical(LABELS, prior[i]), T).belief, {s: z[i] for s, z in readings.items()}, sensors
        )
        np.testing.assert_allclose(stage.belief.log_probabilities[i], alone.belief.log_probabilities)
        np.testing.assert_array_equal(stage.log_likelihoods[i], alone.log_likelihoods)


def test_beliefs_stay_normalised_and_finite_however_sure_they_become() -> None:
    sensors = {"s": np.array([0.9, 0.1, 0.1, 0.0])}
    belief = categorical(LABELS, np.full(K, 0.25))
    for _ in range(2000):  # the odds of a over b reach 9²⁰⁰⁰, far beyond what a float holds
        belief = update(belief, {"s": np.ones(1)}, sensors).belief
        assert np.isfinite(belief.log_probabilities).all()
        assert belief.probabilities.sum() == pytest.approx(1, abs=1e-12)
    assert belief.log_probabilities[1] == pytest.approx(-2000 * math.log(9))
    for _ in range(2000):  # and nothing of b was lost on the way
        belief = update(belief, {"s": np.zeros(1)}, {"s": sensors["s"][[0, 1, 2, 2]]}).belief
    np.testing.assert_allclose(belief.probabilities, [1 / 3, 1 / 3, 1 / 3, 0], rtol=1e-9)


def test_what_is_impossible_stays_so() -> None:
    belief = categorical(LABELS, np.array([0.5, 0.5, 0.0, 0.0]))
    assert belief.log_probabilities.tolist()[2:] == [LOG_ZERO, LOG_ZERO]
    assert belief.probabilities.tolist() == [0.5, 0.5, 0, 0]
    for _ in range(100):
        belief = update(
            predict(belief, np.eye(K)).belief, {"s": np.ones(1)}, {"s": np.array([0.1, 0.1, 0.9, 1.0])}
        ).belief
    assert belief.probabilities.tolist() == pytest.approx([0.5, 0.5, 0, 0])
    assert belief.log_probabilities.tolist()[2:] == [LOG_ZERO, LOG_ZERO]
    opened = predict(belief, redrawn(np.full(K, 0.25), 0.8)).belief  # but a transition may lead there
    np.testing.assert_allclose(opened.probabilities, [0.45, 0.45, 0.05, 0.05])


def test_a_reading_that_no_label_can_give_ends_the_run_at_its_step() -> None:
    sensors = {"s": np.array([1.0, 0, 0, 0]), "t": np.array([0, 1.0, 0, 0])}
    ticks = [Tick(float(k), 0.0, measurements={"s": np.ones(1), "t": np.array([float(k == 2)])}) for k in range(5)]
    steps = list(run(Scenario(DiscreteFilter(np.eye(K), sensors), {0: categorical(LABELS, np.full(K, 0.25))}, ticks)))
    assert len(steps) == 3
    assert steps[-1].error is not None
    assert (steps[-1].error.step, steps[-1].error.stage) == (2, "update")
    assert "no label can give what was read" in steps[-1].error.message
    # One after the other as well: what the first reading left is what the second excludes.
    first = update(categorical(LABELS, np.full(K, 0.25)), {"s": np.ones(1)}, sensors).belief
    with pytest.raises(ArithmeticError, match="no label"):
        update(first, {"t": np.ones(1)}, sensors)
    with pytest.raises(ArithmeticError, match="no label"):
        normalised(np.full((2, 3), LOG_ZERO))


def test_a_label_stays_or_is_drawn_anew() -> None:
    prior = np.array([0.1, 0.2, 0.7])
    T = redrawn(prior, 0.9)
    np.testing.assert_allclose(T.sum(1), 1)
    np.testing.assert_allclose(prior @ T, prior)
    np.testing.assert_allclose(T - np.diag(np.diag(T)), 0.1 * (prior - np.diag(prior)))
    np.testing.assert_array_equal(redrawn(prior, 1.0), np.eye(3))
    belief = predict(categorical("xyz", np.array([1.0, 0, 0])), np.linalg.matrix_power(T, 200)).belief
    np.testing.assert_allclose(belief.probabilities, prior, atol=1e-6)


def test_stages_are_understood_by_their_types() -> None:
    prior, T, sensors = model(np.random.default_rng(9))
    belief = categorical(LABELS, prior)
    moved = predict(belief, T, name="moved")
    assert isinstance(moved, DiscretePredict)
    assert (moved.name, moved.belief.labels) == ("moved", LABELS)
    np.testing.assert_array_equal(moved.transition, T)
    assert isinstance(update(belief, {}, sensors), DiscreteUpdate)
    np.testing.assert_array_equal(update(belief, {}, sensors).belief.probabilities, belief.probabilities)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda b, s: categorical(LABELS, np.array([0.5, 0.5])), "expected 4 probabilities"),
        (lambda b, s: categorical(LABELS, np.full(K, 0.3)), "must sum to 1"),
        (lambda b, s: categorical(LABELS, np.array([1.5, -0.5, 0, 0])), "between 0 and 1"),
        (lambda b, s: logarithms(np.array([0.5, np.nan])), "between 0 and 1"),
        (lambda b, s: DiscreteFilter(np.ones((K, K)), s), "each row of the transition must sum to 1"),
        (lambda b, s: update(b, {"s": np.array([0.5])}, s), "0 or 1"),
        (lambda b, s: update(b, {"s": np.array([np.nan])}, s), "0 or 1"),
    ],
)
def test_what_is_no_probability_or_no_reading_is_refused(call: Any, words: str) -> None:
    prior, _, sensors = model(np.random.default_rng(10))
    with pytest.raises(ValueError, match=words):
        call(categorical(LABELS, prior), sensors)


def test_metrics_are_the_share_of_right_labels_and_the_mean_log_loss() -> None:
    p = np.array([[0.7, 0.2, 0.1], [0.4, 0.5, 0.1], [0.1, 0.1, 0.8], [0.2, 0.2, 0.6]])
    truth = np.array([[0.0], [0.0], [np.nan], [2.0]])
    found = categorical_metrics(np.log(p), truth)
    assert found == {
        "accuracy": pytest.approx(2 / 3),
        "log_loss_nats": pytest.approx(-(math.log(0.7) + math.log(0.4) + math.log(0.6)) / 3),
    }
    assert categorical_metrics(np.log(p), np.full((4, 1), np.nan)) == {}


def test_beliefs_on_data_of_the_model_s_own_are_calibrated() -> None:
    """Of all steps of 400 chains on which a label has about probability p, it is true on a share of p."""
    rng, chains, steps = np.random.default_rng(11), 400, 100
    prior, sensors = np.full(K, 1 / K), {"s": np.array([0.8, 0.1, 0.3, 0.1]), "t": np.array([0.2, 0.9, 0.2, 0.4])}
    T = redrawn(prior, 0.9)
    belief, label = categorical(LABELS, np.tile(prior, (chains, 1))), rng.integers(0, K, chains)
    said, true = [], []
    for _ in range(steps):
        label = np.where(rng.random(chains) < 0.9, label, rng.integers(0, K, chains))
        readings = {s: (rng.random(chains) < yes[label]).astype(float)[:, None] for s, yes in sensors.items()}
        belief = update(predict(belief, T).belief, readings, sensors).belief
        said.append(belief.probabilities)
        true.append(label[:, None] == np.arange(K))
    p, right = np.concatenate(said), np.concatenate(true)
    for low in np.arange(0, 1, 0.1):
        inside = (p >= low) & (p < low + 0.1)
        assert right[inside].mean() == pytest.approx(p[inside].mean(), abs=0.03), low


class Yields:
    """An estimator that yields one belief, whatever it is."""

    def __init__(self, belief: Any) -> None:
        self.belief = belief

    def step(self, belief: Any, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        yield Stage("own", self.belief)


@pytest.mark.parametrize(
    ("belief", "words"),
    [
        (Categorical(LABELS[:3], np.log(np.full(3, 1 / 3))), r"log_probabilities of shape (4,), got (3,)"),
        (Gaussian(Euclidean(["x"]), np.zeros(1), np.eye(1)), "log_probabilities of shape (4,), got NoneType"),
        (Categorical(LABELS, np.array([0.0, -np.inf, -np.inf, -np.inf])), "no longer finite"),
        (None, "log_probabilities of shape (4,), got NoneType"),
    ],
)
def test_a_run_holds_beliefs_over_labels_to_those_of_its_start(belief: Any, words: str) -> None:
    scenario = Scenario(Yields(belief), {0: categorical(LABELS, np.full(K, 0.25))}, [Tick(0.0, 0.0)])
    assert scenario.space is None
    (step,) = run(scenario)
    assert step.error is not None
    assert words in step.error.message
