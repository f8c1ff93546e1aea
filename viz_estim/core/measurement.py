"""What sensors say of a state: how each reads it, and several of them taken in as one vector."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from viz_estim.core.distributions import chi2
from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Product, Space


@dataclass(frozen=True)
class Sensor:
    """How a sensor reads a state: its measurement's space, z = measure(x) ⊞ v with v ~ N(0, noise).

    measure takes states (*, n), and jacobian gives its H (*, m, d) there, for a filter that linearises. gate: the
    probability with which a good reading passes (None: all pass). blind(mean): the unit direction (d,) of the state
    that the sensor cannot see, if there is one.
    """

    space: Space
    measure: Callable[[Array], Array]
    noise: Array
    gate: float | None = None
    blind: Callable[[Array], Array] | None = None
    jacobian: Callable[[Array], Array] | None = None


class Measurement:
    """Sensors read at one moment and taken in as one vector; each keeps its name, gate and block of S."""

    def __init__(self, sensors: dict[str, Sensor]) -> None:
        self.sensors = sensors
        self.space = Product(**{name: sensor.space for name, sensor in sensors.items()})
        self.noise = np.zeros((len(self.space.axes),) * 2)
        for name, sensor in sensors.items():
            self.noise[self.block(name)] = sensor.noise
        self.part = np.repeat(np.arange(len(sensors)), [len(s.space.axes) for s in sensors.values()])
        self.gates = {k: chi2.ppf(s.gate, len(s.space.axes)) for k, s in sensors.items() if s.gate is not None}

    def block(self, name: str) -> tuple[slice, slice]:
        """The sensor's block of a matrix over the measurement's directions."""
        return self.space.axes_at[name], self.space.axes_at[name]

    def measure(self, x: Array) -> Array:
        """The expected reading of all sensors, (*, n)."""
        return np.concatenate([sensor.measure(x) for sensor in self.sensors.values()], axis=-1)

    def jacobian(self, x: Array) -> Array:
        """H (*, m, d) of all sensors, one below the other; ValueError where a sensor has none."""
        for name, sensor in self.sensors.items():
            if sensor.jacobian is None:
                raise ValueError(f"sensor {name} has no jacobian, which a filter that linearises needs")
        rows = [sensor.jacobian(x) for sensor in self.sensors.values() if sensor.jacobian]
        return rows[0] if len(rows) == 1 else np.concatenate(rows, axis=-2)

    def passes(self, residual: Array, cov: Array) -> np.ndarray:
        """Which sensors' residuals pass their gates, (*, s): νᵀS⁻¹ν ≤ χ²(gate), each by its own block of S."""
        used = np.ones((*residual.shape[:-1], len(self.sensors)), bool)
        for i, name in enumerate(self.sensors):
            if name in self.gates:
                part, (rows, cols) = residual[..., self.space.axes_at[name]], self.block(name)
                whitened = np.linalg.solve(cov[..., rows, cols], part[..., None])[..., 0]
                used[..., i] = (part * whitened).sum(-1) <= self.gates[name]
        return used

    def blind(self, mean: Array, d: int) -> Array:
        """Each sensor's blind direction (*, d, s), zero where it has none."""
        directions = np.zeros((*mean.shape[:-1], d, len(self.sensors)))
        for i, sensor in enumerate(self.sensors.values()):
            if sensor.blind is not None:
                directions[..., i] = sensor.blind(mean)
        return directions


def gain(C: Array, S: Array, used: np.ndarray) -> Array:
    """C·S⁻¹ over the directions in use (*, m); zero columns for the others."""
    if not used.all():
        C = C * used[..., None, :]
        S = np.where(used[..., None, :] & used[..., :, None], S, np.eye(S.shape[-1]))
    solved = np.linalg.solve(S, transposed(C)).astype(float, copy=False)
    return transposed(solved)


def split(K: Array, residual: Array, std: Array) -> tuple[Array, Array]:
    """Δ = K·ν by component of the reading: K[:, j]·ν_j (*, d, m), and the same in σ of the state before, std (*, d)."""
    moved = K * residual[..., None, :]
    return moved, moved / np.maximum(std, np.sqrt(np.finfo(float).tiny))[..., None]


def transposed(a: Array) -> Array:
    """The matrices (*, n, m) of a (*, m, n)."""
    return a.mT


def symmetrised(a: Array) -> Array:
    """½(A + Aᵀ): what rounding left of symmetry, put right once."""
    return 0.5 * (a + transposed(a))
