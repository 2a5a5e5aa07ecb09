"""Data types of the acquisition: points in metres, and the rasters made from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Bools, Floats, Orthophoto


@dataclass(frozen=True, eq=False)
class Points:
    """A point cloud in the metric CRS of the rasters."""

    easting: Floats
    """``(n,)``, m."""
    northing: Floats
    """``(n,)``, m."""
    height: Floats
    """``(n,)``, m."""
    kind: NDArray[np.uint8]
    """Class by ASPRS, ``(n,)``: 2 is ground, 17 a bridge deck, 0 and 1 are unclassified."""
    colour: NDArray[np.uint8] | None = None
    """Red, green, blue, ``(n, 3)``, or None if the source has no colours."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.height)

    def __getitem__(self, key: slice | Bools | NDArray[np.intp]) -> Points:
        """Return a subset of the points, by a slice, a mask or indices."""
        colour = None if self.colour is None else self.colour[key]
        return Points(self.easting[key], self.northing[key], self.height[key], self.kind[key], colour)


@dataclass(frozen=True, eq=False)
class TopLayer:
    """The points of each cell that are close below its highest one."""

    height: Floats
    """Their mean height, ``(H, W)``, m; NaN where there are none."""
    count: Floats
    """Their number, ``(H, W)``."""
    spread: Floats
    """Standard deviation of their heights, ``(H, W)``, m; 0 for one point, NaN where there are none."""


@dataclass(frozen=True, eq=False)
class CellHeights:
    """What the points of each cell give, without the cells around it."""

    highest: Floats
    """Highest point, ``(H, W)``, m; NaN where there is none."""
    top: TopLayer
    """The points close below the highest one."""
    ground: Floats
    """Mean easting from the grid's west, northing from its north, and height of the ground points,
    ``(3, H, W)``, m; NaN where there are none."""
    bridges: Floats
    """Mean height of bridge decks, ``(H, W)``, m; NaN where there are none."""


@dataclass(frozen=True, eq=False)
class Rasters:
    """The rasters of an area."""

    grid: Grid
    """The cells of the heights."""
    dsm: Floats
    """Highest point per cell, ``(H, W)``, m; NaN where there is none."""
    dtm: Floats
    """Bare ground, ``(H, W)``, m; NaN where there is none."""
    top: TopLayer
    """The points close below the DSM; its height has the same voids filled, with the count 0."""
    ground: Bools
    """Cells with ground points, ``(H, W)``; in the others the DTM is interpolated."""
    bridges: Floats | None = None
    """Height of bridge decks, ``(H, W)``, m, NaN elsewhere; None if there are none."""
    photo: Orthophoto | None = None
    """The orthophoto; None if the points have no colours."""
