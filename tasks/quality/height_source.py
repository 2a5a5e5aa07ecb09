"""Height source of the fitted surface in each cell: a measurement, the terrain model, or neither.

The fit uses the DSM on road cells that the filter kept and the DTM on all others; a cell without that height
is left out of the loss, and the surface is extrapolated across it. Where an object hides the road, the DTM is
used if it agrees with the visible road beside (`tasks.roads.dtm_validity`).
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.meshing.lines import middles
from flexroad.tasks.roads.dtm_validity import DSM_DTM_TOLERANCE_M, valid_dtm
from flexroad.tasks.types import Mesh, Quality, RoadClusters, RoadMask, TileData


class HeightSource(IntEnum):
    """Source of the surface's height in a cell."""

    NONE = 0
    """Beyond the survey, where there is no mesh."""
    MEASURED = 1
    """The DSM shows the ground: a road cell that the filter kept, or a cell where DSM and DTM agree."""
    DTM = 2
    """An object hides the ground, and the height comes from the DTM."""
    INFERRED = 3
    """The fit had no height; the surface is extrapolated from the cells around."""


def height_source(
    data: TileData, road: RoadMask, clusters: RoadClusters, dsm_dtm_tolerance_m: float = DSM_DTM_TOLERANCE_M
) -> NDArray[np.uint8]:
    """Return the `HeightSource` of each cell, ``(H, W)``, fitted to the DSM on roads and the DTM elsewhere.

    - `data`: DSM and DTM, m.
    - `road`: gives the cells beyond the survey.
    - `clusters`: the road cells fitted to their DSM, and the cells with an invalid DTM.
    """
    has_dtm = np.isfinite(valid_dtm(data, clusters))
    agreed = has_dtm & (np.abs(data.dsm - data.dtm) <= dsm_dtm_tolerance_m)
    classes = np.where(has_dtm & ~clusters.mask, HeightSource.DTM, HeightSource.INFERRED).astype(np.uint8)
    classes[np.where(clusters.mask, np.isfinite(data.dsm), agreed)] = HeightSource.MEASURED
    classes[road.outside] = HeightSource.NONE
    return classes


def of_faces(
    classes: NDArray[np.uint8], road: RoadMask, mesh: Mesh, others: Sequence[tuple[int, Quality]]
) -> NDArray[np.uint8]:
    """Return the `HeightSource` of the core cell under the centroid of each face, ``(F,)``.

    Faces at the limit of the survey, and at the outline of a deck, are inferred where the cell lies beyond.

    - `classes`: the height sources of the cells of level 0.
    - `others`: number and quality of the other levels.
    """
    cells = road.core.cells(*(middles(mesh.vertices, mesh.faces) + mesh.origin[:2]).T)
    kinds = classes[cells]
    if mesh.level is not None:
        for number, of_level in others:
            kinds = np.where(mesh.level == number, of_level.height_source[cells], kinds)
    return np.where(kinds == HeightSource.NONE, np.uint8(HeightSource.INFERRED), kinds)


def top_height_source(quality: Quality, top: NDArray[np.int8]) -> NDArray[np.uint8]:
    """Return the `HeightSource` of the highest level in each cell of the core, ``(H, W)``.

    - `quality`: the quality of level 0, with the other levels.
    - `top` ``(H, W)``: number of the highest level in each cell.
    """
    classes = quality.height_source.copy()
    for number, of_level in quality.levels:
        here = (top == number) & (number > 0)
        classes[here] = of_level.height_source[here]
    return classes
