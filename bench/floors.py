"""Floors of the stages: the least work of any method with the same result, as formulas.

A stage reads every input once, writes every result once, and does the arithmetic below. Its floor is the
longer of two times: bytes over the rate at which one core copies memory, and operations over the rate of a
product of matrices. No stage can be faster. A good implementation may be slower: ``sample`` and ``evaluate``
have branches, ``load`` and ``export`` have (de)compression, which the floors leave out.

Symbols: N cells with the halo, n cells of the tile, V vertices, F faces, and for a fit H x W cells, m x k
control points and s steps.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.timing import Peak
from flexroad.tasks.types import Mesh, RoadClusters, RoadMask, TileData

HEIGHT_SOURCE = 4
"""Basis functions that are not zero at a place, along each axis: degree 3."""
PER_CELL = 10
"""Operations of a fit at each cell and step besides the surface: difference, weight, its sum."""
PATCH = 30
"""Operations of the filter at each cell: running sums of z, xz, yz and zz along both axes (16), a plane and
its residual (14)."""
DRAPE, FACE, EDGE = 10, 20, 30
"""Operations of a height at a cell, of a face's normal and of the angle at an edge."""


@dataclass(frozen=True)
class Work:
    """Operations and bytes that a stage needs at least."""

    flops: float = 0.0
    bytes: float = 0.0

    def __add__(self, other: Work) -> Work:
        return Work(self.flops + other.flops, self.bytes + other.bytes)

    def seconds(self, peak: Peak) -> float:
        """Return the shortest time on one core (s)."""
        return max(self.flops / peak.dgemm, self.bytes / peak.copy)

    def bound(self, peak: Peak) -> str:
        """Return which of the two is the floor."""
        return "flops" if self.flops / peak.dgemm > self.bytes / peak.copy else "bytes"


@dataclass(frozen=True)
class FitSize:
    """The size of one fit."""

    cells: tuple[int, int]
    points: tuple[int, int]
    steps: int
    fields: int
    """Surfaces that are evaluated at each cell: 1, or 2 with weights (numerator and denominator)."""


def size_of(result: Any) -> int:
    """Return the bytes of the arrays of a result."""
    parts = vars(result).values() if dataclasses.is_dataclass(result) else ()
    return sum(part.nbytes for part in parts if isinstance(part, np.ndarray))


def load(data: TileData) -> Work:
    """Bytes: 4 for each height and 1 for each class read, the arrays of the result written."""
    arrays = [part for part in vars(data).values() if isinstance(part, np.ndarray)]
    return Work(0, sum(array.size * (1 if array.dtype == bool else 4) + array.nbytes for array in arrays))


def segment(road: RoadMask) -> Work:
    """Bytes: a mask read and the arrays of the result written."""
    return Work(0, road.mask.nbytes + size_of(road))


def ecsrc(data: TileData, road: RoadMask, clusters: RoadClusters) -> Work:
    """Bytes: DSM, DTM and mask read, labels written. Operations: `PATCH` x N."""
    read = data.dsm.nbytes + data.dtm.nbytes + road.mask.nbytes
    return Work(PATCH * data.dsm.size, read + size_of(clusters))


def surface(cells: tuple[int, int], points: tuple[int, int]) -> int:
    """Operations to evaluate a spline at H x W cells by the axes in turn: 2 x 4 x (m x W + H x W)."""
    (height, width), (m, _) = cells, points
    return 2 * HEIGHT_SOURCE * (m * width + height * width)


def fit(size: FitSize) -> Work:
    """Operations: s x (2 x fields x surface + `PER_CELL` x H x W): the surface, its transpose for a slope.

    Any solver with s steps evaluates both once in each step; the time to solve the equations is left out.
    Bytes: targets and weights are read once, because a cache may keep them.
    """
    cells = size.cells[0] * size.cells[1]
    step = 2 * size.fields * surface(size.cells, size.points) + PER_CELL * cells
    return Work(size.steps * step, 2 * 8 * cells)


def sample(mesh: Mesh) -> Work:
    """Operations: 2 x 4 x V. Bytes: vertices (24), faces (12) and their classes (1) written."""
    return Work(2 * HEIGHT_SOURCE * len(mesh.vertices), size_of(mesh))


def evaluate(mesh: Mesh, data: TileData) -> Work:
    """Operations: `DRAPE` x n + `FACE` x F + `EDGE` x 3/2 F. Bytes: mesh, reference and mask read."""
    cells, faces = data.core.width * data.core.height, len(mesh.faces)
    return Work(DRAPE * cells + (FACE + 1.5 * EDGE) * faces, size_of(mesh) + 9 * cells)


def assess(data: TileData, points: tuple[int, int]) -> Work:
    """Operations: the surface at n cells and `PER_CELL` x n. Bytes: 22 n: heights, labels, masks."""
    cells = data.core.height, data.core.width
    number = cells[0] * cells[1]
    return Work(surface(cells, points) + PER_CELL * number, (8 + 8 + 4 + 1 + 1) * number)


def export(mesh: Mesh, data: TileData, files: int, points: tuple[int, int]) -> Work:
    """Operations: the surface at n cells. Bytes: mesh, two masks and heights read, the files written."""
    cells = data.core.height, data.core.width
    return Work(surface(cells, points), size_of(mesh) + 6 * cells[0] * cells[1] + files)


def rest(artefacts: int) -> Work:
    """Bytes: the stored results, read and written."""
    return Work(0, 2 * artefacts)


@contextmanager
def counted_fits() -> Iterator[list[FitSize]]:
    """Collect the sizes of the fits in a block; for one thread."""
    from flexroad.tasks.fit import smoothing_spline
    from flexroad.tasks.spline import adam

    fits: list[FitSize] = []
    convex, descent = smoothing_spline.minimise, adam.minimise

    def by_steps(loss: Any, start: Any, *rest: Any, **options: Any) -> Any:
        best, losses = convex(loss, start, *rest, **options)
        fits.append(FitSize(loss.objective.target.shape, start.shape, len(losses) - 1, 1))
        return best, losses

    def by_adam(loss: Any, start: Any, *rest: Any, **options: Any) -> Any:
        best, losses = descent(loss, start, *rest, **options)
        fits.append(FitSize(loss.target.shape, start.shape[1:], len(losses), 2))
        return best, losses

    smoothing_spline.minimise, adam.minimise = by_steps, by_adam
    try:
        yield fits
    finally:
        smoothing_spline.minimise, adam.minimise = convex, descent
