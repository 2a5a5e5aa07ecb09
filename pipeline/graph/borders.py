"""Corners and edges of tiles as nodes of the graph; `tasks.border` computes them.

The fingerprint of such a node depends on its position, the options of its stages and the files that reach the
ground around it. So neighbouring tiles have the same node, and the first tile stores its
result.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from flexroad.catalog import Catalog, Grid, Layer, Tile
from flexroad.catalog.borders import Border, Kind, border_at, places_of
from flexroad.catalog.grid import Bounds
from flexroad.catalog.tile import REACH_M, files_around
from flexroad.pipeline.config.models import Chain, Config
from flexroad.pipeline.config.stages import model_files, stage_head
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.sources import border_json, to_json
from flexroad.tasks.border import BorderStages, BorderTask
from flexroad.tasks.errors import TaskError
from flexroad.tasks.options import Options, stage_module
from flexroad.tasks.spline.space import check_spacing

STAGE = "border"
"""Name of the nodes in the store, the log and the table of failures."""
KEPT = 4096
"""Number of corners and edges that are kept for the tiles of the next row: enough for a thousand tiles."""


def has_borders(fit: Options) -> bool:
    """Return whether a fit method computes the border of a tile together with its neighbours."""
    return hasattr(stage_module(fit), "edge")


@dataclass(frozen=True)
class BorderPattern:
    """The part of border nodes that is the same for all tiles of a run, computed once."""

    stages: BorderStages
    head: str
    """Stages, their `VERSION` and options as JSON: the part of the hashed text that all nodes share."""
    reach_m: float
    """`BorderStages.reach_m`."""
    reads: frozenset[str]
    """`BorderStages.reads`."""
    files: tuple[Path, ...]
    """Files named by the options, such as a model."""

    @classmethod
    def of(cls, chain: Chain) -> BorderPattern:
        """Return the pattern of a variant."""
        stages = BorderStages.of(chain)
        heads = [stage_head(stage, options) for stage, options in stages.by_name.items()]
        head = to_json([STAGE, stage_module(stages.load).VERSION, stages.heights, heads])[1:-1]
        files = tuple(file for options in stages.by_name.values() for file in model_files(options))
        return cls(stages, head, stages.reach_m, stages.reads, files)

    def parts(self, tile: Tile) -> Iterator[tuple[BorderTask, str, list[tuple[Layer, Sequence[int]]]]]:
        """Yield the corners and edges of a tile as they enter fingerprints, in the order of `Frame`'s fields.

        Each has its position as JSON, without the closing bracket, and the layers of `BorderTask.ground` with
        the numbers of their files.
        """
        grid, layers = tile.grid, tile.layers_around(self.reads)
        size = grid.width, grid.height
        for kind, start in places_of(grid):
            border, place, bounds, reach = _described(
                kind, repr(start), size, grid.crs, grid.cell, self.reach_m
            )
            yield BorderTask(border, self.stages), place, files_around(layers, bounds, reach)


# Fingerprints distinguish -0.0 from 0.0 and int from float, so the cache does, too: `start` is a text.
@lru_cache(maxsize=KEPT, typed=True)
def _described(
    kind: Kind, start: str, tile: tuple[int, int], crs: str, cell: float, reach_m: float
) -> tuple[Border, str, Bounds, Bounds]:
    """Return a corner or edge, its position as JSON, its ground, and the area that photo and roads reach."""
    east, north = map(float, start.strip("()").split(", "))
    border = border_at(kind, (east, north), tile, crs, cell, reach_m)
    return border, border_json(border)[:-1], border.grid.bounds, border.within(REACH_M)


def check_tiles(config: Config, catalog: Catalog) -> None:
    """Check that adjacent tiles can have a common surface, if a fit joins them."""
    joined = [chain["fit"] for chain in config.chains.values() if has_borders(chain["fit"])]
    tiles = catalog.usable
    if not joined or not tiles:
        return
    size_m = max(grid.cell * max(grid.shape) for grid in (tile.grid for tile in tiles))
    _check_acting(joined, size_m)
    for fit, cell in itertools.product(joined, {tile.grid.cell for tile in tiles}):
        try:
            check_spacing(fit.spacing_m, cell)
        except TaskError as error:
            raise ConfigError(str(error)) from error
    if len({_lattice(tile.grid) for tile in tiles}) <= 1:
        return
    lattices = [_lattice(tile.grid) for tile in tiles]
    boxes = shapely.box(*np.array([tile.grid.bounds for tile in tiles]).T)
    first, second = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    for a, b in zip(first, second, strict=True):
        one, other = tiles[a], tiles[b]
        if lattices[a] != lattices[b] and one.grid.crs == other.grid.crs:
            raise ConfigError(
                f"tiles {one.id} ({_size(one.grid)}) and {other.id} ({_size(other.grid)}) meet, but are not "
                "of one size on one lattice, so they cannot have one surface; catalog them again with one "
                "tile size, or set fit.method to nurbs, which fits each tile alone"
            )


def _check_acting(fits: Sequence[Options], tile_m: float) -> None:
    for fit in fits:
        module: Any = stage_module(fit)
        # A small tile has a smaller distance of control points than the option.
        acting_m = min(module.acting_m(fit), tile_m)
        if acting_m > REACH_M:
            raise ConfigError(
                f"fit.degree times fit.spacing_m is {acting_m:g} m: control points would act farther than "
                f"the {REACH_M:g} m up to which catalogs list files; lower fit.spacing_m"
            )


def _lattice(grid: Grid) -> tuple[object, ...]:
    """Return cell, size and position on the lattice: they are equal for tiles with a common surface."""
    width, height = grid.width * grid.cell, grid.height * grid.cell
    return (
        grid.crs,
        grid.cell,
        grid.width,
        grid.height,
        _offset(grid.west, width),
        _offset(grid.south, height),
    )


def _offset(position: float, size: float) -> float:
    """Return the distance of an edge from the last multiple of a size (m), rounded to a micrometre."""
    offset = round(position % size, 6)
    return 0.0 if offset >= round(size, 6) else offset


def _size(grid: Grid) -> str:
    return f"{grid.width} x {grid.height} cells of {grid.cell:g} m from {grid.west:.10g} {grid.south:.10g}"
