"""Expressions: one at a time and many at once they say the same, as Python would; what none may do is one line."""

from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from viz_estim.core import quaternions
from viz_estim.core.consistency import nis, squared_distance
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO3, Euclidean, Product
from viz_estim.debugger import expressions
from viz_estim.debugger.expressions import Absent
from viz_estim.debugger.functions import FUNCTIONS, BadExpression
from viz_estim.debugger.quantities import Frame

SPACE = Product(attitude=SO3(), rate=Euclidean(("x", "y", "z"), "rad/s"))
MEASURED = Product(**{"gyro": SPACE.parts["rate"], "range/1": Euclidean(("range",), "m")})


def spd(rng: np.random.Generator, count: int, n: int) -> Array:
    root = rng.normal(size=(count, n, n))
    return np.asarray(root @ np.swapaxes(root, 1, 2) + np.eye(n))


def frame(count: int = 7, seed: int = 0) -> Frame:
    """An update of an attitude and a rate at `count` moments, with all that such a stage tells."""
    rng = np.random.default_rng(seed)
    q, true = quaternions.normalise(rng.normal(size=(2, count, 4)))
    values: dict[str, Array] = {
        "mean": np.concatenate([q, rng.normal(size=(count, 3))], axis=1),
        "cov": spd(rng, count, 6),
        "gain": rng.normal(size=(count, 6, 4)),
        "innovation.residual": rng.normal(size=(count, 4)),
        "innovation.cov": spd(rng, count, 4),
        "innovation.z": rng.normal(size=(count, 4)),
        "innovation.offered": np.tile([1.0, 0.0], (count, 1)),
        "sigma.points": rng.normal(size=(count, 12, 7)),
    }
    truth = np.concatenate([true, np.full((count, 3), np.nan)], axis=1)
    k = np.arange(count)
    spaces = {"innovation": MEASURED, "sigma": SPACE}
    return Frame(
        "update", SPACE, (), k, 2 * k + 1, k * 0 + 1, 0.1 * k, 0.1 + 0 * k, values, spaces, truth,
        {"z.gyro": rng.normal(size=(count, 3))}, lambda: {"mean": values["mean"] + 1, "cov": 2 * values["cov"]},
    )  # fmt: skip


def alone(whole: Frame, i: int) -> Frame:
    """One of its moments."""
    rows = slice(i, i + 1)
    before = whole.before()
    assert whole.truth is not None
    return Frame(
        whole.stage, whole.space, (), whole.step[rows], whole.place[rows], whole.index[rows], whole.time[rows],
        whole.dt[rows], {k: v[rows] for k, v in whole.values.items()}, whole.spaces, whole.truth[rows],
        {k: v[rows] for k, v in whole.inputs.items()}, lambda: {k: v[rows] for k, v in before.items()},
    )  # fmt: skip


def value(text: str, of: Frame) -> Array:
    return expressions.evaluate(expressions.parse(text), of.lookup)


SOUND = [
    "mean", "mean.attitude", "mean.rate.y", "mean[-1]", "mean[4:7]", "cov[0:3, 0:3]", "cov.attitude", "cov.rate.x",
    "gain.gyro", "gain.attitude", "innovation", "innovation.gyro", 'innovation["range/1"]', "innovation.cov.gyro",
    "sigma", "sigma[3, 0]", "std", "std.rate", "error", "error.attitude", "error.attitude.x", "nees", "nis",
    "nis.gyro", 'nis["range/1"]', "truth.attitude", "z.gyro", "before.mean - mean", "before.std", "step", "time * 2",
    "min(eig(cov)) < 0", "nis.gyro > chi2(3, .999)", "error.attitude > deg(10)", 'stage == "update"',
    "stage == 'predict' or step >= 3 and not time > 0.35", "norm(mean.rate) / 2", "max(mean.rate, 0)", "1 < 2 < 3",
    "mean.rate @ mean.rate", "cov.rate @ mean.rate", "mean.rate @ cov.rate @ mean.rate", "trace(cov) + det(cov)",
    "diag(cov) - std ** 2", "euler(mean.attitude)", "wrap(mean.rate * 9)", "abs(-mean.rate) % 2 // 1", "any(cov > 3)",
    "mean.rate * cov[0, 0] + step", "arctan2(mean.rate, time)", "min(step, 3, time)",
]  # fmt: skip


@pytest.mark.parametrize("text", SOUND)
def test_many_moments_at_once_are_each_alone(text: str) -> None:
    whole = frame()
    together = np.broadcast_to(value(text, whole), (7, *value(text, whole).shape[1:]))
    held = np.broadcast_to(expressions.holds(expressions.parse(text), whole.lookup), 7) if text != "stage" else None
    for i in range(7):
        one = alone(whole, i)
        got = value(text, one)
        assert got.shape[0] == 1
        if together.dtype.kind == "f":
            np.testing.assert_allclose(together[i], got[0], rtol=1e-12, atol=1e-12)
        else:
            np.testing.assert_array_equal(together[i], got[0])
        if held is not None:
            assert held[i] == expressions.holds(expressions.parse(text), one.lookup)[0]


def test_the_derived_quantities_are_what_the_core_says() -> None:
    f = frame()
    mean, truth, P = f.values["mean"], f.truth, f.values["cov"]
    assert truth is not None
    error = SPACE.minus(mean, truth)
    relative = quaternions.multiply(quaternions.conjugate(truth[:, :4]), mean[:, :4])
    angle = 2 * np.arctan2(np.linalg.norm(relative[:, 1:], axis=1), np.abs(relative[:, 0]))
    np.testing.assert_allclose(value("error.attitude", f), angle)
    np.testing.assert_array_equal(value("error.attitude.z", f), error[:, 2])
    np.testing.assert_allclose(value("nees", f), squared_distance(error[:, :3], P[:, :3, :3]))
    found = nis(
        MEASURED, f.values["innovation.residual"], f.values["innovation.cov"], f.values["innovation.offered"] == 1
    )
    np.testing.assert_array_equal(value("nis.gyro", f), found["gyro"].values)
    assert np.isnan(value('nis["range/1"]', f)).all()  # it gave no reading, so that nothing holds of it
    assert not expressions.holds(expressions.parse('nis["range/1"] > -1'), f.lookup).any()
    np.testing.assert_array_equal(value("std", f), np.sqrt(np.diagonal(P, axis1=1, axis2=2)))
    np.testing.assert_array_equal(value("gain.rate.x", f), f.values["gain"][:, 3])


def test_plain_arithmetic_is_python_s() -> None:
    rng = np.random.default_rng(0)
    words = {
        name: function for name, (function, _) in FUNCTIONS.items() if name in ("sqrt", "abs", "exp", "deg", "hypot")
    }
    for _ in range(200):
        a, b, c = (f"{x:.3f}" for x in rng.uniform(0.1, 3, 3))
        text = str(rng.choice([
            f"{a} + {b} * {c} - {a} / {b}", f"-({a} - {b}) ** 2", f"sqrt({a}) + abs(-{b}) * exp({c})",
            f"{a} < {b} <= {c}", f"{a} > {b} or {b} > {c} and not {a} == {c}", f"deg({a}) % {b} // {c}",
            f"min({a}, {b}, {c}) + max({a}, {b})", f"hypot({a}, {b})",
        ]))  # fmt: skip
        expected: Any = eval(text, {"__builtins__": {"min": min, "max": max}}, words)
        assert value(text, frame())[0] == pytest.approx(expected), text
    assert value("chi2(3, .999)", frame())[0] == chi2.ppf(0.999, 3)


REFUSED = {
    "": "no expression",
    "1 +": "no expression",
    "__import__('os')": "no function __import__",
    "mean.__class__": "no quantity's name begins with _",
    "(1).real": "only quantities have parts",
    "mean[0].T": "only quantities have parts",
    "cov[step]": "an index is a whole number",
    "cov[0.5]": "an index is a whole number",
    "cov[9, 9]": "out of bounds",
    "open('x')": "no function open",
    "min.real(2)": "no function min.real",
    "eig": "no eig",
    "eig(mean)": "expected a square matrix",
    "eig(gain @ gain[0:4])": "expected a square matrix",
    "eig(cov - 2 * cov[0:1])": "symmetric",
    "sqrt(1, 2)": "takes 1 plain argument",
    "sqrt()": "takes 1 plain argument",
    "sqrt(x=1)": "takes 1 plain argument",
    "max(*mean)": "plain argument",
    "lambda: 1": "not allowed",
    "[1, 2]": "not allowed",
    "[x for x in mean]": "not allowed",
    "(mean := 3)": "not allowed",
    "f'{mean}'": "not allowed",
    "1 if step else 2": "not allowed",
    "step & 1": "not allowed",
    "step is 1": "compare by",
    "'a' + 1": "a text is no number",
    "'a' * 10000000000": "a text is no number",
    "stage > 3": "a text compares with texts only",
    "sqrt(stage)": "a text is no number",
    "mean + cov[0:2]": "",
    "mean @ 3": "@ is for vectors and matrices",
    "None": "only numbers and texts",
    "3j": "only numbers and texts",
    "b'x'": "only numbers and texts",
    "...": "only numbers and texts",
    "nothing": "no nothing at stage update",
    "mean.attitud": "no mean.attitud",
    "innovation.baro": "no innovation.baro",
    "nis.gyros": "no nis.gyros",
    "sqrtt(2)": "did you mean sqrt?",
    "(" * 300 + "1" + ")" * 300: "",
    "-" * 900 + "1": "",
    "1" * 2000: "longer than",
    "1e999999 * 10" + "0" * 400: "",
    "mean\x00": "",
    "euler(mean)": "quaternion",
}  # fmt: skip


@pytest.mark.parametrize("text", REFUSED)
def test_what_none_may_do_is_one_line(text: str) -> None:
    try:
        value(text, frame())
        told = ""
    except BadExpression as error:
        told = str(error)
    assert REFUSED[text] in told
    assert "\n" not in told
    assert len(told) < 300


@pytest.mark.parametrize("text", ["9 ** 9 ** 9 ** 9 ** 9", "2 ** 1e300", "10 ** 10 ** 10 % 7", "cov @ cov @ cov @ cov"])
def test_none_takes_long(text: str) -> None:
    """Numbers are of 64 bits: whole ones of Python's would grow until nothing else is done."""
    assert np.asarray(value(text, frame())).dtype == np.float64


def test_what_a_stage_lacks_never_holds() -> None:
    f = frame()
    assert not expressions.holds(expressions.parse("nis.gps > 3"), f.lookup).any()
    assert (
        expressions.holds(expressions.parse("nis.gps > 3 or step >= 2"), f.lookup).tolist() == [False] * 2 + [True] * 5
    )
    with pytest.raises(Absent):
        value("nis.gps", f)
    with pytest.raises(BadExpression):
        expressions.holds(expressions.parse("stage"), f.lookup)


def test_a_covariance_that_is_not_finite_has_no_eigenvalues() -> None:
    f = frame()
    f.values["cov"][3, 0, 0] = np.nan
    found = value("min(eig(cov))", f)
    assert np.isnan(found).tolist() == [i == 3 for i in range(7)]


def test_one_of_several_targets_may_be_written_as_it_is_named() -> None:
    found = frame()
    for text, as_text in (("innovation.range/1", 'innovation["range/1"]'), ("mean.rate/1", "mean.rate")):
        one, other = (expressions.evaluate(expressions.parse(t), found.lookup) for t in (text, as_text))
        np.testing.assert_array_equal(one, other)
    halved, whole = (expressions.evaluate(expressions.parse(t), found.lookup) for t in ("mean.rate/2", "mean.rate"))
    np.testing.assert_array_equal(halved, whole / 2)
