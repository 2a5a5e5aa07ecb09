"""Steps on an edge between two tiles: computed from the ground around it, as its control points are.

Both tiles take them from the same `Edge`, so that the ground beside a road goes on across their border, and
their heights on it are equal.
"""

from __future__ import annotations

import math

import numpy as np

from flexroad.catalog.borders import Border
from flexroad.tasks.roads.distances import distances
from flexroad.tasks.roads.road_height import ground_heights
from flexroad.tasks.spline.frame import rounded
from flexroad.tasks.spline.lattice import Lattice, Range
from flexroad.tasks.spline.space import surface_on
from flexroad.tasks.spline.stepped import KERB_M, ground_beside, with_steps
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Floats, RoadClusters, RoadMask, TileData


def spline_around(lattice: Lattice, border: Border, u: Range, v: Range, control: Floats) -> NurbsSurface:
    """Return the spline with some control heights (m) over a part of the lattice around a corner or edge."""
    (east, north), (along_u, along_v) = border.start, lattice.unit_m
    space, _ = lattice.part(border.grid.shape, border.cell, u, v)
    bounds = east + u[0] * along_u, north + v[0] * along_v, east + u[1] * along_u, north + v[1] * along_v
    return surface_on(space, border.grid, bounds, control, np.ones_like(control), datum=0.0)


def border_steps(
    data: TileData, road: RoadMask, clusters: RoadClusters, border: Border, spline: NurbsSurface
) -> dict[str, Floats]:
    """Return ``steps`` and ``road_m`` of an `Edge`; empty if the filter gives no cells beside streets.

    A step is the mean of those of the two cells beside the edge, so that the ground goes on across it. It is
    0 where one of the two has none: the edge of a road is not moved.

    Parameters
    ----------
    data, road, clusters : TileData, RoadMask, RoadClusters
        The cells around the edge, their road mask and the filtered road.
    spline : NurbsSurface
        The spline around the edge; NaN if there is no ground.
    """
    if clusters.beside is None or np.isnan(spline.A).any():
        return {}
    # As much ground as decides on the steps of the cells beside the edge.
    reach = math.ceil(KERB_M / data.grid.cell) + 1
    (rows, cols), (last_rows, last_cols) = border.sides
    strip = (
        _widened(rows, last_rows, reach, data.grid.height),
        _widened(cols, last_cols, reach, data.grid.width),
    )
    grid, heights = data.grid.part(*strip), ground_heights(data, clusters)
    part = TileData(data.tile_id, grid, grid, heights.dsm[strip], heights.dtm[strip])
    beside = ground_beside(part, RoadClusters(grid, clusters.labels[strip], None, clusters.beside[strip]))
    if beside is None:
        return {}
    steps, has_step = np.zeros((2, *data.grid.shape))
    steps[strip], has_step[strip] = with_steps(beside, spline, grid).steps, beside.cells
    both = border.along(has_step).all(axis=0)
    mean = np.where(both, border.along(steps).sum(axis=0) / 2, 0.0)
    return {"steps": rounded(mean), "road_m": border.along(_to_road(road, border)).min(axis=0)}


def _widened(first: slice, last: slice, reach: int, count: int) -> slice:
    return slice(max(first.start - reach, 0), min(last.stop + reach, count))


def _to_road(road: RoadMask, border: Border) -> Floats:
    """Return the distance of the cells beside an edge to the nearest road cell, ``(H, W)``, m; else inf."""
    beside = np.zeros_like(road.mask)
    for side in border.sides:
        beside[side] = True
    away = np.full(beside.shape, np.inf)
    away[beside] = distances(beside, road.mask) * road.grid.cell
    return away
