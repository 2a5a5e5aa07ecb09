"""The meshes of several tiles as one: vertices at the same place are one vertex."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np


class Union(NamedTuple):
    """A mesh with the number of faces at each of its edges."""

    vertices: np.ndarray
    faces: np.ndarray
    middles: np.ndarray
    """Easting and northing of the middle of each edge, ``(n, 2)``."""
    uses: np.ndarray
    """Number of faces at each edge, ``(n,)``: 1 at an open edge, 2 inside."""

    @classmethod
    def of(cls, parts: Iterable[tuple[np.ndarray, np.ndarray]]) -> "Union":
        """Return the union of meshes, each given by its vertices and faces."""
        vertices, faces, count = [], [], 0
        for points, triangles in parts:
            vertices.append(points)
            faces.append(triangles + count)
            count += len(points)
        unique, number = np.unique(np.concatenate(vertices), axis=0, return_inverse=True)
        joined = number.reshape(-1)[np.concatenate(faces)]
        pairs = np.sort(np.concatenate([joined[:, [0, 1]], joined[:, [1, 2]], joined[:, [2, 0]]]), axis=1)
        edges, uses = np.unique(pairs, axis=0, return_counts=True)
        return cls(unique, joined, unique[edges].mean(axis=1)[:, :2], uses)

    @property
    def inside(self) -> np.ndarray:
        """Edges that are not on the rim of the rectangle around the mesh, ``(n,)``."""
        low, high = self.vertices[:, :2].min(axis=0), self.vertices[:, :2].max(axis=0)
        return ~((self.middles == low) | (self.middles == high)).any(axis=1)

    @property
    def area(self) -> float:
        """Sum of the faces' areas in plan (m2)."""
        a, b, c = (self.vertices[self.faces[:, k], :2] for k in range(3))
        return float(((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum() / 2)
