"""Ground truth of a photogrammetric scene by ECSRC: the paper's DSC3D section.

The paper says that the DTM is refined "via our ECSRC algorithm" and that "road masks, enhanced through
ECSRC", take "ground truth terrain from DTM and road from DSM", and no more. Here

- *refined* means: cells with ground points are clustered like road cells, by their heights. Cells outside
  all clusters of `min_area_m2` differ from the surrounding ground by more than `theta_z_m`: the ground filter
  accepted them wrongly (roofs, hedges, floating fragments), and they are interpolated from their
  surroundings. Cells without ground points are not clustered: interpolated slopes would connect a roof to
  its garden;
- *enhanced* means: the road mask is clustered by the DSM, as in the stage `ecsrc`; cells that are not kept
  (crowns, vehicles, roofs) count as terrain.

This reference has passed the same filter as the method to be evaluated, so it cannot show errors of the
filter. Reports of figures against it must say so (`CIRCULAR`).
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label

from flexroad.catalog.grid import Grid
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.types import Bools, Floats, RoadMask, TileData
from flexroad.tools.prepare.points import tin

CIRCULAR = "reference by ECSRC itself (circular)"
"""Text that is added to the name of data with this reference."""
OPTIONS = ecsrc.Options(keep_largest=None)
"""The paper's thresholds; all clusters of enough area are kept, as their number grows with the area."""


def refine(dtm: Floats, ground: Bools, grid: Grid, fill_m: float, options: ecsrc.Options = OPTIONS) -> Floats:
    """Interpolate the ground cells of a DTM that ECSRC does not keep.

    - `dtm` ``(H, W)``: bare ground as given by a ground filter, m; NaN where there is none.
    - `ground` ``(H, W)``: cells with ground points; the heights of the others are interpolated.
    - `fill_m`: gaps up to this width are interpolated linearly (m), wider ones become NaN.
    - result ``(H, W)``: m; cells without a height in ``dtm`` have none in the result.
    """
    ground = ground & np.isfinite(dtm)
    kept = _kept(dtm, ground, grid, options)
    voids, _ = label(~kept, np.ones((3, 3)))
    # Voids without a removed ground cell keep their interpolated heights.
    replaced = np.isin(voids, voids[ground & ~kept]) & ~kept
    interpolated = tin.fill_voids(np.where(kept, dtm, np.nan), grid, fill_m)
    return np.where(replaced & np.isfinite(dtm), interpolated, dtm)


def reference(
    dsm: Floats, dtm: Floats, road: Bools, grid: Grid, options: ecsrc.Options = OPTIONS
) -> tuple[Floats, Bools]:
    """Return the paper's ground truth: heights of road and terrain, and the road mask, ``(H, W)`` each.

    - `dsm`, `dtm` ``(H, W)``: highest surface and refined bare ground, m; NaN where there is none.
    - `road` ``(H, W)``: the raw road mask.
    """
    kept = _kept(dsm, road, grid, options)
    return np.where(kept, dsm, dtm), kept


def _kept(heights: Floats, cells: Bools, grid: Grid, options: ecsrc.Options) -> Bools:
    """Return the cells that ECSRC keeps when they are clustered by these heights."""
    data = TileData("", grid, grid, heights, heights)
    return ecsrc.ecsrc(data, RoadMask(grid, grid, cells, np.zeros_like(cells)), options).mask
