"""What travels from stage to stage: frozen, arrays on a `Grid`, metres, degrees."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds, Grid
from flexroad.catalog.storage.paths import Location

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Source:
    """A layer that is read where it is used, at its own resolution."""

    name: str
    """One of `catalog.LAYERS`."""
    paths: tuple[Location, ...]
    """Files that reach the tile; of those that overlap, the first with a value wins."""
    crs: str | None = None
    """CRS of files that carry none."""


@dataclass(frozen=True, eq=False)
class TileData:
    """The rasters of one tile on one lattice: what `load` read."""

    tile_id: str
    grid: Grid
    """The lattice of all arrays here: the tile's core grown by the halo."""
    core: Grid
    """The tile itself; what is sampled and evaluated."""
    dsm: Floats
    """Highest surface per cell, ``(H, W)``, m; NaN where unknown."""
    dtm: Floats
    """Bare ground per cell, ``(H, W)``, m; NaN where unknown."""
    road_mask: Bools | None = None
    """Road by the catalog's mask layer, ``(H, W)``, or None if the tile has no such layer."""
    reference: Floats | None = None
    """True height of road and terrain, ``(H, W)``, m, or None: the DTM then stands in."""
    reference_road: Bools | None = None
    """True road cells, ``(H, W)``, or None: the raw segmented mask then stands in."""
    notes: tuple[str, ...] = ()
    """What had to be done to the input (resampling, cut heights), one line each."""
    dop: Source | None = None
    """The orthophoto, or None if the tile has none."""
    roads: Source | None = None
    """Roads as vectors, or None if the tile has none."""


@dataclass(frozen=True, eq=False)
class RoadMask:
    """What `segment` found: the paper's M^r, before the filter."""

    grid: Grid
    core: Grid
    mask: Bools
    """Road cells, ``(H, W)``."""
    outside: Bools
    """Cells beyond the survey, ``(H, W)``: neither DSM nor DTM, in a void that touches the grid's edge.
    Meshes end there; voids inside are bridged."""
    probability: NDArray[np.float32] | None = None
    """Probability of road, ``(H, W)``, 0 to 1, where the method gives one."""
    bridge: Bools | None = None
    """Cells of the mask that lie on bridges, ``(H, W)``, where the method knows them."""
    notes: tuple[str, ...] = ()
    """What to know about the mask (a photo off the heights), one line each."""


@dataclass(frozen=True, eq=False)
class RoadClusters:
    """What ECSRC kept: the paper's labels L and, by `mask`, M^{r+}."""

    grid: Grid
    labels: NDArray[np.int32]
    """``(H, W)``; 0 is no road, clusters count from 1 in the order of their first cell."""
    dtm_invalid: Bools | None = None
    """Cells, none of them kept, whose DTM does not count: under what hides a road it may be another ground's,
    and beside a road it is rounded off, ``(H, W)``; None: nobody asked."""

    @property
    def mask(self) -> Bools:
        """Filtered road cells, ``(H, W)``."""
        return self.labels > 0


@runtime_checkable
class Surface(Protocol):
    """Height and normal of the fitted ground at any easting and northing of the tile."""

    @property
    def bounds(self) -> Bounds:
        """The domain: west, south, east, north (m).

        Beyond it, up to the tile's edge, the surface goes on linearly.
        """

    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights (m) at scattered points, in the points' broadcast shape; NaN where unknown."""

    def lattice(self, eastings: Floats, northings: Floats) -> Floats:
        """Return heights (m) at every pair, ``(len(northings), len(eastings))``."""

    def normal(self, easting: Floats, northing: Floats) -> Floats:
        """Return upward unit normals at scattered points, ``(..., 3)``."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh of one tile; counter-clockwise from above."""

    crs: str
    origin: tuple[float, float, float]
    """Whole-metre (easting, northing, height) the vertices are relative to."""
    vertices: Floats
    """``(V, 3)``, metres from the origin: east, north, up."""
    faces: NDArray[np.int32]
    """``(F, 3)``, indices of vertices."""
    road: Bools
    """``(F,)``, True where the cell under the face's centroid is road by the mask used for sampling."""


@dataclass(frozen=True)
class Metrics:
    """The figures of one mesh against the reference; lengths in metres, angles in degrees.

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
    """Mean distance in space from the reference's road cells to the mesh; NaN unless asked for."""
    nearest_terrain_m: float
    mad_road_deg: float
    mad_terrain_deg: float
    triangles: int
    """Faces of the whole mesh."""
    road_fraction: float
    """Share of the core's reference cells that are road by the evaluation mask."""
    completeness: float
    """Share of the core's reference cells the mesh has a height for."""


@dataclass(frozen=True, eq=False)
class Quality:
    """What a surface tells of itself on the core's road cells by the raw mask; nothing here is ground truth.

    Lengths in metres, shares of the road from 0 to 1. NaN where there is nothing to measure.
    """

    residual_median_m: float
    """Surface minus DSM at the kept road points: a shift."""
    residual_nmad_m: float
    """Spread of the same."""
    residual_p95_m: float
    """95th percentile of its absolute value: points the surface does not follow."""
    curvature_per_m: float
    """Largest second difference of the surface, per squared cell size (1/m)."""
    edge_step_m: float
    """95th percentile of the surface's step where the road ends, against the line of the last two cells."""
    measured_road: float
    """Share of the road where the scan saw the ground."""
    dtm_road: float
    """Share where the DTM stands in."""
    inferred_road: float
    """Share where neither supports the surface."""
    dropped_road: float
    """Share of the mask that the filter dropped."""
    off_dtm_m: float
    """Median of surface minus DTM."""
    off_dtm_road: float
    """Share of the road, where there is a DTM, that is farther from it than two heights of one ground."""
    bounded_weights: float
    """Share of the weights at a bound; NaN unless the surface is a NURBS."""
    error_estimate_m: float
    """Mean distance of the surface to the nearer witness, scan or DTM: what its error may be."""
    suspect_m2: float
    """Largest patch of road farther from its witness than two heights of one ground may be (m2), or 0."""
    flags: tuple[str, ...]
    """What stands out, by `tasks.quality.assess.FLAGS`."""
    support: NDArray[np.uint8]
    """The core's cells by `tasks.quality.support.Support`, ``(H, W)``."""


@dataclass(frozen=True, eq=False)
class Orthophoto:
    """An orthophoto of a piece of ground."""

    grid: Grid
    """Its pixels."""
    colour: NDArray[np.uint8]
    """Red, green, blue, ``(3, h, w)``."""
    known: Bools
    """Pixels with a colour, ``(h, w)``."""
