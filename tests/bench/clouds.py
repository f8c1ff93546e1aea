"""The particle filter and ICP against plain numpy and FilterPy: `python tests/bench/clouds.py` prints a table.

Needs `pip install -e .[bench]`. Beside `particles` too, where that is installed: its 0.4 asks for numpy below 2 and
runs with 2 (`pip install numba joblib scikit-learn && pip install --no-deps particles==0.4`).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from filterpy.monte_carlo import systematic_resample
from filters import Rows, built, recorded
from scipy.spatial import cKDTree
from speed import in_turn

from viz_estim.core.quaternions import Array
from viz_estim.core.run import Scenario, run
from viz_estim.scenarios.scan import scan, scan_icp

try:
    import particles
except ImportError:
    particles = None


def particle_filter(count: int, folder: Path) -> Rows:
    """beacons-pf's model in a plain loop with searchsorted, and with FilterPy's resampling."""
    scenario = built("beacons-pf", f"particles={count}", f"data.duration={300 if count < 10_000 else 12}")
    pf: Any = scenario.estimator
    start, ticks = scenario.beliefs[0], scenario.ticks

    def loop(resample: Any) -> None:
        x, rng = start.states, np.random.default_rng(0)
        for tick in ticks:
            if tick.dt > 0:
                x = pf.propagate(x, tick, rng)
            if tick.measurements:
                log_w = pf.log_likelihood(x, tick)
                w = np.exp(log_w - log_w.max())
                w /= w.sum()
                x = x[resample(w, rng)]

    def by_searchsorted(w: Array, rng: np.random.Generator) -> np.ndarray:
        return np.searchsorted(np.cumsum(w), (np.arange(count) + rng.random()) / count).clip(max=count - 1)

    def ours() -> None:
        for _ in run(scenario):
            pass

    plain, mine, kept, filterpys, theirs = in_turn(
        lambda: loop(by_searchsorted), ours, lambda: recorded(scenario, folder),
        lambda: loop(lambda w, rng: systematic_resample(w)), by_particles(scenario, count),
    )  # fmt: skip
    bound = 1.6 if count < 10_000 else 1.15
    each = 1e6 * mine / len(ticks)
    return [
        (f"PF, N = {count}, / a numpy loop", f"{mine / plain:.2f} (≤ 1.15)", f"{each:.0f} µs a step"),
        (f"PF, N = {count}, / FilterPy's resampling", f"{mine / filterpys:.2f} (< 1)", ""),
        (f"PF, N = {count}, / particles", f"{mine / theirs:.2f} (< 1)" if particles else "not installed", ""),
        (
            f"PF, N = {count}, recorded / itself",
            f"{kept / mine:.2f} (≤ {bound})",
            f"{1e6 * kept / len(ticks):.0f} µs a step",
        ),
    ]


def by_particles(scenario: Scenario, count: int) -> Callable[[], object]:
    """The same filter by `particles` (Chopin and Papaspiliopoulos 2020), resampled at every step."""
    if particles is None:
        return lambda: None
    pf: Any = scenario.estimator
    ticks, rng = scenario.ticks, np.random.default_rng(0)

    class Bootstrap(particles.FeynmanKac):  # type: ignore[name-defined,misc]
        def M0(self, N: int) -> Array:
            return scenario.beliefs[0].states

        def M(self, t: int, xp: Array) -> Array:
            return pf.propagate(xp, ticks[t], rng)

        def logG(self, t: int, xp: Array, x: Array) -> Array:
            return pf.log_likelihood(x, ticks[t])

    return lambda: particles.SMC(fk=Bootstrap(len(ticks)), N=count, resampling="systematic", ESSrmin=1.0).run()


def icp(folder: Path) -> Rows:
    data = scan(None, np.random.default_rng(1), points=10_000)
    scenario = scan_icp(data, iterations=30)
    X, Y = data.X, data.Y

    def bare() -> list[Any]:
        tree, R, t, kept = cKDTree(Y), np.eye(X.shape[1]), np.zeros(X.shape[1]), []
        for _ in range(30):
            moved = X @ R.T + t
            distance, nearest = tree.query(moved, distance_upper_bound=0.25)
            at = np.isfinite(distance)
            a, b = X[at], Y[nearest[at]]
            U, _, Vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
            D = np.eye(X.shape[1])
            D[-1, -1] = np.sign(np.linalg.det(U @ Vt))
            R = U @ D @ Vt
            t = b.mean(0) - R @ a.mean(0)
            kept.append((moved[at], b, distance[at]))
        return kept

    def ours() -> None:
        for _ in run(scenario):
            pass

    plain, mine, kept = in_turn(bare, ours, lambda: recorded(scenario, folder))
    return [
        ("ICP, 10 000 points, / bare scipy", f"{mine / plain:.2f} (≤ 1.1)", f"{1e3 * mine:.0f} ms"),
        ("ICP recorded / bare scipy", f"{kept / plain:.2f} (≤ 1.2)", f"{1e3 * kept:.0f} ms"),
    ]


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for what, figure, detail in [*particle_filter(1200, folder), *particle_filter(100_000, folder), *icp(folder)]:
            print(f"  {what:45} {figure:18} {detail}")


if __name__ == "__main__":
    main()
