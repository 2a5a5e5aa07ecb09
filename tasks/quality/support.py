"""What stands behind the fitted surface, cell by cell: a measurement, the terrain model, or neither.

The fit draws road cells that the filter kept to the DSM, all others to the DTM; a cell without that height
leaves the loss, and the surface goes on through it. Where something hides a road, the DTM stands in; whether
it is sound there, the road that can be seen beside tells.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.roads.dtm_validity import AGREE_M, without_invalid_dtm
from flexroad.tasks.types import Mesh, RoadClusters, RoadMask, TileData


class Support(IntEnum):
    """What the surface's height in a cell rests on."""

    NONE = 0
    """Beyond the survey; there is no mesh."""
    MEASURED = 1
    """The scan saw the ground: a road cell that the filter kept, or a cell where DSM and DTM agree."""
    DTM = 2
    """Something hides the ground, and the terrain model tells its height."""
    INFERRED = 3
    """No height entered the fit: the surface goes on from the cells around."""


def support(
    data: TileData, road: RoadMask, clusters: RoadClusters, agree_m: float = AGREE_M
) -> NDArray[np.uint8]:
    """Return the `Support` of every cell, ``(H, W)``, in a fit to the DSM on roads and the DTM elsewhere.

    Parameters
    ----------
    data : TileData
        DSM and DTM, m.
    road : RoadMask
        Gives the cells beyond the survey.
    clusters : RoadClusters
        The road cells that count by their DSM, and those whose DTM does not count.
    agree_m : float
        Greatest difference of a DSM and a DTM that saw the same ground (m).
    """
    modelled = np.isfinite(without_invalid_dtm(data, clusters).dtm)
    agreed = modelled & (np.abs(data.dsm - data.dtm) <= agree_m)
    found = np.where(modelled & ~clusters.mask, Support.DTM, Support.INFERRED).astype(np.uint8)
    found[np.where(clusters.mask, np.isfinite(data.dsm), agreed)] = Support.MEASURED
    found[road.outside] = Support.NONE
    return found


def of_faces(found: NDArray[np.uint8], road: RoadMask, mesh: Mesh) -> NDArray[np.uint8]:
    """Return the `Support` under the centroid of each face, ``(F,)``, from that of the core's cells."""
    x, y = (mesh.vertices[:, axis][mesh.faces].mean(axis=1) + mesh.origin[axis] for axis in (0, 1))
    return np.asarray(found[road.core.cells(x, y)])
