"""The first finding is the cause: broken data and broken filters beside the gallery, each told by the right words."""

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import viz_estim
from viz_estim.core.beliefs import Gaussian
from viz_estim.core.kalman import linear, linear_sensor
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, Tick, run
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.diagnose import diagnose
from viz_estim.diagnosis import evidence, tuning
from viz_estim.diagnosis.finding import Finding
from viz_estim.recording.memory import collect
from viz_estim.recording.reader import Run
from viz_estim.scenarios import beacons, diffdrive, flawed_data, landmarks
from viz_estim.scenarios.flawed_filters import with_process_noise

Change = Callable[[Scenario], Scenario]


def drive(**params: Any) -> Scenario:
    return diffdrive.diffdrive_ekf(drive_data(), **params)


@functools.cache
def drive_data() -> diffdrive.DriveData:
    return diffdrive.diffdrive(None, np.random.default_rng(100), duration=16.0)


def reads(change: Callable[[Array], Array]) -> Change:
    return lambda s: flawed_data.fed(s, lambda k, z: {name: change(v) for name, v in z.items()})


def steers(change: Callable[[Array], Array]) -> Change:
    def changed(s: Scenario) -> Scenario:
        ticks = [replace(t, control=None if t.control is None else change(t.control)) for t in s.ticks]
        return replace(s, ticks=ticks)

    return changed


def starts(*delta: float) -> Change:
    return lambda s: replace(
        s, beliefs={0: replace(s.beliefs[0], mean=s.space.plus(s.beliefs[0].mean, np.array(delta)))}
    )


def holds(first: float, last: float) -> Change:
    def changed(s: Scenario) -> Scenario:
        at = {k: t.measurements["gps"] for k, t in enumerate(s.ticks) if t.measurements}
        level = next(z for k, z in at.items() if s.ticks[k].time >= first)
        stuck = {k for k in at if first <= s.ticks[k].time < last}
        return flawed_data.fed(s, lambda k, z: {"gps": level} if k in stuck else z)

    return changed


def found(scenario: Scenario, params: dict[str, Any] | None = None) -> list[Finding]:
    return diagnose(collect(scenario, run(scenario), params))


CAUSES: dict[str, tuple[Change, str, str | None, str]] = {
    "axes swapped": (reads(lambda z: z[[1, 0]]), "units_or_axes", "gps", "axes +y +x"),
    "a sign": (reads(lambda z: z * [1, -1]), "units_or_axes", "gps", "axes +x −y"),
    "feet": (reads(lambda z: z / 0.3048), "units_or_axes", "gps", "feet for m"),
    "a scale": (reads(lambda z: 1.1 * z), "units_or_axes", "gps", "× what the truth would give"),
    "an offset": (reads(lambda z: z + np.array([3.0, 0.0])), "biased_innovation", "gps", "readings of gps x are +"),
    "half a second late": (lambda s: flawed_data.shifted(s, 5), "lag", "gps", "s late"),
    "stuck": (holds(8.0, 12.0), "sensor_frozen", "gps", "sticks at one value for"),
    "the other way round": (steers(lambda u: u * [1, -1]), "process_model", None, "heading is predicted to move by -"),
    "degrees": (steers(lambda u: u * [1, 180 / np.pi]), "process_model", None, "degrees for radians"),
    "a rate's bias": (steers(lambda u: u + np.array([0, 0.3])), "process_model", None, "misses a steady -0."),
    "slow wheels": (steers(lambda u: u * [0.7, 1]), "process_model", None, "is predicted to move by 0."),
    "starts backwards": (starts(0, 0, np.pi), "start", None, "heading"),
}  # fmt: skip


@functools.cache
def told_of(name: str) -> list[Finding]:
    return found(CAUSES[name][0](drive()))


@pytest.mark.parametrize("name", CAUSES)
def test_the_cause_is_the_first_finding_and_the_only_error(name: str) -> None:
    _, code, sensor, words = CAUSES[name]
    first, *others = told_of(name)
    assert (first.code, first.sensor, first.severity) == (code, sensor, "error")
    assert words in first.cause
    assert not [finding for finding in others if finding.severity == "error"], others
    assert all("mend " in f.remedy for f in others if f.code in ("overconfident", "coloured_innovation", "diverged"))


def short() -> Scenario:
    """The first 4 s."""
    scenario = drive()
    assert scenario.truth is not None
    return replace(scenario, ticks=scenario.ticks[:400], truth=scenario.truth[:400])


def test_a_wrong_sign_is_to_be_changed_and_not_divided_by() -> None:
    for change in (reads(lambda z: -z), steers(lambda u: u * [1, -1])):
        first = found(change(short()))[0]
        assert "change" in first.remedy
        assert "divide" not in first.remedy
    assert "divide the readings of gps by -1.2" in found(reads(lambda z: -1.2 * z)(short()))[0].remedy


@pytest.mark.parametrize("change", [steers(lambda u: u * [1, -1]), steers(lambda u: u + np.array([0, 0.3]))])
def test_a_motion_is_not_laid_to_a_control_that_is_not_recorded(change: Change) -> None:
    scenario = change(short())
    recorded = collect(scenario, run(scenario))
    del recorded.inputs["control"]
    first = diagnose(recorded)[0]
    assert first.code == "process_model"
    assert "the control" not in first.cause + first.remedy


def test_numbers_that_are_told_are_true() -> None:
    lag = told_of("half a second late")[0]
    assert lag.evidence["lag_s"] == pytest.approx(0.5, abs=0.06)
    drift = told_of("a rate's bias")[0]
    assert drift.evidence["drift"] == pytest.approx(-0.3, abs=0.03)
    scale = told_of("a scale")[0]
    assert float(scale.evidence["map"].removeprefix("a factor of ")) == pytest.approx(1.1, abs=0.01)
    bias = told_of("an offset")[0]
    assert bias.evidence["bias"] == pytest.approx(3.0, abs=0.4)
    stuck = told_of("stuck")[0]
    assert stuck.evidence["from_s"] == pytest.approx(8.0, abs=0.11)
    assert stuck.evidence["to_s"] == pytest.approx(12.0, abs=0.11)


@pytest.mark.parametrize("steps", [1, 2, 30])
@pytest.mark.parametrize("truth", [True, False])
def test_short_runs_and_runs_without_truth_are_healthy(steps: int, truth: bool) -> None:
    scenario = drive()
    scenario = replace(scenario, ticks=scenario.ticks[:steps], truth=scenario.truth if truth else None)
    assert found(scenario) == []


def test_a_truth_with_gaps_or_none_known_changes_nothing() -> None:
    scenario = drive()
    assert scenario.truth is not None
    for rows in (slice(400, 900), slice(None)):
        truth = scenario.truth.copy()
        truth[rows] = np.nan
        assert found(replace(scenario, truth=truth)) == []


@pytest.mark.parametrize("factor", [1 / 9, 9.0])
def test_the_factor_on_r_is_the_one_that_was_put_in(factor: float) -> None:
    data = landmarks.landmarks(None, np.random.default_rng(100), duration=30.0)
    noise = 0.3 * factor**0.5
    told = found(landmarks.landmarks_ekf(data, range_noise=noise), {"range_noise": noise})[0]
    assert (told.code, told.sensor) == ("overconfident" if factor < 1 else "underconfident", "range")
    assert told.evidence["factor_on_R"] == pytest.approx(1 / factor, rel=0.3)
    assert f"set range_noise to about {noise * told.evidence['factor_on_R'] ** 0.5:.2g}" in told.remedy


@pytest.mark.parametrize(("factor", "code"), [(0.01, "overconfident"), (100.0, "underconfident")])
def test_a_wrong_q_is_told_from_a_wrong_r(factor: float, code: str) -> None:
    healthy = landmarks.landmarks_ekf(landmarks.landmarks(None, np.random.default_rng(100), duration=40.0))
    scenario = replace(healthy, estimator=with_process_noise(healthy.estimator, factor), truth=None)  # type: ignore[arg-type]
    told = found(scenario)[0]
    assert told.code == code
    assert np.log(told.evidence["factor_on_Q"] * factor) == pytest.approx(0, abs=np.log(2.5))
    assert "multiply Q by about" in told.remedy


@pytest.mark.parametrize("told_of", [(), ("gain",), ("gain", "z", "noise")])
@pytest.mark.parametrize("r", [1.0, 1 / 9])
def test_a_recording_is_judged_by_what_it_tells(told_of: tuple[str, ...], r: float, tmp_path: Path) -> None:
    """A person's own loop that leaves out readings, noise and gain: no finding is made of what is not there."""
    recorded, path = collect(straight(r), run(straight(r))), tmp_path / "mine.rrd"
    predict, update = recorded.stages["predict"], recorded.stages["update"]
    names = {"gain": "gain", "z": "innovation.z", "noise": "innovation.noise"}
    with viz_estim.record(path, {"x": "m", "v": "m/s"}) as recording:
        for k in range(200):
            recording.stage("moved", mean=predict.mean[k], cov=predict.cov[k])
            told = {name: update.values[names[name]][k + 1] for name in told_of}
            residual, S = (update.values[f"innovation.{name}"][k + 1] for name in ("residual", "cov"))
            recording.stage(
                "read", mean=update.mean[k + 1], cov=update.cov[k + 1], residual=residual, residual_cov=S, **told
            )
            recording.step(time=0.1 * k)
    findings = diagnose(viz_estim.load(path))
    assert [(f.code, f.severity) for f in findings] == ([] if r == 1 else [("overconfident", "error")])
    if r != 1 and "noise" in told_of:
        assert findings[0].evidence["factor_on_R"] == pytest.approx(9, rel=0.35)


def straight(r: float, q: float = 0.02, steps: int = 300) -> Scenario:
    """A point that moves on a line, read with noise 1, by a filter that takes it for r."""
    rng = np.random.default_rng(0)
    F, Q = np.array([[1.0, 0.1], [0.0, 1.0]]), q * np.diag([0.0, 1.0])
    x, readings = np.zeros(2), []
    for _ in range(steps):
        x = F @ x + [0.0, rng.normal(0, 0.02**0.5)]
        readings.append(x[:1] + rng.standard_normal(1))
    sensor = linear_sensor(Euclidean(("z",), "m"), np.eye(1, 2), r * np.eye(1))
    space = Product(position=Euclidean(("x",), "m"), velocity=Euclidean(("v",), "m/s"))
    ticks = [Tick(0.1 * k, 0.1 * (k > 0), measurements={"z": z}) for k, z in enumerate(readings)]
    return Scenario(linear(F, Q, {"z": sensor}), {0: Gaussian(space, np.zeros(2), np.eye(2))}, ticks)


def log_likelihood(recorded: Run) -> float:
    table = recorded.stages["update"].values
    S, v = table["innovation.cov"][:, 0, 0], table["innovation.residual"][:, 0]
    near = v**2 / S < np.inf
    return float(-0.5 * (v[near] ** 2 / S[near] + np.log(S[near])).sum())


def test_tuning_says_what_a_rerun_would() -> None:
    """Of a linear filter, to the digit: the gain in likelihood of its best factor is that of the filter run with it."""
    scenario = straight(4.0)
    recorded = collect(scenario, run(scenario))
    best = tuning.factors(evidence.case(recorded))["z"]
    again = straight(4.0 * best.factor)
    gain = log_likelihood(collect(again, run(again))) - log_likelihood(recorded)
    assert best.gain == pytest.approx(gain, rel=0.02)
    assert best.factor == pytest.approx(0.25, rel=0.25)


def test_particles_that_are_nowhere_near_the_readings_are_told() -> None:
    scenario = beacons.beacons_pf(beacons.beacons(None, np.random.default_rng(100)))
    first, *others = found(reads(lambda z: z / 0.3048)(scenario))
    assert (first.code, first.severity) == ("units_or_axes", "error")
    assert "feet for m" in first.cause
    assert "particles_far" in {finding.code for finding in others}
