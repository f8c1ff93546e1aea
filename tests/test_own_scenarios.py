"""A person's own file: with its data function, or making its data itself; what is wrong with it, in one line."""

from pathlib import Path

import numpy as np
import pytest
from conftest import Cli, strict

import viz_estim

DATA_BESIDE = """
from dataclasses import dataclass
import numpy as np
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.spaces import Euclidean
from viz_estim.core.stages import Stage

@dataclass
class Track:
    z: np.ndarray

def track(source, rng, *, length: int = 20, spread: float = 1.0) -> Track:
    return Track(rng.normal(0, spread, length) if source is None else np.loadtxt(source[0]))

class Mean:
    def step(self, belief, tick, rng):
        yield Stage("mean", Gaussian(belief.space, 0.5 * (belief.mean + tick.measurements["z"]), belief.cov))

def mean(data: Track, *, start: float = 0.0) -> Scenario:
    ticks = [Tick(k / 10, 0.1, measurements={"z": z[None]}) for k, z in enumerate(data.z)]
    return Scenario(Mean(), {0: Gaussian(Euclidean(["x"], "m"), np.array([start]), np.eye(1))}, ticks)
"""
KALMAN = """
from dataclasses import dataclass
import numpy as np
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.run import Scenario, Tick
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.core.stages import Innovation, Stage

@dataclass(frozen=True)
class Correct(Stage):
    innovation: Innovation
    gain: np.ndarray

Z = Product(ruler=Euclidean(["x"], "m"))

class Kalman:
    def __init__(self, q, r):
        self.q, self.r = q, r

    def step(self, belief, tick, rng):
        x, P, R, one = belief.mean, belief.cov, np.array([[self.r]]), np.ones(1, bool)
        if tick.dt:
            P = P + self.q
            yield Stage("move", Gaussian(belief.space, x, P))
        z, S = tick.measurements["ruler"], P + R
        K = P / S
        innovation = Innovation(Z, z, x, z - x, S, R, P, one, one, np.zeros((1, 1)))
        yield Correct("correct", Gaussian(belief.space, x + K @ (z - x), P - K @ S @ K.T), innovation, K)

def kalman(rng, *, q: float = 0.01, r: float = 0.25, trust: float = 1.0) -> Scenario:
    length = 300
    truth = rng.normal(0, 1) + np.cumsum(np.r_[0, rng.normal(0, q**0.5, length - 1)])
    z = truth + rng.normal(0, r**0.5, length)
    ticks = [Tick(0.1 * k, 0.1 * (k > 0), measurements={"ruler": z[k : k + 1]}) for k in range(length)]
    start = Gaussian(Euclidean(["x"], "m"), np.zeros(1), np.eye(1))
    return Scenario(Kalman(q, r / trust), {0: start}, ticks, truth[:, None])
"""


def test_a_scenario_of_one_s_own_with_its_data_function(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(DATA_BESIDE)
    name, out = f"{tmp_path / 'own.py'}:mean", tmp_path / "own.rrd"
    result = strict(cli("run", name, "--set", "data.length=7", "--set", "start=5", "--out", out, "--json"))
    assert result["params"] == {"start": 5.0, "data.length": 7, "data.spread": 1.0}
    rng_z = np.random.default_rng(0).normal(0, 1, 7)
    assert viz_estim.load(out).mean[0, 0] == 0.5 * (5 + rng_z[0])
    np.savetxt(tmp_path / "z.txt", [1.0, 2.0, 4.0])
    strict(cli("run", name, "--data", tmp_path / "z.txt", "--out", out, "--json"))
    assert viz_estim.load(out).mean[:, 0].tolist() == [0.5, 1.25, 2.625]
    assert "error" in strict(cli("show", out, "--json"))


def test_a_kalman_filter_of_one_s_own_is_judged_as_the_built_in_ones(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(KALMAN)
    name, out = f"{tmp_path / 'own.py'}:kalman", tmp_path / "own.rrd"
    result = strict(cli("run", name, "--seed", 1, "--out", out, "--json"))
    assert (result["steps"], result["stages"]) == (300, 600)  # the start is a stage
    nis = result["nis"]["ruler"]
    assert nis["low"] <= nis["mean"] <= nis["high"]
    assert result["nees"]["inside"] > 0.85
    assert result["metrics"].keys() == {"state_rmse_m"}
    wrong = strict(cli("run", name, "--seed", 1, "--set", "trust=30", "--out", out, "--json"))
    assert wrong["seed"] == 1
    shown = strict(cli("show", out, "--step", 9, "--json"))
    assert [stage["name"] for stage in shown["stages"]] == ["move", "correct"]
    assert set(shown["stages"][1]) >= {"gain", "innovation.residual", "innovation.cov", "belief"}
    assert wrong["nis"]["ruler"]["mean"] > 2 * wrong["nis"]["ruler"]["high"]


# What a person may get wrong in a file of theirs: its text, the function asked for, and words of the line they see.
HEAD = "\n".join(line for line in KALMAN.splitlines() if line.startswith(("import", "from"))) + "\n"
BAD_FILES = {
    "raises on import": ("1 / 0", "f", "cannot be imported (ZeroDivisionError: division by zero)"),
    "no Python": ("def f(:", "f", "cannot be imported (SyntaxError"),
    "no such function": ("def kalman(): pass", "kalmann", "no function kalmann; did you mean kalman?"),
    "no function": ("kalman = 3", "kalman", "no function kalman"),
    "returns something else": ("def f(): return 3", "f", "returned int, expected a viz_estim Scenario"),
    "returns nothing": ("def f(): pass", "f", "returned NoneType"),
    "raises": ("def f(): raise KeyError('q')", "f", "KeyError"),
    "needs an argument": ("def f(rng, other): pass", "f", "other"),
    "no data function": ("def f(data): pass", "f", "makes"),
    "data function raises": ("def make(source, rng): return [][0]\ndef f(data): pass", "make", "IndexError"),
    "no ticks": (HEAD + "def f(): return Scenario(None, {}, [])", "f", "at least one tick"),
}


@pytest.mark.parametrize("what", BAD_FILES)
def test_a_bad_file_of_one_s_own_is_one_line(what: str, cli: Cli, tmp_path: Path) -> None:
    content, function, words = BAD_FILES[what]
    (tmp_path / "my.py").write_text(content)
    code, out, err = cli("run", f"{tmp_path / 'my.py'}:{function}", "--out", tmp_path / "out.rrd")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("viz-estim: ")
    assert "my.py" in err
    assert words in err
    assert not list(tmp_path.glob("*.rrd"))


@pytest.mark.parametrize(
    ("name", "words"),
    [("nowhere.py:f", "nowhere.py: no such file"), ("nowhere.py", "name the function too"), ("f.txt:f", "no scenario")],
)
def test_a_file_that_is_not_named_right_is_one_line(name: str, words: str, cli: Cli) -> None:
    code, out, err = cli("run", name)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert words in err


# An estimator's step that goes wrong; whatever it does, the recording shows it.
BAD_STEPS = {
    "a singular S": "yield Correct('c', b, Innovation(Z, z, z, z, 0 * one, one, one, t, t, one), one)",
    "a mean of another length": "yield Stage('a', b); yield Stage('a', Gaussian(b.space, np.zeros(2), b.cov))",
    "a covariance of another shape": "yield Stage('a', Gaussian(b.space, b.mean, np.eye(2)))",
    "no stage": "yield 3",
    "a mean that is a list": "yield Stage('a', Gaussian(b.space, [0.0], b.cov))",
    "another space": "yield Stage('a', Gaussian(Euclidean(['p', 'q']), np.zeros(2), np.eye(2)))",
    "an exception of two lines": "raise ValueError('one\\ntwo')",
}


@pytest.mark.parametrize("what", BAD_STEPS)
def test_a_step_that_goes_wrong_is_recorded_and_no_traceback(what: str, cli: Cli, tmp_path: Path) -> None:
    source = f"""{KALMAN[: KALMAN.index("class Kalman")]}
class Wrong:
    def step(self, b, tick, rng):
        z, one, t = np.ones(1), np.ones((1, 1)), np.ones(1, bool)
        yield Stage("before", b)
        if tick.time > 1:
            {BAD_STEPS[what]}

def wrong():
    ticks = [Tick(0.1 * k, 0.1) for k in range(20)]
    return Scenario(Wrong(), {{0: Gaussian(Euclidean(["x"], "m"), np.zeros(1), np.eye(1))}}, ticks)
"""
    (tmp_path / "my.py").write_text(source)
    out = tmp_path / "out.rrd"
    result = strict(cli("run", f"{tmp_path / 'my.py'}:wrong", "--out", out, "--json"))
    run = viz_estim.load(out)
    assert len(run.step) == result["steps"]
    texts = cli("show", out), cli("show", out, "--step", result["steps"] - 1), cli("diagnose", out)
    assert not any(line.startswith("two") for text in texts for line in text.out.split("\n"))
    if what != "a singular S":
        assert result["error"]["step"] == 11
    strict(cli("show", out, "--step", result["steps"] - 1, "--json"))
