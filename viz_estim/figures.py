"""A run's figures as lines for a person: metrics, NIS by sensor with its band, NEES."""

from __future__ import annotations

from typing import Any

import numpy as np

from viz_estim.core.consistency import band
from viz_estim.core.run import failed_where
from viz_estim.errors import one_line


def lines(result: dict[str, Any]) -> list[str]:
    """Of the result of `run`, or of what `show` tells."""
    found = []
    if result.get("error"):
        error = result["error"]
        found.append(f"FAILED at step {error['step']}, {failed_where(error['stage'])}: {one_line(error['message'])}")
    width = max([24, *map(len, result["metrics"])])
    found += [f"  {name:{width}} {short(value)}" for name, value in result["metrics"].items()]
    for sensor, nis in result["nis"].items():
        inside = nis["low"] <= nis["mean"] <= nis["high"]
        verdict = "inside" if inside else "above: the filter trusts it too much" if nis["mean"] > nis["high"] else (
            "below: the filter trusts it too little")  # fmt: skip
        found.append(
            f"  {f'NIS {sensor}':{width}} {nis['mean']:.3g} (expected {nis['dof']}; 95 % band {nis['low']:.3g} to "
            f"{nis['high']:.3g}: {verdict})"
        )
    if nees := result["nees"]:
        where = f"{nees['inside']:.0%} of the steps inside their 95 % interval"
        if "converged" in result["metrics"]:  # one estimate, where the iterations ended
            low, high = band(nees["dof"])
            verdict = "inside" if nees["inside"] else "above: its covariance is too small" if nees["mean"] > high else (
                "below: its covariance is too large")  # fmt: skip
            where = f"at the end; 95 % interval {low:.3g} to {high:.3g}: {verdict}"
        found.append(f"  {'NEES':{width}} {nees['mean']:.3g} (expected {nees['dof']}; {where})")
    return found


def short(value: Any) -> str:
    """A number with five digits; yes, no or none, as `--set` takes them."""
    if value is None or isinstance(value, bool):
        return "none" if value is None else "yes" if value else "no"
    return f"{value:.5g}" if isinstance(value, (float, np.floating)) else str(value)
