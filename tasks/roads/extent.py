"""Where the survey ends: the cells that no mesh should reach."""

from __future__ import annotations

import numpy as np
import scipy

from flexroad.tasks.types import Bools, TileData


def beyond_extent(data: TileData) -> Bools:
    """Return the cells beyond the survey, ``(H, W)``.

    Cells with neither DSM nor DTM, in a void (joined over cells' sides) that touches the grid's edge.
    A void inside, as water or deep shade leave one, is no end of the survey: meshes bridge it.
    """
    void = np.isnan(data.dsm) & np.isnan(data.dtm)
    labels, _ = scipy.ndimage.label(void)
    edge = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    beyond: Bools = np.isin(labels, edge[edge > 0])
    return beyond
