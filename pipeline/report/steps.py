"""Height steps between neighbouring tiles along their shared edges.

Tiles are fitted independently, so their surfaces do not meet exactly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np
import pandas as pd

from flexroad.catalog import Grid, Tile
from flexroad.pipeline.graph.graph import Node, TileGraph
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.tasks.types import Floats, RoadMask, Surface

COLUMNS = ["variant", "tile", "neighbour", "mean step (m)", "largest step (m)", "on road, mean (m)"]
MOST = 2000
"""Largest number of tiles compared with their neighbours; of larger runs, every n-th tile is compared."""
KEPT = 1024
"""Tiles whose surfaces are kept in memory until their other neighbours are compared."""

Nodes = tuple[Node, Node]
"""Nodes of the surface and of the road mask."""


def edge_steps(run: Run, most: int = MOST) -> tuple[pd.DataFrame, str]:
    """Return the steps per exported variant and pair of neighbours, and a note on the tiles compared.

    Parameters
    ----------
    run : Run
        The run; pairs whose surfaces are not in its store are left out.
    most : int
        Largest number of tiles compared with their neighbours.

    Returns
    -------
    table : DataFrame
        Columns `COLUMNS`, largest steps first.
    note : str
        Which tiles were compared; empty if all.
    """
    tiles = run.catalog.tiles
    every = math.ceil(len(tiles) / most)
    pairs = list(_pairs(tiles, every))
    wanted = {tile.id: tile for pair in pairs for tile in pair}
    done = {
        status.graph.tile.id: _nodes(status.graph)
        for status in peek_statuses(run, wanted.values())
        if status.done
    }
    rows = [row for variant in run.config.export.variants for row in _rows(run, pairs, done, variant)]
    table = pd.DataFrame(rows, columns=COLUMNS)
    note = f"Of one tile in {every}, against its neighbours in the east and north." if every > 1 else ""
    return table.sort_values("largest step (m)", ascending=False, ignore_index=True), note


def _pairs(tiles: Sequence[Tile], every: int) -> Iterator[tuple[Tile, Tile]]:
    corners = {_corner(tile.grid, tile.grid.west, tile.grid.south): tile for tile in tiles}
    for tile in tiles[::every]:
        grid = tile.grid
        for east, north in ((grid.east, grid.south), (grid.west, grid.north)):
            if other := corners.get(_corner(grid, east, north)):
                yield tile, other


def _nodes(graph: TileGraph) -> dict[str, Nodes]:
    exported = {variant: graph.variants[variant] for variant in graph.export.variants}
    return {v: (graph.nodes[names["fit"]], graph.nodes[names["segment"]]) for v, names in exported.items()}


def _rows(
    run: Run, pairs: Sequence[tuple[Tile, Tile]], done: Mapping[str, Mapping[str, Nodes]], variant: str
) -> Iterator[tuple[str, str, str, float, float, float]]:
    store = ArtefactStore(run.store)

    @lru_cache(KEPT)
    def results(tile_id: str) -> tuple[Surface, RoadMask] | None:
        surface, road = (store.get(node) for node in done[tile_id][variant])
        return (surface[0], road[0]) if surface and road else None

    for tile, other in pairs:
        if tile.id not in done or other.id not in done:
            continue
        here, there = results(tile.id), results(other.id)
        if here and there:
            yield (variant, tile.id, other.id, *_step(tile.grid, other.grid, *here, there[0]))


def _corner(grid: Grid, east: float, north: float) -> tuple[str, float, float]:
    # Rounded to the millimetre, because edges computed from cell sizes differ in the last digits.
    return grid.crs, round(east, 3), round(north, 3)


def _step(grid: Grid, other: Grid, a: Surface, road: RoadMask, b: Surface) -> tuple[float, float, float]:
    east, north = _shared_edge(grid, other)
    inside = ~road.outside[road.grid.cells(east, north)]
    step = np.abs(a.height(east, north) - b.height(east, north))
    step = np.where(inside, step, np.nan)
    on_road = step[road.mask[road.grid.cells(east, north)] & np.isfinite(step)]
    valid = step[np.isfinite(step)]
    return (
        float(valid.mean()) if valid.size else float("nan"),
        float(valid.max()) if valid.size else float("nan"),
        float(on_road.mean()) if on_road.size else float("nan"),
    )


def _shared_edge(grid: Grid, other: Grid) -> tuple[Floats, Floats]:
    """Return eastings and northings of points along the shared edge, one per cell."""
    if other.west > grid.west + grid.cell:
        return np.full(grid.height, grid.east), grid.northings
    return grid.eastings, np.full(grid.width, grid.north)
