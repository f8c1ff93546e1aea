"""Least squares that a few wild residuals don't pull, and how sure it is where residuals hang together in time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

from viz_estim.core.quaternions import Array

BLOCK = 1.0  # s: residuals in different blocks are taken as independent


def solve(
    residual: Callable[[Array], Array], jacobian: Callable[[Array], Array], start: Array, blocks: np.ndarray
) -> tuple[Array, Array]:
    """The minimum of a soft-L1 loss, its scale from the median residual, and standard errors.

    The errors are the sandwich H⁻¹ (Σ_b g_b g_bᵀ) H⁻¹, g_b the loss's gradient over block b: residuals within a block
    may hang together as they like (Liang & Zeger 1986). blocks (M,): a whole number for each residual.
    """
    x, scale = start, 1.0
    for _ in range(3):  # the scale follows the residuals
        scale = max(1.5 * typical(residual(x)), 1e-9)
        x = scipy.optimize.least_squares(residual, x, jacobian, loss="soft_l1", f_scale=scale, x_scale="jac").x
    r, J = residual(x), jacobian(x)
    z = 1.0 + (r / scale) ** 2
    H = J.T @ (J * z[:, None] ** -1.5)  # soft-L1 has ρ' = z^(-1/2) and ρ' + 2ρ''r²/scale² = z^(-3/2)
    gradients = np.zeros((blocks.max() + 1, len(x)))
    np.add.at(gradients, blocks, J * (r * z**-0.5)[:, None])
    half = np.linalg.lstsq(H, gradients.T)[0]
    count = len(np.unique(blocks))
    return x, np.sqrt((half**2).sum(1) * count / (count - 1))


def by_second(stamps: list[Array]) -> np.ndarray:
    """Numbers (M,) of the blocks of 1 s that the sets' stamps fall in; no two sets share one."""
    sizes = [int(t[-1] / BLOCK) + 1 for t in stamps]
    firsts = np.cumsum([0, *sizes[:-1]])
    return np.concatenate([first + (t / BLOCK).astype(int) for first, t in zip(firsts, stamps, strict=True)])


def typical(residual: Array) -> float:
    """The size of a residual as its median has it: σ of a normal one, whatever its tails are."""
    return float(1.4826 * np.median(np.abs(residual)))
