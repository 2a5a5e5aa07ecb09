"""The cells of a tile that raise its flags, and the places to look at first.

The worst error is the error of a connected piece of road, not of a single cell.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.compiled import compiled
from flexroad.tasks.quality.estimate import Compared
from flexroad.tasks.roads.union_find import Roots, find, least_cells, unite
from flexroad.tasks.types import Bools, Floats

Bits = NDArray[np.uint16]
"""Flags of cells or points: bit i is the flag ``LOCAL_FLAGS[i]``."""
LOCAL_FLAGS = (
    "error-estimate", "worst-error", "patch", "spike", "edge-step", "loose", "off-dtm", "inferred", "dropped",
)  # fmt: skip
"""Flags of `tasks.quality.assess` that have places; other flags concern the complete tile."""
UNKNOWN = np.uint16(1 << 15)
"""The flag of a tile whose flags are not known, because its result is from an earlier version."""
PIECE_M2 = 25.0
"""Area of a faulty piece of road (m2): too small for a mean over the tile, but noticeable in use."""
EVERY_WAY = np.ones((3, 3), bool)
"""Neighbours of a cell, also at its corners."""
AROUND_M = 10.0
"""Side of the square over which errors are averaged to find the worst place (m)."""
Place = tuple[float, float]
"""Easting and northing of the centre of a cell (m)."""


def flagged_cells(
    cells: Compared,
    cell: float,
    limits: Mapping[str, float],
    dsm_dtm_tolerance_m: float,
    raised: Collection[str],
) -> Bits:
    """Return the raised flags of each cell, ``(H, W)``.

    - `cells`: the surface beside DSM and DTM.
    - `cell`: size of a cell (m).
    - `limits`: threshold of each flag.
    - `raised`: the flags of the tile.
    """
    road = cells.on_road
    bits = np.zeros(road.shape, np.uint16)
    if not any(flag in raised for flag in LOCAL_FLAGS):
        return bits
    found = {
        "error-estimate": road & (cells.estimate > limits["error-estimate"]),
        "worst-error": _pieces(road & (cells.estimate > limits["worst-error"]), PIECE_M2, cell),
        "patch": _pieces(road & (cells.deviation > dsm_dtm_tolerance_m), limits["patch"], cell),
        "spike": (bends(cells.height, road) > limits["spike"] * cell**2).any(axis=0),
        "edge-step": (edge_steps(cells) > limits["edge-step"]).any(axis=0),
        "loose": cells.kept & (np.abs(cells.off_dsm) > limits["loose"]),
        "off-dtm": road & (np.abs(cells.off_dtm) > dsm_dtm_tolerance_m),
        "inferred": cells.lacking,
        "dropped": road & ~cells.kept,
    }
    for i, flag in enumerate(LOCAL_FLAGS):
        if flag in raised:
            bits[found[flag]] |= np.uint16(1 << i)
    return bits


def flag_names(bits: int) -> tuple[str, ...]:
    """Return the names of the flags of a cell, or of all cells that a geometry passes, also ``unknown``."""
    found = [flag for i, flag in enumerate(LOCAL_FLAGS) if bits >> i & 1]
    return (*found, "unknown") if bits & UNKNOWN else tuple(found)


def passed(bits: Bits) -> int:
    """Return the flags of all cells that a geometry passes, from the flags of its points."""
    return int(np.bitwise_or.reduce(bits, axis=None, initial=0))


def bends(height: Floats, road: Bools, last: Bools | None = None) -> Floats:
    """Return absolute second differences (m) at the middle of three cells, ``(k, H, W)``; NaN elsewhere.

    They run along rows and along columns over three cells of the road. With ``last``, only two cells are road
    and the third is a cell of ``last``; they then run in all four directions.
    """
    found = np.full((2 if last is None else 4, *height.shape), np.nan)
    end = road if last is None else last
    ways: list[Callable[[Any], Any]] = [np.asarray, np.transpose, np.flipud, lambda z: z.T[::-1]]
    for out, way in zip(found, ways, strict=False):
        z, on, beyond = way(height), way(road), way(end)
        bend = np.abs(z[2:] - 2 * z[1:-1] + z[:-2])
        way(out)[1:-1] = np.where(beyond[2:] & on[1:-1] & on[:-2], bend, np.nan)
    return found


def edge_steps(cells: Compared) -> Floats:
    """Return how far the cell beside the road lies off the line of the last two road cells, ``(4, H, W)``, m.

    The value is at the last road cell. At abutments it is NaN: the road continues as a deck or in a tunnel.
    """
    return bends(cells.smooth, cells.on_road, ~(cells.on_road | cells.goes_on))


def _pieces(cells: Bools, area_m2: float, cell: float) -> Bools:
    """Return the connected pieces of at least an area."""
    parts, _ = scipy.ndimage.label(cells, EVERY_WAY)
    sizes = np.bincount(parts.ravel())
    return np.asarray(cells & (sizes[parts] >= least_cells(area_m2, cell)))


def worst_piece(estimate: Floats, road: Bools, grid: Grid) -> tuple[float, Place]:
    """Return the largest value (m) that the estimates of `PIECE_M2` of connected road reach, and its place.

    The place is the cell with the largest estimate in that piece. If all connected roads are smaller than
    `PIECE_M2`, the largest of them is the piece. Without road, the values are NaN.

    - `estimate`: estimated error (m), finite on the road.
    - `road`: road cells.
    - `grid`: the grid of both.
    """
    parts, number = scipy.ndimage.label(road, EVERY_WAY)
    if not number:
        return np.nan, (np.nan, np.nan)
    least = min(least_cells(PIECE_M2, grid.cell), float(np.bincount(parts[road]).max()))
    members = np.flatnonzero(road)
    values = estimate.ravel()[members]
    # Equal estimates stay in the order of cells, so that the place does not depend on the sort.
    order = members[np.argsort(-values, kind="stable")]
    last = _last_of_piece(order, np.full(road.size, -1, np.int32), road.shape[1], least)
    value = float(estimate.ravel()[last])
    parts, _ = scipy.ndimage.label(road & (estimate >= value), EVERY_WAY)
    piece = parts == parts.ravel()[last]
    return value, _highest(np.where(piece, estimate, -np.inf), grid)


@compiled()
def _last_of_piece(order: NDArray[np.intp], roots: Roots, cols: int, least: float) -> int:
    """Return the first cell, in the given order, with which a connected piece has ``least`` cells."""
    sizes = np.ones(roots.size, np.int32)
    rows = roots.size // cols
    for i in order:
        roots[i] = i
        row, col = i // cols, i % cols
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(col - 1, 0), min(col + 2, cols)):
                j = r * cols + c
                if roots[j] < 0:
                    continue
                a, b = find(roots, i), find(roots, j)
                if a != b:
                    unite(roots, a, b)
                    sizes[min(a, b)] = sizes[a] + sizes[b]
        if sizes[find(roots, i)] >= least:
            return int(i)
    return int(order[-1])


def places(cells: Compared, grid: Grid, dsm_dtm_tolerance_m: float) -> dict[str, Place]:
    """Return the place of the worst cell, or of the middle of the largest patch, by flag.

    - `cells`: the surface beside DSM and DTM, in the cells of ``grid``.
    - result: easting and northing (m) by flag, whether it is raised or not. Flags without a place are absent:
      flags of the complete tile (``weights``, ``no-road``) and flags without a cell on the tile.
    """
    road = cells.on_road
    scores = {
        "error-estimate": _around(np.where(road, cells.estimate, 0.0), grid.cell),
        "patch": _depth(largest_patch(road & (cells.deviation > dsm_dtm_tolerance_m))),
        "spike": np.fmax.reduce(bends(cells.height, road)),
        "edge-step": np.fmax.reduce(edge_steps(cells)),
        "loose": np.where(cells.kept, np.abs(cells.off_dsm), 0.0),
        "off-dtm": _around(
            np.where(road & (np.abs(cells.off_dtm) > dsm_dtm_tolerance_m), 1.0, 0.0), grid.cell
        ),
        "inferred": _depth(largest_patch(cells.lacking)),
        "dropped": _depth(largest_patch(road & ~cells.kept)),
    }
    found = dict[str, Place]()
    for flag, score in scores.items():
        score = np.nan_to_num(score, nan=0.0)
        if score.max() > 0:
            found[flag] = _highest(score, grid)
    _, worst = worst_piece(cells.estimate, road, grid)
    return found | {"worst-error": worst} if road.any() else found


def _highest(score: Floats, grid: Grid) -> Place:
    """Return the centre of the cell with the highest score."""
    row, col = np.unravel_index(int(np.argmax(score)), score.shape)
    return float(grid.eastings[col]), float(grid.northings[row])


def _around(values: Floats, cell: float) -> Floats:
    """Return the mean over a square around each cell."""
    size = 2 * max(1, round(AROUND_M / cell / 2)) + 1
    return np.asarray(scipy.ndimage.uniform_filter(np.nan_to_num(values), size, mode="constant"))


def largest_patch(cells: Bools) -> Bools:
    """Return the cells of the largest connected patch, ``(H, W)``."""
    patches, number = scipy.ndimage.label(cells)
    return np.asarray(patches == 1 + np.argmax(np.bincount(patches[cells])[1:])) if number else cells


def _depth(cells: Bools) -> Floats:
    """Return the distance of each cell to the outside of its patch (cells); largest in the middle."""
    # Cells beyond the tile are outside, too.
    return np.asarray(scipy.ndimage.distance_transform_edt(np.pad(cells, 1))[1:-1, 1:-1])
