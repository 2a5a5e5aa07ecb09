"""The colours of vertical errors, the same in maps and renders."""

from __future__ import annotations

from matplotlib.colors import LogNorm

ERROR_COLOURS = "magma_r"
ERROR_NORM = LogNorm(0.01, 10)
"""Metres; logarithmic, as on one tile errors go from a centimetre to a house."""
