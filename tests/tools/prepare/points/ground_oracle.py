"""Reference implementation of the ground filter: compares all pairs of points."""

import numpy as np

OUTNUMBERED = 20


def ground(easting, northing, height, options):
    """Return which points are ground, ``(n,)``; for small clouds."""
    out = np.zeros(height.size, bool)
    valid = np.flatnonzero(np.isfinite(easting + northing + height))
    if options.low_m is not None:
        low = low_outliers(easting[valid], northing[valid], height[valid], options)
        valid = valid[~low]
    tolerance = options.confidence * np.sqrt(2) * options.noise_m
    for p in valid:
        for q in valid:
            d = np.sqrt((easting[p] - easting[q]) ** 2 + (northing[p] - northing[q]) ** 2)
            if d <= options.radius_m and height[p] - height[q] > options.slope * d + tolerance:
                break
        else:
            out[p] = True
    return out


def low_outliers(easting, northing, height, options):
    """Return which points are low outliers, ``(n,)``."""
    out = np.zeros(height.size, bool)
    for p in range(height.size):
        near = np.sqrt((easting - easting[p]) ** 2 + (northing - northing[p]) ** 2) <= options.low_radius_m
        as_low = np.count_nonzero(near & (height - height[p] <= options.low_m))
        above = np.count_nonzero(near) - as_low
        out[p] = as_low <= options.low_companions + 1 and above >= OUTNUMBERED * as_low
    return out
