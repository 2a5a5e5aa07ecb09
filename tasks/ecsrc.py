"""Filter the road mask: ECSRC, the paper's step B ("Road and Terrain Point Cloud Extraction", Algorithm 1).

Three parts, as in the algorithm: growth over neighbouring cells (Eq. neighbors), `mergeClusters`,
`cleanClusters`. A cluster is a tree of a union-find forest whose root is its first cell in row-major
order, so that labels do not depend on the order of the merges.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from tasks import options as base
from tasks.types import Bools, Floats, RoadClusters, RoadMask, TileData

VERSION = 1

Roots = NDArray[np.int32]
"""Flat index of each cell's parent, ``(H * W,)``; a root is its own parent, -1 is no road."""


class Options(base.Options):
    """What counts as one road."""

    variant: Literal["paper", "off"] = Field(
        "paper", description="paper: Algorithm 1; off: keep every road cell that has a DSM height"
    )
    theta_xy_m: float = Field(
        10.0, ge=0, le=100, description="clusters merge across gaps up to this distance in plan (m)"
    )
    theta_z_m: float = Field(
        0.5, gt=0, description="largest height difference of neighbouring points of one road (m)"
    )
    min_area_m2: float = Field(50.0, ge=0, description="smaller clusters are dropped (m2)")
    keep_largest: int | None = Field(
        10, ge=1, description="of the rest, keep so many of the largest; null keeps all"
    )


def ecsrc(data: TileData, road: RoadMask, options: Options) -> RoadClusters:
    """Label the road cells that hang together in plan and height; drop the rest (Algorithm 1).

    Parameters
    ----------
    data : TileData
        Its DSM gives the points' heights, ``(H, W)``, m.
    road : RoadMask
        The raw mask M^r on the same grid.
    options : Options
        Thresholds in metres.

    Returns
    -------
    RoadClusters
        Labels L, ``(H, W)``. Road cells without a DSM height have label 0, and so have all cells if
        no cluster is large enough.
    """
    points = road.mask & np.isfinite(data.dsm)
    if options.variant == "off":
        return RoadClusters(data.grid, points.astype(np.int32))
    cell = data.grid.cell
    parents = np.where(points, np.arange(points.size, dtype=np.int32).reshape(points.shape), np.int32(-1))
    roots = parents.ravel()
    heights = np.ascontiguousarray(data.dsm)
    _join(heights, roots, _half_disc(1.5), options.theta_z_m)
    _join(heights, roots, _half_disc(options.theta_xy_m / cell), options.theta_z_m)
    # A cell's area has rounding errors where its size is no binary fraction: 5000 cells of 0.1 m are 50 m2.
    least = options.min_area_m2 / cell**2 * (1 - 1e-9)
    labels = _clean(points, _flatten(roots).reshape(points.shape), least, options.keep_largest)
    return RoadClusters(data.grid, labels)


def _half_disc(radius: float) -> NDArray[np.int64]:
    """Return the (row, col) steps of up to ``radius`` cells that go forward in row-major order, ``(n, 2)``.

    A radius of 1.5 gives the 8-neighbourhood A(i, j). The other half of the disc are the same pairs of
    cells seen from their other end. Short steps come first: they leave fewer sets for the long ones.
    """
    reach = int(radius + 1e-9)
    row, col = np.mgrid[0 : reach + 1, -reach : reach + 1].reshape(2, -1)
    square = row**2 + col**2
    forward = (square <= radius**2 + 1e-9) & ((row > 0) | (col > 0))
    steps = np.stack([row, col], axis=1)[forward]
    return np.ascontiguousarray(steps[np.argsort(square[forward], kind="stable")])


@njit(cache=True)  # type: ignore[untyped-decorator]
def _root(roots: Roots, i: int) -> int:
    while roots[i] != i:
        roots[i] = roots[roots[i]]
        i = roots[i]
    return i


@njit(cache=True)  # type: ignore[untyped-decorator]
def _join(heights: Floats, roots: Roots, steps: NDArray[np.int64], theta_z: float) -> None:
    """Unite the sets of any two points one of the steps apart and within ``theta_z`` in height."""
    rows, cols = heights.shape
    for i in range(roots.size):
        if roots[i] < 0:
            continue
        r, c = i // cols, i % cols
        a = _root(roots, i)
        for k in range(steps.shape[0]):
            row, col = r + steps[k, 0], c + steps[k, 1]
            if row >= rows or col < 0 or col >= cols:
                continue
            j = row * cols + col
            if roots[j] < 0 or roots[j] == a or abs(heights[r, c] - heights[row, col]) > theta_z:
                continue
            b = _root(roots, j)
            a, b = min(a, b), max(a, b)
            roots[b] = a


@njit(cache=True)  # type: ignore[untyped-decorator]
def _flatten(roots: Roots) -> Roots:
    # A parent comes before its children, so it already points at the root.
    for i in range(roots.size):
        if roots[i] >= 0:
            roots[i] = roots[roots[i]]
    return roots


def _clean(points: Bools, roots: Roots, least: float, keep: int | None) -> NDArray[np.int32]:
    """Label the ``keep`` largest of the clusters of at least ``least`` cells (`cleanClusters`).

    Of clusters of equal size the one whose first cell comes first is kept.
    """
    # Roots ascend like first cells, so both ranks below break ties by first cell.
    _, member, sizes = np.unique(roots[points], return_inverse=True, return_counts=True)
    largest = np.argsort(-sizes, kind="stable")[:keep]
    kept = np.sort(largest[sizes[largest] >= least])
    number = np.zeros(len(sizes), np.int32)
    number[kept] = np.arange(1, len(kept) + 1)
    labels = np.zeros(points.shape, np.int32)
    labels[points] = number[member]
    return labels
