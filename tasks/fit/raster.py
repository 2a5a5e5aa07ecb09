"""Use the raster itself as surface: the regular grid triangulation of the paper's Tables I and II (RGT).

It replaces step C. With the DSM on roads and the DTM elsewhere this is the ablation "w/o NURBS".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from flexroad.catalog.grid import Bounds, Grid
from flexroad.tasks.compiled import compiled
from flexroad.tasks.options import Options as BaseOptions
from flexroad.tasks.types import Floats, RoadClusters, Surface, TileData

VERSION = 1
STORED = False
"""The surface is not stored: `load` reads its heights again."""

SNAP = 1e-6
"""Points within this share of a cell from a cell centre are moved onto it, so nodata beside has no effect."""


class Options(BaseOptions):
    """The rasters from which the heights come."""

    method: Literal["raster"] = "raster"
    road: Literal["dsm", "dtm"] = Field("dsm", description="heights of filtered road cells")
    terrain: Literal["dsm", "dtm"] = Field("dsm", description="heights of all other cells")


@dataclass(frozen=True, eq=False)
class RasterSurface(Surface):
    """Cell centres joined by triangles.

    Each quad of four centres is cut along its diagonal from south-west to north-east, as in `tasks.sample`:
    triangles (sw, se, ne) and (sw, ne, nw). Heights are linear on a triangle; they are NaN if a corner is
    NaN, except on edges and corners that have heights. Around the outer centres lies a ring of linearly
    extrapolated heights.
    """

    crs: str
    bounds: Bounds
    """The domain, spanned by the outer cell centres: west, south, east, north (m)."""
    grid: Grid
    heights: Floats
    """Height at each cell centre, ``(H, W)``, m; NaN where unknown; row 0 in the north."""

    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights (m) at scattered points, in their broadcast shape; NaN where unknown."""
        return self._interpolated(easting, northing)[..., 0]

    def lattice(self, eastings: Floats, northings: Floats) -> Floats:
        """Return heights (m) at every pair, ``(len(northings), len(eastings))``; NaN where unknown."""
        return self.height(np.asarray(eastings)[None, :], np.asarray(northings)[:, None])

    def normal(self, easting: Floats, northing: Floats) -> Floats:
        """Return upward unit normals of the triangles at scattered points, ``(..., 3)``, or NaN."""
        slopes = self._interpolated(easting, northing)[..., 1:] / self.grid.cell
        normals = np.concatenate([-slopes, np.ones_like(slopes[..., :1])], axis=-1)
        return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))

    def _interpolated(self, easting: Floats, northing: Floats) -> Floats:
        """Return height (m) and its rise per cell towards east and north, ``(..., 3)``."""
        west, _, _, north = self.bounds
        # Column and row in the grid with its ring; 0 is the centre of a ring cell.
        col = 1 + (np.asarray(easting, dtype=np.float64) - west) / self.grid.cell
        row = 1 + (north - np.asarray(northing, dtype=np.float64)) / self.grid.cell
        cols, rows = np.broadcast_arrays(col, row)
        # An odd reflection, 2 * edge - inner, is the linear extrapolation.
        ringed = np.pad(self.heights, 1, mode="reflect", reflect_type="odd")
        return np.asarray(_on_triangles(ringed, cols.ravel(), rows.ravel()).reshape(*cols.shape, 3))


@compiled()
def _on_triangles(heights: Floats, cols: Floats, rows: Floats) -> Floats:
    out = np.empty((cols.size, 3))
    for k in range(cols.size):
        col, row = _snapped(cols[k]), _snapped(rows[k])
        west_col = int(min(max(np.floor(col), 0), heights.shape[1] - 2))
        north_row = int(min(max(np.floor(row), 0), heights.shape[0] - 2))
        nw, ne = heights[north_row, west_col], heights[north_row, west_col + 1]
        sw, se = heights[north_row + 1, west_col], heights[north_row + 1, west_col + 1]
        x, y = col - west_col, north_row + 1 - row
        if x >= y:
            out[k, 0] = _part(1 - x, sw) + _part(x - y, se) + _part(y, ne)
            out[k, 1], out[k, 2] = se - sw, ne - se
        else:
            out[k, 0] = _part(1 - y, sw) + _part(x, ne) + _part(y - x, nw)
            out[k, 1], out[k, 2] = ne - nw, nw - sw
    return out


@compiled()
def _snapped(position: float) -> float:
    nearest = np.rint(position)
    return float(nearest if abs(position - nearest) < SNAP else position)


@compiled()
def _part(share: float, height: float) -> float:
    """Return the share of a corner in the height; 0, not NaN, if the point lies on the opposite edge."""
    return 0.0 if share == 0 else share * height


def fit(data: TileData, clusters: RoadClusters, options: Options) -> RasterSurface:
    """Return a surface with the heights of one raster on filtered road cells and of another elsewhere."""
    source = {"dsm": data.dsm, "dtm": data.dtm}
    heights = np.where(clusters.mask, source[options.road], source[options.terrain])
    return RasterSurface(crs=data.grid.crs, bounds=data.grid.hull, grid=data.grid, heights=heights)
