"""Heights of a run at any place, from the surfaces of its tiles, of which a process keeps a few in memory."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Bounds, Tile
from flexroad.catalog.storage.paths import parse_location
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.export.source import FinishedTile
from flexroad.pipeline.graph.graph import TileGraph
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator, StageError
from flexroad.tasks.quality import assess
from flexroad.tasks.types import Bools, Floats, Surface

SURFACES, ESTIMATES = 128, 32
"""Numbers of tiles of which a process keeps surface (some 0.2 MB each) and error estimates (0.6 MB)."""


@dataclass(frozen=True)
class RunName:
    """What a process needs to open a run."""

    path: str
    variant: str
    allow: tuple[str, ...]


@dataclass(frozen=True)
class TileName:
    """A finished tile: what a process needs to find its results."""

    id: str
    bounds: Bounds
    fingerprint: str
    """Of its assessment, which depends on its surface and on its input."""

    @classmethod
    def of(cls, tile: FinishedTile) -> TileName:
        """Return the name of a tile."""
        return cls(tile.id, tile.tile.grid.bounds, tile.state.nodes["assess"])


@dataclass(frozen=True)
class Ground:
    """The common ground of some finished tiles."""

    run: RunName
    tiles: tuple[TileName, ...]

    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights (m) at points (m, in the run's CRS), in their broadcast shape.

        NaN off the tiles and beyond the survey. Where tiles meet, the first one with a height counts.

        Raises
        ------
        ConfigError
            If a result of a tile cannot be read, or the run has changed.
        """
        easting, northing = np.broadcast_arrays(easting, northing)
        height = np.full(easting.shape, np.nan)
        for tile in self.tiles:
            here = np.isnan(height) & _within(tile.bounds, easting, northing)
            if here.any():
                height[here] = _patch(self.run, tile).height(easting[here], northing[here])
        return height

    def error(self, easting: Floats, northing: Floats) -> tuple[Floats, NDArray[np.uint8]]:
        """Return the estimated error (m) of the surface and its `tasks.quality.support.Support`, ``(n,)``.

        They are those of the cell at each point. NaN and 0 where no surface is, or its input is gone.
        """
        error, support = np.full(easting.shape, np.nan), np.zeros(easting.shape, np.uint8)
        for tile in self.tiles:
            here = (support == 0) & _within(tile.bounds, easting, northing)
            estimate = _estimate(self.run, tile) if here.any() else None
            if estimate is not None:
                cells = estimate.tile.grid.cells(easting[here], northing[here])
                error[here], support[here] = estimate.error[cells], estimate.support[cells]
        return error, support


@dataclass(frozen=True, eq=False)
class _Patch:
    tile: Tile
    surface: Surface
    outside: Bools
    """Cells beyond the survey, ``(H, W)``."""

    def height(self, easting: Floats, northing: Floats) -> Floats:
        beyond = self.outside[self.tile.grid.cells(easting, northing)]
        return np.where(beyond, np.nan, self.surface.height(easting, northing))


@dataclass(frozen=True, eq=False)
class _Estimate:
    tile: Tile
    error: NDArray[np.float32]
    support: NDArray[np.uint8]


def _within(bounds: Bounds, easting: Floats, northing: Floats) -> Bools:
    west, south, east, north = bounds
    within = (west <= easting) & (easting <= east) & (south <= northing) & (northing <= north)
    return np.asarray(within)


@lru_cache(maxsize=SURFACES)
def _patch(run: RunName, tile: TileName) -> _Patch:
    graph, evaluate = _opened(run, tile)
    nodes = graph.variants[run.variant]
    try:
        surface, road = evaluate(nodes["fit"]), evaluate(nodes["segment"])
    except StageError as error:
        raise ConfigError(f"tile {tile.id}: {error}") from error
    return _Patch(graph.tile, surface, road.outside[road.grid.window(road.core)])


@lru_cache(maxsize=ESTIMATES)
def _estimate(run: RunName, tile: TileName) -> _Estimate | None:
    """Return the estimates of a tile; None if its input cannot be read any more."""
    graph, evaluate = _opened(run, tile)
    nodes = graph.variants[run.variant]
    options = graph.nodes[nodes["assess"]].options
    try:
        data, road, clusters, surface = (
            evaluate(nodes[stage]) for stage in ("load", "segment", "ecsrc", "fit")
        )
    except StageError:
        return None
    assert isinstance(options, assess.Options)
    error, support = assess.cell_errors(data, road, clusters, surface, options)
    return _Estimate(graph.tile, error.astype(np.float32), support)


def _opened(run: RunName, tile: TileName) -> tuple[TileGraph, Evaluator]:
    for _ in range(2):
        opened, tiles = _run(run)
        for status in peek_statuses(opened, [tiles[tile.id]] if tile.id in tiles else []):
            if status.graph.variants.get(run.variant, {}).get("assess") == tile.fingerprint:
                return status.graph, Evaluator(status.graph, ArtefactStore(opened.store))
        # This process may have opened the run before it was changed.
        _run.cache_clear()
    raise ConfigError(
        f"tile {tile.id} has changed during the export; run `flexroad rerun {run.path}`, then export again"
    )


@lru_cache(maxsize=1)
def _run(run: RunName) -> tuple[Run, dict[str, Tile]]:
    opened = Run.open(parse_location(run.path), run.allow)
    return opened, {tile.id: tile for tile in opened.catalog.usable}
