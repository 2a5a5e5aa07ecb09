"""Profiles along roads: cubic pieces of OpenDRIVE, and vertices of lines, as few as a tolerance allows."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats

AHEAD_M = 0.05
"""Distance over which the slope of a surface is taken (m)."""


def cubic_pieces(s: Floats, z: Floats, slope: Floats, tolerance: float) -> Floats:
    """Return the cubic pieces of a profile, ``(k, 5)``: s, a, b, c, d as OpenDRIVE has them.

    They have the values and slopes of the profile at the ends of the pieces, so that value and slope go on
    from piece to piece, and profiles that meet with one value and slope meet exactly. Each piece is as long
    as the tolerance allows.

    - `s` ``(n,)``: distances along the road, ascending (m); at least two.
    - `z`, `slope` ``(n,)``: values of the profile there, and their derivatives by s.
    - `tolerance`: largest distance of a piece from the values between its ends.
    """
    ends = _ends(s, z, slope, tolerance)
    a, b = ends[:-1], ends[1:]
    length = s[b] - s[a]
    rise = (z[b] - z[a]) / length
    c = (3 * rise - 2 * slope[a] - slope[b]) / length
    d = (slope[a] + slope[b] - 2 * rise) / length**2
    return np.column_stack([s[a], z[a], slope[a], c, d])


def value_at(pieces: Floats, s: Floats) -> Floats:
    """Return the values of cubic pieces, ``(k, 5)``, at distances s."""
    at = np.maximum(np.searchsorted(pieces[:, 0], s, side="right") - 1, 0)
    start, a, b, c, d = pieces[at].T
    along = s - start
    return np.asarray(a + along * (b + along * (c + along * d)))


def vertices(s: Floats, z: Floats, kept: Bools, tolerance: float) -> NDArray[np.intp]:
    """Return the indices of the points that a line needs so that it stays within a tolerance.

    - `s`, `z` ``(n,)``: distances along the line and heights (m).
    - `kept` ``(n,)``: the points that the line has in any case; the first and last one are.
    - `tolerance`: largest distance of the line from the heights of the points that it does not have (m).
    """
    return _vertices(s, z, kept, tolerance)


@compiled()
def _ends(s: Floats, z: Floats, slope: Floats, tolerance: float) -> NDArray[np.intp]:
    """Return the indices of the ends of the pieces."""
    ends, start, last = [0], 0, len(s) - 1
    while start < last:
        # The piece grows twofold while it fits; the longest one is between the last two tries.
        fits, step = start + 1, 2
        while fits < last:
            end = min(start + step, last)
            if not _cubic_fits(s, z, slope, start, end, tolerance):
                break
            fits, step = end, 2 * step
        beyond = min(start + step, last + 1)
        while beyond - fits > 1:
            middle = (fits + beyond) // 2
            if _cubic_fits(s, z, slope, start, middle, tolerance):
                fits = middle
            else:
                beyond = middle
        ends.append(fits)
        start = fits
    return np.array(ends)


@compiled()
def _cubic_fits(s: Floats, z: Floats, slope: Floats, a: int, b: int, tolerance: float) -> bool:
    length = s[b] - s[a]
    rise = (z[b] - z[a]) / length
    c = (3 * rise - 2 * slope[a] - slope[b]) / length
    d = (slope[a] + slope[b] - 2 * rise) / length**2
    for i in range(a + 1, b):
        along = s[i] - s[a]
        if not math.fabs(z[a] + along * (slope[a] + along * (c + along * d)) - z[i]) <= tolerance:
            return False
    return True


@compiled()
def _vertices(s: Floats, z: Floats, kept: Bools, tolerance: float) -> NDArray[np.intp]:
    chosen, start, last = [0], 0, len(s) - 1
    while start < last:
        end = start + 1
        # Slopes from the start with which the line stays within the tolerance of all points passed.
        low, high = -np.inf, np.inf
        while True:
            away = s[end] - s[start]
            rise = z[end] - z[start]
            if kept[end] or end == last:
                if away > 0 and not low <= rise / away <= high and end - 1 > start:
                    end -= 1
                break
            if away > 0:
                if not low <= rise / away <= high and end - 1 > start:
                    end -= 1
                    break
                low, high = max(low, (rise - tolerance) / away), min(high, (rise + tolerance) / away)
            end += 1
        chosen.append(end)
        start = end
    return np.array(chosen)
