"""Attitudes kept as Euler angles: every order against SciPy's, and what other tools are told of them."""

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import viz_estim
from viz_estim.core import quaternions
from viz_estim.core.euler import EulerAngles
from viz_estim.core.spaces import Product
from viz_estim.export import export


@pytest.mark.parametrize("order", ["".join(one) for one in permutations("xyz")])
def test_angles_stand_for_the_rotation_of_their_order(order: str) -> None:
    angles = np.random.default_rng(1).uniform(-3, 3, (2, 5, 3))
    rows = angles.reshape(-1, 3)[:, ["xyz".index(letter) for letter in order]]
    want = Rotation.from_euler(order.upper(), rows).as_matrix()
    found = quaternions.to_matrix(EulerAngles(order).to_quaternion(angles))
    np.testing.assert_allclose(found.reshape(-1, 3, 3), want, atol=1e-12)


def test_an_order_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="such as 'zxy', got 'zxz'"):
        EulerAngles("zxz")


def test_a_trajectory_of_angles_is_written_as_their_rotation(tmp_path: Path) -> None:
    angles = np.random.default_rng(2).uniform(-1, 1, (4, 3))
    with viz_estim.record(tmp_path / "a.rrd", space=Product(attitude=EulerAngles("zxy"))) as rec:
        for k, one in enumerate(angles):
            rec.stage("predict", mean=one, cov=np.eye(3))
            rec.step(time=k)
    export(viz_estim.load(tmp_path / "a.rrd"), "tum", tmp_path / "a.tum")
    written = Rotation.from_quat(np.loadtxt(tmp_path / "a.tum")[:, 4:])
    want = Rotation.from_euler("ZXY", angles[:, [2, 0, 1]])
    np.testing.assert_allclose((written.inv() * want).magnitude(), 0, atol=1e-8)
