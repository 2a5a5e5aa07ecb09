"""Distance of a mesh from the surface that it samples: what step D of the paper, the sampling, costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flexroad.tasks.metrics.vertical_distance import drape
from flexroad.tasks.spline.moving import MovingNurbs
from flexroad.tasks.types import Floats, Mesh, RoadMask, Surface

OFF_CENTRE = 0.25
"""Distance of the places from the centre of their cell, to the east and to the north (cells). Meshes have
vertices at centres and corners of cells and half-way between, where they meet the surface by construction."""
FIGURES = ("mesh_p95_road_m", "mesh_max_road_m", "mesh_p95_terrain_m", "mesh_max_terrain_m")
"""Names of the distances in `Metrics`."""


def mesh_distances(mesh: Mesh, surface: Surface, road: RoadMask) -> dict[str, float]:
    """Return the vertical distances of a mesh from its surface, steps included, by the names `FIGURES` (m).

    - `road`: its raw mask classes the places, one in each cell of the core.
    - result: 95th percentile and largest distance per class; NaN for a class without a place on the mesh, and
      for a surface whose heights are not above their places (`MovingNurbs`).
    """
    if isinstance(surface, MovingNurbs):
        return dict.fromkeys(FIGURES, float("nan"))
    core = road.core
    shift = OFF_CENTRE * core.cell
    places = replace(core, west=core.west + shift, north=core.north + shift)
    heights = surface.lattice(places.eastings, places.northings) - mesh.origin[2]
    distances = np.abs(drape(mesh, places) - heights)
    is_road, known = road.mask[road.grid.window(core)], np.isfinite(distances)
    parts = (distances[known & cells] for cells in (is_road, ~is_road))
    return dict(zip(FIGURES, (figure for part in parts for figure in _p95_max(part)), strict=True))


def _p95_max(distances: Floats) -> tuple[float, float]:
    if not distances.size:
        return float("nan"), float("nan")
    return float(np.percentile(distances, 95)), float(distances.max())
