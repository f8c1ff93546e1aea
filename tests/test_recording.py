"""What an estimator did comes back from its recording, bit for bit; what is drawn stands as long as its stage does."""

import dataclasses
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from conftest import SHORT
from rerun.chunk import RrdReader

import viz_estim
from viz_estim.core.beliefs import Gaussian, Particles
from viz_estim.core.measurement import Measurement, Sensor
from viz_estim.core.particle import equal, resample, weigh
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Step, Tick, run
from viz_estim.core.spaces import SO3, Euclidean, Product
from viz_estim.core.stages import Innovation, Matches, Resample, SigmaPoints, Stage
from viz_estim.core.unscented import predict, symmetric, update
from viz_estim.parameters import parameters
from viz_estim.recording.reader import Run
from viz_estim.recording.recorder import Recorder
from viz_estim.recording.schema import by_weight
from viz_estim.running import find, plan
from viz_estim.scenarios import SCENARIOS

ODD, SHARED = "stages that differ from step to step", "two stages that share a sensor"
STILL = "particles without a process, moved after some of their resamplings"
TWICE = "particles weighed again after they were resampled"
# What stands in a scene through all stages, by its place in the entity's path.
STANDING = ("estimate", "truth", "scenery", "moved", "particles", "modes", "camera")
every_scenario = pytest.mark.parametrize("name", [*SCENARIOS, ODD, SHARED, STILL, TWICE])
Kept = dict[str, tuple[Path, list[Step]]]


@dataclasses.dataclass(frozen=True, slots=True)
class Learn(Stage):
    """A stage that the project knows nothing of."""

    weights: Array
    table: Array
    note: str = "not a number"


@dataclasses.dataclass(frozen=True)
class Odd:
    """Another set of stages at each step: `gps` at every third, `learn` until step 20, nothing at all at step 12.

    again: a step after each `gps` the same sensor is taken in once more, by a stage of another name.
    """

    again: bool = False
    gps = Measurement({"gps": Sensor(Euclidean(("x", "y", "z"), "m"), lambda q: 5 * q[..., 1:], np.eye(3))})

    def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        k = round(10 * tick.time)
        if k == 12:
            return
        moved = predict(belief, lambda q: q, 1e-4 * np.eye(3), symmetric(3))
        yield moved
        belief = moved.belief
        if k % 3 == 0 or (self.again and k % 3 == 1):
            name = "gps_again" if k % 3 else "gps"
            taken = update(belief, tick.measurements["gps"], self.gps, symmetric(3), name=name)
            yield taken
            belief = taken.belief
        if k < 20:
            yield Learn("learn", belief, rng.standard_normal(3), rng.standard_normal((2, 4)))


@dataclasses.dataclass(frozen=True)
class Still:
    """Particles that are weighed and resampled where they stood at the end of the step before; at every third step a
    resampling moves its copies too, or, `again`, none does and they are weighed once more in the same step."""

    again: bool = False

    def step(self, belief: Particles, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
        weighed = weigh(belief, lambda x, tick: -np.square(x[..., 0] - tick.measurements["z"][0]), tick)
        yield weighed
        drawn = resample(weighed.belief, rng)
        if not self.again and round(10 * tick.time) % 3 == 0:
            moved = drawn.belief.states + 0.1 * rng.standard_normal(drawn.belief.states.shape)
            drawn = dataclasses.replace(drawn, belief=dataclasses.replace(drawn.belief, states=moved))
        yield drawn
        if self.again:
            yield weigh(drawn.belief, lambda x, tick: -np.abs(x[..., 1]), tick, name="weigh_again")


def still(estimator: Still) -> Scenario:
    rng = np.random.default_rng(2)
    belief = equal(Product(position=Euclidean(("x", "y"), "m")), rng.standard_normal((50, 2)))
    ticks = [Tick(k / 10, 0.1, measurements={"z": rng.standard_normal(1)}) for k in range(40)]
    return Scenario(estimator, {0: belief}, ticks)


def made_up(estimator: Odd) -> Scenario:
    belief = Gaussian(Product(attitude=SO3()), np.array([1.0, 0, 0, 0]), 0.01 * np.eye(3))
    gps = np.random.default_rng(0).standard_normal((40, 3))
    ticks = [Tick(k / 10, 0.1, measurements={"gps": gps[k]} if k % 3 < 2 else {}) for k in range(40)]
    return Scenario(estimator, {0: belief}, ticks)


def scenario(name: str) -> Scenario:
    """A scenario on short simulated data, whatever its data function can be told."""
    if name in (STILL, TWICE):
        return still(Still(again=name == TWICE))
    if name in (ODD, SHARED):
        return made_up(Odd(again=name == SHARED))
    source = find(name)
    known = parameters(source.data) if source.data else {}
    settings = [s for s in SHORT if s.removeprefix("data.").partition("=")[0] in known]
    made = plan(name, data=None, calibration=None, settings=settings, seed=3).build()
    return dataclasses.replace(made, ticks=made.ticks[:400])


def record(path: Path, made: Scenario, *, every: int = 1) -> list[Step]:
    steps = []
    with Recorder(path, made, {"scenario": "test"}, every=every) as recorder:
        for step in run(made, 5):
            recorder.add(step)
            steps.append(step)
    return steps


@pytest.fixture(scope="session")
def kept() -> Kept:
    return {}


@pytest.fixture
def recorded(name: str, kept: Kept, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Step]]:
    """The recording of a scenario, made once, and the steps that went into it."""
    if name not in kept:
        path = tmp_path_factory.mktemp("recorded") / "run.rrd"
        kept[name] = path, record(path, scenario(name))
    return kept[name]


def same(read: Any, held: Any) -> bool:
    """Equal to the last bit, NaN and the sign of zero among them."""
    read, held = np.asarray(read, float), np.asarray(held, float)
    return read.shape == held.shape and read.tobytes() == held.tobytes()


def assert_holds(loaded: Run, steps: list[Step], every: int = 1) -> None:
    """All numbers of all stages are in the run, and its stages come in the same order."""
    assert same(loaded.step, [step.index for step in steps])
    for row, step in enumerate(steps):
        tables = loaded.at(step.index)
        assert [table.name for table, _ in tables] == [stage.name for stage in step.stages]
        for stage, (table, at) in zip(step.stages, tables, strict=True):
            thinned = row % every != 0
            held: dict[str, Any] = {name: getattr(stage.belief, name) for name in stage.belief.shapes}
            if isinstance(stage.belief, Particles):
                assert table.mean[at] == pytest.approx(stage.belief.mean, abs=1e-9)
                assert table.cov[at] == pytest.approx(stage.belief.cov, abs=1e-9)
                held |= {name: table.values[name][at] for name in ("mean", "cov")}
            for field in dataclasses.fields(stage)[2:]:
                value = getattr(stage, field.name)
                if isinstance(value, SigmaPoints):
                    missing = np.full(value.points.shape, np.nan)
                    held[f"{field.name}.points"] = missing if thinned else value.points
                elif isinstance(value, Matches):
                    held |= {f"{field.name}.{part}": getattr(value, part) for part in Matches.__slots__}
                elif isinstance(value, Innovation):
                    held |= {f"{field.name}.{p}": getattr(value, p) for p in Innovation.__slots__ if p != "space"}
                elif isinstance(value, (np.ndarray, float, int)):
                    held[field.name] = value
            assert set(held) == set(table.values)
            assert [key for key, value in held.items() if not same(table.values[key][at], value)] == []
        if step.stages:
            belief = step.stages[-1].belief
            for name, values in loaded.ends.items():
                cloud = isinstance(belief, Particles)
                assert same(values[row], getattr(belief, name)) or (
                    cloud and np.allclose(values[row], getattr(belief, name))
                )


@every_scenario
def test_every_number_comes_back_bit_for_bit(recorded: tuple[Path, list[Step]]) -> None:
    path, steps = recorded
    loaded = viz_estim.load(path)
    assert_holds(loaded, steps)
    assert loaded.complete
    assert same(loaded.dt, [step.tick.dt for step in steps])
    missing = np.full(loaded.truth.shape[1], np.nan)
    assert same(loaded.truth, [missing if step.truth is None else step.truth for step in steps])
    for name, values in loaded.inputs.items():
        kind, _, sensor = name.partition(".")
        where = {"z": "measurements", "raw": "raw", "control": "control"}[kind]
        for step, value in zip(steps, values, strict=True):
            given = getattr(step.tick, where)
            given = given if kind == "control" else given.get(sensor)
            assert same(value, np.full(value.shape, np.nan) if given is None else given)
    ticks = [step.tick for step in steps]
    given = {f"z.{s}" for tick in ticks for s in tick.measurements} | {f"raw.{s}" for tick in ticks for s in tick.raw}
    assert set(loaded.inputs) - {"control"} == given


def large_steps(count: int) -> Scenario:
    """A walk by a filter of one's own whose steps are as large as a scan's matches."""
    rng, space = np.random.default_rng(0), Product(place=Euclidean(("x", "y"), "m"))
    tables = rng.standard_normal((count, 40, 1000))

    class Walk:
        pure = True

        def step(self, belief: Gaussian, tick: Tick, rng: np.random.Generator) -> Iterator[Stage]:
            time.sleep(0.002)  # as in a call that frees the interpreter's lock
            table = tables[round(tick.time)]
            yield Learn("learn", Gaussian(space, belief.mean + table[0, :2], belief.cov), table[:1], table)

    ticks = [Tick(float(k), float(k > 0)) for k in range(count)]
    return Scenario(Walk(), {0: Gaussian(space, np.zeros(2), np.eye(2))}, ticks)


def test_large_steps_come_back_bit_for_bit_though_another_thread_writes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writers = set()
    flush = Recorder._flush

    def seen(self: Recorder, steps: list[Step]) -> None:
        writers.add(threading.current_thread())
        flush(self, steps)

    monkeypatch.setattr(Recorder, "_flush", seen)
    steps = record(tmp_path / "a.rrd", large_steps(60))
    assert_holds(viz_estim.load(tmp_path / "a.rrd"), steps)
    assert writers - {threading.main_thread()}


def test_a_failure_to_write_reaches_the_filter_from_another_thread_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Recorder, steps: list[Step]) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Recorder, "_flush", full)
    with pytest.raises(OSError, match="No space left"):
        record(tmp_path / "a.rrd", large_steps(60))
    assert not (tmp_path / "a.rrd").exists()


def test_every_thins_sigma_points_and_no_numbers(tmp_path: Path) -> None:
    made = scenario("imu-ukf")
    steps = record(tmp_path / "thin.rrd", made, every=5)
    assert_holds(viz_estim.load(tmp_path / "thin.rrd"), steps, every=5)
    assert_geometry(tmp_path / "thin.rrd", steps, every=5)


def rows_of(path: Path) -> Iterator[tuple[str, dict[str, int], list[int]]]:
    """Of each row that is not static: its entity, its times by timeline, and the lengths of its components' batches."""
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            batch = chunk.to_record_batch()
            times = {name: batch.column(name).cast(pa.int64()).to_pylist() for name in chunk.timeline_names}
            columns = [c for n, c in zip(batch.schema.names, batch.columns, strict=True) if ":" in n]
            lengths = [column.value_lengths().to_pylist() for column in columns]
            for row in range(batch.num_rows):
                here = {name: values[row] for name, values in times.items()}
                yield str(chunk.entity_path), here, [n[row] for n in lengths if n[row] is not None]


@every_scenario
def test_data_rows_carry_three_timelines_and_rows_that_only_clear_may_carry_stage_alone(
    recorded: tuple[Path, list[Step]],
) -> None:
    path, steps = recorded
    places = []
    for entity, times, lengths in rows_of(path):
        assert set(times) in ({"step", "time", "stage"}, {"stage"})
        if set(times) == {"stage"}:
            assert not any(lengths), f"{entity} at {times}"
        else:
            assert times["time"] == round(steps[times["step"]].tick.time * 1e9)
        places += [times["stage"]] if entity.startswith("/stages/") else []
    counts = [max(1, len(step.stages)) for step in steps]  # a step without stages takes a place of its own
    starts = np.cumsum([0, *counts[:-1]])
    expected = [start + i for start, step in zip(starts, steps, strict=True) for i in range(len(step.stages))]
    assert sorted(places) == expected


def assert_geometry(path: Path, steps: list[Step], every: int = 1) -> None:
    """At each moment of each timeline a viewer shows (by an entity's latest row) what that moment's stages drew."""
    rows: dict[tuple[str, str], dict[int, bool]] = defaultdict(dict)
    for entity, times, lengths in rows_of(path):
        still = any(entity.split("/")[2:3] == [name] for name in STANDING)
        if entity.startswith(("/sensors/", "/world/", "/attitude/")) and not still:
            for timeline, value in times.items():
                assert value not in rows[entity, timeline], f"{entity}: rows at {timeline} {value} hide each other"
                rows[entity, timeline][value] = any(lengths)
    moments: dict[str, list[tuple[int, set[str]]]] = {"step": [], "time": [], "stage": []}
    place, before, drew = 0, None, False
    for step in steps:
        kept = step.index % every == 0
        shown = []
        for stage in step.stages:
            shown.append(owned(stage, before, drew, step.index) if kept else set())
            before, drew = stage, kept
        shown = shown or [set()]
        moments["step"].append((step.index, set().union(*shown)))
        moments["time"].append((round(step.tick.time * 1e9), set().union(*shown)))
        moments["stage"] += [(place + i, paths) for i, paths in enumerate(shown)]
        place += len(shown)
    drawn = set().union(*(paths for _, paths in moments["step"]))
    assert {entity for entity, _ in rows} == drawn
    for (entity, timeline), found in rows.items():
        visible = False
        for value, paths in moments[timeline]:
            visible = found.get(value, visible)
            assert visible == (entity in paths), f"{entity} at {timeline} {value}"


def leaves(space: Any) -> Iterator[tuple[str, Any]]:
    for name, part in space.parts.items():
        yield from leaves(part) if isinstance(part, Product) else [(name, part)]


def owned(stage: Stage, before: Stage | None, drew: bool, index: int) -> set[str]:
    """The geometry that stands during a stage: sigma points of places and attitudes, readings of sensors in scenes of
    their own, and where the state has a place, what the update moved there. Points that are the stage before's own
    stand on from there."""
    paths: set[str] = set()
    parts = getattr(getattr(stage.belief, "space", None), "parts", {})
    places = {k for k, part in parts.items() if part.names in (("x", "y"), ("x", "y", "z")) and part.units[0] == "m"}
    if isinstance(stage, Resample) and index > 0:
        paths.add(f"/world/{stage.name}/ancestry")
    for field in dataclasses.fields(stage)[2:]:
        value = getattr(stage, field.name)
        if isinstance(value, Matches):
            paths.add(f"/world/{stage.name}/{field.name}")
        elif isinstance(value, Innovation):
            for sensor, part in value.space.parts.items():
                reads = next(iter(getattr(part, "parts", {sensor: part}).values()))
                if places and part.units[0] == "m" and (reads.names in (("x", "y"), ("x", "y", "z")) or before):
                    paths.add(f"/world/{stage.name}/{sensor}")  # a place, or ranges to landmarks
                elif len(part.names) == 3 and reads.units[0] != "m":
                    paths |= {f"/sensors/{sensor}/{stage.name}/{arrow}" for arrow in ("measured", "predicted")}
            if places and before:
                paths |= {f"/world/{stage.name}/before", f"/world/{stage.name}/moved"}
        elif isinstance(value, SigmaPoints):
            shared = (
                [f.name for f in dataclasses.fields(before)[2:] if getattr(before, f.name) is value] if before else []
            )
            owner, called = (before, shared[0]) if shared and drew else (stage, field.name)
            of_state = {name for name, _ in leaves(value.space)} >= parts.keys()
            for name, part in leaves(value.space):
                if name in places or (isinstance(part, SO3) and name in parts):
                    scene = "world" if name in places else "attitude"
                    paths.add(f"/{scene}/{owner.name}/{called}")
                elif not of_state and len(part.names) == 3 and part.units[0] != "m":
                    paths.add(f"/sensors/{name}/{owner.name}/{called}")
    return paths


@every_scenario
def test_geometry_stands_on_each_timeline_while_its_stage_does(recorded: tuple[Path, list[Step]]) -> None:
    assert_geometry(*recorded)


def shown_clouds(path: Path) -> dict[int, set[tuple[Any, ...]]]:
    """By stage, the places and colours of the particles that are to be seen: each component's latest row, and of those
    with a radius."""
    rows: dict[str, dict[int, Any]] = defaultdict(dict)
    for chunk in RrdReader(path).stream():
        if str(chunk.entity_path) == "/world/particles" and not chunk.is_static:
            batch = chunk.to_record_batch()
            stages = batch.column("stage").cast(pa.int64()).to_pylist()
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                if ":" in name:
                    values = zip(stages, column.to_pylist(), strict=True)
                    rows[name.rpartition(":")[2]] |= {at: value for at, value in values if value is not None}
    now: dict[str, Any] = {}
    shown = {}
    for at in sorted(set().union(*rows.values())):
        now |= {name: found[at] for name, found in rows.items() if at in found}
        places = now.get("positions") or now["origins"]
        radii, colours = (now[name] * (1 if len(now[name]) > 1 else len(places)) for name in ("radii", "colors"))
        seen = zip(map(tuple, places), radii, colours, strict=True)
        shown[at] = {(*place, colour) for place, radius, colour in seen if radius}
    return shown


@pytest.mark.parametrize("name", [STILL, TWICE, "beacons-pf", "se2-pf"])
def test_a_cloud_stands_at_each_stage_where_its_particles_do_in_their_weights_colours(
    recorded: tuple[Path, list[Step]],
) -> None:
    path, steps = recorded
    shown = shown_clouds(path)
    at = 0
    for step in steps:
        for stage in step.stages:
            belief = stage.belief
            places = np.zeros((len(belief.states), 3), np.float32)
            places[:, :2] = belief.states[:, :2]
            weights = belief.log_weights.astype(np.float32)
            colours = by_weight(np.exp(weights - weights.max()))
            assert shown[at] == {(*map(float, p), int(c)) for p, c in zip(places, colours, strict=True)}, (at, stage)
            at += 1
