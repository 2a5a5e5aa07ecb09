"""Colour scales of errors and angles, shared by all figures."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm

from flexroad.tasks.types import Floats

ERROR_COLOURS, ERROR_NORM = "magma_r", LogNorm(0.01, 10)
"""Scale of errors (m); logarithmic, because errors on one tile range from a centimetre to several metres."""
ANGLE_COLOURS, ANGLE_NORM = "viridis_r", LogNorm(0.1, 60)
"""Scale of angles (degrees), logarithmic."""
LEAST = 1e-9
"""Replaces zeros, which have no logarithm."""


def drawable(values: Floats) -> np.ma.MaskedArray[tuple[int, ...], np.dtype[np.float64]]:
    """Return values with NaN masked and values below `LEAST` raised to `LEAST`."""
    return np.ma.masked_invalid(np.maximum(values, LEAST))
