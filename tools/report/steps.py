"""Steps and angles between the surfaces of neighbouring tiles along their shared edges.

The surfaces of a fit that shares its borders (`pipeline.graph.borders`) meet exactly; this is checked here.
Other fits do not use the neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np
import pandas as pd

from flexroad.catalog import Grid, Tile
from flexroad.pipeline.graph.borders import has_borders
from flexroad.pipeline.run.finished import RunPlace
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import TileStatus, Track, untracked
from flexroad.tasks.types import Floats, RoadMask, Surface

Results = dict[str, dict[str, tuple[str, str]]]
"""Exported variant -> finished tile -> fingerprints of its surface and road mask. Thousands of graphs would
need too much memory."""


def add_results(results: Results, status: TileStatus) -> None:
    """Add the results of a tile if it is finished."""
    if status.done:
        graph = status.graph
        for variant in graph.export.variants:
            stages = graph.variants[variant]
            results.setdefault(variant, {})[graph.tile.id] = stages["fit"], stages["segment"]


MEAN, LARGEST, ON_ROAD, ANGLE = "mean step (m)", "largest step (m)", "on road, mean (m)", "largest angle (°)"
COLUMNS = ["variant", "tile", "neighbour", MEAN, LARGEST, ON_ROAD, ANGLE]
CHECK = ["variant", "edges", MEAN, LARGEST, ANGLE, "result"]
MOST = 2000
"""Largest number of tiles compared with their neighbours; in larger runs, every n-th tile is compared."""
KEPT = 1024
"""Tiles whose surfaces are kept in memory until their other neighbours are compared."""


def edge_steps(
    run: Run, results: Results, track: Track = untracked
) -> tuple[pd.DataFrame, pd.DataFrame, str]:
    """Return the steps at the shared edges of finished tiles; surfaces missing from the store are left out.

    - result: one row per exported variant, columns `CHECK`, empty if no two neighbours are done; one row per
      edge where the surfaces do not meet, columns `COLUMNS`, largest steps first; and a note if only some
      tiles were compared.
    """
    tiles = run.catalog.usable
    every = math.ceil(len(tiles) / MOST)
    pairs = list(_pairs(tiles, every))
    rows = [
        row
        for variant in run.config.export.variants
        for row in _rows(
            run, track(pairs, "comparing neighbours", len(pairs)), results.get(variant, {}), variant
        )
    ]
    table = pd.DataFrame(rows, columns=COLUMNS)
    check = [_checked(run, str(variant), part) for variant, part in table.groupby("variant", sort=False)]
    apart = table[(table[LARGEST] != 0) | (table[ANGLE] != 0)]
    note = f"Of one tile in {every}, against its neighbours in the east and north." if every > 1 else ""
    apart = apart.sort_values(LARGEST, ascending=False, ignore_index=True)
    return pd.DataFrame(check, columns=CHECK), apart, note


def _checked(run: Run, variant: str, edges: pd.DataFrame) -> tuple[str, int, float, float, float, str]:
    """Return the row of a variant in the table of `CHECK`."""
    largest, angle = float(edges[LARGEST].max()), float(edges[ANGLE].max())
    result = "tiles are fitted independently"
    if has_borders(run.config.chains[variant]["fit"]):
        # NaN (all edges lie outside the survey) is taken as no difference.
        apart = int(((edges[LARGEST] > 0) | (edges[ANGLE] > 0)).sum())
        result = (
            f"error: {apart} edges do not meet" if apart else "one surface: all differences are exactly 0"
        )
    return variant, len(edges), float(edges[MEAN].mean()), largest, angle, result


def _pairs(tiles: Sequence[Tile], every: int) -> Iterator[tuple[Tile, Tile]]:
    beside = [
        (tile, _corner(tile.grid, east, north))
        for tile in tiles[::every]
        for east, north in ((tile.grid.east, tile.grid.south), (tile.grid.west, tile.grid.north))
    ]
    wanted = {corner for _, corner in beside}
    corners = ((_corner(tile.grid, tile.grid.west, tile.grid.south), tile) for tile in tiles)
    found = {corner: tile for corner, tile in corners if corner in wanted}
    for tile, corner in beside:
        if other := found.get(corner):
            yield tile, other


def _rows(
    run: Run, pairs: Iterable[tuple[Tile, Tile]], done: Mapping[str, tuple[str, str]], variant: str
) -> Iterator[tuple[str, str, str, float, float, float, float]]:
    place = RunPlace.of(run)

    @lru_cache(KEPT)
    def results(tile_id: str) -> tuple[Surface, RoadMask] | None:
        return place.stored(*done[tile_id])

    for tile, other in pairs:
        if tile.id not in done or other.id not in done:
            continue
        here, there = results(tile.id), results(other.id)
        if here and there:
            yield (variant, tile.id, other.id, *_step(tile.grid, other.grid, *here, there[0]))


def _corner(grid: Grid, east: float, north: float) -> tuple[str, float, float]:
    # Rounded to the millimetre, because edges computed from cell sizes differ in the last digits.
    return grid.crs, round(east, 3), round(north, 3)


def _step(
    grid: Grid, other: Grid, a: Surface, road: RoadMask, b: Surface
) -> tuple[float, float, float, float]:
    """Return mean and largest step, mean step on roads (m), and largest angle of the normals (degrees)."""
    if other.west > grid.west + grid.cell:
        east, north = np.full(grid.height, grid.east), grid.northings
    else:
        east, north = grid.eastings, np.full(grid.width, grid.north)
    cells = road.grid.cells(east, north)
    inside = ~road.outside[cells]
    step = np.abs(a.height(east, north) - b.height(east, north))
    angle = _angle_deg(a.normal(east, north), b.normal(east, north))
    on_road = inside & road.mask[cells]
    # Unlike max, fmax leaves out NaN. It is NaN if all values are NaN.
    largest, turn = (float(np.fmax.reduce(values[inside], initial=math.nan)) for values in (step, angle))
    return _mean(step[inside]), largest, _mean(step[on_road]), turn


def _angle_deg(a: Floats, b: Floats) -> Floats:
    """Return the angles between unit normals, ``(n,)``."""
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(sine, (a * b).sum(axis=-1))))


def _mean(values: Floats) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else math.nan
