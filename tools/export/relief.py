"""A coarse copy of meshes: heights at the nodes of a lattice, and its largest vertical distance from them.

Each cell of the lattice is two triangles, cut from the north-west to the south-east. The distance is exact:
it is largest at a vertex of one surface, or where edges of both cross in plan. The edges of a lattice are
three families of parallel lines, so all crossings are found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.meshing.normals import vertex_normals
from flexroad.tasks.metrics.mesh_distance import at_nodes
from flexroad.tasks.products.glb import encode_ground
from flexroad.tasks.types import Bools, Floats, Mesh

Faces = NDArray[np.int32]
ON_LINE = 1e-9
"""Points closer than this to a line of the lattice are on it (cells)."""


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights at the nodes of a lattice, row 0 in the north."""

    bounds: Bounds
    """West, south, east and north of the outermost nodes (m)."""
    heights: Floats
    """``(n + 1, m + 1)`` (m); without meaning at nodes that are not corners of a drawn cell."""
    cells: Bools
    """``(n, m)``, the drawn cells: all cells that a mesh touches."""
    error_m: float
    """Largest vertical distance from the meshes (m)."""

    @property
    def places(self) -> Floats:
        """Easting, northing and height of the nodes by rows, ``((n + 1) * (m + 1), 3)``."""
        west, south, east, north = self.bounds
        rows, columns = self.heights.shape
        axes = np.meshgrid(np.linspace(west, east, columns), np.linspace(north, south, rows))
        return np.column_stack([*(axis.ravel() for axis in axes), self.heights.ravel()])

    @property
    def faces(self) -> Faces:
        """Two faces per drawn cell, counter-clockwise from above, ``(F, 3)``."""
        number = np.arange(self.heights.size, dtype=np.int32).reshape(self.heights.shape)
        nw, ne, sw, se = (part[self.cells] for part in _corners(number))
        return np.stack([nw, sw, se, nw, se, ne], axis=-1).reshape(-1, 3)


def highest_first(mesh: Mesh) -> NDArray[np.int32]:
    """Return the faces of a mesh, ``(F, 3)``, faces of the highest level first.

    Where several faces lie above each other, a relief has the height of the first face.
    """
    return mesh.faces if mesh.level is None else mesh.faces[np.argsort(-mesh.level, kind="stable")]


def of_mesh(points: Floats, faces: Faces, spacing_m: float) -> Relief:
    """Return the relief of a mesh.

    - `points` ``(V, 3)``: easting, northing and height (m).
    - `faces` ``(F, 3)``: at least one.
    - `spacing_m`: largest distance of nodes from east to west and from north to south (m).
    """
    west, south = points[:, :2].min(axis=0).tolist()
    east, north = points[:, :2].max(axis=0).tolist()
    bounds = west, south, east, north
    heights = at_nodes(points, faces, bounds, _shape(bounds, spacing_m))
    return _fitted(bounds, heights, [(points, faces, 0.0)])


def joined(parts: Sequence[Relief], spacing_m: float) -> Relief:
    """Return one relief of one or more reliefs; its error is the distance from the meshes of the parts."""
    edges = np.array([part.bounds for part in parts])
    west, south = edges[:, :2].min(axis=0).tolist()
    east, north = edges[:, 2:].max(axis=0).tolist()
    bounds = west, south, east, north
    empty = Relief(bounds, np.full(_shape(bounds, spacing_m), np.nan), np.zeros((1, 1), bool), 0.0)
    heights = empty.heights.ravel()
    for part in parts:
        lacking = np.flatnonzero(np.isnan(heights))
        places = _in_cells(empty.places[lacking], part.bounds, part.heights.shape)
        inside = _on_cells(places, part.cells)
        heights[lacking[inside]] = _height(part.heights, places[inside])
    meshes = [(part.places, part.faces, part.error_m) for part in parts]
    return _fitted(bounds, heights.reshape(empty.heights.shape), meshes)


@dataclass(frozen=True, eq=False)
class Sheet:
    """The triangles of a relief with a skirt: a wall down from its outer edge that hides gaps."""

    points: Floats
    """Easting, northing and height (m), ``(V, 3)``: corners of drawn cells, then the foot of the skirt."""
    faces: Faces
    """Counter-clockwise from above and from outside, ``(F, 3)``: faces of the relief, then the skirt."""
    top: NDArray[np.intp]
    """``(V,)``: for a point of the skirt, the point above it in the relief; for others, the point itself."""
    count: int
    """Number of faces of the relief."""


def sheet(relief: Relief, depth_m: float) -> Sheet:
    """Return the triangles of a relief with a skirt (depth in m); every point is part of a face."""
    used, corners = np.unique(relief.faces, return_inverse=True)
    faces = corners.reshape(-1, 3).astype(np.int32)
    points = relief.places[used]
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    key, opposite = directed @ [len(points), 1], directed @ [1, len(points)]
    start, end = directed[~np.isin(key, opposite)].T
    rim, number = np.unique(np.concatenate([start, end]), return_inverse=True)
    below = len(points) + number.reshape(2, -1)
    skirt = np.concatenate(
        [np.stack([start, below[0], below[1]], axis=1), np.stack([start, below[1], end], axis=1)]
    )
    foot = points[rim] - [0.0, 0.0, depth_m]
    return Sheet(
        np.concatenate([points, foot]),
        np.concatenate([faces, skirt.astype(np.int32)]),
        np.concatenate([np.arange(len(points)), rim]),
        len(faces),
    )


def encode_sheet(sheet: Sheet, local: Floats, bounds: Bounds, image: bytes, photo: bool) -> bytes:
    """Return a coarse copy of meshes with its image as GLB.

    The skirt has the colours and normals of the edge above it, so that it does not show.

    - `local` ``(V, 3)``: its points in a local frame: east, north and up (m).
    - `bounds`: west, south, east and north of the image's outer edges (m, in the CRS of the sheet).
    - `image`: the image seen from above, JPEG.
    - `photo`: whether the image is made of photos, which are shown unlit.
    """
    top = vertex_normals(local[: sheet.top.max() + 1], sheet.faces[: sheet.count])
    west, south, east, north = bounds
    uv = (sheet.points[sheet.top, :2] - (west, south)) / (east - west, north - south)
    return encode_ground(local, top[sheet.top], uv, sheet.faces, image, photo)


def _shape(bounds: Bounds, spacing_m: float) -> tuple[int, int]:
    """Return rows and columns of nodes."""
    west, south, east, north = bounds
    rows, columns = (
        max(1, int(np.ceil(length / spacing_m - 1e-6))) for length in (north - south, east - west)
    )
    return rows + 1, columns + 1


def _fitted(bounds: Bounds, heights: Floats, meshes: Sequence[tuple[Floats, Faces, float]]) -> Relief:
    """Return the relief with these heights at the nodes; NaN where no mesh has a height.

    Each mesh has points, faces and its own error. A cell is drawn under all its points and edges.
    """
    overlays = [(_overlay(_in_cells(points, bounds, heights.shape), faces), e) for points, faces, e in meshes]
    cells: Bools = np.asarray(np.isfinite(np.stack(_corners(heights))).all(axis=0))
    for (_, middles), _ in overlays:
        off_line = (np.abs(middles - np.rint(middles)) > ON_LINE).all(axis=1)
        column, row = np.floor(middles[off_line]).astype(np.intp).T
        cells[np.clip(row, 0, cells.shape[0] - 1), np.clip(column, 0, cells.shape[1] - 1)] = True
    heights = _filled(heights, cells, np.concatenate([places for (places, _), _ in overlays]))
    error = max(
        own + float(np.abs(_height(heights, places) - places[:, 2]).max()) for (places, _), own in overlays
    )
    return Relief(bounds, heights, cells, error)


def _filled(heights: Floats, cells: Bools, places: Floats) -> Floats:
    """Return heights at all nodes. A drawn cell's corner without a height gets the nearest height."""
    needed = np.zeros(heights.shape, bool)
    for corner in _corners(needed):
        corner[cells] = True
    row, column = np.nonzero(needed & np.isnan(heights))
    filled = np.where(np.isnan(heights), places[:, 2].mean(), heights)
    if len(row):
        _, nearest = scipy.spatial.cKDTree(places[:, :2]).query(np.column_stack([column, row]))
        filled[row, column] = places[nearest, 2]
    return filled


def _corners(nodes: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return the north-western, north-eastern, south-western and south-eastern nodes of all cells."""
    return nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]


def _in_cells(points: Floats, bounds: Bounds, shape: tuple[int, ...]) -> Floats:
    """Return points with plan coordinates in cells, east of the western and south of the northern edge."""
    west, south, east, north = bounds
    columns = (points[:, 0] - west) / (east - west) * (shape[1] - 1)
    rows = (north - points[:, 1]) / (north - south) * (shape[0] - 1)
    return np.column_stack([columns, rows, points[:, 2]])


def _on_cells(places: Floats, cells: Bools) -> Bools:
    """Return which places (in cells) lie on a drawn cell or its border."""
    inside = np.zeros(len(places), bool)
    for shift in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        column, row = np.floor(places[:, :2] + np.multiply(shift, ON_LINE)).astype(np.intp).T
        valid = (row >= 0) & (row < cells.shape[0]) & (column >= 0) & (column < cells.shape[1])
        inside[valid] |= cells[row[valid], column[valid]]
    return inside


def _height(heights: Floats, places: Floats) -> Floats:
    """Return the heights of the lattice's triangles at places (in cells)."""
    column = np.clip(np.floor(places[:, 0]), 0, heights.shape[1] - 2).astype(np.intp)
    row = np.clip(np.floor(places[:, 1]), 0, heights.shape[0] - 2).astype(np.intp)
    east, south = places[:, 0] - column, places[:, 1] - row
    nw, se = heights[row, column], heights[row + 1, column + 1]
    other = np.where(east >= south, heights[row, column + 1], heights[row + 1, column])
    most, least = np.maximum(east, south), np.minimum(east, south)
    return np.asarray(nw + most * (other - nw) + least * (se - other))


def _overlay(places: Floats, faces: Faces) -> tuple[Floats, Floats]:
    """Return where edges of a mesh meet the lattice, and in plan the middles between these points.

    The points are the ends of all edges and their crossings with the lines of the lattice, ``(k, 3)``.
    """
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    first, second = np.divmod(np.unique(pairs @ [len(places), 1]), len(places))
    start, step = places[first], places[second] - places[first]
    edges = [np.arange(len(first)), np.arange(len(first))]
    shares = [np.zeros(len(first)), np.ones(len(first))]
    for family in ([1, 0, 0], [0, 1, 0], [1, -1, 0]):
        a, along = start @ family, step @ family
        lowest, highest = np.ceil(np.minimum(a, a + along)), np.floor(np.maximum(a, a + along))
        # An edge parallel to a family crosses its lines only at the edge's ends.
        number = np.where(np.abs(along) > ON_LINE, np.maximum(highest - lowest + 1, 0), 0).astype(np.intp)
        edge = np.repeat(np.arange(len(first)), number)
        order = np.arange(len(edge)) - np.repeat(np.cumsum(number) - number, number)
        edges.append(edge)
        shares.append(np.clip((lowest[edge] + order - a[edge]) / along[edge], 0.0, 1.0))
    edge, share = np.concatenate(edges), np.concatenate(shares)
    sorted_by = np.lexsort((share, edge))
    edge, share = edge[sorted_by], share[sorted_by]
    met = start[edge] + share[:, None] * step[edge]
    piece = (edge[1:] == edge[:-1]) & (np.diff(share) > ON_LINE)
    return met, (met[1:, :2] + met[:-1, :2])[piece] / 2
