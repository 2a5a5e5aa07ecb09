"""Heights between nodes: linear over Delaunay triangles, void where no triangle is small enough.

A triangle counts if its circumcircle, which is empty of nodes, is at most so wide. The circles that hold a
place reach no farther than their width: what a cell gets depends on the nodes within that distance alone,
and land may be cut into blocks at will. At the border of the survey the same rule leaves its bays open.
"""

from __future__ import annotations

import numpy as np
import startinpy
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.metrics.vertical_distance import drape
from flexroad.tasks.types import Floats, Mesh

JITTER = 1e-6
"""Part of a cell by which nodes are moved to choose between triangulations that are equally good."""
SNAP_M = 1e-12
"""Nodes closer than this would be taken for one."""
WIDER = 1 + 1e-9
"""A circle exactly as wide as the limit counts, whatever the rounding."""
COUNTED_FROM = 0.6180339887
"""Part of a cell added to an edge before its whole cells are counted: no lattice is likely to turn there."""


def tin(east: Floats, north: Floats, height: Floats, grid: Grid, widest_m: float) -> Floats:
    """Return the height over the triangles of the nodes at the cell centres, ``(H, W)``, m.

    Parameters
    ----------
    east, north : Floats
        Place of a cell's node, from the grid's north-west corner, ``(H, W)``, m.
    height : Floats
        Height of a cell's node, ``(H, W)``, m; NaN where the cell has none.
    grid : Grid
        The cells.
    widest_m : float
        Largest diameter of a triangle's circumcircle (m).

    Returns
    -------
    Floats
        NaN where no triangle lies above or below.
    """
    row, col = np.nonzero(np.isfinite(height))
    nodes = np.column_stack([east[row, col], north[row, col], height[row, col]])
    faces = _delaunay(nodes[:, :2] + JITTER * grid.cell * _noise(grid, row, col))
    faces = _ordered(faces[_widths(nodes[:, :2], faces) <= widest_m * WIDER], len(nodes))
    corner = grid.west, grid.north, 0.0
    return drape(Mesh(grid.crs, corner, nodes, faces, np.zeros(len(faces), bool)), grid)


def _noise(grid: Grid, row: NDArray[np.intp], col: NDArray[np.intp]) -> Floats:
    """Return two numbers per cell between -0.5 and 0.5 by the cell's place on the whole lattice, ``(n, 2)``.

    Nodes on a lattice are full of cocircular fours; which of the two diagonals is drawn must not hang on
    the order of insertion, which changes with the block. Mixing as in SplitMix64 (Steele et al., 2014).
    """
    east = col + int(np.floor(grid.west / grid.cell + COUNTED_FROM))
    south = row - int(np.floor(grid.north / grid.cell + COUNTED_FROM))
    bits = east.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for mixed_in, factor in ((south, 0xBF58476D1CE4E5B9), (0, 0x94D049BB133111EB)):
        bits = (bits ^ (bits >> np.uint64(30))) + np.asarray(mixed_in).astype(np.uint64)
        bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(factor)
    bits ^= bits >> np.uint64(31)
    halves = np.stack([bits >> np.uint64(32), bits & np.uint64(0xFFFFFFFF)], axis=1)
    return halves / 2.0**32 - 0.5


def _delaunay(plan: Floats) -> NDArray[np.int32]:
    """Return the faces of the Delaunay triangulation, ``(F, 3)``, counter-clockwise."""
    if len(plan) < 3:
        return np.empty((0, 3), np.int32)
    triangulation = startinpy.DT()
    triangulation.snap_tolerance = SNAP_M
    triangulation.insert(np.column_stack([plan, np.zeros(len(plan))]), insertionstrategy="BBox")
    # Vertex 0 of startinpy is at infinity; the points follow in their order.
    faces: NDArray[np.int32] = triangulation.triangles.astype(np.int32).reshape(-1, 3) - 1
    # It can only be dropped in the thread that made it, and a sampling profiler (Dask's is one) may keep
    # this frame and all it holds alive in another.
    del triangulation
    return faces


def _widths(plan: Floats, faces: NDArray[np.int32]) -> Floats:
    """Return the diameters of the circumcircles, ``(F,)``; infinite for three nodes in a line."""
    a, b, c = (plan[faces[:, k]] for k in range(3))
    sides = np.prod([np.hypot(*(p - q).T) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    with np.errstate(divide="ignore"):
        widths: Floats = sides / np.abs(ux * vy - uy * vx)
    return widths


def _ordered(faces: NDArray[np.int32], nodes: int) -> NDArray[np.int32]:
    """Return the faces in the order of their nodes: a centre on an edge meets the same one in any block."""
    first = faces.argmin(axis=1)
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    # No two faces leave one node for the same next one.
    return turned[np.argsort(turned[:, 0] * np.int64(nodes) + turned[:, 1])]
