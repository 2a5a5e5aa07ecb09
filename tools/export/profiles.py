"""Profiles along roads: elevation and superelevation as cubic pieces of OpenDRIVE, within a tolerance.

Each cross-section of a road becomes a straight line: its height on the reference line, and its slope. Along
the road both become cubic pieces, which go on from piece to piece with one value and one slope. What a road
has beside that (crown, ruts, kerbs, bumps) is missed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats


@dataclass(frozen=True, eq=False)
class Profiles:
    """Cubic pieces over the length of a road, ``(k, 5)``: s, a, b, c, d as OpenDRIVE has them."""

    elevation: Floats
    """Height on the line (m)."""
    superelevation: Floats
    """Slope across the road (radians), positive where the left side is higher."""

    def at(self, s: Floats, t: Floats) -> Floats:
        """Return heights at distances along the road and from its reference line."""
        return value_at(self.elevation, s) + t * np.tan(value_at(self.superelevation, s))


def straight_lines(
    t: Floats, z: Floats, inside: Bools, through: Floats | None = None
) -> tuple[Floats, Floats]:
    """Return height at t = 0 and slope of the straight line that fits each cross-section best, ``(n,)`` each.

    NaN where a cross-section has too few points.

    - `t` ``(m,)``: distances from the reference line (m).
    - `z` ``(n, m)``: heights (m).
    - `inside` ``(n, m)``: the points that count; their heights are known.
    - `through` ``(n,)``: heights at t = 0 that the lines have; None: those of the best lines.
    """
    known = np.where(inside, z, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        if through is None:
            number = inside.sum(axis=1)
            middle, height = (inside * t).sum(axis=1) / number, known.sum(axis=1) / number
        else:
            middle, height = np.zeros(len(z)), through
        away = np.where(inside, t - middle[:, None], 0.0)
        rise = np.where(away != 0, known - height[:, None], 0.0)
        slope = (away * rise).sum(axis=1) / (away**2).sum(axis=1)
    return height - slope * middle, slope


def cubic_pieces(s: Floats, z: Floats, slope: Floats, tolerance: float) -> Floats:
    """Return the cubic pieces of a profile, ``(k, 5)``: s, a, b, c, d as OpenDRIVE has them.

    They have the values and slopes of the profile at the ends of the pieces, so that profiles that meet with
    one value and slope meet exactly. Each piece is as long as the tolerance allows.

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
    start, a, b, c, d = np.moveaxis(pieces[at], -1, 0)
    along = s - start
    return np.asarray(a + along * (b + along * (c + along * d)))


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
