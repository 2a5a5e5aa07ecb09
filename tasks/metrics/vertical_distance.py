"""Heights of a mesh at cell centres, from which vertical distances are computed, and at nodes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds, Grid
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats, Mesh

TOLERANCE_M = 1e-6
"""Centres up to this distance outside a triangle count as inside, so none is missed on a shared edge (m)."""


def drape(mesh: Mesh, grid: Grid) -> Floats:
    """Return the mesh's height at every cell centre, ``(H, W)``, m above the mesh's origin.

    NaN where no face lies above or below; where there are several, the first one is used.
    """
    # Local coordinates in metres east and south of the north-western cell's centre.
    east = mesh.vertices[:, 0] + (mesh.origin[0] - grid.west - grid.cell / 2)
    south = (grid.north - mesh.origin[1] - grid.cell / 2) - mesh.vertices[:, 1]
    heights = np.full(grid.shape, np.nan)
    _drape(np.column_stack([east, south, mesh.vertices[:, 2]]), mesh.faces, grid.cell, heights)
    return heights


def at_nodes(points: Floats, faces: NDArray[np.int32], bounds: Bounds, shape: tuple[int, int]) -> Floats:
    """Return the height of faces at the nodes of a lattice, ``shape``; NaN where no face is below or above.

    - `points` ``(V, 3)``: east, north and height of vertices (m).
    - `faces` ``(F, 3)``: indices of points.
    - `bounds`: west, south, east and north of the outermost nodes (m); no two may be equal.
    - `shape`: rows, from north to south, and columns of nodes; 2 of each at least.
    """
    west, south, east, north = bounds
    columns = (points[:, 0] - west) / (east - west) * (shape[1] - 1)
    rows = (north - points[:, 1]) / (north - south) * (shape[0] - 1)
    heights = np.full(shape, np.nan)
    _drape(np.column_stack([columns, rows, points[:, 2]]), faces, 1.0, heights)
    return heights


@compiled()
def _drape(points: Floats, faces: NDArray[np.int32], cell: float, heights: Floats) -> None:
    rows, cols = heights.shape
    for f in range(faces.shape[0]):
        ax, ay, az = points[faces[f, 0]]
        bx, by, bz = points[faces[f, 1]]
        cx, cy, cz = points[faces[f, 2]]
        # Twice the area; negative for faces that look up, because the axes point east and south.
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        side = 1.0 if area > 0 else -1.0
        # Lower bounds of the doubled areas opposite to a, b and c: minus tolerance times edge length.
        slack_a = -TOLERANCE_M * math.hypot(cx - bx, cy - by)
        slack_b = -TOLERANCE_M * math.hypot(cx - ax, cy - ay)
        slack_c = -TOLERANCE_M * math.hypot(bx - ax, by - ay)
        first_row = max(0, math.ceil((min(ay, by, cy) - TOLERANCE_M) / cell))
        last_row = min(rows - 1, math.floor((max(ay, by, cy) + TOLERANCE_M) / cell))
        first_col = max(0, math.ceil((min(ax, bx, cx) - TOLERANCE_M) / cell))
        last_col = min(cols - 1, math.floor((max(ax, bx, cx) + TOLERANCE_M) / cell))
        for r in range(first_row, last_row + 1):
            y = r * cell
            for c in range(first_col, last_col + 1):
                if not math.isnan(heights[r, c]):
                    continue
                x = c * cell
                of_a = side * ((bx - x) * (cy - y) - (by - y) * (cx - x))
                of_b = side * ((cx - x) * (ay - y) - (cy - y) * (ax - x))
                of_c = side * ((ax - x) * (by - y) - (ay - y) * (bx - x))
                if of_a >= slack_a and of_b >= slack_b and of_c >= slack_c:
                    heights[r, c] = (of_a * az + of_b * bz + of_c * cz) / abs(area)
