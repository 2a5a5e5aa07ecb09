"""Filter the road mask: ECSRC, the paper's step B ("Road and Terrain Point Cloud Extraction", Algorithm 1).

Three parts, as in the algorithm: growth over neighbouring cells (Eq. neighbors), `mergeClusters`,
`cleanClusters`. For streets with trees and cars, where this filter fails, see `tasks.filter.planar`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.compiled import compiled
from flexroad.tasks.roads.union_find import (
    Roots,
    clean,
    compress,
    find,
    forward_offsets,
    init,
    largest_of,
    least_cells,
)
from flexroad.tasks.types import Bools, Floats, RoadClusters, RoadMask, TileData

VERSION = 1


class Options(base.Options):
    """Method and thresholds of the filter."""

    method: Literal["paper", "off"] = Field(
        "paper",
        description="paper: Algorithm 1; off: keep every road cell that has a DSM height; "
        "planar: for real streets, with options of its own (docs/filter.md)",
    )
    theta_xy_m: float = Field(
        10.0, ge=0, le=100, description="clusters merge across gaps up to this distance in plan (m)"
    )
    theta_z_m: float = Field(
        0.5, gt=0, description="largest height difference of neighbouring points of one road (m)"
    )
    min_area_m2: float = Field(50.0, ge=0, description="smaller clusters are dropped (m2)")
    keep_largest: int | None = Field(
        10, ge=1, description="number of the largest remaining clusters to keep; null keeps all"
    )


def ecsrc(data: TileData, road: RoadMask, options: Options) -> RoadClusters:
    """Label the clusters of road cells connected in plan and height; drop the rest (Algorithm 1).

    Parameters
    ----------
    data : TileData
        Its DSM gives the points' heights, ``(H, W)``, m.
    road : RoadMask
        The raw mask M^r on the same grid.

    Returns
    -------
    RoadClusters
        Labels L, ``(H, W)``. Road cells without a DSM height have label 0, and so have all cells if
        no cluster is large enough.
    """
    points = road.mask & np.isfinite(data.dsm)
    if options.method == "off":
        return RoadClusters(data.grid, points.astype(np.int32))
    cell, roots = data.grid.cell, init(points)
    heights = np.ascontiguousarray(data.dsm)
    _join(heights, roots, points, forward_offsets(1.5), options.theta_z_m)
    # The search starts only in clusters other than the largest. The largest has most points, so time is
    # saved.
    starts = points & (roots.reshape(points.shape) != largest_of(compress(roots)))
    far = forward_offsets(options.theta_xy_m / cell)
    _join(heights, roots, starts, np.concatenate([far, -far]), options.theta_z_m)
    least = least_cells(options.min_area_m2, cell)
    labels = clean(points, compress(roots).reshape(points.shape), least, options.keep_largest)
    return RoadClusters(data.grid, labels)


@compiled()
def _join(heights: Floats, roots: Roots, starts: Bools, steps: NDArray[np.int64], theta_z: float) -> None:
    """Unite the sets of a start and a point if one step joins them and their heights agree to ``theta_z``."""
    rows, cols = heights.shape
    for i in np.flatnonzero(starts):
        r, c = i // cols, i % cols
        a = find(roots, int(i))
        for k in range(steps.shape[0]):
            row, col = r + steps[k, 0], c + steps[k, 1]
            if row < 0 or row >= rows or col < 0 or col >= cols:
                continue
            j = row * cols + col
            if roots[j] < 0 or roots[j] == a or abs(heights[r, c] - heights[row, col]) > theta_z:
                continue
            b = find(roots, j)
            a, b = min(a, b), max(a, b)
            roots[b] = a
