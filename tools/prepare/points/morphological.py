"""Morphological ground filter: points above what an opening of the surface leaves are not ground.

An opening with a disk removes all objects that are narrower than the disk, such as houses and trees. It keeps
ground on one side of a wall or quay, which the slope filter rejects. Disks of all sizes are used, each with a
tolerance for the height that sloping ground loses by it. See Zhang et al. (2003), "A progressive
morphological filter for removing nonground measurements from airborne LIDAR data", IEEE TGRS 41(4), and
Pingel et al. (2013), "An improved simple morphological filter for the terrain classification of airborne
LIDAR data", ISPRS JPRS 77.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from flexroad.catalog.lazy import lazy
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.prepare.points import low_outliers

cv2 = lazy("cv2")


class Options(low_outliers.Options):
    """Size of objects, slope and roughness of the ground, and the detection of low outliers."""

    radius_m: float = Field(
        18.0, gt=0, le=100, description="radius of the largest disk (m): half the widest roof"
    )
    slope: float = Field(
        0.1, ge=0, le=5, description="slope up to which ridges and all points of a cell are kept: 0.1 is 10 %"
    )
    tolerance_m: float = Field(
        0.1, ge=0, le=2, description="tolerated height above the lowest point of a cell on level ground (m)"
    )
    cell_m: float = Field(1.0, gt=0, le=10, description="cell size of the surface that is opened (m)")

    @property
    def reach_m(self) -> float:
        """Distance up to which other points decide whether a point is ground (m)."""
        return 2 * self.radius_m + math.sqrt(2) * self.cell_m + self.low_reach_m


def ground(easting: Floats, northing: Floats, height: Floats, options: Options) -> Bools:
    """Return which points are ground.

    The surface has the height of the lowest point in each cell. A point is ground if it is at most ``slope *
    (r + cell_m) + tolerance_m`` above the opening of the surface by the disk of radius r, for all radii from
    0 to ``radius_m`` in steps of a cell. Cells without points have no effect. Low outliers are not ground,
    and are not used.

    - `easting`, `northing`, `height` ``(n,)``: in metres. Points with NaN or infinite coordinates are not
      ground.
    - result ``(n,)``: independent of the order of the points, and of points farther away than ``reach_m``.
    """
    points = low_outliers.without_low_outliers(easting, northing, height, options.radius_m, options)
    out = np.zeros(height.shape, bool)
    if points.order.size == 0:
        return out
    kept, cell = points.order, options.cell_m
    # Cells lie on multiples of their size, so that they do not depend on the extent of the points.
    rows, cols = (np.floor(along[kept] / cell).astype(np.int64) for along in (northing, easting))
    rows, cols = rows - rows.min(), cols - cols.min()
    surface = np.full((rows.max() + 1, cols.max() + 1), np.inf)
    np.minimum.at(surface, (rows, cols), height[kept])
    highest = _highest_ground(surface, round(options.radius_m / cell), options.slope * cell)
    limit = highest[rows, cols] + options.slope * cell + options.tolerance_m
    out[kept[height[kept] <= limit]] = True
    return out


def _highest_ground(surface: Floats, radius: int, fall: float) -> Floats:
    """Return the minimum over all radii of the opening plus the fall over its radius, ``(H, W)``, m.

    - `surface`: heights (m); inf without points.
    - `radius`: largest radius, in cells.
    - `fall`: fall of the ground over one cell (m).
    """
    result = surface.copy()
    for size in range(1, radius + 1):
        down, across = np.mgrid[-size : size + 1, -size : size + 1]
        disk = np.asarray(down**2 + across**2 <= size**2, np.uint8)
        lowest = cv2.erode(surface, disk)
        # Where no point is within the disk, the minimum is inf, or OpenCV's value beyond the border.
        there = lowest < np.finfo(np.float64).max
        opened = cv2.dilate(np.where(there, lowest, -np.inf), disk)
        np.minimum(result, opened + fall * size, out=result)
    return result
