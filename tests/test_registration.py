"""Iterated closest points against brute force and Kabsch; the fit, its covariance, and where there is none."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from viz_estim.core import quaternions
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.consistency import band, squared_distance
from viz_estim.core.quaternions import Array
from viz_estim.core.registration import SPACES, ClosestPoints, align, fit, moved, nearest, start, to_pose, to_state
from viz_estim.core.run import Scenario, Step, Tick, run
from viz_estim.core.stages import Align, Match

both = pytest.mark.parametrize("d", [2, 3])


def turn(d: int, vector: Array) -> Array:
    """A rotation matrix (*, d, d) by a rotation vector (*, 3); in the plane by its last number."""
    if d == 3:
        return quaternions.to_matrix(quaternions.exp(vector))
    c, s = np.cos(vector[..., 2]), np.sin(vector[..., 2])
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def surface(rng: np.random.Generator, d: int, count: int) -> Array:
    """Points of a bent curve or surface."""
    p = rng.uniform(-1, 1, (count, d))
    p[:, -1] = 0.4 * np.sin(3 * p[:, 0]) + 0.3 * p[:, 0] ** 2 + (0.3 * np.cos(4 * p[:, 1]) if d == 3 else 0)
    return p


def pair(d: int, seed: int, count: int = 150) -> tuple[Array, Array]:
    """X and Y: two draws from one surface, X shifted and turned a little."""
    rng = np.random.default_rng(seed)
    R, t = turn(d, rng.uniform(-0.2, 0.2, 3)), rng.uniform(-0.15, 0.15, d)
    return (surface(rng, d, count) - t) @ R, surface(rng, d, count + 20)


def scenario(X: Array, Y: Array, max_distance: float, iterations: int) -> Scenario:
    ticks = [Tick(float(k), float(k > 0)) for k in range(iterations + 1)]
    return Scenario(ClosestPoints(X, Y, max_distance), {0: start(X, max_distance)}, ticks)


def naive(X: Array, Y: Array, max_distance: float) -> Iterator[tuple[list[tuple[int, int]], Array, Array]]:
    """Besl and McKay's loop over single points, the fit as Kabsch (1976) wrote it: matches, R, t by iteration."""
    d = X.shape[1]
    R, t = np.eye(d), np.zeros(d)
    while True:
        pairs = []
        for i, x in enumerate(X):
            away = [float(np.linalg.norm(R @ x + t - y)) for y in Y]
            j = int(np.argmin(away))
            if away[j] <= max_distance:
                pairs.append((i, j))
        x_mean = sum(X[i] for i, _ in pairs) / len(pairs)
        y_mean = sum(Y[j] for _, j in pairs) / len(pairs)
        H = sum(np.outer(X[i] - x_mean, Y[j] - y_mean) for i, j in pairs)
        U, _, Vt = np.linalg.svd(H)
        mirror = np.diag([*[1.0] * (d - 1), np.linalg.det(Vt.T @ U.T)])
        R = Vt.T @ mirror @ U.T
        t = y_mean - R @ x_mean
        yield pairs, R, t


@both
@pytest.mark.parametrize("max_distance", [0.12, 5.0])
def test_each_iteration_is_that_of_the_naive_loop(d: int, max_distance: float) -> None:
    X, Y = pair(d, 1, 80)
    steps = list(run(scenario(X, Y, max_distance, 6)))
    assert (steps[1].stages[-1].count < len(X)) == (max_distance < 1)
    assert [[stage.name for stage in step.stages] for step in steps] == [["start"], *[["match", "align"]] * 6]
    for step, (pairs, R, t) in zip(steps[1:], naive(X, Y, max_distance), strict=False):
        found, fitted = step.stages
        assert isinstance(found, Match)
        assert isinstance(fitted, Align)
        matches = found.matches
        assert list(zip(matches.source_index, matches.target_index, strict=True)) == pairs
        assert fitted.count == len(pairs) == len(matches.source)
        assert fitted.count == len(X) or max_distance < 1
        np.testing.assert_array_equal(matches.target, Y[matches.target_index])
        np.testing.assert_allclose(matches.source, moved(found.belief.mean, X)[matches.source_index], atol=1e-14)
        np.testing.assert_allclose(matches.distance, np.linalg.norm(matches.source - matches.target, axis=1))
        for got, want in zip(to_pose(fitted.belief.mean), (R, t), strict=True):
            np.testing.assert_allclose(got, want, atol=1e-12)
        squares = [float(((R @ X[i] + t - Y[j]) ** 2).sum()) for i, j in pairs]
        assert fitted.rmse == pytest.approx(np.sqrt(np.mean(squares)))


@both
def test_the_nearest_is_the_nearest_and_the_bound_is_included(d: int) -> None:
    rng = np.random.default_rng(2)
    points, Y = rng.standard_normal((80, d)), rng.standard_normal((60, d))
    away = np.linalg.norm(points[:, None] - Y, axis=-1)
    bound = float(np.sort(away.min(1))[40])
    found = nearest(points, cKDTree(Y), bound)
    np.testing.assert_array_equal(found.source_index, np.flatnonzero(away.min(1) <= bound))
    np.testing.assert_array_equal(found.target_index, away.argmin(1)[found.source_index])
    np.testing.assert_array_equal(found.source, points[found.source_index])
    assert len(found.distance) == 41
    none = nearest(points + 100, cKDTree(Y), 1.0)
    assert (none.source.shape, none.target.shape, none.distance.shape) == ((0, d), (0, d), (0,))
    every = nearest(points, cKDTree(Y), 100.0)
    assert every.source is points  # no copy where all have a match


@both
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi, -3.0])
def test_a_pose_is_found_again_whatever_its_angle_in_a_batch(d: int, angle: float) -> None:
    rng = np.random.default_rng(3)
    axis = quaternions.normalise(rng.standard_normal((20, 3))) if d == 3 else np.tile([0.0, 0.0, 1.0], (20, 1))
    R, t, x = turn(d, angle * axis), rng.standard_normal((20, d)), rng.standard_normal((20, 7, d))
    y = np.stack([x[i] @ R[i].T + t[i] for i in range(20)])
    found = fit(x, y)
    np.testing.assert_allclose(found.R, R, atol=1e-12)
    np.testing.assert_allclose(found.t, t, atol=1e-12)
    np.testing.assert_allclose(found.residual, 0, atol=1e-12)
    assert np.abs(found.cov).max() < 1e-24
    state = to_state(found.R, found.t)
    assert state.shape == (20, len(SPACES[d].names))
    for got, want in zip(to_pose(state), (R, t), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-12)
    np.testing.assert_allclose(moved(state, x), y, atol=1e-12)


@both
def test_a_mirrored_cloud_gets_a_rotation_and_the_best_there_is(d: int) -> None:
    rng = np.random.default_rng(4)
    x = rng.standard_normal((30, d)) * [3.0, 2.0, 1.0][:d]
    y = x * [*[1.0] * (d - 1), -1.0] + 0.1 * rng.standard_normal((30, d))
    R, t, residual, _ = fit(x, y)
    assert np.linalg.det(R) == pytest.approx(1)
    best = (residual**2).sum()
    for _ in range(2000):  # none of many other rotations, near and far, is better
        other = turn(d, rng.standard_normal(3) * rng.choice([0.01, 0.3, 3.0])) @ R
        at_best = y.mean(0) - other @ x.mean(0)
        assert ((y - x @ other.T - at_best) ** 2).sum() >= best
    np.testing.assert_allclose(t, y.mean(0) - R @ x.mean(0), atol=1e-12)


@both
def test_the_covariance_is_the_least_squares_one_of_a_numerical_jacobian(d: int) -> None:
    rng, space, step = np.random.default_rng(5), SPACES[d], 1e-6
    x = rng.standard_normal((12, d)) + [4.0, -3.0, 2.0][:d]
    y = x @ turn(d, np.array([0.5, -1.0, 2.0])).T + rng.uniform(-1, 1, d) + 0.05 * rng.standard_normal((12, d))
    R, t, residual, cov = fit(x, y)
    state, p = to_state(R, t), len(space.axes)
    J = np.stack(
        [(moved(space.plus(state, e), x) - moved(space.plus(state, -e), x)).ravel() for e in step * np.eye(p)], axis=1
    ) / (2 * step)
    np.testing.assert_allclose(J.T @ residual.ravel(), 0, atol=1e-8)  # it is the minimum
    want = (residual**2).sum() / (12 * d - p) * np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(cov, want, rtol=1e-6)
    np.testing.assert_array_equal(cov, cov.T)


@both
def test_with_right_matches_and_independent_noise_the_covariance_is_consistent(d: int) -> None:
    rng, runs, K = np.random.default_rng(6), 3000, 60
    x = rng.standard_normal((K, d)) + 2
    R, t = turn(d, np.array([0.4, 1.5, -0.7])), rng.standard_normal(d)
    found = fit(np.broadcast_to(x, (runs, K, d)), x @ R.T + t + 0.03 * rng.standard_normal((runs, K, d)))
    error = SPACES[d].minus(to_state(R, t), to_state(found.R, found.t))
    p = len(SPACES[d].axes)
    mean = squared_distance(error, found.cov).mean()
    dof = d * K - p  # s² is estimated too: p·F(p, dof), whose mean is p·dof/(dof − 2)
    low, high = band(p, runs, 0.999)
    assert low <= mean * (dof - 2) / dof <= high


def test_iterated_matches_are_wrong_and_the_covariance_does_not_know() -> None:
    X, Y = pair(3, 7, count=1500)
    *_, last = run(scenario(X, Y, 0.5, 60))
    rng = np.random.default_rng(7)
    truth = to_state(turn(3, rng.uniform(-0.2, 0.2, 3)), rng.uniform(-0.15, 0.15, 3))
    belief = last.stages[-1].belief
    assert squared_distance(SPACES[3].minus(belief.mean, truth), belief.cov) > 50
    assert np.abs(SPACES[3].minus(belief.mean, truth)).max() < 0.03


LINE = np.linspace(-1, 1, 9)[:, None]
DEGENERATE: dict[str, Callable[[], tuple[Array, Array]]] = {
    "one place": lambda: (np.ones((5, 3)), np.ones((5, 3))),
    "one place in the plane": lambda: (np.ones((5, 2)), np.ones((5, 2))),
    "many to one": lambda: (np.random.default_rng(0).standard_normal((5, 3)), np.ones((5, 3))),
    "a line": lambda: (LINE * [1.0, 2.0, 3.0] + 5, LINE * [3.0, -1.0, 0.5]),
    "a line of targets": lambda: (np.random.default_rng(0).standard_normal((9, 3)), LINE * [3.0, -1.0, 0.5]),
    "two points": lambda: (np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0], [0, 1, 0]])),
    "a mirrored square": lambda: (
        np.array([[1.0, 1], [-1, 1], [-1, -1], [1, -1]]),
        np.array([[1.0, -1], [-1, -1], [-1, 1], [1, 1]]),
    ),
}


@pytest.mark.parametrize("what", DEGENERATE)
def test_what_determines_no_rotation_is_refused(what: str) -> None:
    with pytest.raises(ArithmeticError, match="do not determine a rotation"):
        fit(*DEGENERATE[what]())


def test_a_line_in_the_plane_and_two_points_of_it_determine_a_pose() -> None:
    R, t = turn(2, np.array([0.0, 0.0, 2.5])), np.array([1.0, -2.0])
    for x in (LINE * [1.0, 2.0] + 3, np.array([[0.0, 1.0], [2.0, 0.5]])):
        found = fit(x, x @ R.T + t)
        np.testing.assert_allclose(found.R, R, atol=1e-12)
        assert np.isfinite(found.cov).all()


@pytest.mark.parametrize("near", [0, 1, 2])
def test_too_few_matches_end_the_run_at_the_fit_and_the_match_is_kept(near: int) -> None:
    Y = np.random.default_rng(8).standard_normal((20, 3))
    X = np.concatenate([Y[:near], Y[near:] + 100])
    *_, last = run(scenario(X, Y, 0.25, 5))
    assert last.error is not None
    assert (last.index, last.error.stage) == (1, "align")
    assert f"{near} of 20 points have a match, a pose takes at least 3" in last.error.message
    (found,) = last.stages
    assert isinstance(found, Match)
    assert len(found.matches.distance) == near


@both
@pytest.mark.parametrize("max_distance", [0.2, 5.0])
def test_it_converged_where_another_iteration_has_the_same_matches(d: int, max_distance: float) -> None:
    X, Y = pair(d, 9)
    steps = list(run(scenario(X, Y, max_distance, 80)))
    pairs = [(s.stages[0].matches.source_index, s.stages[0].matches.target_index) for s in steps[1:]]
    repeats = [all(map(np.array_equal, a, b)) for a, b in zip(pairs[1:], pairs, strict=False)]
    assert [step.stages[-1].converged for step in steps[1:-1]] == repeats
    first = repeats.index(True)
    assert 3 < first < 79
    assert all(repeats[first:])
    poses = np.stack([step.stages[-1].belief.mean for step in steps[first + 1 :]])
    np.testing.assert_allclose(poses - poses[0], 0, atol=1e-15)
    if max_distance > 1:  # with one set of points in the fit, the error never rises (Besl and McKay's theorem)
        rmse = np.array([step.stages[-1].rmse for step in steps[1:]])
        assert (np.diff(rmse) <= 1e-15).all()


def test_a_run_ends_after_the_first_step_of_which_until_is_true() -> None:
    X, Y = pair(3, 10)
    whole = list(run(scenario(X, Y, 5.0, 80)))
    first = next(step.index for step in whole[1:] if step.stages[-1].converged)

    def converged(step: Step) -> bool:
        return isinstance(step.stages[-1], Align) and step.stages[-1].converged

    ended = list(run(replace(scenario(X, Y, 5.0, 80), until=converged)))
    assert len(ended) == first + 1
    np.testing.assert_array_equal(ended[-1].stages[-1].belief.mean, whole[first].stages[-1].belief.mean)


def test_the_belief_is_all_that_a_step_carries_on() -> None:
    X, Y = pair(3, 11)
    whole = scenario(X, Y, 0.3, 10)
    steps = list(run(whole))
    for k in (7, 3, 9, 4):  # in any order, by the estimator that has run and by a new one
        for estimator in (whole.estimator, ClosestPoints(X, Y, 0.3)):
            again = list(estimator.step(steps[k - 1].stages[-1].belief, whole.ticks[k], np.random.default_rng()))
            for one, other in zip(again, steps[k].stages, strict=True):
                np.testing.assert_array_equal(one.belief.mean, other.belief.mean)
                np.testing.assert_array_equal(one.belief.cov, other.belief.cov)
            assert isinstance(again[1], Align)
            assert again[1] == replace(steps[k].stages[1], belief=again[1].belief)


@both
def test_the_start_is_the_identity_known_as_well_as_a_match_can_bridge(d: int) -> None:
    X = np.random.default_rng(12).standard_normal((500, d)) * 4
    belief = start(X, 0.25)
    np.testing.assert_array_equal(moved(belief.mean, X), X)
    turned = np.sqrt(np.diag(belief.cov)[d:])
    np.testing.assert_allclose(turned * np.sqrt((X**2).sum(1).mean()), 0.25)
    np.testing.assert_allclose(np.diag(belief.cov)[:d], 0.25**2)
    assert np.diag(start(X, 1e6).cov)[-1] == pytest.approx(np.pi**2)
    assert np.diag(start(0 * X, 1.0).cov)[-1] == pytest.approx(np.pi**2)


def test_align_takes_the_belief_s_space_and_its_own_name() -> None:
    X, Y = pair(2, 13)
    belief = Gaussian(SPACES[2], np.zeros(3), np.eye(3))
    stage = align(belief, X, nearest(X, cKDTree(Y), 1.0), name="align/again")
    assert (stage.name, stage.belief.space, stage.converged) == ("align/again", SPACES[2], False)
