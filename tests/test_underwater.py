"""The underwater robot: its figures against all worlds written out, its files, its simulation, the filter over it."""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from viz_estim.core.discrete import categorical_metrics
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Step, run
from viz_estim.core.stages import DiscreteUpdate
from viz_estim.errors import BadInput
from viz_estim.scenarios.underwater import figures, save, underwater, underwater_bayes
from viz_estim.scenarios.underwater_files import LABELS, UnderwaterData

OWN = Path(__file__).parents[1] / "data" / "underwater"
PRIOR, SONAR, FLOW = np.array([0.35, 0.15, 0.5]), np.array([0.9, 0.02, 0.02]), np.array([0.04, 0.45, 0.04])


def simulated(seed: int, steps: int = 120, stay: float = 0.95) -> UnderwaterData:
    return underwater(None, np.random.default_rng(seed), steps=steps, stay=stay)


def at_ends(scenario: Scenario) -> Array:
    """Log probabilities (T, K) at the end of each step."""
    return np.stack([step.stages[-1].belief.log_probabilities for step in run(scenario)])


def worlds(prior: Array, sonar: Array, flow: Array) -> Iterator[tuple[int, bool, bool, float]]:
    """Every label with every pair of readings, and how probable they are together."""
    for j, s, f in itertools.product(range(3), (False, True), (False, True)):
        yield j, s, f, prior[j] * (sonar[j] if s else 1 - sonar[j]) * (flow[j] if f else 1 - flow[j])


def test_the_figures_are_those_of_the_exercise() -> None:
    found = figures(PRIOR, SONAR, FLOW)
    assert found == {
        "p_current_given_warning": pytest.approx(0.17452, abs=1e-5),
        "p_current_given_warning_exact": pytest.approx(0.16657, abs=5e-6),
        "readings": 4,
        "warnings_to_be_sure": 2,
        "variance": 28,
    }
    assert underwater_bayes(simulated(1)).facts == found


@pytest.mark.parametrize("seed", range(6))
def test_enumerating_all_worlds_gives_the_exact_figure_and_the_assumptions_of_the_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    prior, sonar, flow = (PRIOR, SONAR, FLOW) if seed == 0 else (rng.dirichlet(np.ones(3)), *rng.random((2, 3)))
    warned = [world for world in worlds(prior, sonar, flow) if world[1] or world[2]]
    both = sum(p for j, *_, p in warned if j == 1)
    found = figures(prior, sonar, flow)
    assert found["p_current_given_warning_exact"] == pytest.approx(both / sum(p for *_, p in warned))
    silent = [sum(p for *w, p in worlds(prior, sonar, flow) if not w[sensor]) for sensor in (1, 2)]
    assert found["p_current_given_warning"] == pytest.approx(both / (1 - silent[0] * silent[1]))


def test_the_other_figure_is_what_four_worlds_of_independent_events_would_give_below_the_line() -> None:
    """Hazard and current independent, so that both may hold: then the warnings are independent too."""
    hazard, current = PRIOR[:2]
    silent = 0.0
    for h, c in itertools.product((0, 1), (0, 1)):
        p = (hazard if h else 1 - hazard) * (current if c else 1 - current)
        silent += p * (1 - SONAR[1 - h]) * (1 - FLOW[c])
    disjoint = current * (1 - (1 - SONAR[1]) * (1 - FLOW[1]))
    assert figures(PRIOR, SONAR, FLOW)["p_current_given_warning"] == pytest.approx(disjoint / (1 - silent))


@pytest.mark.parametrize(
    ("detection", "false_alarm", "current", "readings", "warnings"),
    [
        (0.45, 0.04, 0.15, 4, 2),
        (0.9, 0.04, 0.15, 1, 2),  # met exactly: one is enough
        (1.0, 0.0, 0.15, 1, 1),
        (0.5, 0.25, 0.5, 4, 4),
        (0.45, 0.04, 0.95, 4, 0),  # sure beforehand
        (0.45, 0.45, 0.15, 4, None),  # a warning says nothing
        (0.3, 0.45, 0.15, 7, None),  # or the opposite
        (0.0, 0.04, 0.15, None, None),
        (0.45, 0.04, 0.0, 4, None),
        (0.0, 0.0, 0.0, None, None),
    ],
)
def test_how_many_readings_it_takes_is_counted_out(
    detection: float, false_alarm: float, current: float, readings: int | None, warnings: int | None
) -> None:
    data = simulated(1, steps=3)
    settings = {"flow_detection": detection, "flow_false_alarm": false_alarm}
    facts = underwater_bayes(data, hazard=0.0, current=current, **settings).facts
    assert (facts.get("readings"), facts.get("warnings_to_be_sure")) == (readings, warnings)
    assert facts.get("variance") == (None if readings is None else 7 * readings)
    assert all(math.isfinite(value) for value in facts.values())
    if readings is not None:
        assert 1 - (1 - detection) ** readings >= 0.9 - 1e-12
        assert 1 - (1 - detection) ** (readings - 1) < 0.9
    if warnings:  # none before the last passes 0.9
        rows = [(k, current * detection**k, (1 - current) * false_alarm**k) for k in range(warnings + 1)]
        assert [yes / (yes + no) >= 0.9 for k, yes, no in rows] == [False] * warnings + [True]


def test_the_mean_of_so_many_readings_is_as_good_as_the_sonar_s_one() -> None:
    facts = underwater_bayes(simulated(1)).facts
    n, rng = int(facts["readings"]), np.random.default_rng(2)
    means = rng.normal(0, facts["variance"] ** 0.5, (200_000, n)).mean(1)
    assert means.var() == pytest.approx(7, rel=0.02)


def test_the_filter_over_a_sequence_is_bayes_rule_over_all_sequences_of_labels() -> None:
    """The last belief of five steps against the sum over all 3⁵ sequences."""
    data, stay = simulated(3, steps=5), 0.7
    total = np.zeros(3)
    for sequence in itertools.product(range(3), repeat=5):
        p = PRIOR[sequence[0]]
        for i, j in itertools.pairwise(sequence):
            p *= stay * (i == j) + (1 - stay) * PRIOR[j]
        for k, j in enumerate(sequence):
            p *= SONAR[j] if data.sonar[k] else 1 - SONAR[j]
            p *= FLOW[j] if data.flow[k] else 1 - FLOW[j]
        total[sequence[-1]] += p
    last = np.exp(at_ends(underwater_bayes(data, stay=stay))[-1])
    np.testing.assert_allclose(last, total / total.sum())


def test_two_warnings_of_the_flow_sensor_alone_bring_the_current_past_nine_tenths() -> None:
    time = np.arange(3.0)
    data = UnderwaterData(time, np.zeros(3), np.ones(3), np.full(3, np.nan))
    # A sonar that warns as often whatever is there says nothing.
    scenario = underwater_bayes(data, sonar_detection=0.02, stay=1)
    p = np.exp(at_ends(scenario))[:, 1]
    assert p[:2] == pytest.approx([0.0675 / 0.1015, 0.030375 / 0.031735])


def test_steps_hold_what_they_should_and_know_which_reading_moved_which_label() -> None:
    data = simulated(10)
    steps: list[Step] = list(run(underwater_bayes(data)))
    assert len(steps) == 120
    assert [s.name for s in steps[0].stages] == ["start", "update"]
    assert [s.name for s in steps[7].stages] == ["predict", "update"]
    assert {step.error for step in steps} == {None}
    warned = next(step for step, sonar in zip(steps, data.sonar, strict=True) if sonar).stages[-1]
    assert isinstance(warned, DiscreteUpdate)
    assert warned.sensors == ("sonar", "flow")
    spread = warned.log_likelihoods[0] - warned.log_likelihoods[0, 2]
    assert spread == pytest.approx([math.log(45), 0, 0])  # the sonar speaks of the hazard alone
    truth = underwater_bayes(data).truth
    assert truth is not None
    assert truth.shape == (120, 1)
    np.testing.assert_array_equal([step.truth[0] for step in steps if step.truth is not None], data.truth)


def test_the_simulation_draws_from_the_model() -> None:
    data = simulated(4, steps=200_000)
    for j, p in enumerate(PRIOR):
        here = data.truth == j
        assert here.mean() == pytest.approx(p, abs=0.02)
        assert data.sonar[here].mean() == pytest.approx(SONAR[j], abs=0.01)
        assert data.flow[here].mean() == pytest.approx(FLOW[j], abs=0.01)
        stays = (data.truth[1:] == j)[here[:-1]]
        assert stays.mean() == pytest.approx(0.95 + 0.05 * p, abs=0.01)
    assert len(set(simulated(5, stay=1).truth)) == 1
    np.testing.assert_array_equal(simulated(6).sonar, simulated(6).sonar)


def test_the_beliefs_are_calibrated_and_no_other_priors_or_rates_do_better() -> None:
    data = simulated(7, steps=1500)

    def loss(**settings: float) -> float:
        return categorical_metrics(at_ends(underwater_bayes(data, **settings)), data.truth[:, None])["log_loss_nats"]

    p, right = np.exp(at_ends(underwater_bayes(data))), data.truth[:, None] == np.arange(3)
    for low in (0.0, 0.25, 0.5, 0.75):
        inside = (p >= low) & (p < low + 0.25)
        assert right[inside].mean() == pytest.approx(p[inside].mean(), abs=0.08), low
    best = loss()
    assert best < 0.35
    for wrong in ({"stay": 0.5}, {"stay": 0.999}, {"flow_false_alarm": 0.3}, {"sonar_detection": 0.5}):
        assert loss(**wrong) > best + 0.005, wrong


@pytest.mark.parametrize("known", [True, False])
def test_a_file_comes_back_as_it_was_saved(tmp_path: Path, known: bool) -> None:
    data = simulated(8)
    if not known:
        data.truth[30:] = np.nan
    (path,) = save(data, tmp_path)
    for source in ([path], [tmp_path]):
        again = underwater(source, np.random.default_rng(0))
        assert again.files == (path,)
        for name in ("time", "sonar", "flow", "truth"):
            np.testing.assert_array_equal(getattr(again, name), getattr(data, name))
    with pytest.raises(BadInput, match="there already"):
        save(data, tmp_path)


def test_files_of_other_people_are_read(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("\ufeffSTATE, Flow ,depth,Time,SONAR\r\nHazard,0,1.5,1700000000.5,1\r\n,1.0,x,1700000002,0\r\n\r\n")
    (tmp_path / "other.csv").write_text("time,range\n0,1\n")
    (tmp_path / "notes.txt").write_text("time,sonar,flow\n0,0,0\n")
    data = underwater([tmp_path], np.random.default_rng(0))
    assert (data.sonar.tolist(), data.flow.tolist(), data.files) == ([1, 0], [0, 1], (path,))
    np.testing.assert_array_equal(data.truth, [0, np.nan])
    assert [(tick.time, tick.dt) for tick in underwater_bayes(data).ticks] == [(0, 0), (1.5, 1.5)]
    path.write_text("time,sonar,flow\n0,0,0\n")  # no truth, one reading
    data = underwater([path], np.random.default_rng(0))
    assert np.isnan(data.truth).all()
    assert len(at_ends(underwater_bayes(data))) == 1


HEADER = "time,sonar,flow,state\n"
ROWS = "0,0,0,clear\n1,1,0,hazard\n2,0,1,\n"
BAD_FILES = {
    "empty": ("", "is empty"),
    "header alone": (HEADER, "column names alone"),
    "truncated in a row": (HEADER + ROWS + "3,1", "line 5 has 2 cells, the first line 4"),
    "truncated in a label": (HEADER + ROWS + "3,1,0,haz", "line 5, state: 'haz' is none of hazard, current, clear"),
    "a column missing": ("time,sonar,current\n0,0,0\n", "missing flow (columns: time, sonar, current)"),
    "a column twice": ("time,sonar,Sonar,flow\n0,0,0,0\n", "two columns have one name"),
    "a column too many": (HEADER + "0,0,0,clear,1\n", "line 2 has 5 cells"),
    "no reading": (HEADER + ROWS + "3,,0,clear\n", "line 5, sonar: '' is not a number"),
    "NaN reading": (HEADER + ROWS + "3,0,nan,clear\n", "line 5, flow: 'nan' is not finite"),
    "no binary reading": (HEADER + ROWS + "3,0,0.7,clear\n", "line 5, flow: '0.7' is neither 0 nor 1"),
    "a text for a reading": (HEADER + "0,yes,0,clear\n", "line 2, sonar: 'yes' is not a number"),
    "infinite stamp": (HEADER + ROWS + "inf,0,0,clear\n", "line 5, time: 'inf' is not finite"),
    "stamps that go back": (HEADER + ROWS + "1,0,0,clear\n", "line 5, time goes back"),
    "behind a blank line": (HEADER + "0,0,0,clear\n\n1,0,0\n", "line 4 has 3 cells"),
    "no table": ("hello " * 1000, "column names alone"),
    "a table of other things": ("a,b\n1,2\n", "missing time, sonar, flow"),
}


def refused(source: list[Path]) -> str:
    with pytest.raises(BadInput) as caught:
        underwater(source, np.random.default_rng(0))
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 500 + len(str(source[0]))
    return text


@pytest.mark.parametrize("what", BAD_FILES)
def test_a_bad_file_is_refused_in_one_line(what: str, tmp_path: Path) -> None:
    content, words = BAD_FILES[what]
    path = tmp_path / "bad.csv"
    path.write_text(content)
    text = refused([path])
    assert text.startswith(str(path))
    assert words in text


def test_what_is_no_file_of_readings_is_refused_in_one_line(tmp_path: Path) -> None:
    assert "no such file" in refused([tmp_path / "nowhere.csv"])
    assert "no file of readings there" in refused([tmp_path])
    (tmp_path / "bad.csv").write_bytes(b"\x93NUMPY\x01\x00\xff\xfe\n" * 50)
    assert "cannot be read" in refused([tmp_path / "bad.csv"])
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(HEADER + ROWS)
    assert "2 files of readings found" in refused([tmp_path])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"hazard": 1.2}, "hazard is a probability between 0 and 1, got 1.2"),
        ({"flow_false_alarm": -0.1}, "flow_false_alarm is a probability"),
        ({"stay": 2.0}, "stay is a probability"),
        ({"hazard": 0.6, "current": 0.5}, "exclude each other"),
    ],
)
def test_what_is_no_probability_is_refused(settings: dict[str, float], words: str) -> None:
    with pytest.raises(BadInput, match=words):
        underwater_bayes(simulated(1), **settings)


@pytest.mark.parametrize(("steps", "stay"), [(0, 0.9), (10, -0.1), (10, 1.1)])
def test_a_simulation_that_cannot_be_is_refused(steps: int, stay: float) -> None:
    with pytest.raises(BadInput, match=r"steps|stay"):
        simulated(1, steps=steps, stay=stay)


def test_a_warning_that_no_label_can_give_ends_the_run() -> None:
    data = UnderwaterData(np.arange(4.0), np.array([0, 0, 1.0, 0]), np.zeros(4), np.full(4, np.nan))
    *_, last = run(underwater_bayes(data, sonar_detection=0, sonar_false_alarm=0))
    assert last.error is not None
    assert (last.error.step, last.error.stage) == (2, "update")
    assert last.error.message.startswith("ArithmeticError: all labels have probability 0")


def test_priors_of_zero_and_one_are_no_trouble() -> None:
    data = simulated(9)
    for hazard, current in ((0, 0), (1, 0), (0, 1), (0.9, 0.1), (0, 0.15)):
        p = np.exp(at_ends(underwater_bayes(data, hazard=hazard, current=current)))
        assert p.shape == (120, 3)
        assert p.sum(1) == pytest.approx(1)
        assert (p[:, np.array([hazard, current, round(1 - hazard - current, 9)]) == 0] == 0).all()


def test_the_own_file_shows_each_label() -> None:
    data = underwater([OWN], np.random.default_rng(0))
    assert {LABELS[int(label)] for label in data.truth} == set(LABELS)
    found = categorical_metrics(at_ends(underwater_bayes(data)), data.truth[:, None])
    assert found == {"accuracy": pytest.approx(0.8833, abs=1e-4), "log_loss_nats": pytest.approx(0.2954, abs=1e-4)}
