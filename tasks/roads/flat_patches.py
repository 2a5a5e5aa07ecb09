"""Flat patches of a road: squares of cells that fit a plane. Cars, crowns and facades do not fit a plane."""

from __future__ import annotations

import math

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats

PATCH_M = 3.0
"""Side of a patch (m); at least three cells."""
STREET_M = 5.0
"""Half side of the square around a patch over which the street's slope is averaged (m)."""
CLIMB = 0.15
"""Steepest road off the ground (m per m): ramps are built with up to 15%, and heaps lie at 50% and more."""


Patches = tuple[Bools, Floats, int, Bools]
"""Centres of flat patches, ``(H, W)``; the slope of the street along rows and columns there, ``(H, W, 2)``, m
per cell, 0 elsewhere; the number of cells from a centre to the edge of its patch; and the centres of patches
that were left out because they climb an object, ``(H, W)``."""


def flat_cells(heights: Floats, points: Bools, cell: float, roughness_m: float, bend: float) -> Bools:
    """Return the cells in flat patches, ``(H, W)``; the parameters are as in `flat_patches`."""
    centres, _, reach, _ = flat_patches(heights, points, cell, roughness_m, bend)
    return np.asarray(scipy.ndimage.binary_dilation(centres, np.ones((2 * reach + 1,) * 2)))


def flat_patches(
    heights: Floats,
    points: Bools,
    cell: float,
    roughness_m: float,
    bend: float,
    ground: Floats | None = None,
    off_m: float = 0.0,
) -> Patches:
    """Find the flat patches.

    A patch is flat under two conditions. The residuals to its least-squares plane have a root mean square
    (over the degrees of freedom) of at most ``roughness_m``. Its slope differs from the street's by at most
    ``bend``; the street's slope is the mean over the patches nearby. The second condition excludes patches
    across a step: a plane tilted up to the roof of a car has small residuals.

    - `heights`: surface model (m).
    - `points`: cells that may belong to a patch; a patch has no other cells.
    - `cell`: size of a cell (m).
    - `roughness_m`: largest root mean square of a patch's residuals (m).
    - `bend`: largest difference of slope (m per m).
    - `ground`: terrain model (m), NaN where unknown. A patch with a cell more than ``off_m`` above or below
      the terrain climbs an object if its slope, both in itself and relative to the terrain, exceeds `CLIMB`.
      It is left out.
    - `off_m`: height difference to the ground (m).
    """
    reach = max(1, math.floor((PATCH_M / cell - 1) / 2 + 1e-9))
    slopes, smooth = _planes(heights, points, reach, roughness_m**2)
    climbs = np.zeros_like(smooth)
    if ground is not None:
        climbs = _climbs(slopes, smooth, heights, ground, reach, off_m, (CLIMB * cell) ** 2)
        smooth &= ~climbs
        slopes[climbs] = 0.0
    around = max(1, math.floor(STREET_M / cell + 1e-9))
    centres = _along_street(slopes, smooth, around, (bend * cell) ** 2)
    return centres, slopes, reach, climbs


@compiled()
def _planes(heights: Floats, points: Bools, reach: int, largest: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the slopes of smooth patches along rows and columns (m per cell), and their centres.

    Slopes are ``(H, W, 2)``, 0 elsewhere.
    """
    rows, cols = heights.shape
    slopes, smooth = np.zeros((rows, cols, 2)), np.zeros((rows, cols), np.bool_)
    side = 2 * reach + 1
    n, spread = side * side, side * (reach * (reach + 1) * side / 3)
    for r in range(reach, rows - reach):
        for c in range(reach, cols - reach):
            if not points[r, c]:
                continue
            whole, z, zz, rz, cz = True, 0.0, 0.0, 0.0, 0.0
            for i in range(-reach, reach + 1):
                for j in range(-reach, reach + 1):
                    whole = whole and points[r + i, c + j]
                    up = heights[r + i, c + j] - heights[r, c]
                    z, zz, rz, cz = z + up, zz + up * up, rz + i * up, cz + j * up
                if not whole:
                    break
            if whole:
                square = zz - z * z / n - (rz * rz + cz * cz) / spread
                smooth[r, c] = square <= largest * (n - 3)
                if smooth[r, c]:
                    slopes[r, c, 0], slopes[r, c, 1] = rz / spread, cz / spread
    return slopes, smooth


@compiled()
def _climbs(
    slopes: Floats, smooth: Bools, heights: Floats, ground: Floats, reach: int, off: float, largest: float
) -> Bools:
    """Return the smooth patches off the ground that are steep, in themselves and relative to the ground.

    A flat deck is steep relative to the bank below it, and a street in a hill is steep in itself.
    """
    rows, cols = smooth.shape
    spread = (2 * reach + 1) ** 2 * (reach * (reach + 1) / 3)
    climbs = np.zeros((rows, cols), np.bool_)
    for r in range(rows):
        for c in range(cols):
            down, across = slopes[r, c, 0], slopes[r, c, 1]
            if not smooth[r, c] or down * down + across * across <= largest:
                continue
            away = False
            for i in range(-reach, reach + 1):
                for j in range(-reach, reach + 1):
                    under = ground[r + i, c + j]
                    away = away or abs(heights[r + i, c + j] - under) > off
                    down, across = down - i * under / spread, across - j * under / spread
            # The comparison is False where the ground is unknown.
            climbs[r, c] = away and down * down + across * across > largest
    return climbs


@compiled()
def _along_street(slopes: Floats, smooth: Bools, around: int, largest: float) -> Bools:
    """Return the smooth patches with the street's slope, ``(H, W)``; replace their slope by the street's.

    The street's slope is the mean of the smooth patches ``around`` a patch. The square of the difference to
    it is at most ``largest``.
    """
    rows, cols = smooth.shape
    side, centres = 2 * around + 1, smooth.copy()
    # Sums of 1 and of both slopes over columns, for the rows around the current row.
    beside = np.zeros((side, cols, 3))
    for last in range(rows + around):
        sums = beside[last % side]
        sums[:] = 0.0
        for c in range(cols if last < rows else 0):
            if smooth[last, c]:
                for j in range(max(c - around, 0), min(c + around + 1, cols)):
                    sums[j, 0] += 1
                    sums[j, 1] += slopes[last, c, 0]
                    sums[j, 2] += slopes[last, c, 1]
        r = last - around
        for c in range(cols if r >= 0 else 0):
            if smooth[r, c]:
                n, down, across = 0.0, 0.0, 0.0
                for i in range(max(r - around, 0), min(last + 1, rows)):
                    of_row = beside[i % side, c]
                    n, down, across = n + of_row[0], down + of_row[1], across + of_row[2]
                down, across = down / n, across / n
                bend = (slopes[r, c, 0] - down) ** 2 + (slopes[r, c, 1] - across) ** 2
                slopes[r, c, 0], slopes[r, c, 1] = down, across
                centres[r, c] = bend <= largest
    return centres
