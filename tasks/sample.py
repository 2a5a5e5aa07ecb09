"""Sample the surface to a mesh: the paper's step D, "Dynamic Surface Sampling".

dynamic: points at ``road_m`` on the road and at ``terrain_m`` elsewhere, joined by Delaunay triangulation;
uniform: a regular grid of triangles (RGT); corners: the two triangles of a plane.

The lattices are anchored at the south-west corner of the domain. The domain is the hull of the core's cell
centres if the tile has neither frame nor halo. Otherwise it is the core's bounds, so that neighbouring tiles
meet. With a frame, neighbours have the same points and heights on the border: the meshes join without a gap.

A dynamic mesh has edges along the limit of the survey and ends there (`tasks.meshing.survey_limit`). If the
roads are polygons, it has edges along their outlines, too (`tasks.meshing.road_outline`).

With levels, dynamic meshes have one part per level, which share no vertex. A deck or tunnel ends at its
outline, and meets level 0 on its abutments (`tasks.meshing.abutment_lines`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flexroad.catalog.grid import Bounds
from flexroad.tasks import options as base
from flexroad.tasks.errors import TaskError
from flexroad.tasks.meshing.abutment_lines import (
    LevelOutline,
    level_outline,
    with_abutments,
    without_abutments,
)
from flexroad.tasks.meshing.lines import (
    DECIMALS,
    apart_from,
    axis,
    divided,
    ends_at_border,
    middles,
    parts_of,
    points_and_segments,
    without_duplicates,
)
from flexroad.tasks.meshing.road_outline import road_outline
from flexroad.tasks.meshing.survey_limit import SurveyLimit, breaklines, survey_limit
from flexroad.tasks.meshing.triangulate import Faces, constrained, delaunay
from flexroad.tasks.spline.frame import (
    NUDGE,
    SAME_M,
    Frame,
    border_heights,
    border_points,
    joined,
    on_border,
)
from flexroad.tasks.spline.moving import MovingNurbs
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.types import Bools, Floats, HeightAt, Mesh, RoadClusters, RoadMask, Surface

VERSION = 5

SMOOTH_M = 1.5
"""Distance from the road up to which a mesh without breaklines has no steps (m): faces between road and
terrain would be steep, and faces on the road's edge are taken as road."""
FEW = 0.1
"""Smallest share of points on a lattice for which the search for its squares saves time."""


class Options(base.Options):
    """Method, spacing and mask of the sampling."""

    method: Literal["dynamic", "uniform", "corners"] = Field(
        "dynamic",
        description="dynamic: fine on roads, coarse elsewhere; uniform: road_m everywhere; corners: a plane",
    )
    road_m: float = Field(1.0, ge=0.05, description="spacing of samples on roads, the paper's s^r (m)")
    terrain_m: float = Field(10.0, ge=0.05, description="spacing of samples elsewhere, the paper's s^t (m)")
    mask: Literal["raw", "filtered"] = Field(
        "raw",
        description="road mask for sampling: raw: as segmented, M^r; filtered: as kept by ECSRC, M^{r+}",
    )
    breaklines: bool = Field(
        False,
        description="dynamic: edges along the kerbs and walls of fit.steps; else the mesh is smooth there",
    )

    @model_validator(mode="after")
    def _only_dynamic_has_breaklines(self) -> Options:
        if self.breaklines and self.method != "dynamic":
            raise ValueError(f"method {self.method} has no breaklines; choose method dynamic")
        return self


def sample(
    surface: Surface,
    road: RoadMask,
    clusters: RoadClusters,
    options: Options,
    frame: Frame | None = None,
) -> Mesh:
    """Sample the surface over the tile's core and join the samples to triangles.

    Parameters
    ----------
    road : RoadMask
        Gives the grids, the raw mask and the cells beyond the survey, where the mesh ends.
    clusters : RoadClusters
        Gives the filtered mask.
    frame : Frame, optional
        The parts that the tile shares with its neighbours; None if its surface was fitted without them.

    Returns
    -------
    Mesh
        Faces are counter-clockwise from above. The mesh covers the domain except where the surface has no
        height and, unless ``corners``, beyond the survey. Equal inputs give equal meshes.

    Raises
    ------
    TaskError
        If the core is a single row or column of cells without halo, or if no face is left.
    """
    mask = road.mask if options.mask == "raw" else clusters.mask
    origin = road.core.origin
    west, south, east, north = _domain(road, frame)
    local = west - origin[0], south - origin[1], east - origin[0], north - origin[1]
    if frame:
        # Subtraction leaves rounding errors if the size of the tile is not a whole number of metres.
        west, south, east, north = (round(edge, DECIMALS) for edge in local)
        local = west, south, east, north
    if isinstance(surface, SteppedSurface) and not options.breaklines:
        on_road = road.mask[road.grid.window(road.core)]
        surface = surface.without_steps_near(on_road, SMOOTH_M, frame)
    if options.method == "dynamic":
        return _levels(surface, road, mask, local, options, frame)
    step = options.road_m if options.method == "uniform" else np.inf
    points, faces = _regular(surface, origin, local, step, frame)
    if isinstance(surface, MovingNurbs):
        points, _ = without_duplicates(_in_space(points, surface, origin))
        faces = delaunay(points)
    inside = np.ones(len(faces), np.bool_)
    if options.method == "uniform":
        inside = ~road.outside[road.grid.cells(*(middles(points, faces) + origin).T)]
        if frame:
            inside |= joined(points, faces, frame, local, road.core.cell)
    return _mesh(points, faces[inside], road, mask)


def _domain(road: RoadMask, frame: Frame | None) -> Bounds:
    """Return west, south, east and north of the area to be meshed (m)."""
    if frame:
        return road.core.exact_bounds
    if road.core != road.grid:
        return road.core.bounds
    if min(road.core.shape) < 2:
        raise TaskError(
            f"the centres of {road.core.width} x {road.core.height} cells span no area; "
            "use larger tiles, or load.halo_m above 0"
        )
    return road.core.hull


def _regular(
    surface: Surface, origin: tuple[float, float], local: Bounds, step: float, frame: Frame | None
) -> tuple[Floats, NDArray[np.int32]]:
    """Return points of a full lattice and two faces per quad, cut from south-west to north-east."""
    west, south, east, north = local
    x, y = axis(west, east, step, to_end=True), axis(south, north, step, to_end=True)
    z = surface.lattice(x + origin[0], y + origin[1])
    points = np.stack([*np.broadcast_arrays(x, y[:, None]), z], axis=-1).reshape(-1, 3)
    if frame:
        border = on_border(points, local)
        easting, northing = (points[border, :2] + origin).T
        points[border, 2] = border_heights(surface.height, easting, northing)
    index = np.arange(len(points), dtype=np.int32).reshape(len(y), len(x))
    sw, se, nw, ne = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    return points, np.stack([sw, se, ne, sw, ne, nw], axis=-1).reshape(-1, 3)


def _levels(
    surface: Surface,
    road: RoadMask,
    mask: Bools,
    local: Bounds,
    options: Options,
    frame: Frame | None,
) -> Mesh:
    """Return the mesh of all levels; they meet on abutments and share no vertex."""
    every = (level_outline(own.level, road.core, local, options.road_m) for own in surface.levels)
    outlines = [outline for outline in every if outline]
    first = _dynamic(surface, road, mask, local, options, frame, outlines)
    meshes, ground = {0: first}, first.vertices + np.array([0.0, 0.0, first.origin[2]])
    for outline in outlines:
        if not outline.area.is_empty:
            held = frame.at(outline.number) if frame else None
            of_level = surface.at(outline.number)
            points, faces = _other_level(of_level, outline, ground, road, local, options, held)
            if len(faces):
                meshes[outline.number] = _mesh(points, faces, road, np.ones_like(mask))
    return with_levels(meshes)


def with_levels(meshes: Mapping[int, Mesh]) -> Mesh:
    """Return the meshes of several levels of a tile as one mesh; they share no vertex.

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


def _other_level(
    surface: Surface,
    outline: LevelOutline,
    ground: Floats,
    road: RoadMask,
    local: Bounds,
    options: Options,
    frame: Frame | None,
) -> tuple[Floats, Faces]:
    """Return points and faces of a deck or tunnel, which ends at its outline and with the survey.

    - `ground` ``(n, 3)``: the vertices of level 0; the level has the same vertices on abutments at the border
      of the tile.
    """
    limit, lines, area = _limit(road, local, frame), [outline.lines], outline.area
    if limit:
        area = shapely.intersection(area, limit.covered)
        lines.append(parts_of(limit.lines))
    border = _border(surface.height, road, local, options, frame, lines)
    border = outline.with_shared(border, ground, local)
    plan, segments = points_and_segments(lines, border[:, :2], local, SAME_M)
    covered = SurveyLimit(
        shapely.multilinestrings(plan[segments]), outline.covered(area, plan[segments], local)
    )
    free = _lattice(surface, road, np.ones_like(road.mask), local, options.road_m)
    free = free[covered.covers(free) & ~on_border(free, local)]
    free = free[apart_from(free, lines, options.road_m / 2)]
    z = surface.height(*(plan + road.core.origin).T)
    points, number = without_duplicates(np.concatenate([free, border, np.column_stack([plan, z])]))
    faces = constrained(points, number[len(free) + len(border) + segments])
    return points, faces[covered.covers(middles(points, faces))]


def _dynamic(
    surface: Surface,
    road: RoadMask,
    mask: Bools,
    local: Bounds,
    options: Options,
    frame: Frame | None,
    others: Sequence[LevelOutline] = (),
) -> Mesh:
    """Return the mesh of road, terrain and border points, with the limit of the survey and roads as edges.

    - `others`: the other levels: their abutments are edges, too.
    """
    fine = _lattice(surface, road, mask, local, options.road_m)
    coarse = _lattice(surface, road, ~mask, local, options.terrain_m)
    limit, roads = _limit(road, local, frame), None
    lines = [] if limit is None else [_divided(limit.lines, road, mask, options)]
    breaks = None
    if isinstance(surface, SteppedSurface) and options.breaklines:
        edges, breaks = breaklines(surface, local)
        lines.append(without_abutments(_divided(edges, road, mask, options), others))
    if road.areas is not None and options.mask == "raw":
        roads, edges_of_roads = road_outline(road.areas, local, options.road_m)
        lines.append(without_abutments(edges_of_roads, others))
        fine = fine[shapely.contains_xy(roads, fine[:, 0], fine[:, 1])]
    lines += [part for other in others for part in (other.abutments, other.feet)]
    free = np.concatenate([fine, coarse])
    if frame:
        free = free[~on_border(free, local)]

    def height(easting: Floats, northing: Floats) -> Floats:
        z = surface.height(easting, northing)
        return with_abutments(z, easting, northing, surface, others, road.core.origin)

    border = _border(height, road, local, options, frame, lines)
    free = free[apart_from(free, lines, options.road_m / 2)]
    if limit:
        free = free[limit.covers(free)]
    plan, segments = points_and_segments(lines, border[:, :2], local, SAME_M)
    place = (plan + road.core.origin).T
    z = breaks(plan) if breaks else surface.height(*place)
    z = with_abutments(z, place[0], place[1], surface, others, road.core.origin)
    if isinstance(surface, MovingNurbs):
        free, border = (_in_space(part, surface, road.core.origin) for part in (free, border))
    points, number = without_duplicates(np.concatenate([free, border, np.column_stack([plan, z])]))
    known = {options.road_m: len(fine), options.terrain_m: len(coarse)}
    if isinstance(surface, MovingNurbs):
        known = {}
    lattices = [(local[:2], step) for step, count in known.items() if count > FEW * len(points)]
    faces = constrained(points, number[len(free) + len(border) + segments], lattices)
    if limit:
        faces = faces[limit.covers(middles(points, faces))]
    return _mesh(points, faces, road, mask, roads)


def _in_space(points: Floats, surface: MovingNurbs, origin: tuple[float, float]) -> Floats:
    """Return the points S(u, v) for the parameters of lattice points, without poles, ``(n, 3)``."""
    places = surface.moved(*(points[:, :2] + origin).T)
    moved = np.column_stack([*places, points[:, 2]])
    moved[:, :2] += np.subtract(surface.origin, origin)
    return moved[np.isfinite(moved).all(axis=1)]


def _limit(road: RoadMask, local: Bounds, frame: Frame | None) -> SurveyLimit | None:
    """Return the limit of the survey on the tile, None if the survey covers all of it."""
    core = road.core
    outside = road.outside[road.grid.window(core)]
    if frame:
        outside = frame.outside(outside)
    if not outside.any():
        return None
    return survey_limit(outside, (core.west - core.origin[0], core.north - core.origin[1]), core.cell, local)


def _divided(
    lines: shapely.MultiLineString, road: RoadMask, mask: Bools, options: Options
) -> NDArray[np.object_]:
    """Return lines with points as dense as the points of the ground beside them."""

    def on_road(places: Floats) -> Bools:
        return np.asarray(mask[road.grid.cells(*(places + road.core.origin).T)])

    return divided(lines, options.road_m, options.terrain_m, on_road)


def _lattice(surface: Surface, road: RoadMask, where: Bools, local: Bounds, step: float) -> Floats:
    """Return the points of a lattice whose nearest cell is in ``where``, ``(n, 3)``."""
    west, south, east, north = local
    x, y = axis(west, east, step, to_end=False), axis(south, north, step, to_end=False)
    eastings, northings = x + road.core.origin[0], y + road.core.origin[1]
    z = surface.lattice(eastings, northings)
    # A point on the line between two cells belongs to the eastern or southern one, independent of rounding.
    nudge = NUDGE * road.grid.cell
    row, col = road.grid.cells(eastings + nudge, northings - nudge)
    i, j = np.nonzero(where[np.ix_(row, col)])
    return np.stack([x[j], y[i], z[i, j]], axis=1)


def _border(
    height: HeightAt, road: RoadMask, local: Bounds, options: Options, frame: Frame | None,
    lines: Sequence[NDArray[np.object_]],
) -> Floats:  # fmt: skip
    """Return points along the border of a dynamic mesh, with corners and ends of lines, ``(n, 3)``.

    With a frame, the neighbours have the same points.
    """
    west, south, east, north = local
    if frame:
        fine, coarse = (
            [axis(0.0, length, step, to_end=True) for length in (east - west, north - south)]
            for step in (options.road_m, options.terrain_m)
        )
        raw, apart_m = options.mask == "raw", options.road_m / 4
        plan = border_points(frame, local, road.core.cell, fine, coarse, raw, apart_m)
        return np.column_stack([plan, border_heights(height, *(plan + road.core.origin).T)])
    x, y = (axis(*ends, options.terrain_m, to_end=True) for ends in ((west, east), (south, north)))
    sides = [np.stack(np.broadcast_arrays(x, edge), axis=1) for edge in (south, north)]
    sides += [np.stack(np.broadcast_arrays(edge, y), axis=1) for edge in (west, east)]
    plan = np.concatenate(sides)
    if lines:
        ends = ends_at_border(lines, local)
        corners = np.isin(plan[:, 0], [west, east]) & np.isin(plan[:, 1], [south, north])
        away = np.linalg.norm(plan[:, None] - ends, axis=2).min(axis=1, initial=np.inf)
        plan = np.concatenate([plan[corners | (away >= options.road_m / 4)], ends])
    return np.column_stack([plan, height(*(plan + road.core.origin).T)])


def _mesh(
    points: Floats, faces: Faces, road: RoadMask, mask: Bools, roads: shapely.MultiPolygon | None = None
) -> Mesh:
    """Return the mesh of the faces that have heights, without unused vertices.

    - `roads`: areas that class the faces, instead of the cells of ``mask``.
    """
    east, north = road.core.origin
    known = np.isfinite(points[:, 2])
    faces = faces if known.all() else faces[known[faces].all(axis=1)]
    if not len(faces):
        raise TaskError("the surface has no height where the tile has data; check the layers of the tile")
    places = middles(points, faces)
    used = np.zeros(len(points), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - np.int32(1)
    vertices = points[used]
    datum = float(np.floor(vertices[:, 2].min()))
    vertices[:, 2] -= datum
    is_road = (
        mask[road.grid.cells(*(places + road.core.origin).T)]
        if roads is None
        else shapely.contains_xy(roads, *places.T)
    )
    return Mesh(road.core.crs, (east, north, datum), vertices, number[faces], is_road)
