"""Filter the road mask on real streets: spatial clustering that cannot climb.

Like the paper's ECSRC (`tasks.filter.ecsrc`) it grows clusters, merges them across gaps and cleans them. But
what grows are flat patches, not cells: no plane fits the ragged steps of a crown or the edge of a car, while
a deck goes on from the street at its ends. Clusters merge along the street's slope, and each is judged as a
whole, by its height over the DTM against its area. What no patch covers is held, cell by cell, against the
ground found around it.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.compiled import compiled
from flexroad.tasks.filter.kit.ground_consistency import CONSISTENT, NO_NEIGHBOURS, against_known
from flexroad.tasks.filter.kit.planar_patches import Patches, flat_patches
from flexroad.tasks.filter.kit.union_find import (
    Roots,
    clean,
    compress,
    find,
    forward_offsets,
    init,
    least_cells,
)
from flexroad.tasks.roads.dtm_validity import invalid_dtm
from flexroad.tasks.types import Bools, Floats, RoadClusters, RoadMask, TileData

VERSION = 2

REACH_M = 4.0
"""How far a cell looks for the ground it is held against (m)."""
STANDING = 0.2
"""A cluster stands on the ground with this part of its cells there: a deck comes with its approaches."""
UNKNOWN_M = 2.0
"""A cluster whose height over the DTM is unknown is taken for one so high (m)."""


class Options(base.Options):
    """What counts as road."""

    method: Literal["planar"] = "planar"
    theta_xy_m: float = Field(
        10.0, ge=0, le=100, description="clusters merge across gaps up to this distance in plan (m)"
    )
    theta_z_m: float = Field(
        0.25,
        gt=0,
        le=2,
        description="largest height over or under the ground: of a cell, and of a cluster along its "
        "street's slope (m)",
    )
    roughness_m: float = Field(
        0.15,
        gt=0,
        le=1,
        description="largest root mean square of a flat patch's residuals to its plane (m); "
        "half as much again as the DSM's noise",
    )
    bend: float = Field(
        0.1, gt=0, le=2, description="largest difference of a flat patch's slope to its street's (m per m)"
    )
    raised_m2_per_m: float = Field(
        150.0,
        ge=0,
        description="area from which a cluster off the ground counts as road, per metre over or under the "
        "DTM (m2 per m); what goes on from the ground needs none",
    )
    min_area_m2: float = Field(50.0, ge=0, description="smaller clusters are dropped (m2)")
    keep_largest: int | None = Field(
        None, ge=1, description="of the rest, keep so many of the largest; null keeps all"
    )
    verge_m: float = Field(
        0.0,
        ge=0,
        le=50,
        description="beside the mask the DTM does not count up to this distance (m): a terrain model rounds "
        "kerbs and banks off, and a surface drawn to it lifts the road's edge",
    )


def ecsrc(data: TileData, road: RoadMask, options: Options) -> RoadClusters:
    """Label the road cells whose DSM shows the road; drop what stands or hangs above it.

    Parameters
    ----------
    data : TileData
        Its DSM gives the points' heights, its DTM the ground's, ``(H, W)``, m.
    road : RoadMask
        The raw mask M^r on the same grid.
    options : Options
        Thresholds in metres.

    Returns
    -------
    RoadClusters
        Labels L, ``(H, W)``. Road cells without a DSM height have label 0, and so have all cells if
        no cluster is large enough. With them, the cells whose DTM does not count: dropped ones where it is
        not the road's either (under a car on a bridge it is the valley's), and the verge.
    """
    cell, theta = data.grid.cell, options.theta_z_m
    points = road.mask & np.isfinite(data.dsm)
    patches = flat_patches(data.dsm, points, cell, options.roughness_m, options.bend)
    clusters = _clusters(data.dsm, patches, options.theta_xy_m / cell, theta)
    ground = _on_ground(data, clusters, options)
    reach = max(1, math.floor(REACH_M / cell + 1e-9))
    near = against_known(data.dsm, data.dtm, ground, points & ~ground, reach, theta)
    level = np.abs(data.dsm - data.dtm) <= theta
    kept = ground | (near == CONSISTENT) | (points & ~ground & (near == NO_NEIGHBOURS) & level)
    labels = _labels(kept, cell, options)
    astray = invalid_dtm(data, road, labels > 0) | _verge(road.mask, labels > 0, options.verge_m / cell)
    return RoadClusters(data.grid, labels, astray)


def _verge(mask: Bools, kept: Bools, width: float) -> Bools:
    """Return the cells beside the streets at most ``width`` cells away, ``(H, W)``.

    A street is a part of the mask of which something was kept, what hangs over its edge with it.
    """
    if not kept.any() or width <= 0:
        return np.zeros_like(mask)
    parts, count = scipy.ndimage.label(mask, np.ones((3, 3)))
    street = np.zeros(count + 1, np.bool_)
    street[parts[kept]] = True
    verge: Bools = ~mask & (scipy.ndimage.distance_transform_edt(~street[parts]) <= width)
    return verge


def _clusters(dsm: Floats, patches: Patches, gap: float, theta: float) -> NDArray[np.int32]:
    """Return the root of the cluster of each cell that lies in a flat patch, ``(H, W)``, else -1.

    Neighbouring patches share most of their cells, so one plane goes over into the next. Across gaps,
    clusters merge if any two of their edges agree in height along the street's slope.
    """
    forest = init(patches.centres)
    _join(forest, patches.centres, forward_offsets(1.5), dsm, patches.trend, math.inf)
    _join(forest, _edges(patches.centres), forward_offsets(gap), dsm, patches.trend, theta)
    roots: NDArray[np.int32] = _covered(compress(forest).reshape(dsm.shape), patches.reach)
    return roots


def _on_ground(data: TileData, clusters: NDArray[np.int32], options: Options) -> Bools:
    """Return the cells of the clusters that stand on the ground or are large for their height, ``(H, W)``."""
    among = clusters >= 0
    roots, member, size = np.unique(clusters[among], return_inverse=True, return_counts=True)
    height = np.abs(data.dsm - data.dtm)[among]
    standing = np.bincount(member, height <= options.theta_z_m, len(roots)) >= STANDING * size
    needed = options.raised_m2_per_m * _medians(height, member, len(roots))
    ground = np.zeros_like(among)
    ground[among] = (standing | (size * data.grid.cell**2 >= needed))[member]
    return ground


def _medians(values: Floats, member: NDArray[np.intp], count: int) -> Floats:
    """Return the median of each cluster's known values, `UNKNOWN_M` where there is none, ``(count,)``."""
    known = np.isfinite(values)
    values, member = values[known], member[known]
    ordered = values[np.lexsort((values, member))]
    n = np.bincount(member, minlength=count)
    first, some = np.cumsum(n) - n, n > 0
    medians = np.full(count, UNKNOWN_M)
    medians[some] = (ordered[(first + (n - 1) // 2)[some]] + ordered[(first + n // 2)[some]]) / 2
    return medians


def _labels(kept: Bools, cell: float, options: Options) -> NDArray[np.int32]:
    """Return the clusters of what was kept: heights have been seen to, so now only gaps part them."""
    forest, level, slope = init(kept), np.zeros(kept.shape), np.zeros((*kept.shape, 2))
    _join(forest, kept, forward_offsets(1.5), level, slope, math.inf)
    _join(forest, _edges(kept), forward_offsets(options.theta_xy_m / cell), level, slope, math.inf)
    roots = compress(forest).reshape(kept.shape)
    return clean(kept, roots, least_cells(options.min_area_m2, cell), options.keep_largest)


def _edges(members: Bools) -> Bools:
    """Return the members with a neighbour that is none: of two clusters the nearest cells are such."""
    edges: Bools = members & ~scipy.ndimage.binary_erosion(members, np.ones((3, 3)))
    return edges


@compiled()
def _join(
    roots: Roots, members: Bools, steps: NDArray[np.int64], heights: Floats, slope: Floats, theta: float
) -> None:
    """Unite the sets of members one of the steps apart and within ``theta`` in height along the slope."""
    rows, cols = members.shape
    for i in range(roots.size):
        r, c = i // cols, i % cols
        if not members[r, c]:
            continue
        a = find(roots, i)
        for down, across in steps:
            row, col = r + down, c + across
            if row >= rows or col < 0 or col >= cols or not members[row, col]:
                continue
            j = row * cols + col
            if roots[j] == a:
                continue
            fall = slope[r, c] + slope[row, col]
            up = (down * fall[0] + across * fall[1]) / 2
            if abs(heights[row, col] - heights[r, c] - up) > theta:
                continue
            b = find(roots, j)
            a, b = min(a, b), max(a, b)
            roots[b] = a


@compiled()
def _covered(roots: NDArray[np.int32], reach: int) -> NDArray[np.int32]:
    """Return the first of the clusters whose patches cover a cell, ``(H, W)``; -1 where none does."""
    rows, cols = roots.shape
    found = np.full((rows, cols), -1, np.int32)
    for r in range(rows):
        for c in range(cols):
            if roots[r, c] < 0:
                continue
            # A patch lies inside the grid as a whole.
            for i in range(r - reach, r + reach + 1):
                for j in range(c - reach, c + reach + 1):
                    if found[i, j] < 0 or roots[r, c] < found[i, j]:
                        found[i, j] = roots[r, c]
    return found
