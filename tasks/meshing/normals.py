"""Normals of the vertices of a mesh."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Floats, Mesh, Surface

SMALLEST_ANGLE = 1e-8
"""Faces with a smaller angle (radians) are lines and have no normal."""
ROUNDING_M = 1e-6
"""Vertices this near to the border of a surface are on it (m)."""


def mesh_normals(mesh: Mesh, surface: Surface | None = None) -> Floats:
    """Return unit normals of a mesh's vertices, ``(V, 3)``.

    Inner vertices have the mean normal of the adjacent faces. Border vertices have the normal of the surface,
    so that neighbouring tiles agree and no line is visible along their border.

    - `surface`: the fitted surface of the mesh. Only a spline over exactly the tile has a border.
    """
    if mesh.level is not None:
        every = np.empty_like(mesh.vertices)
        for number in mesh.numbers:
            of_level = surface and surface.at(number)
            every[np.unique(mesh.faces[mesh.level == number])] = mesh_normals(mesh.at(number), of_level)
        return every
    normals = vertex_normals(mesh.vertices, mesh.faces)
    if isinstance(surface, NurbsSurface):
        x, y = (mesh.vertices[:, :2] + mesh.origin[:2]).T
        west, south, east, north = surface.bounds
        away = np.min([np.abs(x - west), np.abs(x - east), np.abs(y - south), np.abs(y - north)], axis=0)
        border = away <= ROUNDING_M
        normals[border] = surface.normal(x[border], y[border])
    return normals


def vertex_normals(points: Floats, faces: NDArray[np.int32]) -> Floats:
    """Return unit normals, ``(V, 3)``: the mean normal of the adjacent faces, weighted by angle.

    The weights follow Thürmer and Wüthrich (1998), Computing vertex normals from polygonal facets.

    - `points` ``(V, 3)``: a vertex without faces, or with lines only, has the normal (0, 0, 1).
    - `faces` ``(F, 3)``: counter-clockwise seen from the side of their normals.
    """
    normals = np.zeros((len(points), 3))
    _add(np.ascontiguousarray(points, np.float64), np.ascontiguousarray(faces, np.int32), normals)
    _to_units(normals)
    return normals


@compiled()
def _add(points: Floats, faces: NDArray[np.int32], normals: Floats) -> None:
    """Add the normal of each face, times its angle, to the normals of its vertices."""
    for a, b, c in faces:
        ux, uy, uz = (points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2])
        vx, vy, vz = (points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2])
        wx, wy, wz = vx - ux, vy - uy, vz - uz
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        area = math.sqrt(nx * nx + ny * ny + nz * nz)
        # Twice the area is the sine of an angle times its two sides.
        at_a = math.atan2(area, ux * vx + uy * vy + uz * vz)
        at_b = math.atan2(area, -(ux * wx + uy * wy + uz * wz))
        at_c = math.pi - at_a - at_b
        if min(at_a, at_b, at_c) < SMALLEST_ANGLE:
            continue
        for vertex, angle in ((a, at_a), (b, at_b), (c, at_c)):
            normals[vertex, 0] += angle * nx / area
            normals[vertex, 1] += angle * ny / area
            normals[vertex, 2] += angle * nz / area


@compiled()
def _to_units(normals: Floats) -> None:
    """Scale vectors, ``(V, 3)``, to length 1; a vector of length 0 becomes (0, 0, 1)."""
    for i in range(normals.shape[0]):
        x, y, z = normals[i]
        length = math.sqrt(x * x + y * y + z * z)
        if length > 0.0:
            normals[i, 0], normals[i, 1], normals[i, 2] = x / length, y / length, z / length
        else:
            normals[i, 2] = 1.0
