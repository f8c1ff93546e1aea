"""What the single numbers of stages are called in a plot."""

from __future__ import annotations

# What the single numbers of our own stages mean, those first that say most.
_OF_CLOUDS = {
    "evidence": "log-evidence of the reading",
    "ess": "effective sample size before resampling",
    "distinct": "distinct ancestors",
}
_OF_FITS = {"rmse": "RMSE [m]", "count": "matches", "converged": "settled (0 or 1)"}
COUNTED = ("ess", "distinct")  # of all particles


def figure_names(fields: list[str], *, fit: bool, particles: int | None) -> dict[str, str]:
    """By field, what a stage's single numbers mean; a person's own are called as they call them. fit: the run is a
    registration; particles: how many there are, None where there are none, 0 where that differs."""
    known = _OF_FITS if fit else {} if particles is None else _OF_CLOUDS
    fields = sorted(fields, key=lambda field: list(known).index(field) if field in known else len(known))
    return {f: known.get(f, f) + (f", of {particles}" if particles and f in COUNTED else "") for f in fields}


def figures_once(stages: dict[str, list[str]]) -> dict[str, list[str]]:
    """By stage the single numbers to show: of a resampling not the effective sample size that it found, where the
    weighing before it has told the same."""
    weighed = any("ess" in fields and "distinct" not in fields for fields in stages.values())
    return {
        stage: [f for f in fields if not (weighed and f == "ess" and "distinct" in fields)]
        for stage, fields in stages.items()
    }
