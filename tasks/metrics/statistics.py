"""Mean and spread of arrays, NaN for empty ones."""

from __future__ import annotations

import numpy as np

from flexroad.tasks.types import Bools, Floats

GAUSSIAN = 1.4826
"""Standard deviation of a Gaussian divided by its median absolute deviation."""


def mean(values: Floats | Bools) -> float:
    """Return the mean; NaN if there are no values."""
    return float(values.mean()) if values.size else float("nan")


def nmad(values: Floats) -> float:
    """Return the normalised median absolute deviation from the median; NaN if there are no values."""
    return float(GAUSSIAN * np.median(np.abs(values - np.median(values)))) if values.size else float("nan")
