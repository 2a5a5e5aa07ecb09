"""What travels between the makers of rasters: points in metres, and the rasters of a piece of ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Bools, Floats, Orthophoto


@dataclass(frozen=True, eq=False)
class Points:
    """A point cloud, in the metric CRS of the rasters it is to become."""

    easting: Floats
    """``(n,)``, m."""
    northing: Floats
    """``(n,)``, m."""
    height: Floats
    """``(n,)``, m."""
    kind: NDArray[np.uint8]
    """Class by ASPRS, ``(n,)``: 2 is ground, 17 a bridge deck; 0 and 1 say nothing."""
    colour: NDArray[np.uint8] | None = None
    """Red, green, blue, ``(n, 3)``, or None if the source has no colours."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.height)

    def __getitem__(self, which: slice | Bools | NDArray[np.intp]) -> Points:
        """Return some of the points: by a slice, a mask or indices."""
        colour = None if self.colour is None else self.colour[which]
        return Points(self.easting[which], self.northing[which], self.height[which], self.kind[which], colour)


@dataclass(frozen=True, eq=False)
class Rasters:
    """What a piece of ground came to be."""

    grid: Grid
    """The cells of the heights."""
    dsm: Floats
    """Highest point per cell, ``(H, W)``, m; NaN where unknown."""
    dtm: Floats
    """Bare ground, ``(H, W)``, m; NaN where unknown."""
    ground: Bools
    """Cells with points on the ground, ``(H, W)``; the DTM is inferred in the others."""
    bridges: Floats | None = None
    """Height of bridge decks, ``(H, W)``, m, NaN elsewhere; None if there is none."""
    photo: Orthophoto | None = None
    """None if the points have no colours."""
