"""Where on a tile each flag of `tasks.quality.assess` has its cause: the place to look at first."""

from __future__ import annotations

import numpy as np
import scipy

from flexroad.catalog.grid import Grid
from flexroad.tasks.quality.assess import Options
from flexroad.tasks.quality.estimate import Compared
from flexroad.tasks.quality.flagged import bend, edge_step
from flexroad.tasks.quality.worst import worst_piece
from flexroad.tasks.types import Bools, Floats

AROUND_M = 10.0
"""Side of the square over which errors are added up to find where most of them lie (m)."""

Place = tuple[float, float]
"""Easting and northing of the centre of a cell (m)."""


def places(cells: Compared, grid: Grid, options: Options) -> dict[str, Place]:
    """Return the place of the worst cell, or of the middle of the largest patch, by flag.

    - `cells`: the surface beside DSM and DTM, in the cells of ``grid``.
    - result: easting and northing (m) by flag, whether it is raised or not. Flags without a place are absent:
      those of the complete tile (``weights``, ``no-road``) and those of which the tile has no cell.
    """
    road, dsm_dtm_tolerance_m = cells.on_road, options.dsm_dtm_tolerance_m
    scores = {
        "error-estimate": _around(np.where(road, cells.estimate, 0.0), grid.cell),
        "patch": _depth(_largest_patch(road & (cells.deviation > dsm_dtm_tolerance_m))),
        "spike": bend(cells.height, road),
        "edge-step": edge_step(cells.smooth, road, cells.goes_on),
        "loose": np.where(cells.kept, np.abs(cells.off_dsm), 0.0),
        "off-dtm": _around(
            np.where(road & (np.abs(cells.off_dtm) > dsm_dtm_tolerance_m), 1.0, 0.0), grid.cell
        ),
        "inferred": _depth(_largest_patch(cells.lacking)),
        "dropped": _depth(_largest_patch(road & ~cells.kept)),
    }
    found = {flag: place for flag, score in scores.items() if (place := _highest(score, grid)) is not None}
    worst = worst_piece(cells.estimate, road, grid)
    return found if worst is None else found | {"worst-error": (worst.easting, worst.northing)}


def _highest(score: Floats, grid: Grid) -> Place | None:
    """Return the centre of the cell with the highest score, None if no score is positive."""
    score = np.nan_to_num(score, nan=0.0)
    row, col = (int(i) for i in np.unravel_index(int(np.argmax(score)), score.shape))
    return (float(grid.eastings[col]), float(grid.northings[row])) if score[row, col] > 0 else None


def _around(values: Floats, cell: float) -> Floats:
    """Return the mean over a square around each cell."""
    size = 2 * max(1, round(AROUND_M / cell / 2)) + 1
    return np.asarray(scipy.ndimage.uniform_filter(np.nan_to_num(values), size, mode="constant"))


def _largest_patch(cells: Bools) -> Bools:
    patches, number = scipy.ndimage.label(cells)
    return np.asarray(patches == 1 + np.argmax(np.bincount(patches[cells])[1:])) if number else cells


def _depth(cells: Bools) -> Floats:
    """Return the distance of each cell to the outside of its patch (cells); largest in the middle."""
    # Cells beyond the tile are outside, too.
    return np.asarray(scipy.ndimage.distance_transform_edt(np.pad(cells, 1))[1:-1, 1:-1])
