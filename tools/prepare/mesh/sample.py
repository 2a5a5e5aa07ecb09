"""Points and an orthophoto from a textured mesh: random samples of its surface, and its view from above.

The mesh may be inside out or not manifold: neither result depends on the orientation of faces or on the
number of faces at an edge.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds, Grid
from flexroad.catalog.to_metres import MetricTransform
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats, Orthophoto
from flexroad.tools.prepare.points.binning import Points

CHUNK = 500_000
"""Points, or rays of the orthophoto, processed at a time, to limit the memory."""
MOST_RAYS = 4
"""Largest number of rays across a pixel of the orthophoto."""
TOLERANCE_M = 1e-6
"""A ray this far outside a triangle still hits it, so that no ray passes between two neighbours."""

Faces = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Georeferenced triangles with their colours."""

    crs: str
    """CRS of the vertices."""
    vertices: Floats
    """``(V, 3)``: easting, northing, height."""
    faces: Faces
    """``(F, 3)``, indices of vertices."""
    texture: NDArray[np.int32]
    """``(F,)``, index of the face's texture in `textures`; -1 without a texture."""
    textures: tuple[NDArray[np.uint8], ...] = ()
    """Red, green, blue, ``(h, w, 3)`` each."""
    uv: NDArray[np.float32] | None = None
    """Texture coordinates of the corners of faces, ``(F, 3, 2)``: 0 to 1 from the left and from below."""
    colours: NDArray[np.uint8] | None = None
    """Red, green, blue of the corners of faces without a texture, ``(F, 3, 3)``."""
    notes: tuple[str, ...] = ()
    """Harmless defects of the mesh, one line each."""

    @property
    def coloured(self) -> bool:
        """Whether every face has a colour."""
        return len(self.faces) > 0 and (self.colours is not None or bool((self.texture >= 0).all()))

    @property
    def bounds(self) -> Bounds:
        """West, south, east and north of the vertices that faces use."""
        used = self.vertices[np.unique(self.faces), :2]
        (west, south), (east, north) = used.min(axis=0), used.max(axis=0)
        return float(west), float(south), float(east), float(north)

    @property
    def normals(self) -> Floats:
        """Normals of the faces, ``(F, 3)``; their length is twice the area of the face."""
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
        normals: Floats = np.cross(b - a, c - a)
        return normals

    @property
    def area(self) -> float:
        """Area of the surface, in squared units of the CRS."""
        return float(np.linalg.norm(self.normals, axis=1).sum() / 2)


def in_metres(mesh: TexturedMesh, frame: MetricTransform) -> TexturedMesh:
    """Return the mesh in the frame's CRS, in metres."""
    return replace(mesh, crs=frame.target, vertices=np.column_stack(frame.metres(*mesh.vertices.T)))


def sample(mesh: TexturedMesh, density: float, seed: int) -> Iterator[Points]:
    """Yield points evenly distributed on the mesh's surface, chunk by chunk.

    Stratified sampling: the surface is divided, along the sequence of faces, into parts of equal area with
    one random point each. So points have fewer clusters and gaps than independent points. Equal input gives
    equal points.

    - `mesh`: in a CRS in metres.
    - result: at most `CHUNK` points, with colours if all faces have a colour.
    """
    rng = np.random.default_rng(seed)
    cumulative = np.cumsum(np.linalg.norm(mesh.normals, axis=1) / 2)
    total = max(1, round(cumulative[-1] * density))
    for first in range(0, total, CHUNK):
        draw = rng.random((min(CHUNK, total - first), 3))
        position = (first + np.arange(len(draw)) + draw[:, 0]) * (cumulative[-1] / total)
        face = np.minimum(np.searchsorted(cumulative, position, side="right"), len(cumulative) - 1)
        # The square root gives a uniform distribution over the triangle.
        along, across = np.sqrt(draw[:, 1]), draw[:, 2]
        weights = np.stack([1 - along, along * (1 - across), along * across], axis=1)
        east, north, up = np.einsum("nk,nkd->dn", weights, mesh.vertices[mesh.faces[face]])
        colour = _colour(mesh, face, weights).round().astype(np.uint8) if mesh.coloured else None
        yield Points(east, north, up, np.zeros(len(up), np.uint8), colour)


def orthophoto(mesh: TexturedMesh, grid: Grid) -> Orthophoto:
    """Draw the mesh from above: a vertical ray has the colour of the highest surface that it hits.

    If the texture is finer than the pixels, several rays per pixel are averaged, at most `MOST_RAYS` across.

    - `mesh`: must be in a CRS in metres, and all faces must have a colour.
    - result: pixels are valid where at least one of their rays hits the mesh.
    """
    rays = _rays(mesh, grid.cell)
    colour = np.zeros((3, *grid.shape), np.uint8)
    valid = np.zeros(grid.shape, bool)
    rows = max(1, CHUNK // (rays**2 * grid.width))
    for first in range(0, grid.height, rows):
        band = slice(first, min(first + rows, grid.height))
        colour[:, band], valid[band] = _draw_rows(mesh, grid, band, rays)
    return Orthophoto(grid, colour, valid)


def _draw_rows(mesh: TexturedMesh, grid: Grid, rows: slice, rays: int) -> tuple[NDArray[np.uint8], Bools]:
    """Return colours, ``(3, h, W)``, and validity, ``(h, W)``, of some rows of an orthophoto."""
    height = rows.stop - rows.start
    north = grid.north - rows.start * grid.cell
    fine = Grid(grid.crs, grid.west, north, grid.cell / rays, grid.width * rays, height * rays)
    _, face_index = project_down(mesh, fine)
    row, col = np.nonzero(face_index >= 0)
    face = face_index[row, col]
    colour = np.zeros((*fine.shape, 3), np.float32)
    weights = np.empty((len(face), 3))
    _weights(mesh.vertices, mesh.faces[face], fine.eastings[col], fine.northings[row], weights)
    colour[row, col] = _colour(mesh, face, weights)
    pixels = height, rays, grid.width, rays
    hits = (face_index >= 0).reshape(pixels).sum(axis=(1, 3))
    mean = colour.reshape(*pixels, 3).sum(axis=(1, 3)) / np.maximum(hits, 1)[..., None]
    return np.moveaxis(mean.round().astype(np.uint8), -1, 0), hits > 0


def _rays(mesh: TexturedMesh, pixel: float) -> int:
    """Return the number of rays across a pixel: the size of the pixel in texels of the median face."""
    if mesh.uv is None:
        return 1
    texels = np.array([t.shape[0] * t.shape[1] for t in mesh.textures] or [0])[mesh.texture]
    (u, v), (s, t) = np.moveaxis(mesh.uv[:, 1:] - mesh.uv[:, :1], 0, -1)
    textured = (mesh.texture >= 0) & (np.abs(u * t - v * s) > 0)
    if not textured.any():
        return 1
    size = np.sqrt(
        np.linalg.norm(mesh.normals, axis=1)[textured] / (np.abs(u * t - v * s) * texels)[textured]
    )
    return int(np.clip(math.ceil(pixel / max(float(np.median(size)), 1e-9) - 0.01), 1, MOST_RAYS))


@compiled()
def _weights(vertices: Floats, corners: Faces, east: Floats, north: Floats, weights: Floats) -> None:
    """Compute the barycentric weights of faces' corners, ``(n, 3)``, at positions in plan."""
    for n in range(corners.shape[0]):
        a, b, c = vertices[corners[n, 0]], vertices[corners[n, 1]], vertices[corners[n, 2]]
        ax, ay, bx, by = a[0] - east[n], a[1] - north[n], b[0] - east[n], b[1] - north[n]
        cx, cy = c[0] - east[n], c[1] - north[n]
        of_a, of_b, of_c = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
        side = 1.0 if of_a + of_b + of_c > 0 else -1.0
        # A ray slightly outside has a weight slightly below zero.
        of_a, of_b, of_c = max(side * of_a, 0.0), max(side * of_b, 0.0), max(side * of_c, 0.0)
        whole = of_a + of_b + of_c
        weights[n, 0], weights[n, 1], weights[n, 2] = of_a / whole, of_b / whole, of_c / whole


def _colour(mesh: TexturedMesh, face: Faces | NDArray[np.intp], weights: Floats) -> NDArray[np.float32]:
    """Return the colours at points on faces, ``(n, 3)``, 0 to 255, by barycentric ``weights``, ``(n, 3)``."""
    colour = np.zeros((len(face), 3), np.float32)
    if mesh.colours is not None:
        colour[:] = np.einsum("nk,nkd->nd", weights, mesh.colours[face])
    if mesh.uv is None:
        return colour
    texture_index = mesh.texture[face]
    for index, texture in enumerate(mesh.textures):
        selected = np.flatnonzero(texture_index == index)
        _texels(texture, mesh.uv, face, weights, selected, colour)
    return colour


@compiled()
def _texels(
    texture: NDArray[np.uint8],
    uv: NDArray[np.float32],
    face: Faces | NDArray[np.intp],
    weights: Floats,
    selected: NDArray[np.int64],
    colour: NDArray[np.float32],
) -> None:
    """Sample a texture bilinearly at the selected points; coordinates outside 0 to 1 repeat it."""
    height, width = texture.shape[:2]
    for n in selected:
        u = v = 0.0
        for corner in range(3):
            u += weights[n, corner] * uv[face[n], corner, 0]
            v += weights[n, corner] * uv[face[n], corner, 1]
        if u < 0 or u > 1:
            u %= 1
        if v < 0 or v > 1:
            v %= 1
        # v counts from below, rows from above.
        col, row = u * width - 0.5, (1 - v) * height - 0.5
        left, upper = math.floor(col), math.floor(row)
        east, south = col - left, row - upper
        right, lower = min(left + 1, width - 1), min(upper + 1, height - 1)
        left, upper = max(left, 0), max(upper, 0)
        for band in range(3):
            above = texture[upper, left, band] * (1 - east) + texture[upper, right, band] * east
            below = texture[lower, left, band] * (1 - east) + texture[lower, right, band] * east
            colour[n, band] = above * (1 - south) + below * south


def project_down(mesh: TexturedMesh, grid: Grid) -> tuple[Floats, Faces]:
    """Return height and face of the highest surface at each centre, ``(H, W)``; NaN and -1 without one."""
    # Column and row in metres from the centre of the north-western cell: small numbers.
    points = np.column_stack(
        [
            mesh.vertices[:, 0] - (grid.west + grid.cell / 2),
            (grid.north - grid.cell / 2) - mesh.vertices[:, 1],
            mesh.vertices[:, 2],
        ]
    )
    heights, face_index = np.full(grid.shape, np.nan), np.full(grid.shape, -1, np.int32)
    _raster(points, np.ascontiguousarray(mesh.faces, np.int32), grid.cell, heights, face_index)
    return heights, face_index


@compiled()
def _raster(points: Floats, faces: Faces, cell: float, heights: Floats, face_index: Faces) -> None:
    """Set height and face of the highest surface at each centre; at equal heights the first face is used."""
    rows, cols = heights.shape
    for f in range(faces.shape[0]):
        ax, ay, az = points[faces[f, 0]]
        bx, by, bz = points[faces[f, 1]]
        cx, cy, cz = points[faces[f, 2]]
        first_row = max(0, math.ceil((min(ay, by, cy) - TOLERANCE_M) / cell))
        last_row = min(rows - 1, math.floor((max(ay, by, cy) + TOLERANCE_M) / cell))
        if first_row > last_row:
            continue
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        longest = max(
            math.hypot(cx - bx, cy - by), math.hypot(cx - ax, cy - ay), math.hypot(bx - ax, by - ay)
        )
        # A vertical face is a line in plan: rays at its edges hit the neighbouring faces.
        if abs(area) <= TOLERANCE_M * longest:
            continue
        side = 1.0 if area > 0 else -1.0
        # Lower limit of the doubled sub-triangle areas: tolerance times edge length.
        slack = -TOLERANCE_M * longest
        first_col = max(0, math.ceil((min(ax, bx, cx) - TOLERANCE_M) / cell))
        last_col = min(cols - 1, math.floor((max(ax, bx, cx) + TOLERANCE_M) / cell))
        lowest, highest = min(az, bz, cz), max(az, bz, cz)
        for r in range(first_row, last_row + 1):
            y = r * cell
            for c in range(first_col, last_col + 1):
                x = c * cell
                of_a = side * ((bx - x) * (cy - y) - (by - y) * (cx - x))
                of_b = side * ((cx - x) * (ay - y) - (cy - y) * (ax - x))
                of_c = side * ((ax - x) * (by - y) - (ay - y) * (bx - x))
                if of_a < slack or of_b < slack or of_c < slack:
                    continue
                height = (of_a * az + of_b * bz + of_c * cz) / abs(area)
                # Slightly outside a steep face, its plane is far above or below the face.
                height = min(max(height, lowest), highest)
                if face_index[r, c] < 0 or height > heights[r, c]:
                    heights[r, c], face_index[r, c] = height, f
