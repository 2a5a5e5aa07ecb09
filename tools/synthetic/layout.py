"""The tiles of a synthetic survey."""

from __future__ import annotations

import math
from itertools import islice

from flexroad.catalog.grid import Grid

WEST_M, SOUTH_M = 500_000, 5_600_000
"""South-west corner of a block: on the central meridian of EPSG:25832, a multiple of common tile sizes."""


def block(
    tiles: int, size_m: int = 250, cell: float = 1.0, crs: str = "EPSG:25832"
) -> list[tuple[str, Grid]]:
    """Return the ids and grids of a near-square block of neighbouring tiles.

    - `tiles`: number of tiles; the last row may be incomplete.
    - `size_m`: side of a tile on the absolute grid (m).
    - `cell`: cell size (m).
    - `crs`: coordinate reference system in metres.
    """
    columns = math.ceil(math.sqrt(tiles))
    rows = math.ceil(tiles / max(columns, 1))
    west, south = WEST_M // size_m * size_m, SOUTH_M // size_m * size_m
    bounds = (west, south, west + columns * size_m, south + rows * size_m)
    return list(islice(Grid.covering(crs, bounds, cell).tiles(size_m), tiles)) if tiles > 0 else []
