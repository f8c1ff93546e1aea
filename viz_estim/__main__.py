"""`python -m viz_estim` is `viz-estim`."""

from viz_estim.cli import entry

entry()
