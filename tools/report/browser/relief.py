"""The background of the map: relief and roads of every finished tile, in one picture of a modest size."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from flexroad.catalog import Tile
from flexroad.pipeline.run.finished import RunPlace
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Track, untracked
from flexroad.tasks.types import Floats, RoadMask, Surface
from flexroad.tools.report.render import sunlight
from flexroad.tools.report.steps import Results

PIXELS = 2_000_000
"""Pixels of the complete picture."""
SIDE_PX = (6, 320)
"""Smallest and largest side of the part of one tile."""
QUALITY = 62
"""Quality of the WebP picture."""
EXAGGERATION = 2.0
"""Factor of the slopes; terrain without buildings is flat."""
LEVEL, ROAD = 226, 92
"""Grey of level ground and of roads."""
OPACITY = 0.78
"""Opacity of roads over the relief."""


@dataclass(frozen=True)
class _Relief:
    """One picture with the tiles side by side, in squares of equal size."""

    webp: bytes
    side_px: int
    """Side of the square of a tile."""
    columns: int
    """Squares in a row of the picture."""
    places: dict[str, int]
    """Number of the square of each tile by id, row by row from the top left."""


def relief(run: Run, tiles: Iterable[Tile], results: Results, track: Track = untracked) -> _Relief | None:
    """Draw the surfaces of tiles as a shaded relief with their roads; None if none is in the store.

    - `tiles`: the tiles to draw; those whose surface is not in the store are left out.
    """
    tiles = list(tiles)
    if not tiles:
        return None
    side = min(max(math.isqrt(PIXELS // len(tiles)), SIDE_PX[0]), SIDE_PX[1])
    columns = math.isqrt(len(tiles) - 1) + 1
    picture = np.zeros((side * math.ceil(len(tiles) / columns), side * columns, 2), np.uint8)
    place, stored = RunPlace.of(run), results.get(run.config.export.variants[0], {})
    places: dict[str, int] = {}
    for tile in track(tiles, "drawing the map", len(tiles)):
        if tile.id not in stored or not (found := place.stored(*stored[tile.id])):
            continue
        row, column = divmod(len(places), columns)
        square = picture[row * side : (row + 1) * side, column * side : (column + 1) * side]
        square[:] = _square(*found, side)
        places[tile.id] = len(places)
    if not places:
        return None
    buffer = io.BytesIO()
    Image.fromarray(picture, "LA").convert("RGBA").save(buffer, "webp", quality=QUALITY, method=4)
    return _Relief(buffer.getvalue(), side, columns, places)


def _square(surface: Surface, road: RoadMask, side: int) -> NDArray[np.uint8]:
    """Return grey and opacity of one tile, ``(side, side, 2)``; pixels are not square if the tile is not."""
    grid = road.core
    step_x, step_y = grid.width * grid.cell / side, grid.height * grid.cell / side
    # One pixel beyond each edge, so that the shading goes on across tiles.
    beyond: Floats = np.arange(-1.0, side + 1.0) + 0.5
    east: Floats = np.asarray(grid.west + beyond * step_x)
    north: Floats = np.asarray(grid.north - beyond * step_y)
    height = surface.lattice(east, north)
    to_south, to_east = np.gradient(EXAGGERATION * height, step_y, step_x)
    light = sunlight(np.asarray(to_east), np.asarray(to_south))
    grey = np.clip(LEVEL * light, 0.35 * LEVEL, 255.0)[1:-1, 1:-1]
    share, outside = (_resampled(cells, road, side) for cells in (road.mask, road.outside))
    grey = grey + OPACITY * share * (ROAD - grey)
    visible = np.isfinite(grey) & (outside < 0.5)
    return np.dstack([np.where(visible, np.nan_to_num(grey), LEVEL), 255 * visible]).astype(np.uint8)


def _resampled(cells: NDArray[np.bool_], road: RoadMask, side: int) -> Floats:
    """Return the share of True cells in each pixel."""
    core = np.ascontiguousarray(cells[road.grid.window(road.core)], np.float32)
    return np.asarray(cv2.resize(core, (side, side), interpolation=cv2.INTER_AREA), np.float64)
