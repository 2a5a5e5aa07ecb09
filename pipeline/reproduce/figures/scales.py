"""The colours of errors and angles, the same wherever they are drawn."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm

from flexroad.tasks.types import Floats

ERROR_COLOURS, ERROR_NORM = "magma_r", LogNorm(0.01, 10)
"""Metres; logarithmic, as on one tile errors go from a centimetre to a house."""
ANGLE_COLOURS, ANGLE_NORM = "viridis_r", LogNorm(0.1, 60)
"""Degrees; logarithmic for the same reason."""
LEAST = 1e-9


def drawable(values: Floats) -> np.ma.MaskedArray[tuple[int, ...], np.dtype[np.float64]]:
    """Return values with NaN masked, and with the zeros, which have no logarithm, just above zero."""
    return np.ma.masked_invalid(np.maximum(values, LEAST))
