"""Where on a tile each flag of `tasks.quality.assess` has its cause: the place to look at first."""

from __future__ import annotations

import numpy as np
import scipy

from flexroad.catalog.grid import Grid
from flexroad.tasks.quality.assess import Options
from flexroad.tasks.quality.estimate import Compared
from flexroad.tasks.types import Bools, Floats

AROUND_M = 10.0
"""Side of the square over which errors are added up to find where most of them lie (m)."""

Place = tuple[float, float]
"""Easting and northing of the centre of a cell (m)."""


def places(cells: Compared, grid: Grid, options: Options) -> dict[str, Place]:
    """Return the place of the worst cell, or of the middle of the largest patch, by flag.

    Parameters
    ----------
    cells : Compared
        The surface beside DSM and DTM, in the cells of ``grid``.

    Returns
    -------
    dict of str to tuple
        Easting and northing (m) by flag, whether it is raised or not. Flags without a place are absent: those
        of the complete tile (``weights``, ``no-road``) and those of which the tile has no cell.
    """
    road, agree_m = cells.on_road, options.agree_m
    scores = {
        "error-estimate": _around(np.where(road, cells.estimate, 0.0), grid.cell),
        "patch": _depth(_largest_patch(road & (cells.deviation > agree_m))),
        "spike": _bend(cells.height, road),
        "edge-step": _edge_step(cells.smooth, road, cells.goes_on),
        "loose": np.where(cells.kept, np.abs(cells.off_dsm), 0.0),
        "off-dtm": _around(np.where(road & (np.abs(cells.off_dtm) > agree_m), 1.0, 0.0), grid.cell),
        "inferred": _depth(_largest_patch(cells.lacking)),
        "dropped": _depth(_largest_patch(road & ~cells.kept)),
    }
    return {flag: place for flag, score in scores.items() if (place := _highest(score, grid)) is not None}


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


def _bend(height: Floats, road: Bools) -> Floats:
    """Return the larger second difference of each cell, along its row or column, if all three are road."""
    bend = np.zeros(height.shape)
    for z, on, out in ((height, road, bend), (height.T, road.T, bend.T)):
        middle = np.abs(z[2:] - 2 * z[1:-1] + z[:-2])
        out[1:-1] = np.fmax(out[1:-1], np.where(on[2:] & on[1:-1] & on[:-2], middle, 0.0))
    return bend


def _edge_step(height: Floats, road: Bools, goes_on: Bools) -> Floats:
    """Return how far the cell beside the road lies off the line of the last two on it, at the last one."""
    steps, beside = np.zeros(height.shape), ~(road | goes_on)
    for z, on, off, out in ((height, road, beside, steps), (height.T, road.T, beside.T, steps.T)):
        for profile, inside, outside, into in ((z, on, off, out), (z[::-1], on[::-1], off[::-1], out[::-1])):
            step = np.abs(profile[2:] - 2 * profile[1:-1] + profile[:-2])
            at_edge = outside[2:] & inside[1:-1] & inside[:-2]
            into[1:-1] = np.fmax(into[1:-1], np.where(at_edge, step, 0.0))
    return steps
