"""The limit of the survey as lines: meshes end there, and not at the next vertex of a coarse lattice.

The lines run half-way between the centres of cells with data and of cells beyond the survey ("marching
squares"). They are simplified by less than the distance to any centre. So every centre with data stays
inside, every other centre outside, and the lines follow the limit to within a cell.

The edges of kerbs and walls are found in the same way. Each edge is two lines side by side, one per height.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
import shapely

from flexroad.catalog.grid import Bounds
from flexroad.catalog.lazy import lazy
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.types import Bools, Floats

rasterio = lazy("rasterio")

TOLERANCE = 0.3
"""Largest distance by which the lines are simplified (cells): centres are at least 0.35 cells away."""
LEAST_M = 0.08
"""Smaller steps have no line (m): they are within the noise of a surface model."""
CELLS = 10
"""Connected steps of fewer cells have no line: they are noise, or single objects."""
APART = 0.2
"""Distance of the two lines of an edge (cells)."""


@dataclass(frozen=True, eq=False)
class SurveyLimit:
    """The limit of the survey on a tile."""

    lines: shapely.MultiLineString
    """Lines through the tile, each closed or from border to border."""
    covered: shapely.MultiPolygon
    """The part of the tile that the survey covers."""

    def covers(self, points: Floats) -> Bools:
        """Return which points, ``(n, 2 or more)``, the survey covers, ``(n,)``."""
        shapely.prepare(self.covered)
        return np.asarray(shapely.intersects_xy(self.covered, points[:, 0], points[:, 1]))


def survey_limit(outside: Bools, corner: tuple[float, float], cell: float, within: Bounds) -> SurveyLimit:
    """Return the limit of the survey on a tile.

    - `outside` ``(H, W)``: the tile's cells beyond the survey, without halo; row 0 in the north.
    - `corner`: X and y of the north-western corner of the cells (m).
    - `cell`: cell size (m).
    - `within`: west, south, east and north of the area to be meshed (m): the cells or the hull of their
      centres.
    """
    if outside.all():
        return SurveyLimit(shapely.MultiLineString(), shapely.MultiPolygon())
    west, south, east, north = within
    low = np.array([west - corner[0], corner[1] - north]) / cell
    high = np.array([east - corner[0], corner[1] - south]) / cell
    steps = np.clip(_steps(outside), low, high)
    steps = steps[(steps[:, 0] != steps[:, 1]).any(axis=1)]
    merged = shapely.line_merge(shapely.multilinestrings(shapely.linestrings(steps)))
    lines = shapely.simplify(shapely.multilinestrings(shapely.get_parts(merged)), TOLERANCE)
    covered = _covered(lines, shapely.box(*low, *high), outside)

    def placed(points: Floats) -> Floats:
        return np.asarray(np.array(corner) + points * [cell, -cell])

    return SurveyLimit(shapely.transform(lines, placed), shapely.transform(covered, placed))


def _steps(outside: Bools) -> Floats:
    """Return the segments of the limit, ``(n, 2, 2)``: ends as (column, row) of cell corners.

    Each square between four cell centres has up to two segments, from side to side. Beyond the tile, cells
    repeat the cells at its border, so that the limit meets the border at the corner of a cell.
    """
    padded = np.pad(outside, 1, mode="edge")
    north_west, north_east = padded[:-1, :-1], padded[:-1, 1:]
    south_west, south_east = padded[1:, :-1], padded[1:, 1:]
    row, col = np.indices(north_west.shape, dtype=np.float64)
    shifts = {"west": (-0.5, 0.0), "east": (0.5, 0.0), "north": (0.0, -0.5), "south": (0.0, 0.5)}
    middle = {side: np.stack([col + x, row + y], axis=-1) for side, (x, y) in shifts.items()}
    passed = {
        "west": north_west != south_west,
        "east": north_east != south_east,
        "north": north_west != north_east,
        "south": south_west != south_east,
    }
    crossed = passed["west"] & passed["east"] & passed["north"] & passed["south"]
    # Cells with data that touch at a corner are joined; cells beyond the survey are not.
    cuts = {
        ("west", "east"): passed["west"] & passed["east"] & ~crossed,
        ("north", "south"): passed["north"] & passed["south"] & ~crossed,
        ("north", "west"): (passed["north"] & passed["west"] & ~crossed) | (crossed & north_west),
        ("south", "east"): (passed["south"] & passed["east"] & ~crossed) | (crossed & north_west),
        ("north", "east"): (passed["north"] & passed["east"] & ~crossed) | (crossed & ~north_west),
        ("south", "west"): (passed["south"] & passed["west"] & ~crossed) | (crossed & ~north_west),
    }
    parts = [np.stack([middle[a][at], middle[b][at]], axis=1) for (a, b), at in cuts.items()]
    return np.concatenate(parts)


def _covered(lines: shapely.MultiLineString, area: shapely.Polygon, outside: Bools) -> shapely.MultiPolygon:
    """Return the parts of an area, divided by the lines, whose cells have data, in columns and rows."""
    network = shapely.union_all([lines, shapely.boundary(area)])
    parts = shapely.get_parts(shapely.polygonize(shapely.get_parts(network)))
    number = rasterio.features.rasterize(
        list(zip(parts, range(1, len(parts) + 1), strict=True)),
        out_shape=outside.shape, transform=rasterio.transform.Affine.identity(), dtype=np.int32,
    )  # fmt: skip
    cells = np.bincount(number.ravel(), minlength=len(parts) + 1)
    beyond = np.bincount(number.ravel(), outside.ravel(), len(parts) + 1)
    return shapely.MultiPolygon(list(parts[(2 * beyond < cells)[1:]]))


def breaklines(
    surface: SteppedSurface, local: Bounds
) -> tuple[shapely.MultiLineString, Callable[[Floats], Floats]]:
    """Return the edges of the steps of a surface, and a function from points, ``(n, 2)``, to heights (m).

    The height depends on the side of the lines on which a point lies.

    - `local`: west, south, east and north of the tile, from the origin of its cells (m).
    """
    cells = surface.cells
    # The median does not move straight edges. Noise of single cells would break lines into pieces.
    large = np.abs(scipy.ndimage.median_filter(surface.steps, 3)) >= LEAST_M
    # Lines end before the border of the tile, because the neighbour's lines may not meet them there.
    large[[0, -1]], large[:, [0, -1]] = False, False
    parts, _ = scipy.ndimage.label(large)
    size = np.bincount(parts.ravel())
    high = large & (size[parts] >= CELLS)
    corner = cells.west - cells.origin[0], cells.north - cells.origin[1]
    level = survey_limit(high, corner, cells.cell, local)
    edges = shapely.get_parts(level.lines)
    sides = [shapely.offset_curve(edges, side * APART / 2 * cells.cell) for side in (-1, 1)]
    lines = shapely.get_parts(np.concatenate(sides)) if len(edges) else edges
    nearest = surface.steps
    if high.any():
        at = scipy.ndimage.distance_transform_edt(~high, return_distances=False, return_indices=True)
        nearest = surface.steps[tuple(at)]

    def height(points: Floats) -> Floats:
        place = (points + cells.origin).T
        step = nearest[cells.cells(*place)]
        return np.asarray(surface.smooth(*place) + np.where(level.covers(points), 0.0, step))

    return shapely.multilinestrings(lines), height
