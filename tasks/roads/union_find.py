"""Clusters of cells as a union-find forest.

A cluster is a tree whose root is its first cell in row-major order. So the result does not depend on the
order of the merges.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools

Roots = NDArray[np.int32]
"""Flat index of each cell's parent, ``(H * W,)``; a root is its own parent; -1 for cells without cluster."""


def init(members: Bools) -> Roots:
    """Return a forest in which every member is a cluster of its own."""
    cells = np.arange(members.size, dtype=np.int32)
    return np.where(members.ravel(), cells, np.int32(-1))


def forward_offsets(radius: float) -> NDArray[np.int64]:
    """Return the (row, col) steps of up to ``radius`` cells that go forward in row-major order, ``(n, 2)``.

    A radius of 1.5 gives the 8-neighbourhood A(i, j). The other half of the disc would give the same pairs of
    cells again. Short steps come first, so that fewer sets are left for long steps.
    """
    reach = int(radius + 1e-9)
    row, col = np.mgrid[0 : reach + 1, -reach : reach + 1].reshape(2, -1)
    square = row**2 + col**2
    forward = (square <= radius**2 + 1e-9) & ((row > 0) | (col > 0))
    steps = np.stack([row, col], axis=1)[forward]
    return np.ascontiguousarray(steps[np.argsort(square[forward], kind="stable")])


@compiled()
def find(roots: Roots, i: int) -> int:
    """Return the root of a cell and shorten the path to it."""
    while roots[i] != i:
        roots[i] = roots[roots[i]]
        i = roots[i]
    return i


@compiled()
def unite(roots: Roots, i: int, j: int) -> None:
    """Unite the clusters of two cells."""
    a, b = find(roots, i), find(roots, j)
    roots[max(a, b)] = min(a, b)


@compiled()
def compress(roots: Roots) -> Roots:
    """Make the root of every member its parent, in place."""
    # A parent has a lower index than its children, so its own parent is already the root.
    for i in range(roots.size):
        if roots[i] >= 0:
            roots[i] = roots[roots[i]]
    return roots


@compiled()
def largest_of(roots: Roots) -> int:
    """Return the root of the largest cluster of a compressed forest; the first of equal ones; 0 if empty."""
    sizes, largest = np.zeros(roots.size, np.int32), 0
    for root in roots:
        if root >= 0:
            sizes[root] += 1
    for root in range(roots.size):
        if sizes[root] > sizes[largest]:
            largest = root
    return largest


def members_of(roots: NDArray[np.int32], cells: int) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Return the number of each cell's cluster, in ascending order of roots, and the cells of each cluster.

    - `roots`: the root of each cell, a flat index.
    - `cells`: number of cells of the grid.
    """
    member, count = _numbered(roots, cells)
    return member, np.bincount(member, minlength=count)


@compiled()
def _numbered(roots: NDArray[np.int32], cells: int) -> tuple[NDArray[np.intp], int]:
    """Return the number of each cell's cluster, in ascending order of roots, and the number of clusters."""
    number = np.zeros(cells, np.int32)
    for root in roots:
        number[root] = 1
    count = 0
    for root in range(cells):
        if number[root]:
            number[root] = count
            count += 1
    member = np.empty(len(roots), np.intp)
    for k in range(len(roots)):
        member[k] = number[roots[k]]
    return member, count


def clean(points: Bools, roots: Roots, least: float, keep: int | None) -> NDArray[np.int32]:
    """Label the ``keep`` largest of the clusters of at least ``least`` cells (`cleanClusters`).

    Of clusters of equal size, the cluster with the earlier first cell is kept.
    """
    # Roots ascend like first cells, so both ranks below break ties by first cell.
    member, sizes = members_of(roots[points], roots.size)
    largest = np.argsort(-sizes, kind="stable")[:keep]
    kept = np.sort(largest[sizes[largest] >= least])
    number = np.zeros(len(sizes), np.int32)
    number[kept] = np.arange(1, len(kept) + 1)
    labels = np.zeros(points.shape, np.int32)
    labels[points] = number[member]
    return labels


def least_cells(area_m2: float, cell: float) -> float:
    """Return the number of cells in an area."""
    # The tolerance removes rounding errors of the cell size: 5000 cells of 0.1 m are 50 m2.
    return area_m2 / cell**2 * (1 - 1e-9)
