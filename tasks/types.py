"""Data passed from stage to stage: frozen dataclasses with arrays on a `Grid`; metres and degrees."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds, Grid
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import Location

scipy = lazy("scipy")

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

BLEND_M = 4.0
"""Beyond an approach the ground returns to its own surface over this distance (m)."""
ON_ABUTMENT_M = 1e-3
"""Points within this distance of an abutment lie on it (m)."""
FREE_M = 0.05
"""Points lie at a free edge if a level's outline is nearer by at least this (m) than its abutments."""


@dataclass(frozen=True)
class Source:
    """A layer that the stage that uses it reads, at its own resolution; `load` does not read it."""

    name: str
    """One of `catalog.LAYERS`."""
    paths: tuple[Location, ...]
    """Files that reach the tile; where files overlap, the first one with a value is used."""
    crs: str | None = None
    """CRS of files without a CRS of their own."""
    optional: bool = False
    """Whether missing or broken rasters are left out, as around a border; else they are an error."""
    reproject: bool = False
    """Whether rasters in another CRS than the tile's are warped; else they are an error."""
    sublayer: str | None = None
    """Layer to read from vector files with several layers."""
    missing: frozenset[str] | None = None
    """Full names of files that are missing; None if that is not known."""


@dataclass(frozen=True, eq=False)
class TileData:
    """The rasters of one tile on one lattice: the result of `load`."""

    tile_id: str
    grid: Grid
    """Grid of all arrays: the tile's core grown by the halo."""
    core: Grid
    """Grid of the tile itself, which is sampled and evaluated."""
    dsm: Floats
    """Highest surface per cell, ``(H, W)``, m; NaN where unknown."""
    dtm: Floats
    """Bare ground per cell, ``(H, W)``, m; NaN where unknown."""
    road_mask: Bools | None = None
    """Road by the catalog's mask layer, ``(H, W)``, or None if the tile has no such layer."""
    reference: Floats | None = None
    """True height of road and terrain, ``(H, W)``, m, or None if the DTM is used instead."""
    reference_road: Bools | None = None
    """True road cells, ``(H, W)``, or None if the raw segmented mask is used instead."""
    notes: tuple[str, ...] = ()
    """Changes made to the input (resampling, heights taken as nodata), one line each."""
    dop: Source | None = None
    """The orthophoto, or None if the tile has none."""
    roads: Source | None = None
    """Roads as vectors, or None if the tile has none."""
    road_height: Floats | None = None
    """Height of hard surfaces without the bias of the highest point, ``(H, W)``, m; NaN where unknown. None
    if roads are not fitted to it."""
    offset_dsm: bool = False
    """Whether roads are fitted to the DSM minus its height above the DTM on open road
    (`tasks.roads.road_height`)."""
    decks: Floats | None = None
    """Height of bridge decks, ``(H, W)``, m, NaN elsewhere (the layer ``bridges``); None if the tile has no
    such layer."""

    def lacks_road(self, mask: Bools) -> bool:
        """Return whether no cell of the tile's core is road in a mask, ``(H, W)``."""
        return not mask[self.grid.window(self.core)].any()

    def beyond_extent(self) -> Bools:
        """Return the cells beyond the survey, ``(H, W)``.

        These are the cells with neither DSM nor DTM in a void (4-connected) that touches the grid's edge. A
        void inside, such as water or deep shade, is not beyond the survey: meshes bridge it.
        """
        void = np.isnan(self.dsm) & np.isnan(self.dtm)
        if not any(side.any() for side in (void[0], void[-1], void[:, 0], void[:, -1])):
            return np.zeros(void.shape, np.bool_)
        labels, count = scipy.ndimage.label(void)
        beyond = np.zeros(count + 1, np.bool_)
        for side in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
            beyond[side] = True
        beyond[0] = False
        outside: Bools = beyond[labels]
        return outside


@dataclass(frozen=True, eq=False)
class Level:
    """The roads of one level: decks above the ground (number above 0), or tunnels below it (below 0).

    Level 0 is the ground with its streets and has no `Level`. Coordinates are in the tile's CRS (m).
    """

    number: int
    areas: shapely.MultiPolygon
    """The decks or tunnels on and around the tile."""
    abutments: shapely.MultiLineString
    """The parts of their outline where a road of level 0 continues."""
    approach: shapely.MultiPolygon
    """The road of level 0 beyond the abutments: there level 0 has the surface of this level."""
    passing: shapely.MultiPolygon = field(default_factory=shapely.MultiPolygon)
    """The streets of level 0 near the abutments that pass below the deck, or above the tunnel."""

    @cached_property
    def rasters(self) -> dict[tuple[str, Grid], tuple[tuple[slice, ...], Bools]]:
        """Cells of grids by name, as windows and the cells in them; kept by `tasks.levels.seen`."""
        return {}

    def covers(self, easting: Floats, northing: Floats) -> Bools:
        """Return which points lie on the decks or tunnels, in the points' broadcast shape."""
        shapely.prepare(self.areas)
        return np.asarray(shapely.intersects_xy(self.areas, easting, northing))

    def weight(self, easting: Floats, northing: Floats) -> Floats:
        """Return the weight of this level's surface in level 0, from 0 to 1, in the broadcast shape.

        It is 1 on the approach, falls to 0 over `BLEND_M` beside and behind it, and is 0 below the decks, at
        their free edges, and on streets that pass.
        """
        easting, northing = np.broadcast_arrays(easting, northing)
        result = np.zeros(easting.shape)
        if self.approach.is_empty:
            return result
        near = np.zeros(easting.shape, np.bool_)
        for west, south, east, north in shapely.bounds(shapely.get_parts(self.approach)):
            near |= (np.abs(2 * easting - west - east) < east - west + 2 * BLEND_M) & (
                np.abs(2 * northing - south - north) < north - south + 2 * BLEND_M
            )
        places = shapely.points(easting[near], northing[near])
        shapely.prepare(self.approach)
        reached = shapely.dwithin(self.approach, places, BLEND_M)
        near[near], places = reached, places[reached]
        share = np.clip(1 - shapely.distance(self.approach, places) / BLEND_M, 0.0, 1.0)
        away, from_abutments = shapely.distance(self.areas, places), shapely.distance(self.abutments, places)
        free = (away < from_abutments - FREE_M) | ((away == 0.0) & (from_abutments > ON_ABUTMENT_M))
        shapely.prepare(self.passing)
        free |= shapely.contains_properly(self.passing, places)
        result[near] = np.where(free, 0.0, share * share * (3 - 2 * share))
        return result


@dataclass(frozen=True, eq=False)
class RoadMask:
    """The result of `segment`: the paper's M^r, before the filter.

    With levels, mask and areas show level 0, without the decks and tunnels.
    """

    grid: Grid
    core: Grid
    mask: Bools
    """Road cells, ``(H, W)``."""
    outside: Bools
    """Cells beyond the survey, ``(H, W)``: neither DSM nor DTM, in a void that touches the grid's edge.
    Meshes end there; voids inside are bridged."""
    probability: NDArray[np.float32] | None = None
    """Probability of road, ``(H, W)``, 0 to 1, or None if the method gives none."""
    bridge: Bools | None = None
    """Cells of the mask that lie on bridges, ``(H, W)``, or None if the method does not detect bridges."""
    areas: NDArray[np.uint8] | None = None
    """The road as polygons (WKB of `tasks.meshing.road_outline.encoded`), if the mask was made from polygons;
    else None."""
    notes: tuple[str, ...] = ()
    """Warnings about the mask (such as a photo shifted against the heights), one line each."""
    levels: tuple[Level, ...] = ()
    """The other levels on which the tile's surface depends, by ascending number."""


@dataclass(frozen=True, eq=False)
class RoadClusters:
    """The result of ECSRC: the paper's labels L and, as `mask`, M^{r+}.

    With levels, the labels show the streets of level 0, without approaches.
    """

    grid: Grid
    labels: NDArray[np.int32]
    """``(H, W)``; 0 is no road, clusters are numbered from 1 in the order of their first cell."""
    dtm_invalid: Bools | None = None
    """Dropped cells whose DTM is invalid, ``(H, W)``, or None if the DTM was not checked. Under objects that
    hide a road the DTM may show other ground; beside a road it is smoothed."""
    beside: Bools | None = None
    """Cells beside the streets whose ground has its own height (`tasks.spline.stepped`), ``(H, W)``: the
    shoulder, whose DTM is left out of the fit, and cells near it. None if there is no shoulder."""
    level: Level | None = None
    """The level of these clusters; None: level 0."""
    levels: tuple[RoadClusters, ...] = ()
    """The clusters of each other level: of its roads, and of streets far from them."""

    @property
    def mask(self) -> Bools:
        """Filtered road cells, ``(H, W)``."""
        return self.labels > 0

    @property
    def number(self) -> int:
        """The number of their level."""
        return self.level.number if self.level else 0


@dataclass(frozen=True, eq=False)
class LevelSpline:
    """The spline of a level other than 0."""

    level: Level
    A: Floats
    """Control heights, ``(m, n)``, m; row 0 in the south."""


HeightAt = Callable[[Floats, Floats], Floats]
"""Heights (m) at eastings and northings (m)."""


class Surface(ABC):
    """Height and normal of the fitted ground at any easting and northing of the tile.

    Most surfaces have level 0 alone, without steps.
    """

    bounds: Bounds
    """The domain: west, south, east, north (m).

    Beyond it, up to the tile's edge, the surface is extrapolated linearly.
    """
    levels: tuple[LevelSpline, ...] = ()
    """The other levels, by ascending number."""

    @abstractmethod
    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights (m) at scattered points, in the points' broadcast shape; NaN where unknown."""

    @abstractmethod
    def lattice(self, eastings: Floats, northings: Floats) -> Floats:
        """Return heights (m) at every pair, ``(len(northings), len(eastings))``."""

    @abstractmethod
    def normal(self, easting: Floats, northing: Floats) -> Floats:
        """Return upward unit normals at scattered points, ``(..., 3)``."""

    def smooth(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights without the steps beside roads (m), in the points' broadcast shape."""
        return self.height(easting, northing)

    def step(self, easting: Floats, northing: Floats) -> Floats:
        """Return the steps beside roads (m), in the points' broadcast shape."""
        return np.zeros(np.broadcast_shapes(np.shape(easting), np.shape(northing)))

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers of the levels, ascending, including 0."""
        return tuple(sorted((0, *(own.level.number for own in self.levels))))

    def at(self, number: int) -> Surface:
        """Return the surface of a level."""
        return self

    @property
    def highest(self) -> Surface:
        """The surface of the highest level at each place."""
        return self

    def covers(self, number: int, easting: Floats, northing: Floats) -> Bools:
        """Return which points a level covers, in their broadcast shape; level 0 covers all points."""
        for own in self.levels:
            if own.level.number == number:
                return own.level.covers(easting, northing)
        return np.full(np.broadcast_shapes(np.shape(easting), np.shape(northing)), number == 0)

    def top(self, easting: Floats, northing: Floats) -> NDArray[np.int8]:
        """Return the number of the highest level at points, in their broadcast shape."""
        result = np.zeros(np.broadcast_shapes(np.shape(easting), np.shape(northing)), np.int8)
        for own in self.levels:
            if own.level.number > 0:
                result[own.level.covers(easting, northing)] = own.level.number
        return result


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh of one tile; counter-clockwise from above."""

    crs: str
    origin: tuple[float, float, float]
    """Origin of the vertices: whole-metre (easting, northing, height)."""
    vertices: Floats
    """``(V, 3)``, metres from the origin: east, north, up."""
    faces: NDArray[np.int32]
    """``(F, 3)``, indices of vertices."""
    road: Bools
    """``(F,)``, True where the cell under the face's centroid is road by the mask used for sampling, or where
    the centroid is in the road's polygons, if the mesh has their outline."""
    level: NDArray[np.int8] | None = None
    """Level of each face, ``(F,)``; None: all are on level 0. Faces of different levels share no vertex: on
    an abutment both have vertices at the same places."""

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers of its levels, 0 first."""
        others = [] if self.level is None else np.unique(self.level[self.level != 0]).tolist()
        return 0, *others

    def at(self, number: int) -> Mesh:
        """Return the part on one level, with the same origin."""
        if self.level is None:
            return self
        chosen = self.level == number
        used, faces = self.part(chosen)
        return replace(self, vertices=self.vertices[used], faces=faces, road=self.road[chosen], level=None)

    def part(self, faces: Bools) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
        """Return the vertices that some faces, ``(F,)``, use, ascending, and these faces in their numbers."""
        chosen = self.faces[faces]
        is_used = np.zeros(len(self.vertices), np.bool_)
        is_used[chosen] = True
        number = np.cumsum(is_used, dtype=np.int32) - np.int32(1)
        return np.flatnonzero(is_used), number[chosen]

    def texture_coordinates(self, bounds: Bounds) -> Floats:
        """Return the places of the vertices in an image seen from above, ``(V, 2)``.

        They are 0 to 1 from west to east, and from south to north.

        - `bounds`: west, south, east and north of the image's outer edges (m).
        """
        west, south, east, north = bounds
        place = self.vertices[:, :2] + self.origin[:2]
        return np.asarray((place - (west, south)) / (east - west, north - south), np.float64)


@dataclass(frozen=True)
class Metrics:
    """Errors and size of one mesh against the reference; lengths in metres, angles in degrees.

    NaN where a class has no cell or no face.
    """

    l2_road_m: float
    """Mean vertical distance over the road cells of the reference."""
    l2_terrain_m: float
    rmse_road_m: float
    rmse_terrain_m: float
    nmad_road_m: float
    """1.4826 times the median absolute deviation of the signed distance from its median."""
    p95_road_m: float
    """95th percentile of the vertical distance."""
    nearest_road_m: float
    """Mean 3-D distance from the reference's road cells to the mesh; NaN if not computed."""
    nearest_terrain_m: float
    mad_road_deg: float
    mad_terrain_deg: float
    triangles: int
    """Faces of the complete mesh."""
    road_fraction: float
    """Share of the core's reference cells that are road by the evaluation mask."""
    completeness: float
    """Share of the core's reference cells for which the mesh has a height."""
    mesh_p95_road_m: float
    """95th percentile of the vertical distance of the mesh from the surface that it samples, over the road
    cells of the raw mask."""
    mesh_max_road_m: float
    mesh_p95_terrain_m: float
    mesh_max_terrain_m: float


@dataclass(frozen=True)
class Structures:
    """Figures of the decks or tunnels of a level on a tile's core."""

    area_m2: float
    abutments: int
    """Number of abutments whose middle lies on the core."""
    clearance_m: float
    """Median height of a deck above level 0, or of level 0 above a tunnel (m); NaN without cells."""
    crossed: float
    """Share of cells 2 m and more from abutments with the deck below level 0, or the tunnel above it."""


@dataclass(frozen=True, eq=False)
class Quality:
    """Quality figures of a surface without ground truth, on the core's road cells of the raw mask.

    Lengths in metres, shares of the road from 0 to 1. NaN where there is nothing to measure.
    """

    residual_median_m: float
    """Median of surface minus fitted heights at the kept road cells: a vertical shift."""
    residual_nmad_m: float
    """NMAD (spread) of that difference."""
    residual_p95_m: float
    """95th percentile of the absolute difference: cells that the surface does not follow."""
    curvature_per_m: float
    """Largest second difference of the surface, per squared cell size (1/m)."""
    edge_step_m: float
    """95th percentile of the surface's step at the road's edge, against the line of the last two cells."""
    measured_road: float
    """Share of the road where the scan measured the ground."""
    dtm_road: float
    """Share of the road supported by the DTM only."""
    inferred_road: float
    """Share of the road supported by neither."""
    dropped_road: float
    """Share of the mask that the filter dropped."""
    dsm_excess_m: float
    """Median height of the DSM above the heights to which the road was fitted; 0 if these are the DSM."""
    off_dtm_m: float
    """Median of surface minus DTM."""
    off_dtm_road: float
    """Share of the road with a DTM whose distance to the DTM exceeds the tolerance for the same ground."""
    bounded_weights: float
    """Share of the weights at a bound; NaN unless the surface is a NURBS."""
    error_estimate_m: float
    """Mean estimated error of the surface, by `tasks.quality.estimate`."""
    worst_error_estimate_m: float
    """Largest estimated error that 25 m2 of connected road reach, by `tasks.quality.flagged`."""
    worst_easting: float
    """Easting of the cell with the largest estimate in that piece of road (m)."""
    worst_northing: float
    max_unexplained_area_m2: float
    """Area of the largest road patch whose distance to scan and DTM exceeds the tolerance for the same ground
    (m2); 0 without such a patch."""
    holdout_squares: float
    """Number of squares of road that a second fit left out; NaN without a second fit."""
    holdout_error_m: float
    """Mean absolute difference of the second fit and the heights of these squares."""
    holdout_covered: float
    """Share of these squares whose difference is within the 90% interval of the error estimate."""
    flags: tuple[str, ...]
    """Names of problems, from `tasks.quality.assess.FLAGS`."""
    height_source: NDArray[np.uint8]
    """Class of the core's cells by `tasks.quality.height_source.HeightSource`, ``(H, W)``."""
    flagged: NDArray[np.uint16]
    """Raised flags of the core's cells by `tasks.quality.flagged.LOCAL_FLAGS`, ``(H, W)``."""
    levels: tuple[tuple[int, Quality], ...] = ()
    """Number and quality of each other level; beyond its decks or tunnels there is no height source."""
    structures: Structures | None = None
    """Figures of these decks or tunnels; None for level 0."""

    def at(self, number: int) -> Quality:
        """Return the quality of a level, or of level 0 if the level has none."""
        return dict(self.levels).get(number, self)


@dataclass(frozen=True, eq=False)
class Orthophoto:
    """A part of an orthophoto."""

    grid: Grid
    """Grid of the pixels."""
    colour: NDArray[np.uint8]
    """Red, green, blue, ``(3, h, w)``."""
    known: Bools
    """Pixels with a colour, ``(h, w)``."""
