"""Smoothness of a mesh: the mean angle between neighbouring faces (Eq. mad)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats, Mesh

Indices = NDArray[np.int32]


def mean_angles(mesh: Mesh) -> Floats:
    """Return each face's mean angle to the faces that share an edge with it, ``(F,)``, 0 to 90 degrees.

    The paper averages over three neighbours; a face at the border has fewer. NaN without a neighbour.
    """
    totals, counts = np.zeros(len(mesh.faces)), np.zeros(len(mesh.faces))
    start, far, owner = edges(mesh.faces, len(mesh.vertices))
    _add_angles(_normals(mesh.vertices, mesh.faces), start, far, owner, totals, counts)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.degrees(totals / counts))


@compiled()
def _normals(vertices: Floats, faces: Indices) -> Floats:
    """Return a normal per face, ``(F, 3)``; its length is twice the face's area."""
    normals = np.empty((faces.shape[0], 3))
    for f in range(faces.shape[0]):
        ax, ay, az = vertices[faces[f, 0]]
        bx, by, bz = vertices[faces[f, 1]]
        cx, cy, cz = vertices[faces[f, 2]]
        ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        normals[f, 0], normals[f, 1], normals[f, 2] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return normals


@compiled()
def edges(faces: Indices, vertices: int) -> tuple[Indices, Indices, Indices]:
    """Return the faces' edges sorted by their lower vertex.

    The edges of vertex v are ``start[v]`` to ``start[v + 1]`` (exclusive). For each edge, ``far`` is its
    higher vertex and ``owner`` its face.
    """
    start = np.zeros(vertices + 1, np.int32)
    for f in range(faces.shape[0]):
        for k in range(3):
            start[min(faces[f, k], faces[f, k - 1]) + 1] += 1
    start = np.cumsum(start).astype(np.int32)
    fill = start[:-1].copy()
    far, owner = np.empty(faces.size, np.int32), np.empty(faces.size, np.int32)
    for f in range(faces.shape[0]):
        for k in range(3):
            near = min(faces[f, k], faces[f, k - 1])
            far[fill[near]] = max(faces[f, k], faces[f, k - 1])
            owner[fill[near]] = f
            fill[near] += 1
    return start, far, owner


@compiled()
def _add_angles(
    normals: Floats, start: Indices, far: Indices, owner: Indices, totals: Floats, counts: Floats
) -> None:
    """Add the angle across every shared edge (radians) to both of its faces."""
    for v in range(start.size - 1):
        for i in range(start[v], start[v + 1]):
            for j in range(i + 1, start[v + 1]):
                if far[i] != far[j]:
                    continue
                nx, ny, nz = normals[owner[i]]
                mx, my, mz = normals[owner[j]]
                cross = math.sqrt(
                    (ny * mz - nz * my) ** 2 + (nz * mx - nx * mz) ** 2 + (nx * my - ny * mx) ** 2
                )
                # The arccos of the paper's formula loses half the digits if faces are nearly parallel.
                angle = math.atan2(cross, abs(nx * mx + ny * my + nz * mz))
                for f in (owner[i], owner[j]):
                    totals[f] += angle
                    counts[f] += 1
