"""Linear interpolation over Delaunay triangles of limited size: the DTM from ground points, and voids.

A triangle is used if the diameter of its circumcircle, which has no other node inside, is at most a given
width. So the height of a cell depends only on nodes within that distance, and does not change if the area is
divided into blocks. A void stays where a disc of that diameter fits into it: so bays at the border of the
survey stay open, and lakes keep their shore.
"""

from __future__ import annotations

import math

import numpy as np
import startinpy
from numpy.typing import NDArray
from scipy import ndimage

from flexroad.catalog.grid import Grid
from flexroad.tasks.metrics.mesh_distance import drape
from flexroad.tasks.types import Bools, Floats, Mesh

Window = tuple[slice, slice]
"""Rows and columns of a raster."""
JITTER = 1e-6
"""Largest displacement of nodes (cells); it makes the triangulation of cocircular nodes unique."""
SNAP_M = 1e-12
"""Nodes closer than this would be merged (m)."""
LIMIT_FACTOR = 1 + 1e-9
"""Factor of the limit, so that a circle exactly as wide as the limit is used despite rounding errors."""
COUNT_OFFSET = 0.6180339887
"""Offset (cells) added before rounding down to whole cells, so that rounding errors do not matter."""
EMPTY_CIRCLE_CELLS = 2 * math.sqrt(2)
"""Largest diameter (cells) of an empty circle if every cell has a node anywhere in it."""
CHAIN_CELLS = 4 * math.sqrt(2)
"""Diameter (cells) of a disc that contains a square of 3 x 3 complete cells at every position."""
REACH_CELLS = math.ceil(CHAIN_CELLS)
DIAGONAL = math.sqrt(2)
"""Largest distance of the centres of touching cells (cells), added to the width of a void."""


def triangulated(ground: Floats, grid: Grid, void_m: float, inner: Window | None = None) -> Floats:
    """Return the ground height at the cell centres, linear between the centroids of cells, ``(H, W)``, m.

    A centroid is the mean of the points of a cell in plan and height. It is exact on planes and, unlike the
    lowest point, not biased. A cell with ground points whose centre is outside all triangles, for example at
    the border of the survey, has the mean height of its points.

    - `ground` ``(3, H, W)``: easting and northing of the cells' centroids from the grid's north-west corner,
      and their height (m); NaN without ground points.
    - `void_m`: the DTM is NaN where a circle of this diameter plus `EMPTY_CIRCLE_CELLS` has no node (m).
    """
    east, north, height = ground
    interpolated = tin(east, north, height, grid, void_m + EMPTY_CIRCLE_CELLS * grid.cell, inner)
    return np.where(np.isnan(interpolated), height, interpolated)


def tin_reach_m(void_m: float, cell: float) -> float:
    """Return the largest distance from a cell at which points can change its triangulated height (m)."""
    return math.ceil(void_m / cell + EMPTY_CIRCLE_CELLS) * cell


def tin(
    east: Floats, north: Floats, height: Floats, grid: Grid, widest_m: float, inner: Window | None = None
) -> Floats:
    """Return heights at the cell centres, interpolated over the triangles of the nodes, ``(H, W)``, m.

    - `east`, `north`: position of a cell's node, from the grid's north-west corner, ``(H, W)``, m.
    - `height`: height of a cell's node, ``(H, W)``, m; NaN if the cell has no node.
    - `widest_m`: largest diameter of a triangle's circumcircle (m).
    - `inner`: the cells whose heights are needed; others may be wrong. None: all.
    - result: NaN outside of all triangles.
    """
    nodes = np.isfinite(height)
    if inner is not None:
        nodes &= _acting(nodes, inner)
    (result,) = _interpolated(east, north, height[None], nodes, grid, widest_m)
    return result


def _acting(nodes: Bools, inner: Window) -> Bools:
    """Return the cells whose nodes may belong to triangles at inner cells, ``(H, W)``.

    Other nodes are far from the inner cells and from each void that is connected to them. Then no empty
    circle touches both a node and an inner cell. Proof: move a disc of `CHAIN_CELLS` within such a circle
    from the inner cell to the node. At every position it contains a square of 3 x 3 cells without nodes.
    These squares form a void that connects the inner cells to the node.
    """
    near = np.zeros(nodes.shape, bool)
    rows, cols = (slice(max(part.start - REACH_CELLS, 0), part.stop + REACH_CELLS) for part in inner)
    near[rows, cols] = True
    # The ground beyond the grid has no nodes.
    centres = ndimage.minimum_filter(~nodes, 3, mode="constant", cval=True)
    numbers, count = ndimage.label(centres, np.ones((3, 3), bool))
    connected = np.zeros(count + 1, bool)
    connected[numbers[near]] = True
    connected[0] = False
    acting: Bools = ndimage.maximum_filter(connected[numbers], 2 * REACH_CELLS + 3, mode="constant")
    return acting | near


def _interpolated(
    east: Floats, north: Floats, heights: Floats, is_node: Bools, grid: Grid, widest_m: float
) -> list[Floats]:
    """Return several heights of the same nodes, ``(n, H, W)``, interpolated over their triangles."""
    row, col = np.nonzero(is_node)
    plan = np.column_stack([east[row, col], north[row, col]])
    faces = _delaunay(plan + JITTER * grid.cell * _noise(grid, row, col), _coarse_first(row, col))
    faces = _ordered(faces[_widths(plan, faces) <= widest_m * LIMIT_FACTOR], len(plan))
    corner, none = (grid.west, grid.north, 0.0), np.zeros(len(faces), bool)
    return [
        drape(Mesh(grid.crs, corner, np.column_stack([plan, height[row, col]]), faces, none), grid)
        for height in heights
    ]


def _noise(grid: Grid, row: NDArray[np.intp], col: NDArray[np.intp]) -> Floats:
    """Return two pseudo-random numbers from -0.5 to 0.5 per cell, ``(n, 2)``: a hash of its position.

    The four nodes of a lattice square are cocircular. The choice of the diagonal must not depend on the order
    of insertion, which differs between blocks. The hash function is from SplitMix64 (Steele et al., 2014).
    """
    east = col + int(np.floor(grid.west / grid.cell + COUNT_OFFSET))
    south = row - int(np.floor(grid.north / grid.cell + COUNT_OFFSET))
    bits = east.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for value, factor in ((south, 0xBF58476D1CE4E5B9), (0, 0x94D049BB133111EB)):
        bits = (bits ^ (bits >> np.uint64(30))) + np.asarray(value).astype(np.uint64)
        bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(factor)
    bits ^= bits >> np.uint64(31)
    halves = np.stack([bits >> np.uint64(32), bits & np.uint64(0xFFFFFFFF)], axis=1)
    return halves / 2.0**32 - 0.5


def _coarse_first(row: NDArray[np.intp], col: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return an order of cells that begins with every 2^k-th cell, ``(n,)``.

    Inserting nodes row by row takes 1.5 times as long: each node changes the long triangles next to the rows
    that are done. Here nodes are first spread evenly, and each further node changes only small triangles.
    """
    position = row | col
    # The greatest power of two that divides both row and column.
    return np.argsort(-(position & -position), kind="stable")


def _delaunay(plan: Floats, order: NDArray[np.intp]) -> NDArray[np.int32]:
    """Return the faces of the Delaunay triangulation, ``(F, 3)``, counter-clockwise.

    Nodes are inserted in the given order; it has an effect only on the time.
    """
    if len(plan) < 3:
        return np.empty((0, 3), np.int32)
    triangulation = startinpy.DT()
    triangulation.snap_tolerance = SNAP_M
    triangulation.insert(np.column_stack([plan, np.zeros(len(plan))])[order])
    # Vertex 0 of startinpy is at infinity; the points follow in their order.
    numbers = triangulation.triangles.astype(np.intp).reshape(-1, 3) - 1
    faces: NDArray[np.int32] = order[numbers].astype(np.int32)
    # The object may only be deleted in the thread that created it, but a sampling profiler such as Dask's may
    # keep this frame alive in another thread.
    del triangulation
    return faces


def _widths(plan: Floats, faces: NDArray[np.int32]) -> Floats:
    """Return the diameters of the circumcircles, ``(F,)``; infinite for three collinear nodes."""
    a, b, c = (plan[faces[:, k]] for k in range(3))
    sides = np.prod([np.hypot(*(p - q).T) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    with np.errstate(divide="ignore"):
        widths: Floats = sides / np.abs(ux * vy - uy * vx)
    return widths


def _ordered(faces: NDArray[np.int32], nodes: int) -> NDArray[np.int32]:
    """Return the faces in the order of their nodes, so that all blocks use the same face for a centre."""
    first = faces.argmin(axis=1)
    rotated = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    # No two faces have the same first two nodes.
    return rotated[np.argsort(rotated[:, 0] * np.int64(nodes) + rotated[:, 1])]


def fill_voids(heights: Floats, grid: Grid, size_m: float) -> Floats:
    """Return the heights with voids of up to ``size_m`` filled, m.

    The centres of the cells around the voids are triangulated (see `tin`). A square or a strip of n cells
    across is filled if ``size_m`` is at least n cells.

    - `heights` ``(H, W) or (n, H, W)``: one raster, or several with the same voids (m); NaN in voids.
    """
    layers = heights.reshape(-1, *grid.shape)
    void = np.isnan(layers[0])
    border = ~void & ndimage.maximum_filter(void, 3, mode="constant")
    row, col = np.indices(grid.shape, np.float64)
    east, north = (col + 0.5) * grid.cell, -(row + 0.5) * grid.cell
    filled = _interpolated(east, north, layers, border, grid, size_m + DIAGONAL * grid.cell)
    return np.where(void, filled, layers).reshape(heights.shape)


def voids_reach_m(size_m: float, cell: float) -> float:
    """Return the largest distance from a cell at which other cells can change the result of `fill` (m)."""
    return (math.ceil(size_m / cell + DIAGONAL) + 1) * cell
