"""The extent of the survey: cells beyond it get no mesh.

A fitted surface goes on beyond the survey, but its heights there are no heights of the ground.
"""

from __future__ import annotations

import numpy as np
import scipy

from flexroad.tasks.types import Bools, TileData


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
