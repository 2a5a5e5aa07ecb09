"""Ground truth of a photogrammetric scene by ECSRC: the paper's DSC3D section.

The paper says that the DTM is refined "via our ECSRC algorithm" and that "road masks, enhanced through
ECSRC", take "ground truth terrain from DTM and road from DSM", and no more. Here

- *refined* means: the cells in which ground was found are clustered like road cells, on their own heights.
  What is in no cluster of `min_area_m2` stands apart from all ground around it by more than `theta_z_m`: it
  is what the ground filter let through (roofs, hedges, floating shreds), and is replaced from around it.
  Cells between them take no part: their slopes would tie a roof to its garden;
- *enhanced* means: the road mask is clustered on the DSM, as by the stage `ecsrc`; the rest of it (crowns,
  vehicles, roofs) counts as terrain.

A reference made like this has passed the same filter as the method it is to judge: it cannot show what the
filter does wrong. Whoever reports figures against it has to say so (`CIRCULAR`).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points import fill_voids
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.types import Bools, Floats, RoadMask, TileData

CIRCULAR = "reference by ECSRC itself (circular)"
"""What the name of such data has to say."""
OPTIONS = ecsrc.Options(keep_largest=None)
"""The paper's thresholds. All clusters of enough area stay: how many there are depends on the area's size."""


def refine(dtm: Floats, ground: Bools, grid: Grid, fill_m: float, options: ecsrc.Options = OPTIONS) -> Floats:
    """Replace the cells of a DTM that ECSRC does not find on the ground.

    Parameters
    ----------
    dtm : ndarray, (H, W)
        Bare ground as a ground filter left it, m; NaN where unknown.
    ground : ndarray of bool, (H, W)
        Cells in which ground was found; the heights of the others come from around them.
    grid : Grid
        Its cells.
    fill_m : float
        Gaps up to this width are bridged linearly (m), wider ones become unknown.
    options : ecsrc.Options
        Thresholds in metres.

    Returns
    -------
    ndarray, (H, W)
        m; cells without a height before have none after.
    """
    ground = ground & np.isfinite(dtm)
    kept = _kept(dtm, ground, grid, options)
    voids_of_all, _ = label(~kept, np.ones((3, 3)))
    # Voids that lost no ground keep the heights they were bridged with.
    force = np.isin(voids_of_all, voids_of_all[ground & ~kept]) & ~kept
    bridged = fill_voids.fill(np.where(kept, dtm, np.nan), grid, fill_m)
    return np.where(force & np.isfinite(dtm), bridged, dtm)


def reference(
    dsm: Floats, dtm: Floats, road: Bools, grid: Grid, options: ecsrc.Options = OPTIONS
) -> tuple[Floats, Bools]:
    """Return the paper's ground truth: height of road and terrain, and which cells are road, ``(H, W)`` each.

    Parameters
    ----------
    dsm, dtm : ndarray, (H, W)
        Highest surface and refined bare ground, m; NaN where unknown.
    road : ndarray of bool, (H, W)
        The raw road mask.
    grid : Grid
        Their cells.
    options : ecsrc.Options
        Thresholds in metres.
    """
    kept = _kept(dsm, road, grid, options)
    return np.where(kept, dsm, dtm), kept


def _kept(heights: Floats, cells: Bools, grid: Grid, options: ecsrc.Options) -> Bools:
    """Return those of the cells that ECSRC keeps, clustered on these heights."""
    data = TileData("", grid, grid, heights, heights)
    return ecsrc.ecsrc(data, RoadMask(grid, grid, cells, np.zeros_like(cells)), options).mask
