"""Point clouds for tests."""

from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
from laspy.header import GpsTimeType
from pyproj import CRS

from flexroad.catalog import Grid
from flexroad.tasks.types import Bools, Floats, Orthophoto
from flexroad.tools.prepare.points.binning import Points
from flexroad.tools.prepare.points.to_rasters import (
    Options,
    cells_reach_m,
    of_cells,
    of_points,
    points_reach_m,
)


def write_cloud(
    path: Path,
    xyz,
    kind=1,
    crs=None,
    colour=None,
    withheld=None,
    scale=0.01,
    gps=None,
    standard=False,
    created=None,
) -> Path:
    """Write a LAS or LAZ file of points ``(n, 3)``; one class for all or per point; colours ``(n, 3)``.

    GPS times are ``standard`` or seconds of a week; ``created`` is the date in the header, by default today.
    """
    xyz = np.asarray(xyz, np.float64).reshape(-1, 3)
    header = laspy.LasHeader(point_format=6 if colour is None else 7, version="1.4")
    header.scales = [scale] * 3
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else [0, 0, 0]
    header.creation_date = created or date.today()
    header.global_encoding.gps_time_type = GpsTimeType.STANDARD if standard else GpsTimeType.WEEK_TIME
    if crs:
        header.add_crs(CRS.from_user_input(crs))
    points = laspy.LasData(header)
    points.x, points.y, points.z = xyz.T
    points.classification = np.broadcast_to(np.asarray(kind, np.uint8), len(xyz))
    if colour is not None:
        points.red, points.green, points.blue = np.asarray(colour, np.uint16).T
    if gps is not None:
        points.gps_time = np.broadcast_to(gps, len(xyz))
    if withheld is not None:
        points.withheld = withheld
    path.parent.mkdir(parents=True, exist_ok=True)
    points.write(path)
    return path


class Top(NamedTuple):
    """The top layer of each cell, ``(H, W)``."""

    height: Floats
    count: Floats
    spread: Floats


@dataclass(frozen=True, eq=False)
class Rasters:
    """The rasters of an area."""

    grid: Grid
    dsm: Floats
    """Highest point per cell, ``(H, W)``, m; NaN where no height is known."""
    dtm: Floats
    """Bare ground, ``(H, W)``, m; NaN where no height is known."""
    top: Top
    """The points close below the DSM; its height has the same voids filled, with the count 0."""
    ground: Bools
    """Cells with ground points, ``(H, W)``; in the others the DTM is interpolated."""
    bridges: Floats | None = None
    """Height of bridge decks, ``(H, W)``, m, NaN elsewhere; None without decks."""
    photo: Orthophoto | None = None
    """The orthophoto; None if the points have no colours."""


def rasterise(points: Points, grid: Grid, options: Options, dop_cell: float | None) -> Rasters:
    """Make the rasters of a block of ground.

    - `points`: in the grid's CRS (m), including a rim of `reach_m` around the grid; others have no effect.
    - `dop_cell`: pixel of the orthophoto (m); None makes no orthophoto.
    - result: NaN without points, and the DTM without ground points; no orthophoto if the points have no
      colours.
    """
    rim = grid.buffered(cells_reach_m(options, grid.cell))
    pixels = Grid.covering(grid.crs, grid.bounds, dop_cell) if dop_cell else None
    heights, image = of_points(points, rim, options, pixels)
    layers = of_cells(heights, rim, grid, options)
    top, bridges = Top(*layers["road_height"]), layers.get("bridges")
    return Rasters(grid, layers["dsm"], layers["dtm"], top, layers["ground"], bridges, image)


def reach_m(options: Options, cell: float) -> float:
    """Return the largest distance from a grid of such cells at which points can change a value in it (m)."""
    return points_reach_m(options, cell) + cells_reach_m(options, cell)
