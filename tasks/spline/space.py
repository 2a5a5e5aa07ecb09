"""The spline space of a tile, and the control heights that a fit starts from."""

from __future__ import annotations

import numpy as np
import scipy

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.metrics.plane_lstsq import least_squares_plane
from flexroad.tasks.spline.surface import clamped_knots, greville
from flexroad.tasks.types import Bools, Floats, TileData

Space = tuple[Floats, Floats, tuple[int, int]]
"""Knots along easting and northing, degrees along both."""


def points_at_spacing(grid: Grid, degree: int, spacing_m: float) -> tuple[int, int]:
    """Return the number of control points along easting and northing at about this distance (m)."""
    west, south, east, north = grid.hull
    n, m = (max(degree + 1, round(span / spacing_m) + 1) for span in (east - west, north - south))
    return n, m


def spline_space(grid: Grid, degree: int, points: tuple[int, int]) -> Space:
    """Return knots and degrees of the surface over a grid's hull.

    Raises
    ------
    TaskError
        If the grid is a single row or column, or has fewer cells than control points.
    """
    if min(grid.shape) < 2:
        raise TaskError(f"a surface needs at least 2 x 2 cells, not {grid.width} x {grid.height}")
    # Checked before arrays are allocated: a spacing in the wrong unit would need more memory than there is.
    _check_enough(grid.width * grid.height, f"{grid.width} x {grid.height} cells", points)
    n, m = points
    return clamped_knots(n, degree), clamped_knots(m, degree), (degree, degree)


def cells_with_height(data: TileData, road: Bools, points: tuple[int, int]) -> int:
    """Return the number of cells with a height to fit: the DSM's on the road, the DTM's elsewhere.

    Raises
    ------
    TaskError
        If there are fewer of them than control points.
    """
    cells = int(np.count_nonzero(np.isfinite(np.where(road, data.dsm, data.dtm))))
    _check_enough(cells, f"{cells} cells with a height", points)
    return cells


def _check_enough(cells: int, name: str, points: tuple[int, int]) -> None:
    n, m = points
    if cells < n * m:
        raise TaskError(
            f"{name} are fewer than {n} x {m} control points; lower fit.control_points or raise fit.spacing_m"
        )


def start_heights(data: TileData, road: Bools, space: Space, terrain: bool = True) -> tuple[Floats, float]:
    """Return the control heights to start from, ``(m, n)`` with row 0 in the south, and their mean (m).

    With DTM support they are the DTM at the Greville abscissae, else the least-squares plane through the
    road: the start may not depend on the DTM then.

    Raises
    ------
    TaskError
        If neither the DTM nor the road has a height to start from.
    """
    u, v = (greville(knots, degree) for knots, degree in zip(space[:2], space[2], strict=True))
    cols, rows = u * (data.grid.width - 1), (1 - v) * (data.grid.height - 1)
    if terrain and np.isfinite(data.dtm).any():
        heights = scipy.ndimage.map_coordinates(
            _nearest_filled(data.dtm), np.meshgrid(rows, cols, indexing="ij"), order=1
        )
    else:
        r, c = np.nonzero(road & np.isfinite(data.dsm))
        if not len(r):
            dtm = "empty too" if terrain else "not to be used (fit.terrain)"
            raise TaskError(f"no filtered road cell has a DSM height to start from, and the DTM is {dtm}")
        level, by_col, by_row = least_squares_plane(c.astype(float), r.astype(float), data.dsm[r, c])
        heights = level + by_col * cols[None, :] + by_row * rows[:, None]
    return heights, float(heights.mean())


def _nearest_filled(heights: Floats) -> Floats:
    missing = ~np.isfinite(heights)
    if not missing.any():
        return heights
    nearest = scipy.ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(heights[tuple(nearest)])
