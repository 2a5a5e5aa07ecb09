"""Mean and spread of arrays, NaN for empty ones, and the least-squares plane through points."""

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


def least_squares_plane(easting: Floats, northing: Floats, height: Floats) -> tuple[float, float, float]:
    """Return (c, a, b) of ``z = c + a * easting + b * northing`` with the least squared vertical error.

    Points that do not span a plane (one point, points on a line) give the plane through them that is level in
    the undetermined direction. Coordinates should be local, so that c keeps its digits.
    """
    e, n, z = easting.mean(), northing.mean(), height.mean()
    (a, b), *_ = np.linalg.lstsq(np.column_stack([easting - e, northing - n]), height - z, rcond=1e-9)
    return float(z - a * e - b * n), float(a), float(b)
