"""The cells of a tile that raise its flags: what a point or a road passes there."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.tasks.quality.estimate import Compared
from flexroad.tasks.quality.worst import EVERY_WAY, PIECE_M2
from flexroad.tasks.roads.union_find import least_cells
from flexroad.tasks.types import Bools, Floats

Bits = NDArray[np.uint16]
"""Flags of cells or points: bit i is that of ``LOCAL_FLAGS[i]``."""
LOCAL_FLAGS = (
    "error-estimate", "worst-error", "patch", "spike", "edge-step", "loose", "off-dtm", "inferred", "dropped",
)  # fmt: skip
"""Flags of `tasks.quality.assess` that have places; the others concern the complete tile."""
UNKNOWN = np.uint16(1 << 15)
"""Of a tile whose flags are not known: its result is of an earlier version."""


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
    - `dsm_dtm_tolerance_m`: largest difference between two heights of the same ground (m).
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
        "spike": bend(cells.height, road) > limits["spike"] * cell**2,
        "edge-step": edge_step(cells.smooth, road, cells.goes_on) > limits["edge-step"],
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
    """Return the names of the flags of a cell, or of all cells that a geometry passes; ``unknown`` is one."""
    found = [flag for i, flag in enumerate(LOCAL_FLAGS) if bits >> i & 1]
    return (*found, "unknown") if bits & UNKNOWN else tuple(found)


def passed(bits: Bits) -> int:
    """Return the flags of all cells that a geometry passes, from those of its points."""
    return int(np.bitwise_or.reduce(bits, axis=None, initial=0))


def bend(height: Floats, road: Bools) -> Floats:
    """Return the larger second difference of each cell, along its row or column, if all three are road."""
    largest = np.zeros(height.shape)
    for z, on, out in ((height, road, largest), (height.T, road.T, largest.T)):
        middle = np.abs(z[2:] - 2 * z[1:-1] + z[:-2])
        out[1:-1] = np.fmax(out[1:-1], np.where(on[2:] & on[1:-1] & on[:-2], middle, 0.0))
    return largest


def edge_step(height: Floats, road: Bools, goes_on: Bools) -> Floats:
    """Return how far the cell beside the road lies off the line of the last two on it, at the last one."""
    steps, beside = np.zeros(height.shape), ~(road | goes_on)
    for z, on, off, out in ((height, road, beside, steps), (height.T, road.T, beside.T, steps.T)):
        for profile, inside, outside, into in ((z, on, off, out), (z[::-1], on[::-1], off[::-1], out[::-1])):
            step = np.abs(profile[2:] - 2 * profile[1:-1] + profile[:-2])
            at_edge = outside[2:] & inside[1:-1] & inside[:-2]
            into[1:-1] = np.fmax(into[1:-1], np.where(at_edge, step, 0.0))
    return steps


def _pieces(cells: Bools, area_m2: float, cell: float) -> Bools:
    """Return the connected pieces of at least an area."""
    parts, _ = scipy.ndimage.label(cells, EVERY_WAY)
    sizes = np.bincount(parts.ravel())
    return np.asarray(cells & (sizes[parts] >= least_cells(area_m2, cell)))
