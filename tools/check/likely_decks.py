"""Decks that no road names: level road above the DTM that goes on as street of the same height."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
import shapely

from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks.roads.flat_patches import flat_cells
from flexroad.tasks.types import Bools, Floats

rasterio = lazy("rasterio")

RISE_M, AREA_M2 = 1.5, 20.0
"""Least height above the DTM, and least area, of what may be a deck."""
ROUGHNESS_M, BEND = 0.15, 0.1
"""Limits of flat patches (`flat_patches`): those of ``ecsrc: planar``."""
STREET_M = 0.5
"""Largest difference of DSM and DTM on a street (m)."""
END_M, END_M2 = 6.0, 4.0
"""A deck ends at a street of at least this area within this distance."""
STEP_M, GRADE = 0.5, 0.1
"""Largest difference in height of a street to a deck that ends there: a step, and a slope (m per m)."""
GAP_M = 1.5
"""Places of streets that are this near to each other are one end (m)."""
ENDS = 2
"""What has fewer ends may also be a roof."""
EVERY_WAY = np.ones((3, 3), bool)


@dataclass(frozen=True, eq=False)
class Deck:
    """A place that looks like a deck."""

    area: shapely.Geometry
    """Outline of its flat cells."""
    rise_m: float
    """Median height above the DTM."""
    ends: int
    """Number of places where a street of the same height goes on."""

    @property
    def is_sure(self) -> bool:
        """Whether it cannot be a roof."""
        return self.ends >= ENDS


def likely_decks(dsm: Floats, dtm: Floats, road: Bools, grid: Grid) -> list[Deck]:
    """Return the places of road that look like decks.

    - `dsm`, `dtm`: heights (m), NaN where unknown.
    - `road`: cells of roads, with those on decks.
    - `grid`: the grid of all of them.
    """
    points = road & np.isfinite(dsm)
    flat = flat_cells(dsm, points, grid.cell, ROUGHNESS_M, BEND) & points
    rise = dsm - dtm
    street = flat & (np.abs(rise) <= STREET_M)
    parts, number = scipy.ndimage.label(flat & (rise > RISE_M), EVERY_WAY)
    sizes = np.bincount(parts.ravel(), minlength=number + 1) * grid.cell**2
    decks = []
    for k, box in enumerate(scipy.ndimage.find_objects(parts), 1):
        if sizes[k] >= AREA_M2:
            # Only what is near matters: a tile may have millions of cells.
            around = _grown(box, math.ceil(END_M / grid.cell) + 1, road.shape)
            own, here = parts[around] == k, grid.part(*around)
            ends = _ends(own, street[around], dsm[around], grid.cell)
            decks.append(Deck(_outline(own, here), float(np.median(rise[around][own])), ends))
    return decks


def _grown(box: tuple[slice, ...], cells: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the rows and columns of a box, and so many cells on each side of it."""
    rows, cols = (
        slice(max(side.start - cells, 0), min(side.stop + cells, length))
        for side, length in zip(box, shape, strict=True)
    )
    return rows, cols


def _ends(own: Bools, street: Bools, dsm: Floats, cell: float) -> int:
    """Return the number of streets of the same height within `END_M` of some cells."""
    away, nearest = scipy.ndimage.distance_transform_edt(~own, sampling=cell, return_indices=True)
    off = np.abs(dsm - dsm[tuple(nearest)])
    level = street & (away <= END_M) & (off <= STEP_M + GRADE * away)
    grown = scipy.ndimage.binary_dilation(level, iterations=max(1, round(GAP_M / cell)))
    places, _ = scipy.ndimage.label(grown)
    sizes = np.bincount(places[level], minlength=1) * cell**2
    return int((sizes[1:] >= END_M2).sum())


def _outline(cells: Bools, grid: Grid) -> shapely.Geometry:
    """Return the outline of some cells, without the steps from cell to cell."""
    shapes = rasterio.features.shapes(cells.astype(np.uint8), mask=cells, transform=grid.transform)
    outline = shapely.union_all([shapely.geometry.shape(shape) for shape, _ in shapes])
    return shapely.simplify(outline, grid.cell)
