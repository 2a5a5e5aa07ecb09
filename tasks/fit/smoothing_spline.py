"""Fit a smoothing spline to road and terrain: step C in production.

The surface is the NURBS graph of `tasks.spline.surface` with unit weights. It minimises Huber's function of
the height differences plus the bending energy of a thin plate that is stiffer on roads than beside them. The
problem is convex; `tasks.spline.irls` solves it. docs/fit.md compares it with the paper's fit.

Control points lie on the lattice of `tasks.spline.space`, which all tiles share. Points that act on a corner
of the tile are fitted first, then points on its edges. Both are fitted to the ground around, without regard
to the tile (`corner` and `edge`). `fit` keeps them fixed, and fits the points inside to the tile's own cells.
So two neighbours have one surface, although no tile waits for another (docs/mosaic.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
import shapely
from pydantic import Field

from flexroad.catalog.borders import Border
from flexroad.tasks.levels.seen import level_data, level_road
from flexroad.tasks.meshing.road_outline import crossings
from flexroad.tasks.options import Options as BaseOptions
from flexroad.tasks.roads.distances import distances
from flexroad.tasks.roads.dtm_validity import Slices, ground_to_fit, valid_dtm
from flexroad.tasks.roads.road_height import with_road_heights
from flexroad.tasks.spline.frame import Corner, Edge, Frame, rounded
from flexroad.tasks.spline.irls import HuberObjective, minimise
from flexroad.tasks.spline.levelled import LevelledSurface
from flexroad.tasks.spline.objective import objective
from flexroad.tasks.spline.space import Lattice, Range, Space, check_cells, start_heights, surface_on
from flexroad.tasks.spline.stencil import bending_energy
from flexroad.tasks.spline.stepped import border_steps, spline_around, with_steps
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Bools, Floats, Level, LevelSpline, RoadClusters, RoadMask, TileData

VERSION = 8

REACHES_M = (25.0, 50.0, 100.0)
"""Distances from a corner or edge up to which its control points are fitted (m): the first sufficient
distance is used, else all the ground around."""
BEYOND_DATA_M = 15.0
"""A distance is sufficient if it exceeds the distance of the farthest needed ground by at least this (m)."""
NEAR_M = 25.0
"""A corner or edge has control points of the levels within this distance (m)."""
ON_ABUTMENT_M = 0.05
"""Crossings of a level's outline within this distance of its abutments (m) are crossings of abutments."""
TOLERANCE, BORDER_TOLERANCE = 1e-4, 1e-6
"""The fit of a tile, and of a corner or edge, ends when the loss falls by less than this share in a step.
Corners and edges are small, and in a void the loss changes little."""
ITERATIONS = 200
"""Largest number of steps; a fit takes 5 to 12."""
TERRAIN_BENDING = 0.02
"""Weight of the terrain's squared curvature, as a share of the road's: banks beside roads stay steep."""


class Options(BaseOptions):
    """Stiffness of the surface and weights of its data; the defaults are production's (docs/fit.md)."""

    method: Literal["smoothing_spline"] = "smoothing_spline"
    degree: int = Field(3, ge=2, le=10, description="degree of the basis along easting and northing")
    spacing_m: float = Field(
        3.6, gt=0, description="largest distance of control points (m); a tile is a whole number of distances"
    )
    lambda_terrain: float = Field(0.3, ge=0, description="weight of the terrain's height differences")
    huber_m: float = Field(
        0.1, ge=0, description="smaller differences (m) are squared, larger differences are linear; 0 is L1"
    )
    bending_m3: float = Field(30.0, gt=0, description="weight of the road's squared curvature (m3)")
    steps: bool = Field(
        True, description="give the cells beside roads a step above the spline: kerbs, walls and banks"
    )


def fit(data: TileData, clusters: RoadClusters, options: Options, frame: Frame | None = None) -> NurbsSurface:
    """Fit the surface to the DSM on filtered road cells and to the valid DTM elsewhere, on the tile's core.

    Parameters
    ----------
    frame : Frame, optional
        Fixed control points on the tile's border; None fits all points to the tile alone.

    Raises
    ------
    TaskError
        If there are fewer cells with a height than control points, or if neither the DTM nor the road has a
        height to start from.
    """
    seen = level_data(data, clusters)
    surface = _spline(seen, clusters, options, frame)
    if clusters.levels:
        surface = LevelledSurface.of(surface, _level_splines(data, clusters, options, frame), data.core)
    return with_steps(seen, clusters, surface, frame) if options.steps else surface


def _level_splines(
    data: TileData, clusters: RoadClusters, options: Options, frame: Frame | None
) -> tuple[LevelSpline, ...]:
    """Return the splines of the levels other than 0."""
    splines = []
    for own in clusters.levels:
        assert own.level
        number = own.level.number
        held = frame.at(number) if frame else None
        spline = _spline(level_data(data, clusters, number), own, options, held)
        splines.append(LevelSpline(own.level, spline.A))
    return tuple(splines)


def _spline(data: TileData, clusters: RoadClusters, options: Options, frame: Frame | None) -> NurbsSurface:
    """Return the spline of one level over the tile's core."""
    fitted, core = with_road_heights(data, clusters), data.core
    rows, cols = data.grid.window(core)
    lattice = _lattice((core.width, core.height), core.cell, options)
    n, m = lattice.intervals
    shape = m + options.degree, n + options.degree
    if clusters.level is None:
        check_cells(ground_to_fit(fitted, clusters, (rows, cols)), (shape[1], shape[0]))
    held = frame.control(shape) if frame else np.full(shape, np.nan)
    start = rows.stop, cols.start
    space, z = _fitted(fitted, clusters, lattice, start, (0, n), (0, m), held, options, TOLERANCE)
    # Heights are relative to sea level. With a datum for each tile, sums would differ in the last digits.
    return surface_on(space, core, core.exact_bounds, z, np.ones_like(z), datum=0.0)


def acting_m(options: Options) -> float:
    """Return the distance (m) beyond which no control point of a corner or edge acts."""
    return options.degree * options.spacing_m


def near(border: Border, options: Options) -> Slices:
    """Return the cells that the fit of a corner or edge uses, if no ground is missing there."""
    lattice = _lattice(border.tile, border.grid.cell, options)
    reach_m = max(np.multiply(lattice.lines_within(REACHES_M[0]), lattice.unit_m))
    return border.strip(math.ceil(reach_m / border.grid.cell) + 1)[0]


def is_near(data: TileData, clusters: RoadClusters, border: Border, options: Options) -> bool:
    """Return whether the fit of a corner or edge uses only the cells of `near`; parameters as in `corner`."""
    lattice = _lattice(border.tile, border.grid.cell, options)
    nearest = lattice.lines_within(REACHES_M[0])
    levels = [clusters, *(of_level for _, of_level in _near(clusters, border))]
    return all(
        _lines(level_data(data, clusters, own.number), own, border, lattice) == nearest for own in levels
    )


def corner(
    data: TileData, road: RoadMask, clusters: RoadClusters, border: Border, options: Options
) -> Corner:
    """Fit the control points that act on a corner of tiles to the ground around it.

    Parameters
    ----------
    data, road, clusters : TileData, RoadMask, RoadClusters
        The cells of ``border.grid``, their road mask and the filtered road.
    """
    own = _corner(level_data(data, clusters), road, clusters, border, options)
    levels = []
    for level, of_level in _near(clusters, border):
        part = _corner(level_data(data, clusters, level.number), road, of_level, border, options)
        if np.isfinite(part.control).all():
            levels.append((level.number, part))
    return replace(own, levels=tuple(levels))


def _corner(
    data: TileData, road: RoadMask, clusters: RoadClusters, border: Border, options: Options
) -> Corner:
    """Return the corner of one level."""
    data = with_road_heights(data, clusters)
    lattice, p = _lattice(border.tile, border.grid.cell, options), options.degree
    k, j = _lines(data, clusters, border, lattice)
    held = np.full((2 * j + p, 2 * k + p), np.nan)
    _, z = _fitted(data, clusters, lattice, border.cell, (-k, k), (-j, j), held, options)
    row, col = border.cell
    around = road.outside[row - 1 : row + 1, col - 1 : col + 1]
    return Corner(rounded(z[j : j + p, k : k + p]), around)


def edge(
    data: TileData,
    road: RoadMask,
    clusters: RoadClusters,
    border: Border,
    ends: tuple[Corner, Corner],
    options: Options,
) -> Edge:
    """Fit the control points that act on an edge, but on none of its corners, and find the steps on it.

    Parameters
    ----------
    data, road, clusters : TileData, RoadMask, RoadClusters
        The cells of ``border.grid``, their road mask and the filtered road.
    ends : tuple of Corner
        The corners at the western and eastern, or the southern and northern end; their points stay fixed.
    """
    seen, near = level_data(data, clusters), list(_near(clusters, border))
    heights = [level_data(data, clusters, level.number) for level, _ in near]
    lattice = _lattice(border.tile, border.grid.cell, options)
    # The splines of all levels use the same part of the lattice.
    lines = [_lines(seen, clusters, border, lattice)]
    lines += [_lines(part, own, border, lattice) for part, (_, own) in zip(heights, near, strict=True)]
    reach = max(k for k, _ in lines), max(j for _, j in lines)
    control, spline = _along(seen, clusters, border, reach, ends, options)
    outside = border.along(road.outside)
    first, last = (end.outside for end in ends)
    outside[:, 0], outside[:, -1] = (
        (first[:, 1], last[:, 0]) if border.kind == "east" else (first[0], last[1])
    )
    own = Edge(
        control,
        road=border.along(road.mask)[1],
        kept=border.along(clusters.mask)[1],
        outside=outside,
        crossings=crossings(road.areas, border),
    )
    splines = []
    for (level, of_level), part_of in zip(near, heights, strict=True):
        held = ends[0].at(level.number), ends[1].at(level.number)
        control, around = _along(part_of, of_level, border, reach, held, options)
        if np.isfinite(control).all():
            splines.append(LevelSpline(level, around.A))
            mine = level_road(road, level.number)
            part = replace(
                own,
                control=control,
                road=border.along(mine.mask)[1],
                kept=border.along(mine.mask & of_level.mask)[1],
                crossings=crossings(mine.areas, border),
                levels=(),
            )
            on_abutments = part.crossings[_on_abutments(level, part.crossings, border)]
            own = replace(
                own,
                crossings=np.union1d(own.crossings, on_abutments),
                levels=(*own.levels, (level.number, part)),
            )
    if splines:
        spline = LevelledSurface.of(spline, tuple(splines), border.grid)
    beside = border_steps(seen, road, clusters, border, spline) if options.steps else {}
    return replace(own, steps=beside.get("steps"), road_m=beside.get("road_m"))


def _along(
    data: TileData,
    clusters: RoadClusters,
    border: Border,
    reach: tuple[int, int],
    ends: tuple[Corner, Corner],
    options: Options,
) -> tuple[Floats, NurbsSurface]:
    """Return the control points of an edge for one level, and the spline around the edge.

    - `reach`: number of intervals around the edge that are fitted, along easting and northing.
    """
    fitted, (k, j) = with_road_heights(data, clusters), reach
    lattice, p = _lattice(border.tile, border.grid.cell, options), options.degree
    eastward = border.kind == "east"
    n, m = (lattice.intervals[0], 0) if eastward else (0, lattice.intervals[1])
    held = np.full((m + 2 * j + p, n + 2 * k + p), np.nan)
    acting = slice(j, j + m + p), slice(k, k + n + p)
    held[acting][:p, :p], held[acting][-p:, -p:] = (end.control for end in ends)
    u, v = (-k, n + k), (-j, m + j)
    _, around = _fitted(fitted, clusters, lattice, border.cell, u, v, held, options)
    z = rounded(around[acting])
    return z[:, p:-p] if eastward else z[p:-p], spline_around(lattice, border, u, v, around)


def _near(clusters: RoadClusters, border: Border) -> Iterator[tuple[Level, RoadClusters]]:
    """Yield the levels near a corner or edge, with their clusters."""
    here = shapely.box(*border.within(NEAR_M))
    for own in clusters.levels:
        level = own.level
        if level and (shapely.intersects(level.areas, here) or shapely.intersects(level.approach, here)):
            yield level, own


def _on_abutments(level: Level, positions: Floats, border: Border) -> Bools:
    """Return which positions on an edge (m from its start) lie on the abutments of a level."""
    (east, north), along = border.start, positions
    places = (east + along, north + 0 * along) if border.kind == "east" else (east + 0 * along, north + along)
    return np.asarray(shapely.dwithin(level.abutments, shapely.points(*places), ON_ABUTMENT_M))


def _lattice(cells: tuple[int, int], cell: float, options: Options) -> Lattice:
    return Lattice.of(cells, cell, options.degree, options.spacing_m)


def _lines(data: TileData, clusters: RoadClusters, border: Border, lattice: Lattice) -> tuple[int, int]:
    """Return the number of intervals up to which a corner or edge is fitted, along easting and northing."""
    cell = data.grid.cell
    for lines in map(lattice.lines_within, REACHES_M):
        reach_m = min(np.multiply(lines, lattice.unit_m))
        # Ground outside the strip is farther away than this distance.
        window, strip = border.strip(max(math.ceil((reach_m - BEYOND_DATA_M) / cell), 0) + 1)
        missing = np.isnan(ground_to_fit(data, clusters, window))
        along = np.zeros_like(missing)
        for side in strip.sides:
            along[side] = missing[side]
        farthest = float(distances(along, ~missing).max(initial=0.0))
        if reach_m >= BEYOND_DATA_M + farthest * cell:
            return lines
    return lattice.lines_over((border.cell[1] - 0.5) * cell)


def _fitted(
    data: TileData, clusters: RoadClusters, lattice: Lattice, start: tuple[int, int], u: Range, v: Range,
    held: Floats, options: Options, tolerance: float = BORDER_TOLERANCE,
) -> tuple[Space, Floats]:  # fmt: skip
    """Return the splines over a part of the lattice, and their control heights (m), fitted to its cells.

    Points with a finite height in ``held`` keep it. The other points are NaN if no cell has a height.
    """
    space, window = lattice.part(data.grid.shape, start, u, v)
    dsm, road, dtm = data.dsm[window], clusters.labels[window] > 0, valid_dtm(data, clusters, window)
    ground = np.where(road, dsm, dtm)
    if np.isnan(ground).all():
        # At a corner or edge without ground, tiles that bridge it must still share the same points.
        dtm = ground = dsm
    if np.isnan(ground).all():
        return space, held
    first, datum = start_heights(dsm, dtm, road, space)
    is_held = np.isfinite(held)
    first = np.where(is_held, held, first) - datum
    stiffness = options.bending_m3 * np.where(road, 1.0, TERRAIN_BENDING)
    weight = np.where(road, 1.0, options.lambda_terrain)
    z = _minimum(space, ground - datum, weight, stiffness, first, is_held, options.huber_m, tolerance)
    return space, np.where(is_held, held, z + datum)


def _minimum(
    space: Space, heights: Floats, weight: Floats, stiffness: Floats, first: Floats, held: Bools,
    huber_m: float, tolerance: float,
) -> Floats:  # fmt: skip
    """Return the control heights above the datum, ``(m, n)``, that minimise the loss over a raster."""
    # The bending energy is divided by the number of cells with a height, like the differences, so that voids
    # do not change the balance.
    bending = bending_energy(stiffness / np.count_nonzero(np.isfinite(heights)), space)
    loss = HuberObjective(objective(heights, weight, space), held, bending, huber_m)
    return minimise(loss, first, ITERATIONS, tolerance)[0]
