"""Resampling schemes by their properties, the filter against a plain loop and against Kalman's, moments and modes."""

from typing import Any, get_args

import numpy as np
import pytest

from viz_estim.core import kalman
from viz_estim.core.beliefs import Gaussian, Particles
from viz_estim.core.modes import moments, several
from viz_estim.core.particle import ParticleFilter, equal, predict, resample, weigh
from viz_estim.core.resampling import METHODS, Method
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.core.spaces import S2, SE2, SO2, SO3, Euclidean, Product, Space
from viz_estim.core.stages import Resample, Weigh

LINE = Euclidean(("x",), "m")
PLANAR = Product(position=Euclidean(("x", "y"), "m"), heading=SO2())
READ = Tick(1.0, 0.1, measurements={"range": np.zeros(1)})
EVERY = pytest.mark.parametrize("method", get_args(Method))


def random_weights(rng: np.random.Generator, *shape: int) -> Any:
    weights = rng.random(shape) ** 4
    weights[..., 3] = 0.0
    return weights / weights.sum(-1, keepdims=True)


@EVERY
@pytest.mark.parametrize("shape", [(1,), (2,), (7,), (1000,), (3, 50), (2, 3, 20)])
def test_copies_are_as_many_as_particles(method: Method, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    weights = random_weights(rng, *shape[:-1], max(shape[-1], 4))[..., : shape[-1]]
    weights = weights / weights.sum(-1, keepdims=True)
    copies = METHODS[method](weights, rng)
    assert (copies.shape, copies.dtype.kind) == (shape, "i")
    assert (copies >= 0).all()
    assert (copies.sum(-1) == shape[-1]).all()
    assert (copies[weights == 0] == 0).all()


@EVERY
def test_copies_are_unbiased_and_spread_as_the_method_allows(method: Method) -> None:
    rng = np.random.default_rng(2)
    weights = random_weights(rng, 12)
    copies = METHODS[method](np.broadcast_to(weights, (20_000, 12)), rng)
    expected = 12 * weights
    std = np.sqrt(expected * (1 - weights))  # of independent draws: no method has more
    assert (np.abs(copies.mean(0) - expected) <= 4.5 * std / np.sqrt(20_000) + 1e-12).all()
    if method == "multinomial":
        np.testing.assert_allclose(copies.std(0), std, atol=0.03)
    else:
        assert copies.var(0).sum() < (std**2).sum()
    if method == "systematic":
        assert ((copies == np.floor(expected)) | (copies == np.ceil(expected))).all()
    if method == "residual":
        assert (copies >= np.floor(expected)).all()
    if method == "stratified":
        assert (np.abs(copies - expected) < 2).all()


@EVERY
@pytest.mark.parametrize("count", [3, 10, 1000, 100_000])
def test_equal_weights_and_one_heavy_particle(method: Method, count: int) -> None:
    rng = np.random.default_rng(3)
    if method != "multinomial":
        copies = METHODS[method](np.exp(np.full(count, -np.log(count))), rng)
        # Rounding may shift a stratum's border by one particle.
        assert np.abs(copies - 1).max() <= (method != "residual")
        assert (copies != 1).sum() <= (0 if method == "residual" else 0.02 * count)
    one = np.zeros(count)
    one[count // 2] = 1.0
    assert (METHODS[method](one, rng) == count * one).all()


def test_systematic_and_stratified_are_a_search_for_their_points() -> None:
    weights = random_weights(np.random.default_rng(4), 500)
    for method, size in (("systematic", 1), ("stratified", 500)):
        u = np.random.default_rng(5).random(size)
        found = np.searchsorted(np.cumsum(weights), (np.arange(500) + u) / 500, side="right")
        copies = METHODS[method](weights, np.random.default_rng(5))  # type: ignore[index]
        np.testing.assert_array_equal(np.repeat(np.arange(500), copies), found)


def diffuse(x: Any, tick: Tick, rng: np.random.Generator) -> Any:
    return x + rng.normal(0, 0.3, x.shape)


def near_zero(x: Any, tick: Tick) -> Any:
    return -0.5 * (x[..., 0] - tick.measurements["range"][0]) ** 2 / 0.5


def test_stages_against_the_textbook_s_sums() -> None:
    rng = np.random.default_rng(6)
    states, weights = rng.normal(0, 2, (300, 1)), random_weights(rng, 300) + 1e-9
    belief = Particles(LINE, states, np.log(weights / weights.sum()))
    moved = predict(belief, diffuse, READ, np.random.default_rng(7))
    assert moved.belief.log_weights is belief.log_weights
    np.testing.assert_array_equal(moved.belief.states, states + np.random.default_rng(7).normal(0, 0.3, (300, 1)))
    stage = weigh(belief, near_zero, READ)
    likelihood = np.exp(-(states[:, 0] ** 2))
    after = np.exp(belief.log_weights) * likelihood
    np.testing.assert_allclose(stage.log_likelihoods, np.log(likelihood))
    assert stage.evidence == pytest.approx(np.log(after.sum()))
    np.testing.assert_allclose(np.exp(stage.belief.log_weights), after / after.sum())
    assert stage.ess == pytest.approx(after.sum() ** 2 / (after**2).sum())
    assert stage.belief.ess == pytest.approx(float(stage.ess))
    drawn = resample(stage.belief, rng)
    np.testing.assert_array_equal(drawn.belief.states, states[drawn.ancestors])
    np.testing.assert_allclose(drawn.belief.log_weights, -np.log(300))
    assert (drawn.distinct, drawn.ess) == (len(np.unique(drawn.ancestors)), pytest.approx(float(stage.ess)))
    assert all(isinstance(value, np.ndarray) for value in (stage.evidence, stage.ess, drawn.distinct, drawn.ess))


@EVERY
def test_it_is_the_kalman_filter_where_that_is_exact(method: Method) -> None:
    F, Q, R = np.eye(1), np.array([[0.09]]), np.array([[0.5]])
    exact = kalman.linear(F, Q, {"range": kalman.linear_sensor(LINE, F, R)})

    def log_likelihood(x: Any, tick: Tick) -> Any:
        return near_zero(x, tick) - 0.5 * np.log(2 * np.pi * 0.5)

    rng = np.random.default_rng(8)
    z = rng.normal(1, 0.7, 15)
    ticks = [Tick(float(k), float(k > 0), measurements={"range": z[k : k + 1]}) for k in range(15)]
    cloud = equal(LINE, rng.normal(0, 1, (40_000, 1)))
    wanted = run(Scenario(exact, {0: Gaussian(LINE, np.zeros(1), np.eye(1))}, ticks))
    filters = ParticleFilter(diffuse, log_likelihood, method, 0.7)
    for step, want in zip(run(Scenario(filters, {0: cloud}, ticks)), wanted, strict=True):
        got, true = step.stages[-1].belief, want.stages[-1].belief
        np.testing.assert_allclose(got.mean, true.mean, atol=0.025)
        np.testing.assert_allclose(got.cov, true.cov, rtol=0.06)
        (evidence,) = [stage.evidence for stage in step.stages if isinstance(stage, Weigh)]
        seen: Any = want.stages[-1]
        S = seen.innovation.cov[0, 0]
        assert evidence == pytest.approx(
            -0.5 * (seen.innovation.residual[0] ** 2 / S + np.log(2 * np.pi * S)), abs=0.03
        )


def test_it_resamples_below_the_threshold_alone() -> None:
    cloud = equal(LINE, np.linspace(-3, 3, 100)[:, None])
    ess = float(weigh(cloud, near_zero, READ).ess) / 100
    rng = np.random.default_rng(9)
    for threshold, names in ((1.0, 3), (ess + 0.01, 3), (ess - 0.01, 2)):
        still = ParticleFilter(lambda x, tick, rng: x, near_zero, threshold=threshold)
        assert len(list(still.step(cloud, READ, rng))) == names
    assert [s.name for s in still.step(cloud, Tick(0.0, 0.0), rng)] == []
    assert [s.name for s in still.step(cloud, Tick(0.0, 0.1), rng)] == ["predict"]
    assert [s.name for s in still.step(cloud, Tick(0.0, 0.0, measurements=READ.measurements), rng)] == ["weigh"]


@EVERY
def test_a_batch_is_resampled_where_its_members_need_it(method: Method) -> None:
    rng = np.random.default_rng(10)
    states = np.stack([np.linspace(-9, 9, 200)[:, None], 0.01 * rng.standard_normal((200, 1))])
    both = ParticleFilter(lambda x, tick, rng: x, near_zero, method, 0.5)
    *_, weighed, drawn = both.step(equal(LINE, states), READ, rng)
    assert isinstance(drawn, Resample)
    np.testing.assert_array_equal(drawn.ancestors[1], np.arange(200))
    np.testing.assert_array_equal(drawn.belief.log_weights[1], weighed.belief.log_weights[1])
    assert (drawn.distinct[0] < 100, drawn.distinct[1]) == (True, 200)
    for state, ancestors, copied in zip(states, drawn.ancestors, drawn.belief.states, strict=True):
        np.testing.assert_array_equal(state[ancestors], copied)
    for i in (0, 1):
        alone = equal(LINE, states[i])
        np.testing.assert_allclose(weigh(alone, near_zero, READ).evidence, weighed.evidence[i])
        np.testing.assert_allclose(equal(LINE, states).mean[i], alone.mean, atol=1e-12)
        np.testing.assert_allclose(equal(LINE, states).cov[i], alone.cov)


def test_impossible_particles_are_let_go_and_impossible_readings_end_the_run() -> None:
    cloud = equal(LINE, np.linspace(-1, 1, 10)[:, None])

    def wall(x: Any, tick: Tick) -> Any:
        return np.where(x[..., 0] > tick.measurements["range"][0], -np.inf, 0.0)

    ticks = [Tick(float(k), float(k > 0), measurements={"range": np.array([z])}) for k, z in enumerate((0.0, -2.0))]
    still = ParticleFilter(lambda x, tick, rng: x, wall)
    first, last = run(Scenario(still, {0: cloud}, ticks))
    assert (first.stages[-1].belief.states < 0).all()
    assert (first.error, np.exp(first.stages[1].belief.log_weights[-1])) == (None, 0)
    assert last.error
    assert (last.error.stage, last.stages[-1].name) == ("weigh", "predict")
    assert "no particle" in last.error.message
    broken = ParticleFilter(lambda x, tick, rng: x, lambda x, tick: np.full(10, np.nan))
    assert next(run(Scenario(broken, {0: cloud}, ticks[:1]))).error is not None


def test_chance_comes_from_the_step_alone() -> None:
    ticks = [Tick(float(k), float(k > 0), measurements=READ.measurements) for k in range(5)]
    scenario = Scenario(
        ParticleFilter(diffuse, near_zero, "multinomial"), {0: equal(LINE, np.linspace(-1, 1, 50)[:, None])}, ticks
    )
    one, again, other = (list(run(scenario, seed)) for seed in (4, 4, 5))
    np.testing.assert_array_equal(one[-1].stages[-1].belief.states, again[-1].stages[-1].belief.states)
    assert (one[-1].stages[-1].belief.states != other[-1].stages[-1].belief.states).any()


SPACES: list[Space] = [LINE, SO2(), SO3(), SE2(), S2(), PLANAR]


@pytest.mark.parametrize("space", SPACES, ids=lambda space: type(space).__name__)
def test_moments_are_those_on_the_manifold(space: Space) -> None:
    rng = np.random.default_rng(11)
    d = len(space.axes)
    start = {4: np.array([0.5, 0.5, -0.5, 0.5]), 3: np.array([0.0, 0.6, 0.8])}.get(len(space.names), np.array([3.1]))
    states = space.plus(start, 0.4 * rng.standard_normal((2, 400, d)))
    weights = random_weights(rng, 2, 400)
    with np.errstate(divide="ignore"):
        log_weights = np.maximum(np.log(weights), -1e9)
    belief = Particles(space, states, log_weights)
    np.testing.assert_allclose(space.minus(belief.mean, space.mean(states, weights)), 0, atol=1e-8)
    error = space.minus(states, belief.mean[:, None])
    np.testing.assert_allclose(belief.cov, np.einsum("bn,bni,bnj->bij", weights, error, error), atol=1e-12)
    assert belief.mean is belief.mean
    assert belief.shapes == {"states": (400, len(space.names)), "log_weights": (400,)}


def test_headings_all_around_have_a_position_all_the_same() -> None:
    rng = np.random.default_rng(12)
    states = rng.uniform([0, 0, -np.pi], [20, 10, np.pi], (1200, 3))
    belief = equal(PLANAR, states)
    np.testing.assert_allclose(belief.mean[:2], states[:, :2].mean(0))
    assert np.isfinite(belief.mean).all()
    assert 2 < belief.cov[2, 2] < 5  # π²/3 where every heading is as likely
    opposite = equal(SO2(), np.array([[-np.pi / 2], [np.pi / 2]]))
    assert np.isfinite(opposite.mean).all()


def cloud(*parts: tuple[float, float, float, float], count: int = 1200, seed: int = 0) -> Particles:
    """Gaussian blobs (share, x, y, σ) with any heading."""
    rng = np.random.default_rng(seed)
    share, x, y, std = np.array(parts).T
    of = rng.choice(len(share), count, p=share)
    position = np.stack([x[of], y[of]], axis=-1) + std[of, None] * rng.standard_normal((count, 2))
    return equal(PLANAR, np.column_stack([position, rng.uniform(-np.pi, np.pi, count)]))


@pytest.mark.parametrize("count", [300, 1200, 100_000])
@pytest.mark.parametrize("seed", range(3))
def test_modes_that_stand_apart_are_found(count: int, seed: int) -> None:
    belief = cloud((0.6, 10, 1, 0.7), (0.3, 10, 9, 0.5), (0.1, 3, 4, 0.5), count=count, seed=seed)
    found = belief.modes()
    assert several(belief.space, belief.states, belief.log_weights)
    assert [mode.weight for mode in found] == pytest.approx([0.6, 0.3, 0.1], abs=3 / np.sqrt(count))
    for mode, (x, y, std) in zip(found, ((10, 1, 0.7), (10, 9, 0.5), (3, 4, 0.5)), strict=True):
        np.testing.assert_allclose(mode.mean[:2], [x, y], atol=6 * std / np.sqrt(count * mode.weight))
        np.testing.assert_allclose(mode.cov[:2, :2], std**2 * np.eye(2), atol=0.3 * std)


def test_weights_make_modes_and_unmake_them() -> None:
    two = cloud((0.5, 10, 1, 0.7), (0.5, 10, 9, 0.7))
    low = two.states[:, 1] < 5
    for share, count in ((0.5, 2), (0.9, 2), (0.97, 1)):
        weights = np.where(low, share / low.sum(), (1 - share) / (~low).sum())
        found = Particles(PLANAR, two.states, np.log(weights)).modes()
        assert len(found) == count
        assert found[0].weight == pytest.approx(share)
    assert len(Particles(PLANAR, two.states, np.log(weights)).modes(least=0.01)) == 2


@pytest.mark.parametrize("seed", range(20))
def test_one_mode_is_not_taken_for_several(seed: int) -> None:
    rng = np.random.default_rng(seed)
    uniform = equal(PLANAR, rng.uniform([0, 0, -np.pi], [20, 10, np.pi], (1200, 3)))
    blob = cloud((1.0, 5, 5, 1.0), seed=seed)
    few = equal(PLANAR, blob.states[np.repeat(rng.choice(1200, 60), 20)])
    turned = equal(SO3(), SO3().plus(np.array([1.0, 0, 0, 0]), 0.3 * rng.standard_normal((500, 3))))
    for one in (uniform, blob, few, turned, equal(PLANAR, np.ones((50, 3))), equal(LINE, np.zeros((1, 1)))):
        assert [mode.weight for mode in one.modes()] == [pytest.approx(1, abs=0.05)]
        assert not several(one.space, one.states, one.log_weights)


def test_modes_of_what_has_no_metres() -> None:
    rng = np.random.default_rng(13)
    angles = np.where(np.arange(400) < 150, -1.0, 1.0)[:, None] + 0.1 * rng.standard_normal((400, 1))
    found = equal(SO2(), angles).modes()
    assert [mode.weight for mode in found] == pytest.approx([250 / 400, 150 / 400])
    np.testing.assert_allclose([mode.mean[0] for mode in found], [1, -1], atol=0.05)


def test_modes_are_the_moments_of_their_members() -> None:
    two = cloud((0.5, 10, 1, 0.7), (0.5, 10, 9, 0.7))
    low = two.states[:, 1] < 5
    mean, cov = moments(PLANAR, two.states[low], np.full(low.sum(), -np.log(low.sum())))
    found = min(two.modes(), key=lambda mode: mode.mean[1])
    np.testing.assert_allclose(found.mean, mean, atol=1e-6)
    np.testing.assert_allclose(found.cov, cov, atol=1e-6)
