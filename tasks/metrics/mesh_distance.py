"""Heights of a mesh at cell centres and at nodes, and 3-D distances from points to it.

For 3-D distances the faces are binned in squares, which are searched ring by ring.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds, Grid
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats, Mesh

Indices = NDArray[np.int32]

FACES_PER_BIN = 4
TOLERANCE_M = 1e-6
"""Centres up to this distance (m) outside a triangle are taken as inside, so shared edges lose no centre."""


def drape(mesh: Mesh, grid: Grid) -> Floats:
    """Return the mesh's height at every cell centre, ``(H, W)``, m above the mesh's origin.

    NaN where no face lies above or below; where several faces lie, the first face is used.
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
        # Twice the area; negative for faces that face up, because the axes point east and south.
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


def nearest(vertices: Floats, faces: Indices, points: Floats, at_most: Floats) -> Floats:
    """Return the distance from each point to the nearest point of the mesh, ``(N,)``, m.

    - `points` ``(N, 3)``: in the coordinates of the vertices.
    - `at_most` ``(N,)``: upper bound of each distance (m), such as the vertical distance, or infinity. Faces
      farther away are not searched.
    """
    plan = vertices[faces][:, :, :2]
    low, high = plan.min(axis=1), plan.max(axis=1)
    west, south = low.min(axis=0)
    width, height = high.max(axis=0) - (west, south)
    side = max(math.sqrt(FACES_PER_BIN * width * height / len(faces)), 1e-3)
    shape = int(height / side) + 1, int(width / side) + 1
    boxes = ((np.hstack([low, high]) - (west, south, west, south)) / side).astype(np.int32)
    start, members = _bins(boxes, shape[0], shape[1])
    local = points - (west, south, 0.0)
    out = np.empty(len(points))
    _search(vertices - (west, south, 0.0), faces, start, members, shape, side, local, at_most, out)
    return out


@compiled()
def _bins(boxes: Indices, rows: int, cols: int) -> tuple[Indices, Indices]:
    """Return the faces whose bounding box touches each bin.

    The faces of bin b are ``members[start[b] : start[b + 1]]``.
    """
    start = np.zeros(rows * cols + 1, np.int32)
    for f in range(boxes.shape[0]):
        for r in range(boxes[f, 1], boxes[f, 3] + 1):
            for c in range(boxes[f, 0], boxes[f, 2] + 1):
                start[r * cols + c + 1] += 1
    start = np.cumsum(start).astype(np.int32)
    fill = start[:-1].copy()
    members = np.empty(start[-1], np.int32)
    for f in range(boxes.shape[0]):
        for r in range(boxes[f, 1], boxes[f, 3] + 1):
            for c in range(boxes[f, 0], boxes[f, 2] + 1):
                members[fill[r * cols + c]] = f
                fill[r * cols + c] += 1
    return start, members


@compiled()
def _search(
    vertices: Floats,
    faces: Indices,
    start: Indices,
    members: Indices,
    shape: tuple[int, int],
    side: float,
    points: Floats,
    at_most: Floats,
    out: Floats,
) -> None:
    rows, cols = shape
    for i in range(points.shape[0]):
        x, y, z = points[i]
        row = min(max(math.floor(y / side), 0), rows - 1)
        col = min(max(math.floor(x / side), 0), cols - 1)
        best = at_most[i] ** 2
        for ring in range(max(rows, cols)):
            # The faces of all inner rings are measured; the others lie outside the ring's inner edge.
            inner = min(x - (col - ring + 1) * side, (col + ring) * side - x)
            inner = max(min(inner, y - (row - ring + 1) * side, (row + ring) * side - y), 0.0)
            if ring and inner**2 >= best:
                break
            for r in range(max(row - ring, 0), min(row + ring, rows - 1) + 1):
                # The rows between a ring's first and last have only two bins, its first and last column.
                step = 1 if abs(r - row) == ring else max(2 * ring, 1)
                for c in range(col - ring, col + ring + 1, step):
                    if c < 0 or c >= cols:
                        continue
                    for k in range(start[r * cols + c], start[r * cols + c + 1]):
                        best = min(best, _to_triangle(vertices, faces[members[k]], x, y, z, best))
        out[i] = math.sqrt(best)


@compiled()
def _to_triangle(vertices: Floats, face: Indices, x: float, y: float, z: float, best: float) -> float:
    """Return the squared distance from a point to a triangle, or ``best`` if its bounding box is farther."""
    ax, ay, az = vertices[face[0], 0] - x, vertices[face[0], 1] - y, vertices[face[0], 2] - z
    bx, by, bz = vertices[face[1], 0] - x, vertices[face[1], 1] - y, vertices[face[1], 2] - z
    cx, cy, cz = vertices[face[2], 0] - x, vertices[face[2], 1] - y, vertices[face[2], 2] - z
    # Coordinates are now relative to the point.
    gap_x = max(min(ax, bx, cx), -max(ax, bx, cx), 0.0)
    gap_y = max(min(ay, by, cy), -max(ay, by, cy), 0.0)
    gap_z = max(min(az, bz, cz), -max(az, bz, cz), 0.0)
    if gap_x**2 + gap_y**2 + gap_z**2 >= best:
        return best
    nx = (by - ay) * (cz - az) - (bz - az) * (cy - ay)
    ny = (bz - az) * (cx - ax) - (bx - ax) * (cz - az)
    nz = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    of_c = nx * (ay * bz - az * by) + ny * (az * bx - ax * bz) + nz * (ax * by - ay * bx)
    of_a = nx * (by * cz - bz * cy) + ny * (bz * cx - bx * cz) + nz * (bx * cy - by * cx)
    of_b = nx * (cy * az - cz * ay) + ny * (cz * ax - cx * az) + nz * (cx * ay - cy * ax)
    length = nx * nx + ny * ny + nz * nz
    if of_a >= 0 and of_b >= 0 and of_c >= 0 and length > 0:
        square: float = (nx * ax + ny * ay + nz * az) ** 2 / length
        return square
    ab: float = _to_edge(ax, ay, az, bx, by, bz)
    bc: float = _to_edge(bx, by, bz, cx, cy, cz)
    ca: float = _to_edge(cx, cy, cz, ax, ay, az)
    return min(ab, bc, ca)


@compiled()
def _to_edge(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    """Return the squared distance from the origin to the segment a - b."""
    ux, uy, uz = bx - ax, by - ay, bz - az
    length = ux * ux + uy * uy + uz * uz
    along = -(ax * ux + ay * uy + az * uz) / length if length > 0 else 0.0
    t = min(max(along, 0.0), 1.0)
    return (ax + t * ux) ** 2 + (ay + t * uy) ** 2 + (az + t * uz) ** 2
