"""Fit a plane to the road (the baseline "Plane" of the paper's Table I, in place of step C)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from flexroad.catalog.grid import Bounds
from flexroad.tasks.errors import TaskError
from flexroad.tasks.options import Options as BaseOptions
from flexroad.tasks.roads.road_height import with_road_heights
from flexroad.tasks.spline.space import least_squares_plane
from flexroad.tasks.types import Floats, RoadClusters, Surface, TileData

VERSION = 1


class Options(BaseOptions):
    """The plane has no options."""

    method: Literal["plane"] = "plane"


@dataclass(frozen=True, eq=False)
class PlaneSurface(Surface):
    """A plane."""

    crs: str
    bounds: Bounds
    """The domain: west, south, east, north (m)."""
    origin: tuple[float, float]
    """Easting and northing (m) where the height is ``level``."""
    level: float
    """Height at the origin (m)."""
    slope: tuple[float, float]
    """Rise (m/m) towards east and towards north."""
    from_dtm: bool
    """Whether the plane was fitted to the DTM because no road cell had a height."""

    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights (m) at scattered points, in their broadcast shape."""
        east, north = np.asarray(easting) - self.origin[0], np.asarray(northing) - self.origin[1]
        return np.asarray(self.level + self.slope[0] * east + self.slope[1] * north)

    def lattice(self, eastings: Floats, northings: Floats) -> Floats:
        """Return heights (m) at every pair, ``(len(northings), len(eastings))``."""
        return self.height(np.asarray(eastings)[None, :], np.asarray(northings)[:, None])

    def normal(self, easting: Floats, northing: Floats) -> Floats:
        """Return upward unit normals at scattered points, ``(..., 3)``."""
        shape = np.broadcast_shapes(np.shape(easting), np.shape(northing))
        upward = np.array([-self.slope[0], -self.slope[1], 1.0])
        return np.broadcast_to(upward / np.linalg.norm(upward), (*shape, 3)).copy()


def fit(data: TileData, clusters: RoadClusters, options: Options) -> PlaneSurface:
    """Return the least-squares plane through the filtered road cells of the DSM, else through the DTM.

    Raises
    ------
    TaskError
        If neither the road nor the DTM has a height.
    """
    data = with_road_heights(data, clusters)
    heights = np.where(clusters.mask, data.dsm, np.nan)
    from_dtm = not np.isfinite(heights).any()
    if from_dtm:
        heights = data.dtm
    rows, cols = np.nonzero(np.isfinite(heights))
    if not len(rows):
        raise TaskError("neither the DSM on the road nor the DTM has a height to put a plane through")
    east, north = (float(c) for c in data.grid.origin)
    level, *slope = least_squares_plane(
        data.grid.eastings[cols] - east, data.grid.northings[rows] - north, heights[rows, cols]
    )
    return PlaneSurface(
        crs=data.grid.crs,
        bounds=data.grid.hull,
        origin=(east, north),
        level=level,
        slope=(slope[0], slope[1]),
        from_dtm=from_dtm,
    )
