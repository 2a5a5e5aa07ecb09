"""Mean and spread of what may be empty: NaN then."""

from __future__ import annotations

import numpy as np

from flexroad.tasks.types import Bools, Floats

GAUSSIAN = 1.4826
"""Standard deviations of a Gaussian in its median absolute deviation."""


def mean(values: Floats | Bools) -> float:
    """Return the mean."""
    return float(values.mean()) if values.size else float("nan")


def nmad(values: Floats) -> float:
    """Return the standard deviation as the median absolute deviation from the median tells it."""
    return float(GAUSSIAN * np.median(np.abs(values - np.median(values)))) if values.size else float("nan")
