"""The outline of roads from vectors as lines, so that roads end in the mesh where they end in the vectors.

Coordinates are metres from the whole-metre origin of a grid (`Grid.origin`). Before the areas are united,
points are moved to multiples of `GRID_M`, which are the same for all tiles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.borders import Border
from flexroad.catalog.grid import Bounds, Grid
from flexroad.tasks.io.vectors import has_place
from flexroad.tasks.meshing.lines import GRID_M
from flexroad.tasks.types import Floats

TOLERANCE_M = 0.01
"""Largest distance by which an outline is simplified (m)."""
GAP_M = 0.02
"""Gaps between roads up to this width (m) are closed: drawn neighbours often miss each other."""
MARGIN_M = 1.0
"""Distance beyond a grid up to which its roads are kept (m)."""


def encoded(areas: NDArray[np.object_], core: Grid) -> NDArray[np.uint8] | None:
    """Return the union of roads on a grid as WKB, None if no road reaches the grid; gaps are closed.

    - `areas`: in the CRS of the grid.
    """
    west, south, east, north = core.bounds
    within = shapely.box(west - MARGIN_M, south - MARGIN_M, east + MARGIN_M, north + MARGIN_M)
    near = areas[~shapely.is_empty(areas) & has_place(areas)]
    valid = polygons_of(np.where(shapely.is_valid(near), near, shapely.make_valid(near)))
    valid = valid[shapely.intersects(valid, within)]
    cut = shapely.transform(shapely.intersection(valid, within), lambda points: points - core.origin)
    united = shapely.union_all(shapely.set_precision(polygons_of(cut), GRID_M), grid_size=GRID_M)
    polygons = polygons_of(shapely.union(united, _closed(united), grid_size=GRID_M))
    if not len(polygons):
        return None
    return np.frombuffer(shapely.to_wkb(shapely.multipolygons(polygons)), np.uint8)


def road_outline(
    areas: NDArray[np.uint8], local: Bounds, spacing_m: float
) -> tuple[shapely.MultiPolygon, NDArray[np.object_]]:
    """Return roads as areas, and their outline on a tile: lines, each closed or from border to border.

    - `areas`: the result of `encoded`.
    - `local`: west, south, east and north of the tile (m).
    - `spacing_m`: largest distance of the points of lines (m).
    """
    united = shapely.from_wkb(areas.tobytes())
    shapely.prepare(united)
    inside = shapely.intersection(shapely.boundary(united), shapely.box(*local))
    parts = shapely.get_parts(shapely.line_merge(lines_of(inside)))
    simple = shapely.simplify(shapely.multilinestrings(parts), TOLERANCE_M)
    return united, shapely.get_parts(shapely.segmentize(simple, spacing_m))


def crossings(areas: NDArray[np.uint8] | None, border: Border) -> Floats:
    """Return where an edge crosses the outline of roads, in metres from its start, ascending, ``(n,)``.

    - `areas`: the result of `encoded` for ``border.grid``.
    """
    if areas is None:
        return np.empty(0)
    west, south, east, north = border.within(0.0)
    ends = np.array([[west, south], [east, north]]) - border.grid.origin
    met = shapely.intersection(shapely.boundary(shapely.from_wkb(areas.tobytes())), shapely.linestrings(ends))
    distances = (shapely.get_coordinates(met) - ends[0]).sum(axis=1)
    return np.unique(np.round(distances / GRID_M) * GRID_M)


def _closed(areas: shapely.Geometry) -> shapely.Geometry:
    """Return areas with closed gaps; narrow tips may be lost."""
    # GEOS buffers areas of a fixed precision on their grid, and so fills large holes.
    areas = shapely.set_precision(areas, 0)
    wider = shapely.buffer(areas, GAP_M / 2, join_style="mitre")
    closed = shapely.buffer(wider, -GAP_M / 2, join_style="mitre")
    # GEOS rarely returns a mitred outline that crosses itself, which it then refuses to unite.
    return closed if shapely.is_valid(closed) else shapely.union_all(polygons_of(shapely.make_valid(closed)))


def polygons_of(geometries: Any) -> NDArray[np.object_]:
    """Return the polygons in geometries of any kind."""
    parts = shapely.get_parts(shapely.get_parts(geometries))
    return np.asarray(parts[(shapely.get_type_id(parts) == 3) & ~shapely.is_empty(parts)])


def lines_of(geometry: shapely.Geometry) -> shapely.MultiLineString:
    """Return the lines of a geometry that may have points as well."""
    parts = shapely.get_parts(shapely.get_parts(geometry))
    return shapely.multilinestrings(parts[shapely.get_type_id(parts) == 1])
