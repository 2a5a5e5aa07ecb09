"""How well neighbouring tiles meet: the height step along their shared edge.

Tiles are fitted independently, so nothing makes their surfaces meet; this says how far they do.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from catalog import Grid
from pipeline.graph import TileGraph
from pipeline.run import Run
from pipeline.store import Store
from pipeline.work import Pull
from tasks.types import Floats, RoadMask, Surface

COLUMNS = ["variant", "tile", "neighbour", "mean step (m)", "largest step (m)", "on road, mean (m)"]


def edge_steps(run: Run) -> pd.DataFrame:
    """Return one row per exported variant and pair of neighbours, the largest steps first.

    Only pairs whose surfaces are in the store are told of.
    """
    rows = [row for variant in run.config.export.variants for row in _rows(run, variant)]
    table = pd.DataFrame(rows, columns=COLUMNS)
    return table.sort_values("largest step (m)", ascending=False, ignore_index=True)


def _rows(run: Run, variant: str) -> Iterator[tuple[str, str, str, float, float, float]]:
    store = Store(run.store)
    graphs = {graph.tile.id: graph for graph in run.graphs() if run.folder(graph.tile.id).done(graph)}
    corners = {_corner(g.tile.grid, g.tile.grid.west, g.tile.grid.south): g for g in graphs.values()}
    for graph in graphs.values():
        grid = graph.tile.grid
        for east, north in ((grid.east, grid.south), (grid.west, grid.north)):
            other = corners.get(_corner(grid, east, north))
            if other is None or not (_kept(graph, variant, store) and _kept(other, variant, store)):
                continue
            yield (variant, graph.tile.id, other.tile.id, *_step(graph, other, variant, store))


def _corner(grid: Grid, east: float, north: float) -> tuple[str, float, float]:
    # To the millimetre: edges that are sums of cell sizes differ in the last digits.
    return grid.crs, round(east, 3), round(north, 3)


def _kept(graph: TileGraph, variant: str, store: Store) -> bool:
    return all(store.has(graph.nodes[graph.variants[variant][stage]]) for stage in ("fit", "segment"))


def _step(graph: TileGraph, other: TileGraph, variant: str, store: Store) -> tuple[float, float, float]:
    east, north = _shared_edge(graph.tile.grid, other.tile.grid)
    a, road = _results(graph, variant, store)
    b, _ = _results(other, variant, store)
    inside = ~road.outside[road.grid.cells(east, north)]
    step = np.abs(a.height(east, north) - b.height(east, north))
    step = np.where(inside, step, np.nan)
    on_road = step[road.mask[road.grid.cells(east, north)] & np.isfinite(step)]
    known = step[np.isfinite(step)]
    return (
        float(known.mean()) if known.size else float("nan"),
        float(known.max()) if known.size else float("nan"),
        float(on_road.mean()) if on_road.size else float("nan"),
    )


def _shared_edge(grid: Grid, other: Grid) -> tuple[Floats, Floats]:
    """Return points along the edge, one per cell."""
    if other.west > grid.west + grid.cell:
        return np.full(grid.height, grid.east), grid.northings
    return grid.eastings, np.full(grid.width, grid.north)


def _results(graph: TileGraph, variant: str, store: Store) -> tuple[Surface, RoadMask]:
    pull = Pull(graph, store)
    made = graph.variants[variant]
    return pull(made["fit"]), pull(made["segment"])
