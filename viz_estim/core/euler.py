"""An attitude kept as three angles; what is said of it is said of the rotation that they stand for."""

from __future__ import annotations

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import SO2, Product

_AXES = "xyz"


class EulerAngles(Product):
    """Roll, pitch and yaw (rad), the turns about the body's x, y and z, which give body → world in `order`: the letters
    of R's factors from the left, so that "zxy" is Rz(yaw)·Rx(roll)·Ry(pitch). Errors are the angles', one by one."""

    def __init__(self, order: str) -> None:
        if sorted(order) != list(_AXES):
            raise ValueError(f"expected an order of the axes x, y and z such as 'zxy', got {order!r}")
        super().__init__(roll=SO2(), pitch=SO2(), yaw=SO2())
        self.order = order

    def to_quaternion(self, angles: Array) -> Array:
        """Quaternions body → world (*, 4) of roll, pitch, yaw (*, 3)."""
        turns = np.eye(3) * angles[..., None, :]  # the three single turns, as rotation vectors
        a, b, c = (quaternions.exp(turns[..., _AXES.index(letter)]) for letter in self.order)
        return quaternions.multiply(quaternions.multiply(a, b), c)
