"""Modes: none reaches past another, and a cloud in one place stays one."""

import numpy as np
import pytest

from viz_estim.core.modes import modes, several
from viz_estim.core.spaces import Euclidean

PLANE = Euclidean(("x", "y"), "m")


def cloud(rng: np.random.Generator, *parts: tuple[tuple[float, float], tuple[float, float], int]) -> np.ndarray:
    return np.concatenate([rng.normal(centre, std, (count, 2)) for centre, std, count in parts])


@pytest.mark.parametrize("seed", range(3))
def test_few_particles_beside_a_mode_are_not_joined_to_one_far_off(seed: int) -> None:
    near, far, beside = ((9.2, 2.2), (0.2, 0.35), 660), ((9.4, 7.8), (0.4, 0.6), 470), ((10.4, 2.1), (0.15, 0.35), 60)
    between = ((10.3, 4.8), (0.15, 1.5), 80)  # they bridge the way to the far one
    states = cloud(np.random.default_rng(seed), near, far, beside, between)
    found = several(PLANE, states, np.full(len(states), -np.log(len(states))))
    assert [mode.weight for mode in found[:2]] == pytest.approx([0.52, 0.37], abs=0.05)
    for mode in found:
        assert np.sqrt(np.linalg.eigvalsh(mode.cov)[-1]) < 1.3


@pytest.mark.parametrize("std", [(0.5, 0.5), (0.1, 3.0)])
def test_a_cloud_in_one_place_is_one_mode(std: tuple[float, float]) -> None:
    states = cloud(np.random.default_rng(0), ((1.0, -2.0), std, 1200))
    weights = np.full(1200, -np.log(1200))
    assert several(PLANE, states, weights) == ()
    assert len(modes(PLANE, states, weights)) == 1
