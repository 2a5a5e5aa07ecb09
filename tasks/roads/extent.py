"""The extent of the survey: cells beyond it get no mesh.

A fitted surface goes on beyond the survey, but its heights there are no heights of the ground. Formats
without meshes ask here what is covered.
"""

from __future__ import annotations

import numpy as np
import scipy

from flexroad.catalog.grid import Bounds
from flexroad.tasks.types import Bools, RoadMask, TileData


def beyond_extent(data: TileData) -> Bools:
    """Return the cells beyond the survey, ``(H, W)``.

    These are the cells with neither DSM nor DTM in a void (4-connected) that touches the grid's edge. A void
    inside, as in water or deep shade, is not beyond the survey: meshes bridge it.
    """
    void = np.isnan(data.dsm) & np.isnan(data.dtm)
    if not any(side.any() for side in (void[0], void[-1], void[:, 0], void[:, -1])):
        return np.zeros(void.shape, np.bool_)
    labels, count = scipy.ndimage.label(void)
    beyond = np.zeros(count + 1, np.bool_)
    for side in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        beyond[side] = True
    beyond[0] = False
    outside: Bools = beyond[labels]
    return outside


def covered(road: RoadMask) -> tuple[Bounds, float]:
    """Return the smallest rectangle around all covered cells of a tile, and what of it is beyond the survey.

    - `bounds`: west, south, east and north (m); those of the core if none of its cells is covered.
    - `beyond_m2`: area within the bounds that is beyond the survey (m2).
    """
    core, inside = road.core, ~road.outside[road.grid.window(road.core)]
    if inside.all() or not inside.any():
        return core.bounds, float((~inside).sum() * core.cell**2)
    rows, cols = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    top, bottom, left, right = rows[0], rows[-1] + 1, cols[0], cols[-1] + 1
    west, north = core.bounds[0], core.bounds[3]
    bounds = (
        float(west + left * core.cell),
        float(north - bottom * core.cell),
        float(west + right * core.cell),
        float(north - top * core.cell),
    )
    return bounds, float((~inside[top:bottom, left:right]).sum() * core.cell**2)
