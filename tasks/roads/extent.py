"""The extent of the survey: cells beyond it get no mesh."""

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
    labels, _ = scipy.ndimage.label(void)
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    beyond: Bools = np.isin(labels, edge[edge > 0])
    return beyond
