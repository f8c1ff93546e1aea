"""Runs side by side: where they part first, their figures, and the recording that holds them all."""

import dataclasses
import functools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from conftest import SHORTEST, Cli, Result
from rerun.chunk import RrdReader

import viz_estim
from viz_estim.comparison_table import Row, text
from viz_estim.core import quaternions
from viz_estim.core.alignment import on_stamps, paired
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.run import Scenario, Step, Tick, run
from viz_estim.core.spaces import SE2, SO2, SO3, Euclidean, Product
from viz_estim.core.stages import Stage
from viz_estim.differences import first_difference, other_data
from viz_estim.recording import links, overlaid_stages
from viz_estim.recording.compared import Clock, Compared
from viz_estim.recording.merged import _recoloured
from viz_estim.recording.reader import Run, load
from viz_estim.recording.recorder import Recorder
from viz_estim.running import plan

COMPARED = {"recording", "runs", "first_difference", "same", "reason"}


def answer(done: Result) -> dict[str, Any]:
    assert done.err == ""
    value = json.loads(done.out)
    assert isinstance(value, dict)
    assert set(value) == COMPARED
    assert all(set(one) == {"name", "file", "metrics", "nis", "nees"} for one in value["runs"])
    assert done.code == (0 if value["same"] else 1)
    return value


@pytest.fixture(scope="session")
def made(cli: Cli, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Short runs of several systems by name."""
    folder = tmp_path_factory.mktemp("made")
    short = [f"--set={setting}" for setting in SHORTEST]
    asked = {
        "ukf": ["imu-ukf", *short, "--seed", "3"],
        "again": ["imu-ukf", *short, "--seed", "3"],
        "reject": ["imu-ukf", *short, "--seed", "3", "--set", "frozen=reject"],
        "loose": ["imu-ukf", *short, "--seed", "3", "--set", "gyro_noise=0.2"],
        "gyro": ["imu-gyro", *short, "--seed", "3"],
        "alone": ["imu-ukf-gyro", *short, "--seed", "3"],
        "other": ["imu-gyro", *short, "--seed", "4"],
        "longer": ["imu-gyro", *short, "--seed", "3", "--set", "data.noise_scale=2"],
        "drive": ["diffdrive-ekf", "--set", "data.duration=3", "--seed", "1"],
        "labels": ["underwater-bayes", "--set", "data.steps=40", "--seed", "1"],
        "stay": ["underwater-bayes", "--set", "data.steps=40", "--seed", "1", "--set", "stay=0.8"],
    }
    for name, arguments in asked.items():
        done = cli("run", *arguments, "--out", folder / f"{name}.rrd")
        assert (done.code, done.err) == (0, "")
    return {name: folder / f"{name}.rrd" for name in asked}


def record(path: Path, steps: list[Step], made: Scenario, **facts: Any) -> Path:
    with Recorder(path, made, {"scenario": "test", "seed": 0, "params": {}, **facts}) as recorder:
        for step in steps:
            recorder.add(step)
        recorder.close({})
    return path


@functools.cache
def steps_of(name: str) -> tuple[Scenario, list[Step]]:
    made = plan(name, data=None, calibration=None, settings=SHORTEST, seed=3).build()
    made = dataclasses.replace(made, ticks=made.ticks[:200])
    return made, list(run(made, 3))


def thinned(name: str, folder: Path, keep: slice) -> Path:
    """The scenario's own steps, every other of them say, through the recorder: a run at another rate."""
    made, steps = steps_of(name)
    return record(folder / f"{name}-{keep.start}-{keep.stop}-{keep.step}.rrd", steps[keep], made)


# Alignment: the clock.


def test_stamps_pair_to_the_nanosecond_and_in_their_order_where_they_repeat() -> None:
    first, other = paired(np.array([0.0, 1.0, 1.0, 2.0, 3.0]), np.array([1.0, 1.0, 1.0, 2.0 + 3e-10, 2.5]))
    assert first.tolist() == [1, 2, 3]
    assert other.tolist() == [0, 1, 3]


@pytest.mark.parametrize("seed", range(5))
def test_a_state_between_two_stamps_lies_on_the_geodesic(seed: int) -> None:
    """Against a naive transcription, over all kinds of parts; at a stamp the state is the recorded one, bit for bit."""
    rng = np.random.default_rng(seed)
    space = Product(attitude=SO3(), heading=SO2(), pose=SE2(), place=Euclidean(("x", "y"), "m"))
    start = np.concatenate([[1.0, 0, 0, 0], np.zeros(1), np.zeros(3), np.zeros(2)])
    states = space.plus(start, rng.standard_normal((9, 9)))
    times = np.sort(rng.uniform(0, 1, 9))
    at = np.concatenate([times[2:5], rng.uniform(-0.2, 1.2, 20)])
    found = on_stamps(space, times, states, at)
    assert found[:3].tobytes() == states[2:5].tobytes()
    for t, x in zip(at, found, strict=True):
        if not times[0] <= t <= times[-1]:
            assert np.isnan(x).all()
            continue
        j = max(k for k in range(len(times)) if times[k] <= t)
        k = min(j + 1, len(times) - 1)
        share = 0.0 if j == k else (t - times[j]) / (times[k] - times[j])
        np.testing.assert_allclose(x, space.plus(states[j], share * space.minus(states[k], states[j])), atol=1e-12)


def test_angles_are_read_off_the_shorter_way_round() -> None:
    between = on_stamps(SO2(), np.array([0.0, 1.0]), np.array([[3.0], [-3.0]]), np.array([0.5]))
    assert abs(abs(between[0, 0]) - np.pi) < 1e-12
    q = quaternions.from_euler(np.array([[0.0, 0, 3.0], [0.0, 0, -3.0]]))
    turned = on_stamps(SO3(), np.array([0.0, 1.0]), q, np.array([0.5]))
    np.testing.assert_allclose(np.abs(turned), [[0, 0, 0, 1]], atol=1e-12)


# The first difference.


def test_the_same_seed_twice_is_the_same(cli: Cli, made: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    found = answer(cli("compare", made["ukf"], made["again"], "--out", out, "--tol", 0, "--json"))
    assert (found["same"], found["first_difference"], found["reason"]) == (True, None, None)
    assert [one["name"] for one in found["runs"]] == ["ukf", "again"]
    assert found["recording"] == str(out)
    told = cli("compare", made["ukf"], made["again"], "--out", tmp_path / "out.rrd").out
    assert told.splitlines()[-1] == f"viz-estim open {tmp_path / 'out.rrd'}"
    assert "again is the same as ukf" in told


def test_the_figures_are_those_of_each_run(cli: Cli, made: dict[str, Path], tmp_path: Path) -> None:
    found = answer(cli("compare", made["ukf"], made["loose"], "--out", tmp_path / "out.rrd", "--json"))
    for one in found["runs"]:
        shown = json.loads(cli("show", one["file"], "--json").out)
        assert {k: one[k] for k in ("metrics", "nis", "nees")} == {k: shown[k] for k in ("metrics", "nis", "nees")}
    told = cli("compare", made["ukf"], made["loose"], "--out", tmp_path / "out.rrd").out
    assert "gyro_noise" in told
    assert "accel_noise" not in told
    assert "NEES" in told
    assert "difference to ukf:\n  attitude_rmse_deg" in told


def test_a_parameter_that_acts_after_the_freeze_shows_there_first(
    cli: Cli, made: dict[str, Path], tmp_path: Path
) -> None:
    """Until the gyro freezes the two filters are one; the naive search, step by step, says where they part."""
    found = answer(cli("compare", made["ukf"], made["reject"], "--out", tmp_path / "out.rrd", "--json"))
    a, b = (viz_estim.load(made[name]) for name in ("ukf", "reject"))
    expected = naive(a, b, 1e-9)
    assert expected is not None
    assert expected[0] > 50
    difference = found["first_difference"]
    assert (difference["step"], difference["stage"], difference["quantity"]) == expected[:3]
    assert difference["by"] == pytest.approx(expected[3], rel=1e-9)


def naive(a: Run, b: Run, tol: float) -> tuple[int, str, str, float] | None:
    for step in a.step.tolist():
        for (mine, i), (theirs, j) in zip(a.at(step), b.at(step), strict=True):
            assert mine.name == theirs.name
            P = mine.cov[i]
            ratios = {
                "mean": np.abs(a.space.minus(theirs.mean[j], mine.mean[i]) / np.sqrt(np.diag(P))).max(),
                "cov": np.linalg.norm(theirs.cov[j] - P) / np.linalg.norm(P),
            }
            if "innovation.residual" in mine.values:
                sigma = np.sqrt(np.diag(mine.values["innovation.cov"][i]))
                moved = theirs.values["innovation.residual"][j] - mine.values["innovation.residual"][i]
                ratios["residual"] = np.abs(moved / sigma).max()
            for quantity, ratio in ratios.items():
                key = "innovation.residual" if quantity == "residual" else quantity
                equal = mine.values[key][i].tobytes() == theirs.values[key][j].tobytes()
                if ratio > tol and not equal:  # Log(x⁻¹x) is not always zero to the bit
                    return step, mine.name, quantity, float(ratio)
    return None


def test_tol_bounds_the_ratio(cli: Cli, made: dict[str, Path], tmp_path: Path) -> None:
    steps = []
    a, b = (load(made[name], points=False) for name in ("ukf", "loose"))
    for tol in (0, 1e-9, 1e-3, 0.1, 1.0):
        expected = naive(a, b, tol)
        difference = first_difference(a, b, tol)
        assert expected is not None
        assert difference is not None
        assert difference[:3] == expected[:3]
        assert difference.by is not None
        assert difference.by > tol
        steps.append(difference.step)
    assert steps == sorted(steps)
    out = tmp_path / "out.rrd"
    assert answer(cli("compare", made["ukf"], made["loose"], "--out", out, "--tol", 1e9, "--json"))["same"]


@dataclasses.dataclass(frozen=True)
class Walk:
    """A step on at each tick; from step `late` on something is changed in the last bit, in the covariance, or a stage
    is left out or put in."""

    change: str = ""
    late: int = 7

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        changed = tick.time >= self.late
        mean, cov = belief.mean + 1, belief.cov
        if changed and self.change == "bit":
            mean = np.nextafter(mean, np.inf)
        if changed and self.change == "cov":
            cov = cov * (1 + 1e-6)
        moved = Gaussian(belief.space, mean, cov)
        yield Stage("predict", moved)
        if changed and self.change == "more":
            yield Stage("gate", moved)
        if not (changed and self.change == "less"):
            yield Stage("correct", moved)


def walked(folder: Path, change: str, count: int = 20, **facts: Any) -> Run:
    ticks = [Tick(float(k), 1.0) for k in range(count)]
    belief = Gaussian(Euclidean(["x", "y"], "m"), np.zeros(2), np.diag([4.0, 1.0]))
    made = Scenario(Walk(change), {0: belief}, ticks)
    return load(record(folder / f"{change or 'plain'}{count}.rrd", list(run(made)), made, **facts))


@pytest.mark.parametrize(
    ("change", "tol", "expected"),
    [
        ("", 0.0, None),
        ("bit", 1e-9, None),
        ("bit", 0.0, (7, "predict", "mean", np.spacing(8.0))),
        ("cov", 1e-9, (7, "predict", "cov", 1e-6)),
        ("cov", 1e-3, None),
        ("less", 1e-9, (7, "correct", "stage", None)),
        ("more", 1e-9, (7, "gate", "stage", None)),
    ],
)
def test_what_is_found_first(tmp_path: Path, change: str, tol: float, expected: Any) -> None:
    plain, changed = walked(tmp_path, ""), walked(tmp_path, change)
    for a, b in ((plain, changed), (changed, plain)):
        found = first_difference(a, b, tol)
        if expected is None:
            assert found is None
        else:
            assert found is not None
            assert found[:3] == expected[:3]
            assert (found.by is None) == (expected[3] is None)
            if found.by is not None:
                assert found.by == pytest.approx(expected[3], rel=1e-3)


def test_runs_of_other_lengths_rates_and_starts_are_compared_where_they_overlap(tmp_path: Path) -> None:
    whole = load(thinned("imu-ukf", tmp_path, slice(0, 200, 1)))
    for keep in (slice(0, 200, 2), slice(31, 200, 3), slice(0, 90, 1), slice(120, 150, 1)):
        part = load(thinned("imu-ukf", tmp_path, keep))
        for a, b in ((whole, part), (part, whole)):
            assert other_data(a, b) is None
            assert first_difference(a, b, 0) is None
        assert len(part.step) < len(whole.step)


def test_data_are_the_same_by_their_sha256_and_simulations_by_seed_and_parameters(tmp_path: Path) -> None:
    def files(*names: str) -> dict[str, Any]:
        return {"data": [{"path": f"/somewhere/{n}", "sha256": n} for n in names], "system": "imu"}

    def ran(**facts: Any) -> Run:
        return walked(tmp_path, "", **facts)

    a = ran(**files("one"))
    assert other_data(a, ran(**files("one"), seed=5)) is None
    assert other_data(a, ran(**files("one", "fit"), calibration="/somewhere/fit")) is None
    assert "SHA-256" in str(other_data(a, ran(**files("two"))))
    assert "another system" in str(other_data(a, ran(**files("one") | {"system": "plaza"})))
    assert "simulation" in str(other_data(a, ran(system="imu")))
    simulated = ran(system="imu", params={"data.freeze": 1, "gyro_noise": 1})
    assert other_data(simulated, ran(system="imu", params={"data.freeze": 1, "gyro_noise": 2})) is None
    assert "data.freeze" in str(other_data(simulated, ran(system="imu", params={"data.freeze": 2})))
    assert "seed" in str(other_data(simulated, ran(system="imu", seed=1, params={"data.freeze": 1})))
    by_hand = [ran(recorded_by="a person", scenario=name, seed=None) for name in ("mine", "mended")]
    assert other_data(*by_hand) is None


@pytest.mark.parametrize(
    ("other", "words"),
    [("other", "seed 4"), ("longer", "data.noise_scale"), ("drive", "diffdrive"), ("labels", "underwater")],
)
def test_runs_of_other_data_are_compared_without_a_first_difference(
    cli: Cli, made: dict[str, Path], tmp_path: Path, other: str, words: str
) -> None:
    out = tmp_path / "out.rrd"
    found = answer(cli("compare", made["ukf"], made[other], "--out", out, "--json"))
    assert (found["first_difference"], found["same"]) == (None, False)
    assert words in found["reason"]
    assert entities(out).keys() >= {"/runs/ukf/attitude/truth", "/runs/ukf/steps", f"/runs/{other}/steps"}
    assert words in cli("compare", made["ukf"], made[other], "--out", out).out


def test_scenarios_of_one_system_are_compared_on_the_parts_they_share(
    cli: Cli, made: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out.rrd"
    found = answer(cli("compare", made["ukf"], made["alone"], made["gyro"], "--out", out, "--json"))
    assert found["reason"] is None
    assert found["first_difference"]["step"] == 0
    drawn = entities(out)
    assert {f"/plots/difference/attitude.{axis}/{name}" for axis in "xyz" for name in ("alone", "gyro")} <= set(drawn)
    assert "/plots/difference/rate.x/gyro" not in drawn
    assert {"/plots/state/rate.x/ukf"} <= set(drawn)


def test_labels_are_compared_by_their_probabilities(cli: Cli, made: dict[str, Path], tmp_path: Path) -> None:
    found = answer(cli("compare", made["labels"], made["stay"], "--out", tmp_path / "out.rrd", "--json"))
    a, b = (
        np.exp(viz_estim.load(made[name]).stages["predict"].values["log_probabilities"]) for name in ("labels", "stay")
    )
    difference = found["first_difference"]
    assert (difference["stage"], difference["quantity"]) == ("predict", "probabilities")
    assert difference["by"] == pytest.approx(np.abs(a[0] - b[0]).max())


def test_particles_are_compared_by_their_weighted_moments_at_each_stage(cli: Cli, tmp_path: Path) -> None:
    """Other weights, and the same cloud before: they part where the readings are weighed."""
    files = [tmp_path / f"{noise}.rrd" for noise in (0.8, 2)]
    short = ["--set=particles=100", "--set=data.duration=1", "--seed=1"]
    for file in files:
        assert cli("run", "beacons-pf", *short, f"--set=range_noise={file.stem}", "--out", file).code == 0
    found = answer(cli("compare", *files, "--out", tmp_path / "out.rrd", "--json"))["first_difference"]
    assert (found["step"], found["stage"], found["quantity"]) == (0, "weigh", "mean")
    a, b = map(viz_estim.load, files)
    mean, other = (run.stages["weigh"].mean[0] for run in (a, b))
    sigma = np.sqrt(np.diag(a.stages["weigh"].cov[0]))
    assert found["by"] == pytest.approx(np.abs(a.space.minus(other, mean) / sigma).max())


# The merged recording.


def entities(path: Path) -> dict[str, int]:
    """Rows by entity."""
    found: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        found[str(chunk.entity_path)] = found.get(str(chunk.entity_path), 0) + chunk.num_rows
    return found


def test_each_run_keeps_all_but_its_plots_and_truth_is_there_once(
    cli: Cli, made: dict[str, Path], tmp_path: Path
) -> None:
    files = [made[name] for name in ("ukf", "loose", "reject")]
    cli("compare", *files, "--out", tmp_path / "out.rrd")
    merged = entities(tmp_path / "out.rrd")
    for file in files:
        for entity, rows in entities(file).items():
            kept = merged.get(f"/runs/{file.stem}{entity}", 0)
            head = entity.split("/")[1]
            left_out = head in ("plots", "notes", "__properties")
            again = "/truth" in entity and file is not files[0]
            assert kept == (0 if left_out or again else rows), entity
    truths = {entity for entity in merged if "truth" in entity}
    assert {entity.split("/")[2] for entity in truths if entity.startswith("/runs/")} == {"ukf"}
    assert {entity for entity in truths if entity.startswith("/plots/")} == {
        f"/plots/state/attitude.{c}/-truth" for c in ("qw", "qx", "qy", "qz")
    }


def plotted(path: Path, group: str) -> dict[str, list[tuple[int, float]]]:
    """By entity under a group of plots, steps and values."""
    found: dict[str, list[tuple[int, float]]] = {}
    for chunk in RrdReader(path).stream().filter(content=[f"/plots/{group}/**"]):
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            values = batch.column("Measurements:values").to_pylist()
            rows = zip(batch.column("step").to_pylist(), values, strict=True)
            found.setdefault(str(chunk.entity_path), []).extend((step, value[0]) for step, value in rows if value)
    return found


def test_what_moved_each_estimate_is_drawn_by_direction_all_readings_together(
    cli: Cli, made: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out.rrd"
    cli("compare", made["ukf"], made["loose"], made["gyro"], "--out", out)
    lines = plotted(out, "moved")
    assert {path.split("/")[-1] for path in lines} == {"ukf", "loose"}  # nothing corrects the other
    for name in ("ukf", "loose"):
        a = viz_estim.load(made[name])
        for axis, (step, value) in (
            (i, lines[f"/plots/moved/{path}/{name}"][40]) for i, path in enumerate(a.space.axes)
        ):
            ((update, row),) = [(table, row) for table, row in a.at(step) if table.name == "update"]
            before, at = a.before(update, row) or pytest.fail("no stage before it")
            delta = update.values["gain"][row] @ update.values["innovation.residual"][row]
            assert value == pytest.approx(delta[axis] / np.sqrt(before.cov[at][axis, axis]))


def test_what_several_updates_of_a_step_moved_is_their_sum(tmp_path: Path) -> None:
    with viz_estim.record(tmp_path / "two.rrd", space={"x": "m", "y": "m"}) as rec:
        for k in range(4):
            rec.stage("predict", mean=[0, 0], cov=np.diag([4.0, 1.0]))
            for name, K in (("gps", [[0.5], [0.25]]), ("lidar", [[0.25], [0.0]])):
                if not (k == 2 and name == "lidar"):
                    rec.stage(name, mean=[0, 0], cov=np.eye(2), residual=[k], residual_cov=[[1.0]], gain=K)
            rec.step(time=0.1 * k)
    place, step, total = overlaid_stages.moved(load(tmp_path / "two.rrd"))
    assert step.tolist() == [0, 1, 2, 3]
    assert place.tolist() == [2, 5, 7, 10]
    np.testing.assert_allclose(total[:, 0], [0, 0.25 + 0.25, 0.5, 0.75 + 0.75])
    np.testing.assert_allclose(total[:, 1], [0, 0.25, 0.5, 0.75])


def test_an_error_has_its_length_and_readings_of_the_state_lie_beneath_it(
    cli: Cli, made: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out.rrd"
    cli("compare", made["ukf"], made["loose"], "--out", out)
    a = viz_estim.load(made["ukf"])
    turn = np.degrees(np.linalg.norm(SO3().minus(a.mean[:, :4], a.truth[:, :4]), axis=1))
    step, value = plotted(out, "error")["/plots/error/attitude.length/ukf"][50]
    assert value == pytest.approx(turn[step])
    step, value = plotted(out, "state")["/plots/state/rate.y/-reading"][50]
    assert value == a.inputs["z.gyro"][step, 1]


def test_a_nis_of_other_degrees_of_freedom_is_another_quantity(cli: Cli, made: dict[str, Path], tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    told = cli("compare", made["ukf"], made["alone"], "--out", out).out
    assert re.search(r"NIS accel \(3 expected\) +[\d.]+ \w+ +–", told)
    assert re.search(r"NIS accel \(2 expected\) +– +[\d.]+ \w+\n", told)
    assert {"/plots/nis/accel/ukf", "/plots/nis/accel-2/alone"} <= set(entities(out))


@pytest.mark.parametrize("width", [60, 80, 120, 400])
def test_the_table_is_as_wide_as_the_terminal(width: int) -> None:
    names = [f"a rather long name of run {i}" for i in range(6)]
    table = [
        Row("metric_of_unit", [f"{i}" for i in range(6)]),
        Row("difference:", []),
        Row("  other", ["–"] * 5 + ["7"]),
    ]
    lines = text(names, table, width)
    assert max(map(len, lines)) <= width
    words = " ".join(lines)
    assert all(words.count(name) == 1 for name in names)
    assert words.count("  other") == 1
    assert len(lines) == (4 if width == 400 else 4 * lines.count("") + 3 + 1)


def test_a_difference_plot_is_the_turn_between_the_two_on_the_first_run_s_stamps(tmp_path: Path, cli: Cli) -> None:
    fast, slow = (thinned("imu-ukf", tmp_path, keep) for keep in (slice(0, 200, 1), slice(30, 150, 7)))
    cli("compare", fast, slow, "--out", tmp_path / "out.rrd")
    a, b = load(fast), load(slow)
    found: dict[float, float] = {}
    for chunk in RrdReader(tmp_path / "out.rrd").stream():
        if str(chunk.entity_path).startswith("/plots/difference/attitude.length/") and not chunk.is_static:
            batch = chunk.to_record_batch()
            for i, value in enumerate(batch.column("Measurements:values").to_pylist()):
                if value:
                    assert batch.column("step")[i].as_py() in a.step
                    found[batch.column("time")[i].value / 1e9] = value[0]
    inside = (a.time >= b.time[0]) & (a.time <= b.time[-1])
    np.testing.assert_allclose(sorted(found), a.time[inside])
    truth = on_stamps(SO3(), b.time, b.mean[:, :4], a.time[inside])
    relative = quaternions.multiply(quaternions.conjugate(a.mean[inside, :4]), truth)
    angles = np.degrees(2 * np.arctan2(np.linalg.norm(relative[:, 1:], axis=1), np.abs(relative[:, 0])))
    np.testing.assert_allclose([found[t] for t in sorted(found)], angles, atol=1e-9)


def test_a_slower_run_s_rows_stand_at_the_first_run_s_steps_and_stages(tmp_path: Path, cli: Cli) -> None:
    fast, slow = (thinned("imu-ukf", tmp_path, keep) for keep in (slice(0, 200, 1), slice(30, 200, 7)))
    for first, other in ((fast, slow), (slow, fast)):
        cli("compare", first, other, "--out", tmp_path / "out.rrd")
        a = load(first)
        stamps = np.round(a.time * 1e9).astype(int)
        step_at = {
            int(place): int(step) for t in a.stages.values() for place, step in zip(t.place, t.step, strict=True)
        }
        seen = 0
        for chunk in RrdReader(tmp_path / "out.rrd").stream():
            if str(chunk.entity_path).startswith(f"/runs/{other.stem}/attitude/estimate") and not chunk.is_static:
                batch = chunk.to_record_batch()
                times = (batch.column(name).cast(pa.int64()).to_pylist() for name in ("time", "step", "stage"))
                for time, step, stage in zip(*times, strict=True):
                    row = int(np.searchsorted(stamps, time, side="right")) - 1
                    if 0 <= row < len(stamps) - 1:
                        assert step == a.step[row]
                        assert step_at[stage] == step
                        seen += 1
        assert seen > 20


def test_a_clock_of_equal_runs_changes_nothing(made: dict[str, Path]) -> None:
    runs = [Compared(load(made[name], points=False), i, name, True) for i, name in enumerate(("ukf", "loose", "gyro"))]
    assert Clock(runs[0], runs[0]).same
    assert Clock(runs[0], runs[1]).same
    assert not Clock(runs[0], runs[2]).same


def test_only_the_estimate_s_colour_is_turned_into_the_run_s() -> None:
    amber, dimmed, white, red, clear = 0xFFB000FF, 0x8C6000FF, 0xEBEBEBFF, 0xEB4646FF, 0xFFB00080
    column = pa.array([[amber, dimmed], [], [white, red, clear]], pa.list_(pa.uint32()))
    (a, b), none, (c, d, e) = _recoloured(column, (90, 150, 255)).to_pylist()
    assert (a, c, d, none) == (0x5A96FFFF, white, red, [])
    assert e == 0x5A96FF80
    assert b == round(90 * 140 / 255) << 24 | round(150 * 140 / 255) << 16 | round(255 * 140 / 255) << 8 | 255


def test_a_killed_run_is_compared_as_far_as_it_goes(cli: Cli, made: dict[str, Path], tmp_path: Path) -> None:
    content = made["ukf"].read_bytes()
    cut = tmp_path / "cut.rrd"
    for share in (0.95, 0.85, 0.75):
        cut.write_bytes(content[: int(share * len(content))])
        found = answer(cli("compare", made["ukf"], cut, "--out", tmp_path / "out.rrd", "--json"))
        assert found["same"]
    assert "cut off" in cli("compare", made["ukf"], cut, "--out", tmp_path / "out.rrd").out
    assert any(entity.startswith("/runs/cut/") for entity in entities(tmp_path / "out.rrd"))


@pytest.mark.parametrize(
    ("entity", "selected"), [("/lanes/01_frozen_range/1", "/lanes/01_frozen_range/1"), ("/runs/a\\ b/steps", "/runs")]
)
def test_a_panel_s_links_go_to_the_time_in_the_viewer_that_holds_it(entity: str, selected: str) -> None:
    """The address is the one that the real viewer follows, in `test_compare_pictures`."""
    text = f"see {links.link('step 3', entity, 0.25)} and [others](https://rerun.io)"
    blueprint = {
        "/view/v": {"ViewBlueprint": {"a": 1}},
        "/view/v/o": {"TextDocument": {"text": text, "media_type": "m"}},
    }
    moved = links.moving(blueprint, "rerun+http://127.0.0.1:1", "Recording:18EB:ab12")
    assert moved is not None
    url = f"rerun+http://127.0.0.1:1/dataset/18EB?segment_id=ab12#selection={selected}&when=time@0.250000000s"
    assert moved["/view/v/o"]["TextDocument"]["text"] == f"see [→ step 3]({url}) and [others](https://rerun.io)"
    assert moved["/view/v"] == blueprint["/view/v"]
    assert links.moving({"/view/v": {"ViewBlueprint": {"a": 1}}}, "rerun+http://127.0.0.1:1", "Recording:1:2") is None


# Usage.


def test_the_default_output_and_names_of_equal_files(
    cli: Cli, made: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "ukf.rrd").write_bytes(made["ukf"].read_bytes())
    done = cli("compare", made["ukf"], made["ukf"], tmp_path / "b" / "ukf.rrd", "--json")
    found = answer(done)
    folder = made["ukf"].parent.name
    assert [one["name"] for one in found["runs"]] == [f"{folder}/ukf", f"{folder}/ukf 2", "b/ukf"]
    assert (tmp_path / found["recording"]).is_file()
    assert Path(found["recording"]).parent == Path("recordings")


def test_wrong_usage_is_one_line(cli: Cli, made: dict[str, Path], tmp_path: Path) -> None:
    before = made["ukf"].read_bytes()
    (tmp_path / "noise.rrd").write_bytes(b"noise")
    merged = tmp_path / "merged.rrd"
    assert cli("compare", made["ukf"], made["again"], "--out", merged).code == 0
    for arguments in (
        [made["ukf"]],
        [made["ukf"]] * 7,
        [made["ukf"], tmp_path / "none.rrd"],
        [made["ukf"], tmp_path / "noise.rrd"],
        [made["ukf"], merged],
        [made["ukf"], made["loose"], "--tol", "-1"],
        [made["ukf"], made["loose"], "--tol", "nan"],
        [made["ukf"], made["loose"], "--out", made["ukf"]],
        [made["ukf"], made["loose"], "--out", tmp_path / "out.txt"],
    ):
        done = cli("compare", *arguments, *([] if "--out" in arguments else ["--out", tmp_path / "out.rrd"]))
        assert (done.code, done.out) == (2, ""), arguments
        assert done.err.count("\n") == 1
        assert not (tmp_path / "out.rrd").exists()
    assert made["ukf"].read_bytes() == before
