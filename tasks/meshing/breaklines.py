"""The edges of kerbs and walls as lines of a mesh: two lines side by side, one on each height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import shapely
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.meshing.survey_limit import SurveyLimit, survey_limit
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.types import Bools, Floats

LEAST_M = 0.08
"""Smaller steps have no line (m): they are within the noise of a surface model."""
CELLS = 10
"""Connected steps of fewer cells have no line: they are noise, or single objects."""
APART = 0.2
"""Distance of the two lines of an edge (cells)."""


@dataclass(frozen=True, eq=False)
class Breaklines:
    """The edges of steps on a tile."""

    surface: SteppedSurface
    lines: shapely.MultiLineString
    level: SurveyLimit
    """The ground without steps."""
    nearest: NDArray[np.float32]
    """The step of the nearest cell that has one, ``(H, W)``, m."""

    def height(self, points: Floats) -> Floats:
        """Return the heights (m) of points, ``(n, 2)``, by the side of the lines on which they lie."""
        place = (points + self.surface.cells.origin).T
        step = self.nearest[self.surface.cells.cells(*place)]
        return np.asarray(self.surface.smooth(*place) + np.where(self.level.covers(points), 0.0, step))


def breaklines(surface: SteppedSurface, local: Bounds) -> Breaklines:
    """Return the edges of the steps of a surface.

    - `local`: west, south, east and north of the tile, from the origin of its cells (m).
    """
    cells = surface.cells
    # The median leaves straight edges where they are. Noise of single cells would break lines into pieces.
    large = np.abs(scipy.ndimage.median_filter(surface.steps, 3)) >= LEAST_M
    # Lines end before the border of the tile: those of the neighbour need not meet them there.
    large[[0, -1]], large[:, [0, -1]] = False, False
    high = _large(large)
    corner = cells.west - cells.origin[0], cells.north - cells.origin[1]
    level = survey_limit(high, corner, cells.cell, local)
    parts = shapely.get_parts(level.lines)
    sides = [shapely.offset_curve(parts, side * APART / 2 * cells.cell) for side in (-1, 1)]
    lines = shapely.get_parts(np.concatenate(sides)) if len(parts) else parts
    nearest = surface.steps
    if high.any():
        at = scipy.ndimage.distance_transform_edt(~high, return_distances=False, return_indices=True)
        nearest = surface.steps[tuple(at)]
    return Breaklines(surface, shapely.multilinestrings(lines), level, nearest)


def _large(cells: Bools) -> Bools:
    """Return the cells of large connected parts, ``(H, W)``."""
    parts, _ = scipy.ndimage.label(cells)
    size = np.bincount(parts.ravel())
    size[0] = 0
    return np.asarray(size[parts] >= CELLS)
