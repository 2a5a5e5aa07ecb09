"""Triangle meshes: from a lattice of heights to a simplified mesh with floating fragments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.lazy import lazy
from flexroad.tasks.types import Bools, Floats

pv = lazy("pyvista")

Faces = NDArray[np.int32]
FRAGMENT_M = (0.4, 1.5)
"""Least and greatest radius of a floating fragment (m)."""
RIM = 7
"""Number of corners of a floating fragment."""


def lattice(eastings: Floats, northings: Floats, height: Floats, gap: Bools) -> tuple[Floats, Faces]:
    """Return vertices ``(V, 3)`` and faces ``(F, 3)``, two per quad, counter-clockwise from above.

    Parameters
    ----------
    eastings, northings : (W,) and (H,) array
        Coordinates of the nodes (m); northings descend.
    height, gap : (H, W) array
        Heights of the nodes (m), and nodes in gaps; quads with a node in a gap are left out.
    """
    x, y = np.meshgrid(eastings, northings)
    node = np.arange(height.size, dtype=np.int32).reshape(height.shape)
    nw, sw, se, ne = node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]
    quads = np.stack([nw, sw, se, nw, se, ne], axis=-1).reshape(-1, 2, 3)
    complete = ~gap.ravel()[quads].any(axis=(1, 2))
    return np.column_stack([x.ravel(), y.ravel(), height.ravel()]), quads[complete].reshape(-1, 3)


def simplified(vertices: Floats, faces: Faces, triangles: int) -> tuple[Floats, Faces]:
    """Return a mesh with about ``triangles`` triangles, large where the surface is flat.

    Edges are collapsed in the order of their error (quadrics), as in photogrammetry software. Coordinates
    should be small, because they are converted to float32.
    """
    mesh = pv.PolyData.from_regular_faces(vertices, faces).clean()
    if mesh.n_cells > triangles:
        mesh = mesh.decimate(1 - triangles / mesh.n_cells)
    return np.asarray(mesh.points, np.float64), mesh.regular_faces.astype(np.int32)


def fragments(centres: Floats, rng: np.random.Generator) -> tuple[Floats, Faces]:
    """Return small irregular pieces of surface around points ``(n, 3)``, facing up."""
    n = len(centres)
    radius = rng.uniform(*FRAGMENT_M, (n, 1)) * rng.uniform(0.6, 1.4, (n, RIM))
    turn = np.linspace(0, 2 * np.pi, RIM, endpoint=False) + rng.uniform(0, 2 * np.pi, (n, 1))
    tilt = rng.normal(0, 0.3, (n, 1, 2))
    out = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)
    rise = (out * tilt).sum(axis=-1) + rng.normal(0, 0.1, (n, RIM))
    rim = centres[:, None] + np.concatenate([out, rise[..., None]], axis=-1)
    vertices = np.concatenate([centres[:, None], rim], axis=1).reshape(-1, 3)
    corner = np.arange(RIM)
    fan = np.column_stack([np.zeros(RIM, np.int64), 1 + corner, 1 + (corner + 1) % RIM])
    faces = fan + (RIM + 1) * np.arange(n)[:, None, None]
    return vertices, faces.reshape(-1, 3).astype(np.int32)
