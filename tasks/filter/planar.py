"""Filter the road mask on real streets: ECSRC for streets with cars and trees.

Like the paper's ECSRC (`tasks.filter.ecsrc`) it grows clusters, merges them across gaps and cleans them.
Clusters grow over flat patches instead of cells, so they do not climb onto objects: no plane fits a tree
crown or the edge of a car, but a bridge deck continues the street at its ends. Clusters merge along the
street's slope. Each cluster is accepted or dropped completely, by its height above the DTM and its area.
Cells outside all patches are compared, one by one, with the accepted cells around them.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.compiled import compiled
from flexroad.tasks.levels.seen import level_clusters
from flexroad.tasks.roads.distances import columns_of, within
from flexroad.tasks.roads.dtm_validity import Slices, invalid_dtm
from flexroad.tasks.roads.flat_patches import flat_patches
from flexroad.tasks.roads.union_find import (
    Roots,
    clean,
    compress,
    init,
    largest_of,
    least_cells,
    members_of,
    unite,
)
from flexroad.tasks.types import Bools, Floats, RoadClusters, RoadMask, TileData

VERSION = 4

REACH_M = 4.0
"""Distance up to which a cell is compared with ground cells around it (m)."""
GROUND_SHARE = 0.2
"""Share of cells on the ground from which a cluster is on the ground: a deck is joined to its approaches."""
BEYOND_M = 3.0
"""Distance beyond the shoulder up to which a smooth surface may not follow the ground yet (m)."""
UNKNOWN_M = 2.0
"""Assumed height of a cluster above the DTM where the DTM is unknown (m)."""
NO_NEIGHBOURS, INCONSISTENT, CONSISTENT = np.uint8(0), np.uint8(1), np.uint8(2)
"""Results per cell: no ground cell is near; the cell is off the ground; the cell lies on the ground."""
MAX_PLANE_VARIANCE = 0.5
"""A plane is used only where the variance of its height is at most this share of a single cell's."""

Window = tuple[int, int, int, int]
"""First and last row, first and last column; the last row and column are exclusive."""
BEND = 0.1
"""Largest difference between the slope of a flat patch and the slope of the street (m per m)."""
RAISED_M2_PER_M = 150.0
"""Smallest area of a cluster off the ground, per metre above or below the DTM (m2 per m): an elevated road
is large for its height, a roof is not. Clusters connected to the ground need no area."""


class Options(base.Options):
    """Thresholds of the filter."""

    method: Literal["planar"] = "planar"
    theta_xy_m: float = Field(
        10.0, ge=0, le=100, description="clusters merge across gaps up to this distance in plan (m)"
    )
    theta_z_m: float = Field(
        0.25,
        gt=0,
        le=2,
        description="largest height difference to the ground of a cell, and of two clusters to be merged, "
        "along the street's slope (m)",
    )
    roughness_m: float = Field(
        0.15,
        gt=0,
        le=1,
        description="largest root mean square of a flat patch's residuals to its plane (m); "
        "set it to 1.5 times the DSM's noise",
    )
    min_area_m2: float = Field(50.0, ge=0, description="smaller clusters are dropped (m2)")
    keep_largest: int | None = Field(
        None, ge=1, description="number of the largest remaining clusters to keep; null keeps all"
    )
    shoulder_m: float = Field(
        0.0,
        ge=0,
        le=50,
        description="distance beside the road up to which the DTM is ignored (m). Terrain models smooth "
        "kerbs and banks, which would lift the road's edge",
    )


def ecsrc(data: TileData, road: RoadMask, options: Options) -> RoadClusters:
    """Label the road cells whose DSM shows the road; drop cells covered by objects.

    Parameters
    ----------
    data : TileData
        The DSM has the heights of the points, the DTM the heights of the ground, ``(H, W)``, m.
    road : RoadMask
        The raw mask M^r on the same grid.

    Returns
    -------
    RoadClusters
        Labels L, ``(H, W)``. Road cells without a DSM height have label 0, and so have all cells if no
        cluster is large enough. ``dtm_invalid`` marks the shoulder and dropped cells where the DTM shows
        other ground, such as the valley below a bridge. ``beside`` marks the shoulder and cells up to
        `BEYOND_M` from it. With levels, there are clusters for each level.
    """
    return ecsrc_near(data, road, options, (slice(0, data.grid.height), slice(0, data.grid.width)))


def ecsrc_near(data: TileData, road: RoadMask, options: Options, near: Slices) -> RoadClusters:
    """Return the result of `ecsrc` with ``dtm_invalid`` and ``beside`` only in a part of the raster.

    Elsewhere they may be False. Labels are complete: clusters are judged by all their cells.

    - `near`: (row, col) slices of that part; they have a start and a stop.
    """
    if road.levels:

        def of_level(seen: TileData, road: RoadMask, other: bool) -> RoadClusters:
            # A deck from the vectors needs no minimum area.
            return _clusters_of(seen, road, options, near, 0.0 if other else RAISED_M2_PER_M)

        return level_clusters(data, road, of_level, options.shoulder_m, BEYOND_M)
    return _clusters_of(data, road, options, near, RAISED_M2_PER_M)


def _clusters_of(
    data: TileData, road: RoadMask, options: Options, near: Slices, raised_m2_per_m: float
) -> RoadClusters:
    """Return the clusters of one level."""
    cell, theta = data.grid.cell, options.theta_z_m
    points = road.mask & np.isfinite(data.dsm)
    centres, trend, reach, climbs = flat_patches(
        data.dsm, points, cell, options.roughness_m, BEND, data.dtm, theta
    )
    # Neighbouring patches share most of their cells, so they always merge. Across gaps, clusters merge if any
    # two of their edge cells agree in height along the street's slope.
    roots = _merged(centres, options.theta_xy_m / cell, data.dsm, trend, theta)
    clusters = _covered(roots, reach)
    ground = _on_ground(data, clusters, theta, raised_m2_per_m)
    reach = max(1, math.floor(REACH_M / cell + 1e-9))
    # The plane of a patch at the foot of an object continues up its side.
    climbing = climbs & (np.abs(data.dsm - data.dtm) > theta)
    others = points & ~ground & ~climbing
    consistency = ground_consistency(data.dsm, data.dtm, ground, others, reach, theta)
    kept = ground | (consistency == CONSISTENT)
    alone = others & (consistency == NO_NEIGHBOURS)
    kept[alone] = np.abs(data.dsm[alone] - data.dtm[alone]) <= theta
    # Clusters merge without regard to heights, which were checked before.
    roots = _merged(kept, options.theta_xy_m / cell, data.dsm, trend, math.inf)
    labels = clean(kept, roots, least_cells(options.min_area_m2, cell), options.keep_largest)
    dtm_invalid = invalid_dtm(data, road, labels > 0, near)
    if options.shoulder_m == 0:
        return RoadClusters(data.grid, labels, dtm_invalid)
    reach = math.ceil((options.shoulder_m + BEYOND_M) / cell) + 1
    around = tuple(slice(max(part.start - reach, 0), part.stop + reach) for part in near)
    mask, beside = road.mask[around], np.zeros_like(dtm_invalid)
    shoulder = ~mask & within(_streets(road.mask, labels > 0)[around], cell, options.shoulder_m)
    dtm_invalid[around] |= shoulder
    beside[around] = ~mask & within(shoulder, cell, BEYOND_M)
    return RoadClusters(data.grid, labels, dtm_invalid, beside)


def _streets(mask: Bools, kept: Bools) -> Bools:
    """Return the streets, ``(H, W)``: the connected parts of the mask with a kept cell, complete."""
    parts = init(mask)
    _join_neighbours(parts, mask)
    parts = compress(parts).reshape(mask.shape)
    # The last element belongs to the cells in no part.
    street = np.zeros(mask.size + 1, np.bool_)
    street[parts[kept]] = True
    return street[parts]


def _on_ground(data: TileData, clusters: NDArray[np.int32], theta: float, raised_m2_per_m: float) -> Bools:
    """Return the cells of clusters that are on the ground or large for their height, ``(H, W)``."""
    clustered = clusters >= 0
    member, size = members_of(clusters[clustered], clusters.size)
    height = np.abs(data.dsm[clustered] - data.dtm[clustered])
    accepted = np.bincount(member, height <= theta, len(size)) >= GROUND_SHARE * size
    raised = ~accepted
    above = raised[member]
    needed = raised_m2_per_m * _medians(height[above], member[above], len(size))
    accepted[raised] = (size * data.grid.cell**2 >= needed)[raised]
    ground = np.zeros_like(clustered)
    ground[clustered] = accepted[member]
    return ground


def _medians(values: Floats, member: NDArray[np.intp], count: int) -> Floats:
    """Return the median of each cluster's finite values, or `UNKNOWN_M`, ``(count,)``."""
    finite = np.isfinite(values)
    values, member = values[finite], member[finite]
    ordered = values[np.lexsort((values, member))]
    n = np.bincount(member, minlength=count)
    first, present = np.cumsum(n) - n, n > 0
    medians = np.full(count, UNKNOWN_M)
    medians[present] = (ordered[(first + (n - 1) // 2)[present]] + ordered[(first + n // 2)[present]]) / 2
    return medians


def _merged(members: Bools, gap: float, heights: Floats, slope: Floats, theta: float) -> NDArray[np.int32]:
    """Unite neighbours, then sets across gaps; return the root of each member's set, ``(H, W)``, else -1.

    Sets merge across a gap if any two of their edge cells are at most ``gap`` cells apart and agree in height
    to ``theta`` along the slope.
    """
    forest = init(members)
    _join_neighbours(forest, members)
    # The search starts only in sets other than the largest. The largest has most cells, so time is saved.
    edges = _edges(members)
    others = edges & (forest.reshape(members.shape) != largest_of(compress(forest)))
    _join_across(forest, others, edges, gap, heights, slope, theta)
    return compress(forest).reshape(members.shape)


@compiled()
def _edges(members: Bools) -> Bools:
    """Return the members with a neighbour outside; they contain the nearest cells of any two clusters."""
    rows, cols = members.shape
    edges = members.copy()
    for r in range(1, rows - 1):
        for c in range(1, cols - 1):
            if members[r, c]:
                inside = True
                for row in (r - 1, r, r + 1):
                    inside = inside and members[row, c - 1] and members[row, c] and members[row, c + 1]
                edges[r, c] = not inside
    return edges


@compiled()
def _join_neighbours(roots: Roots, members: Bools) -> None:
    """Unite the sets of members that are neighbours, also at corners."""
    rows, cols = members.shape
    for r in range(rows):
        for c in range(cols):
            if not members[r, c]:
                continue
            i = r * cols + c
            if r > 0 and members[r - 1, c]:
                # The other neighbours are also neighbours of this cell, so they are united with it already.
                unite(roots, i, i - cols)
                continue
            if c > 0 and members[r, c - 1]:
                unite(roots, i, i - 1)
            elif r > 0 and c > 0 and members[r - 1, c - 1]:
                unite(roots, i, i - cols - 1)
            if r > 0 and c + 1 < cols and members[r - 1, c + 1]:
                unite(roots, i, i - cols + 1)


@compiled()
def _join_across(
    roots: Roots, starts: Bools, ends: Bools, gap: float, heights: Floats, slope: Floats, theta: float
) -> None:
    """Unite sets if an end is ``gap`` cells from a start and within ``theta`` in height along the slope."""
    rows, cols = starts.shape
    reach = int(gap + 1e-9)
    columns, before = columns_of(ends)
    for i in np.flatnonzero(starts):
        r, c = i // cols, i % cols
        for row in range(max(r - reach, 0), min(r + reach + 1, rows)):
            down = row - r
            wide = int(math.sqrt(gap**2 + 1e-9 - down**2))
            first, last = row * cols + max(c - wide, 0), row * cols + min(c + wide + 1, cols)
            for col in columns[before[first] : before[last]]:
                j, across = row * cols + col, col - c
                if roots[j] == roots[i]:
                    continue
                fall, drift = slope[r, c, 0] + slope[row, col, 0], slope[r, c, 1] + slope[row, col, 1]
                up = (down * fall + across * drift) / 2
                if abs(heights[row, col] - heights[r, c] - up) <= theta:
                    unite(roots, int(i), j)


@compiled()
def _covered(roots: NDArray[np.int32], reach: int) -> NDArray[np.int32]:
    """Return the lowest root of the clusters whose patches cover each cell, ``(H, W)``, or -1."""
    rows, cols = roots.shape
    result = np.full((rows, cols), -1, np.int32)
    for r in range(rows):
        for c in range(cols):
            if roots[r, c] < 0:
                continue
            # Patches lie completely inside the grid.
            for i in range(r - reach, r + reach + 1):
                for j in range(c - reach, c + reach + 1):
                    if result[i, j] < 0 or roots[r, c] < result[i, j]:
                        result[i, j] = roots[r, c]
    return result


@compiled()
def ground_consistency(
    dsm: Floats, dtm: Floats, ground: Bools, candidates: Bools, reach: int, theta: float
) -> NDArray[np.uint8]:
    """Return `NO_NEIGHBOURS`, `INCONSISTENT` or `CONSISTENT` for each candidate cell, ``(H, W)``.

    A cell is compared with the ground cells at most ``reach`` rows and columns away. It is consistent if its
    height is within ``theta`` (m) of the DTM plus their mean height above the DTM. It is also consistent if
    it is within ``theta`` of their least-squares plane, if that is precise enough (`MAX_PLANE_VARIANCE`).
    Other cells are `NO_NEIGHBOURS`.
    """
    rows, cols = dsm.shape
    result = np.zeros((rows, cols), np.uint8)
    for r in range(rows):
        for c in range(cols):
            if not candidates[r, c]:
                continue
            window = max(r - reach, 0), min(r + reach + 1, rows), max(c - reach, 0), min(c + reach + 1, cols)
            n, offset = _count_and_offset(dsm, dtm, ground, window)
            # NaN where the DTM is unknown: the comparison is then False.
            consistent = abs(dsm[r, c] - dtm[r, c] - offset) <= theta
            if n > 0:
                consistent = consistent or abs(_above_plane(dsm, ground, window, n, r, c)) <= theta
                result[r, c] = CONSISTENT if consistent else INCONSISTENT
    return result


@compiled()
def _count_and_offset(dsm: Floats, dtm: Floats, ground: Bools, window: Window) -> tuple[int, float]:
    """Return the number of ground cells and their mean height above the DTM (m), NaN if it is unknown."""
    top, bottom, left, right = window
    n, m, offset = 0, 0, 0.0
    for i in range(top, bottom):
        for j in range(left, right):
            if ground[i, j]:
                n += 1
                if not np.isnan(dtm[i, j]):
                    m, offset = m + 1, offset + dsm[i, j] - dtm[i, j]
    return n, offset / m if m > 0 else np.nan


@compiled()
def _above_plane(dsm: Floats, ground: Bools, window: Window, n: int, r: int, c: int) -> float:
    """Return a cell's height above the plane of the ground cells (m), NaN if the plane is too uncertain."""
    top, bottom, left, right = window
    y, x, z = 0.0, 0.0, 0.0
    for i in range(top, bottom):
        for j in range(left, right):
            if ground[i, j]:
                y, x, z = y + (i - r), x + (j - c), z + dsm[i, j] - dsm[r, c]
    y, x, z = y / n, x / n, z / n
    yy, yx, xx, yz, xz = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(top, bottom):
        for j in range(left, right):
            if ground[i, j]:
                a, b, up = i - r - y, j - c - x, dsm[i, j] - dsm[r, c] - z
                yy, yx, xx, yz, xz = yy + a * a, yx + a * b, xx + b * b, yz + a * up, xz + b * up
    det = yy * xx - yx * yx
    if det <= 1e-9 * (yy + xx) ** 2:
        return np.nan
    variance = 1 / n + (xx * y * y - 2 * yx * y * x + yy * x * x) / det
    if variance > MAX_PLANE_VARIANCE:
        return np.nan
    return -(z - (y * (xx * yz - yx * xz) + x * (yy * xz - yx * yz)) / det)
