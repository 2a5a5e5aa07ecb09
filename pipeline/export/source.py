"""What an export is made of: the finished tiles of a run, with their surfaces and meshes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from flexroad.catalog import Bounds, Tile
from flexroad.catalog.storage.paths import Location, parse_location
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.graph import TileGraph
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator, StageError
from flexroad.tasks.io.vertical import vertical_crs
from flexroad.tasks.types import Mesh, Surface


@dataclass(frozen=True, eq=False)
class FinishedTile:
    """One finished tile of a run; results are read from the store when they are used."""

    graph: TileGraph
    variant: str
    store: str
    """The run's store of stage results."""

    @property
    def id(self) -> str:
        """Id of the tile."""
        return self.graph.tile.id

    @property
    def fingerprint(self) -> str:
        """Name of the mesh by what it was made of."""
        return self.graph.variants[self.variant]["sample"]

    @property
    def mesh(self) -> Mesh:
        """The mesh of road and terrain."""
        mesh: Mesh = self._result("sample")
        return mesh

    @property
    def surface(self) -> Surface:
        """The fitted surface."""
        surface: Surface = self._result("fit")
        return surface

    @cached_property
    def _evaluator(self) -> Evaluator:
        return Evaluator(self.graph, ArtefactStore(parse_location(self.store)))

    def _result(self, stage: str) -> Any:
        try:
            return self._evaluator(self.graph.variants[self.variant][stage])
        except StageError as error:
            raise ConfigError(f"tile {self.id}: {error}") from error


@dataclass(frozen=True, eq=False)
class Source:
    """The finished tiles of a run that an export contains."""

    run: Run
    variant: str
    tiles: tuple[Tile, ...]
    """In the order of the catalog."""
    left_out: tuple[str, ...]
    """Ids of selected tiles that are not finished."""

    @property
    def crs(self) -> str:
        """The horizontal CRS of all tiles."""
        return self.tiles[0].grid.crs

    @cached_property
    def vertical(self) -> str | None:
        """The vertical CRS of the heights, by the files of the first tile; None if it is not known."""
        return vertical_crs(self.tiles[0])

    @property
    def origin(self) -> tuple[float, float]:
        """Whole-metre easting and northing that meshes of the run are relative to."""
        return self.run.origin

    def finished(self) -> Iterator[FinishedTile]:
        """Yield the tiles one by one.

        Raises
        ------
        ConfigError
            If a tile is no longer finished, as its sources have changed in the meantime.
        """
        for status in peek_statuses(self.run, self.tiles):
            if not status.done:
                raise ConfigError(
                    f"{self.run.path}: tile {status.graph.tile.id} is no longer finished; "
                    f"run `flexroad rerun {self.run.path}`, then export again"
                )
            yield FinishedTile(status.graph, self.variant, str(self.run.store))


def select(
    location: Location,
    ids: Sequence[str] = (),
    bbox: Bounds | None = None,
    variant: str | None = None,
    allow: Sequence[str] = (),
) -> Source:
    """Return the finished tiles of a run, of all or of the selected tiles.

    Raises
    ------
    ConfigError
        If the folder is no run, the variant has no meshes in the store, no selected tile is finished, or
        tiles have different CRSs.
    CatalogError
        If an id is not in the run, or no tile touches the box.
    """
    run = Run.open(location, allow)
    variants = run.config.export.variants
    variant = variant or variants[0]
    if variant not in variants:
        raise ConfigError(f"{location} exports no variant {variant!r}; it has {', '.join(variants)}")
    wanted = run.catalog.select(ids, bbox).tiles
    done = {status.graph.tile.id for status in peek_statuses(run, wanted) if status.done}
    tiles = tuple(tile for tile in wanted if tile.id in done)
    if not tiles:
        raise ConfigError(f"{location} has no finished tile to export; see `flexroad status {location}`")
    systems = {tile.grid.crs for tile in tiles}
    if len(systems) > 1:
        raise ConfigError(f"{location} has tiles in {len(systems)} CRSs; select tiles of one with --bbox")
    return Source(run, variant, tiles, tuple(tile.id for tile in wanted if tile.id not in done))
