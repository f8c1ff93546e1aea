"""Sensors against the truth: by the filter's own model, wherever the estimate has gone, the right cause is told."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, run
from viz_estim.diagnosis import against, evidence, truth
from viz_estim.diagnosis.finding import Finding
from viz_estim.recording.memory import collect
from viz_estim.scenarios import beacons, diffdrive, flawed_data, landmarks, quadrotor

TURN = quaternions.exp(np.array([0.0, 0.0, np.radians(30.0)]))
C, S = np.cos(0.3), np.sin(0.3)


def case(scenario: Scenario) -> evidence.Case:
    return evidence.case(collect(scenario, run(scenario)))


def ranges() -> Scenario:
    return landmarks.landmarks_ekf(landmarks.landmarks(None, np.random.default_rng(3), duration=15.0))


def gps() -> Scenario:
    return diffdrive.diffdrive_ekf(diffdrive.diffdrive(None, np.random.default_rng(3), duration=20.0))


def pose() -> Scenario:
    return quadrotor.quadrotor_ukf_pose(quadrotor.quadrotor(None, np.random.default_rng(3), duration=2.5))


def read(scenario: Scenario, change: Callable[[Array], Array]) -> Scenario:
    return flawed_data.fed(scenario, lambda k, z: {name: change(v) for name, v in z.items()})


def attitude(change: Callable[[Array], Array]) -> Callable[[Array], Array]:
    return lambda z: np.concatenate([z[:3], change(z[3:])])


WRONG: dict[str, tuple[Callable[[], Scenario], Callable[[Array], Array]]] = {
    "range 1 and range 2 are exchanged": (ranges, lambda z: z[::-1]),
    "a round trip": (ranges, lambda z: 2 * z),
    "a root is missing": (ranges, lambda z: z**2),
    "feet for m": (ranges, lambda z: z / 0.3048),
    "1.1× what the truth would give": (ranges, lambda z: 1.1 * z),
    "readings of range 2 are +4.98 m": (ranges, lambda z: z + np.array([0.0, 5.0])),
    "turned by 17°": (gps, lambda z: np.array([C * z[0] - S * z[1], S * z[0] + C * z[1]])),
    "axes +y +x": (gps, lambda z: z[::-1]),
    "body → world is taken for world → body": (pose, attitude(quaternions.conjugate)),
    "w stands last": (pose, attitude(lambda q: q[[1, 2, 3, 0]])),
    "the world's axes are others": (pose, attitude(lambda q: quaternions.multiply(TURN, q))),
    "it is mounted so on the body": (pose, attitude(lambda q: quaternions.multiply(q, TURN))),
    "axes +x −y −z": (pose, lambda z: np.concatenate([z[:3] * [1, -1, -1], z[3:]])),
}


@pytest.mark.parametrize("words", WRONG)
def test_the_cause_is_told(words: str) -> None:
    make, change = WRONG[words]
    (finding,) = truth.sensors(case(read(make(), change)))
    assert finding.severity == "error"
    assert words in finding.cause


@pytest.mark.parametrize("make", [ranges, gps, pose])
def test_sound_readings_have_no_cause(make: Callable[[], Scenario]) -> None:
    assert list(truth.sensors(case(make()))) == []
    assert all(one.exact for one in against.against(case(make())))


def by_beacons(change: Callable[[Array], Array], seed: int = 0) -> list[Finding]:
    data = beacons.beacons(None, np.random.default_rng(seed), duration=8.0)
    log = replace(data.log, ranges=change(data.log.ranges))
    return list(truth.sensors(case(beacons.beacons_pf(replace(data, log=log), particles=400))))


def test_what_particles_were_weighed_by_is_recovered_from_their_weights() -> None:
    data = beacons.beacons(None, np.random.default_rng(1))
    first, second = against.against(case(beacons.beacons_pf(data, particles=300, range_noise=0.7)))
    for one, place in zip((first, second), beacons.BEACONS, strict=True):
        assert one.places is not None
        np.testing.assert_allclose(one.places[0], place, atol=1e-3)
        np.testing.assert_allclose(one.noise[:, 0, 0], 0.49, rtol=1e-3)


def test_ranges_that_particles_are_weighed_by_are_held_to_the_truth() -> None:
    assert by_beacons(lambda z: z) == []
    (exchanged,) = by_beacons(lambda z: z[:, ::-1])
    assert "would give" in exchanged.cause
    (off,) = by_beacons(lambda z: z + np.array([2.0, 0.0]))
    assert off.evidence["bias"] == pytest.approx(2.0, abs=0.3)
