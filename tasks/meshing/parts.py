"""Meshes of several levels, and places of faces and vertices."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.types import Floats, Mesh


def with_levels(meshes: Mapping[int, Mesh]) -> Mesh:
    """Return the meshes of several levels of a tile as one; they share no vertex.

    - `meshes`: by number of the level; level 0 is the first.
    """
    first, *others = meshes.values()
    if not others:
        return first
    east, north, _ = first.origin
    datum = min(mesh.origin[2] for mesh in meshes.values())
    counts = [len(mesh.vertices) for mesh in meshes.values()]
    starts = np.cumsum([0, *counts[:-1]], dtype=np.int32)
    return Mesh(
        crs=first.crs,
        origin=(east, north, datum),
        vertices=np.concatenate(
            [mesh.vertices + np.array([0.0, 0.0, mesh.origin[2] - datum]) for mesh in meshes.values()]
        ),
        faces=np.concatenate(
            [mesh.faces + start for mesh, start in zip(meshes.values(), starts, strict=True)]
        ),
        road=np.concatenate([mesh.road for mesh in meshes.values()]),
        level=np.repeat(np.array([*meshes], np.int8), [len(mesh.faces) for mesh in meshes.values()]),
    )


def highest_first(mesh: Mesh) -> NDArray[np.int32]:
    """Return the faces of a mesh, ``(F, 3)``, those of the highest level first.

    Where several faces are above a place, `tasks.metrics.mesh_distance` takes the height of the first.
    """
    return mesh.faces if mesh.level is None else mesh.faces[np.argsort(-mesh.level, kind="stable")]


def middles(points: Floats, faces: NDArray[np.int32]) -> Floats:
    """Return the centroids of faces in plan, ``(F, 2)``."""
    a, b, c = faces.T
    # Three short sums are several times faster than one of numpy over an axis of three.
    axes = np.ascontiguousarray(points[:, :2].T)
    return np.stack([(axis[a] + axis[b] + axis[c]) / 3.0 for axis in axes], axis=1)


def texture_coordinates(mesh: Mesh, bounds: Bounds) -> Floats:
    """Return the places of a mesh's vertices in an image seen from above, ``(V, 2)``.

    - `mesh`: with ``V`` vertices.
    - `bounds`: west, south, east and north of the image's outer edges (m).
    - result ``(V, 2)``: 0 to 1 from west to east, and from south to north.
    """
    west, south, east, north = bounds
    place = mesh.vertices[:, :2] + mesh.origin[:2]
    return np.asarray((place - (west, south)) / (east - west, north - south), np.float64)
