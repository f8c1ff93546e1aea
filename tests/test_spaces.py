"""The axioms of all spaces over batch shapes and draws, near identity and near half a turn; rotations against SciPy."""

import json

import numpy as np
import pytest
from scipy.linalg import block_diag, expm, logm
from scipy.spatial.transform import Rotation, Slerp

from viz_estim.core import quaternions
from viz_estim.core.descriptions import describe, rebuild
from viz_estim.core.euler import EulerAngles
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import S2, SE2, SO2, SO3, Euclidean, Product, Space, wrap

Shape = tuple[int, ...]
ORIGINS = {SO2: [0.0], SO3: [1.0, 0.0, 0.0, 0.0], SE2: [0.0, 0.0, 0.0], S2: [0.0, 0.0, 1.0]}
KRAFT = Product(attitude=SO3(), rate=Euclidean(("x", "y", "z"), "rad/s"))
GROUPS: list[Space] = [Euclidean(("a", "b"), ("m", "s")), SO2(), SO3(), SE2(), KRAFT]
SPACES = [*GROUPS, EulerAngles("zxy"), S2(), Product(pose=SE2(), heading=SO2(), imu=KRAFT, up=S2())]
SIZES = [None, 0.0, 1e-15, 1e-9, np.pi - 1e-9, np.pi]
spaces = pytest.mark.parametrize("space", SPACES, ids=lambda s: type(s).__name__)
groups = pytest.mark.parametrize("space", GROUPS, ids=lambda s: type(s).__name__)
shapes = pytest.mark.parametrize("shape", [(), (7,), (3, 5)], ids=str)
sizes = pytest.mark.parametrize("size", SIZES, ids=repr)


def unit(rng: np.random.Generator, shape: Shape, n: int) -> Array:
    return quaternions.normalise(rng.standard_normal((*shape, n)))


def origin(space: Space) -> Array:
    if isinstance(space, Product):
        return np.concatenate([origin(part) for part in space.parts.values()])
    return np.array(ORIGINS.get(type(space), [0.0] * len(space.names)))


def change(space: Space, rng: np.random.Generator, shape: Shape, size: float | None = None) -> Array:
    """Changes (*, d) that turn by `size` rad (None: any up to 3) and shift by about a metre, or by `size` if tiny."""
    if isinstance(space, Product):
        return np.concatenate([change(part, rng, shape, size) for part in space.parts.values()], axis=-1)
    shift = 1.0 if size is None or size > 1 else size
    turn = rng.uniform(0.01, 3.0, (*shape, 1)) if size is None else size
    if isinstance(space, SE2):
        return np.concatenate([shift * rng.standard_normal((*shape, 2)), turn * unit(rng, shape, 1)], axis=-1)
    return (shift if isinstance(space, Euclidean) else turn) * unit(rng, shape, len(space.axes))


def state(space: Space, rng: np.random.Generator, shape: Shape) -> Array:
    return space.plus(np.broadcast_to(origin(space), (*shape, len(space.names))), change(space, rng, shape))


def gap(space: Space, x: Array, y: Array) -> float:
    """The largest difference of two arrays of states: quaternions up to sign, angles up to full turns."""
    assert x.shape == y.shape
    if isinstance(space, Product):
        return max(gap(part, x[..., space.at[k]], y[..., space.at[k]]) for k, part in space.parts.items())
    if isinstance(space, SO3):
        return float(np.minimum(np.abs(x - y).max(-1), np.abs(x + y).max(-1)).max())
    differences = np.where(np.array(space.units) == "rad", wrap(x - y), x - y)
    return float(np.abs(differences).max())


@spaces
@shapes
@sizes
def test_plus_and_minus_undo_each_other(space: Space, shape: Shape, size: float | None) -> None:
    rng = np.random.default_rng(1)
    x, d = state(space, rng, shape), change(space, rng, shape, size)
    y = space.plus(x, d)
    assert gap(space, space.plus(x, space.minus(y, x)), y) < 1e-12
    if size != np.pi:  # a change is found again within half a turn; close to it a sphere's directions run together
        np.testing.assert_allclose(space.minus(y, x), d, rtol=0, atol=1e-6 if size and size > 3 else 1e-13)
    assert gap(space, space.plus(x, np.zeros_like(d)), x) < 1e-15
    assert np.abs(space.minus(x, x)).max() < 1e-15
    assert x.shape == (*shape, len(space.names)) == (*shape, len(space.units))
    assert space.minus(x, x).shape == (*shape, len(space.axes)) == (*shape, len(space.axis_units))


def test_the_opposite_direction_is_half_a_turn_away() -> None:
    x = np.concatenate([np.eye(3), unit(np.random.default_rng(4), (20,), 3)])
    np.testing.assert_allclose(np.linalg.norm(S2().minus(-x, x), axis=1), np.pi)
    np.testing.assert_allclose(S2().plus(x, S2().minus(-x, x)), -x, atol=1e-12)


@spaces
@shapes
def test_a_batch_equals_its_members_one_by_one(space: Space, shape: Shape) -> None:
    rng = np.random.default_rng(5)
    x, y, d = state(space, rng, shape), state(space, rng, shape), change(space, rng, shape)
    points, weights = (
        space.plus(x[..., None, :], change(space, rng, (*shape, 6), 0.4)),
        rng.dirichlet(np.ones(6), shape),
    )
    whole = space.plus(x, d), space.minus(y, x), space.transport(x, d), space.mean(points, weights)
    for i in np.ndindex(*shape):
        single = space.plus(x[i], d[i]), space.minus(y[i], x[i]), space.transport(x[i], d[i])
        for batch, one in zip(whole, (*single, space.mean(points[i], weights[i])), strict=True):
            np.testing.assert_allclose(batch[i], one, rtol=0, atol=1e-10)


@spaces
@shapes
@pytest.mark.parametrize("size", [1e-15, 1e-9, 0.3, 1.0])
def test_the_mean_of_points_that_lie_about_a_centre_is_the_centre(space: Space, shape: Shape, size: float) -> None:
    rng = np.random.default_rng(6)
    x, d = state(space, rng, shape), change(space, rng, (*shape, 3), size)
    points = space.plus(x[..., None, :], np.concatenate([d, -d, 0 * d[..., :1, :]], axis=-2))
    half = 0.4 * rng.dirichlet(np.ones(3))
    assert gap(space, space.mean(points, np.concatenate([half, half, [0.2]])), x) < 1e-9


@spaces
def test_the_mean_forgets_the_order_of_points_and_balances_their_weighted_errors(space: Space) -> None:
    rng = np.random.default_rng(7)
    points = space.plus(state(space, rng, (4, 1)), change(space, rng, (4, 9), 0.8))
    weights = rng.dirichlet(np.ones(9))
    mean = space.mean(points, weights)
    for order in (rng.permutation(9), np.arange(9)[::-1]):
        assert gap(space, space.mean(points[:, order], weights[order]), mean) < 1e-9
    np.testing.assert_allclose(weights @ space.minus(points, mean[:, None]), 0, atol=1e-9)
    twice = np.concatenate([points, points[:, :1]], axis=1)  # a weight of 2 is a point that comes twice
    assert gap(space, space.mean(points, np.array([2, *[1] * 8]) / 10), space.mean(twice, np.full(10, 0.1))) < 1e-9
    assert gap(space, space.mean(points, np.eye(9)[3]), points[:, 3]) < 1e-9


def compose(space: Space, g: Array, x: Array) -> Array:
    """The group's product g·x = g·Exp(Log(x))."""
    return space.plus(g, space.minus(x, np.broadcast_to(origin(space), x.shape)))


@groups
def test_the_mean_moves_with_the_group(space: Space) -> None:
    rng = np.random.default_rng(8)
    g, weights = state(space, rng, (4, 1)), rng.dirichlet(np.ones(9))
    points = space.plus(state(space, rng, (4, 1)), change(space, rng, (4, 9), 0.8))
    moved = space.mean(compose(space, g, points), weights)
    assert gap(space, moved, compose(space, g[:, 0], space.mean(points, weights))) < 1e-9
    q, points = unit(rng, (), 4), S2().plus(unit(rng, (), 3), change(S2(), rng, (9,), 0.8))
    turned = S2().mean(quaternions.rotate(q, points), weights)
    np.testing.assert_allclose(turned, quaternions.rotate(q, S2().mean(points, weights)), atol=1e-9)


@pytest.mark.filterwarnings("ignore:invalid value")
def test_points_that_have_no_mean_say_so() -> None:
    poles = np.array([[0.0, 0.0, 1.0, 7.0], [0.0, 0.0, -1.0, 7.0]])
    for space, points in ((S2(), poles[:, :3]), (Product(up=S2(), rate=Euclidean(("x",))), poles)):
        with pytest.raises(ArithmeticError, match="the mean of the points does not settle: they are spread too widely"):
            space.mean(points, np.array([0.5, 0.5]))


@pytest.mark.parametrize("place", [1.0, 1e3, 5e6])
def test_the_mean_of_poses_is_found_far_from_the_origin(place: float) -> None:
    d = 0.1 * np.random.default_rng(10).standard_normal((50, 6, 3))
    x = np.array([place, 0.8 * place, 0.3])  # 5000 km: a place in UTM coordinates
    mean = SE2().mean(SE2().plus(x, np.concatenate([d, -d], axis=1)), np.full(12, 1 / 12))
    np.testing.assert_allclose(mean, np.broadcast_to(x, mean.shape), rtol=1e-14, atol=1e-9)


def hat(space: Space, d: Array) -> Array:
    a, b, c = d
    return np.array(
        [[0, -c, b], [c, 0, -a], [-b, a, 0]] if isinstance(space, SO3) else [[0, -c, a], [c, 0, b], [0] * 3]
    )


@pytest.mark.parametrize("space", [SO3(), SE2()], ids=["SO3", "SE2"])
@sizes
def test_transport_keeps_an_error_that_is_fixed_in_the_world(space: Space, size: float | None) -> None:
    rng = np.random.default_rng(12)
    x, xi = state(space, rng, ()), change(space, rng, (), 0.2)
    E = compose(space, space.plus(x, xi), space.plus(origin(space), space.minus(origin(space), x)))  # y·x⁻¹
    for d in change(space, rng, (5,), size):
        A, step = space.transport(x, d), expm(hat(space, d))
        for i, e in enumerate(np.eye(3)):  # A = Ad(Exp(−δ))
            np.testing.assert_allclose(hat(space, A[:, i]), np.linalg.inv(step) @ hat(space, e) @ step, atol=1e-12)
        moved = space.plus(x, d)
        np.testing.assert_allclose(space.minus(compose(space, E, moved), moved), A @ xi, atol=1e-12)
        whole = Product(vector=Euclidean(("a", "b")), group=space, angle=SO2())  # identity where the order is free
        A_whole = whole.transport(np.zeros(len(whole.names)), np.concatenate([[1, 2], d, [0.3]]))
        np.testing.assert_array_equal(A_whole, block_diag(np.eye(2), A, 1))


def test_transport_on_the_sphere_carries_a_step_into_its_own_continuation() -> None:
    rng = np.random.default_rng(13)
    x, d = state(S2(), rng, (40,)), change(S2(), rng, (40,))
    carried = (S2().transport(x, d) @ d[..., None])[..., 0]
    np.testing.assert_allclose(carried, -S2().minus(x, S2().plus(x, d)), atol=1e-11)


@sizes
def test_planar_poses_follow_the_matrix_exponential_and_logarithm(size: float | None) -> None:
    def matrix(x: Array) -> Array:
        c, s = np.cos(x[2]), np.sin(x[2])
        return np.array([[c, -s, x[0]], [s, c, x[1]], [0, 0, 1]])

    rng = np.random.default_rng(14)
    for x, d in zip(state(SE2(), rng, (10,)), change(SE2(), rng, (10,), size), strict=True):
        y = SE2().plus(x, d)
        np.testing.assert_allclose(matrix(y), matrix(x) @ expm(hat(SE2(), d)), atol=1e-12)
        if size is None or size < 3:
            twist = logm(np.linalg.inv(matrix(x)) @ matrix(y)).real
            np.testing.assert_allclose(hat(SE2(), SE2().minus(y, x)), twist, atol=1e-7)


@spaces
def test_a_description_survives_json(space: Space) -> None:
    again = rebuild(json.loads(json.dumps(describe(space))))
    assert describe(again) == describe(space)
    assert (type(again), again.names, again.units) == (type(space), space.names, space.units)
    assert (again.axes, again.axis_units) == (space.axes, space.axis_units)


def turns(rng: np.random.Generator) -> Array:
    """Unit quaternions (338, 4): any, each component the largest with either sign, half turns, and near identity."""
    led = 0.3 * unit(rng, (8, 25), 4) + np.concatenate([np.eye(4), -np.eye(4)])[:, None]
    half = np.concatenate([np.zeros((23, 1)), np.concatenate([unit(rng, (20,), 3), np.eye(3)])], axis=1)
    near = np.concatenate([np.ones((15, 1)), np.logspace(-16, -2, 15)[:, None] * unit(rng, (15,), 3)], axis=1)
    return quaternions.normalise(np.concatenate([unit(rng, (100,), 4), led.reshape(-1, 4), half, near]))


def test_quaternions_agree_with_scipy_s_rotations() -> None:
    rng, matrix, close = np.random.default_rng(16), quaternions.to_matrix, np.testing.assert_allclose
    q = turns(rng)
    p, v, R = q[::-1], rng.standard_normal((len(q), 3)), Rotation.from_quat(q, scalar_first=True)
    close(matrix(q), R.as_matrix(), atol=1e-14)
    close(matrix(quaternions.multiply(p, q)), (Rotation.from_quat(p, scalar_first=True) * R).as_matrix(), atol=1e-14)
    assert gap(SO3(), quaternions.from_matrix(R.as_matrix()), q) < 1e-14
    assert (quaternions.from_matrix(R.as_matrix())[:, 0] >= 0).all()
    assert gap(SO3(), quaternions.from_rotation(R.as_matrix()), q) < 1e-14
    close(quaternions.rotate(q, v), R.apply(v), atol=1e-13)
    close(quaternions.cross(q[:, 1:], v), np.cross(q[:, 1:], v), atol=1e-15)
    close(np.linalg.norm(quaternions.log(q), axis=1), R.magnitude(), rtol=1e-13)
    close(Rotation.from_rotvec(quaternions.log(q)).as_matrix(), R.as_matrix(), atol=1e-14)
    close(matrix(quaternions.exp(3 * v)), Rotation.from_rotvec(3 * v).as_matrix(), atol=1e-14)
    close(quaternions.log(-q)[q[:, 0] != 0], quaternions.log(q)[q[:, 0] != 0], rtol=1e-14)
    angles, free = quaternions.to_euler(q), np.abs(R.as_matrix()[:, 2, 0]) < 0.999  # at ±90° roll and yaw are one
    close(wrap(angles - R.as_euler("ZYX")[:, ::-1])[free], 0, atol=1e-10)
    close(matrix(quaternions.from_euler(angles))[free], R.as_matrix()[free], atol=1e-10)


def test_slerp_agrees_with_scipy_s_whatever_the_signs() -> None:
    rng = np.random.default_rng(17)
    q, stamps = unit(rng, (200,), 4), np.sort(rng.uniform(0, 9, 200))
    times = np.concatenate([rng.uniform(stamps[0], stamps[-1], 300), stamps])
    found = quaternions.slerp(times, stamps, quaternions.continuous(q))
    assert gap(SO3(), quaternions.slerp(times, stamps, q), found) < 1e-13
    oracle = Slerp(stamps, Rotation.from_quat(q, scalar_first=True))(times)
    assert gap(SO3(), found, oracle.as_quat(scalar_first=True)) < 1e-12


@pytest.mark.parametrize("spread", [0.5, 3.0, 40.0])
def test_many_angles_are_wrapped_as_each_alone(spread: float) -> None:
    angles = np.random.default_rng(0).uniform(-spread, spread, 500)
    angles[:6] = np.pi, -np.pi, np.nextafter(np.pi, 0), np.nextafter(-np.pi, -4), 0.0, np.nan
    together = wrap(angles)
    np.testing.assert_array_equal(together, [wrap(angle) for angle in angles])
    np.testing.assert_allclose(np.exp(1j * together[:5]), np.exp(1j * angles[:5]))


def test_products_in_turn_are_to_the_bit_those_of_pairs() -> None:
    rng = np.random.default_rng(11)
    steps = quaternions.exp(0.1 * rng.standard_normal((200, 3)))
    found = np.empty((200, 4))
    found[0] = before = quaternions.normalise(rng.standard_normal(4))
    quaternions.accumulate(found, steps)
    for step, product in zip(steps, found[1:], strict=False):
        before = quaternions.multiply(before, step)
        assert product.tobytes() == before.tobytes()
