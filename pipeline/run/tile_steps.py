"""Steps between the surfaces of neighbouring tiles, of methods whose tiles have no common borders."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Bounds
from flexroad.tasks.types import Bools, Floats

LARGEST_M = 0.05
"""Step up to which tiles carry a road; tiles with common borders meet."""
REMEDY = "use a run of production, whose tiles have common borders"

HeightOf = Callable[[int, Floats, Floats, Bools], Floats]
"""Heights of the surface of the tile with a number at x and y, for some of the lines."""


def largest_tile_step(
    start: Floats,
    end: Floats,
    tile_of_start: NDArray[np.int64],
    tile_of_end: NDArray[np.int64],
    bounds: Sequence[Bounds],
    height: HeightOf,
) -> float:
    """Return the largest step (m) on lines from one tile to another; 0 if there are none.

    Both surfaces are taken where the line leaves the first tile.

    - `start`, `end` ``(2, n)``: eastings and northings of the ends of the lines (m).
    - `tile_of_start`, `tile_of_end` ``(n,)``: numbers of their tiles; -1 if there is none.
    - `bounds`: of each tile.
    - `height`: NaN beyond the survey.
    """
    steps = [0.0]
    crossing = (tile_of_start != tile_of_end) & (tile_of_start >= 0) & (tile_of_end >= 0)
    pairs = np.unique(np.stack([tile_of_start, tile_of_end])[:, crossing], axis=1)
    for one, other in pairs.T.tolist():
        lines = (tile_of_start == one) & (tile_of_end == other)
        x, y = _leaving(bounds[one], start[:, lines], end[:, lines])
        steps += np.abs(height(one, x, y, lines) - height(other, x, y, lines)).tolist()
    return float(np.nanmax(steps))


def length_text(metres: float, digits: int = 0) -> str:
    """Return a length for the user, in millimetres below one metre."""
    return f"{1000 * metres:.{digits}f} mm" if metres < 1 else f"{metres:.2f} m"


def _leaving(bounds: Bounds, start: Floats, end: Floats) -> Floats:
    """Return where lines from inside a rectangle, ``(2, n)``, leave it, or end."""
    along = end - start
    edges = np.where(along > 0, np.reshape(bounds[2:], (2, 1)), np.reshape(bounds[:2], (2, 1)))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(along == 0, np.inf, (edges - start) / along)
    return np.asarray(start + np.clip(share.min(axis=0), 0.0, 1.0) * along)
