"""What an export is made of: the finished tiles of a run, with their surfaces and meshes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Bounds, Tile
from flexroad.catalog.area import Area
from flexroad.catalog.storage.paths import Location, stat
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.export.states import (
    COMPUTED_AGAIN,
    FileStates,
    RunPlace,
    TileState,
    tile_states,
)
from flexroad.pipeline.graph.graph import TileGraph
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Track, untracked
from flexroad.pipeline.worker.evaluator import Evaluator, StageError
from flexroad.tasks.io.vertical import vertical_crs
from flexroad.tasks.quality import assess
from flexroad.tasks.types import Floats, Mesh, Quality, RoadClusters, RoadMask, Surface, TileData


@dataclass(frozen=True, eq=False)
class FinishedTile:
    """One finished tile of a run; results are read from the store when they are used."""

    tile: Tile
    variant: str
    state: TileState
    place: RunPlace

    @property
    def id(self) -> str:
        """Id of the tile."""
        return self.tile.id

    @property
    def label(self) -> str:
        """Name of the tile in messages."""
        return f"tile {self.id}"

    @property
    def fingerprint(self) -> str:
        """Name of the mesh by what it was made of."""
        return self.state.nodes["sample"]

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

    @property
    def road(self) -> RoadMask:
        """The road mask before the filter, with the cells beyond the survey."""
        road: RoadMask = self._result("segment")
        return road

    @property
    def clusters(self) -> RoadClusters:
        """The road after the filter."""
        clusters: RoadClusters = self._result("ecsrc")
        return clusters

    @property
    def quality(self) -> Quality:
        """Figures and support of the surface."""
        quality: Quality = self._result("assess")
        return quality

    @property
    def data(self) -> TileData:
        """The rasters; read from the source files."""
        data: TileData = self._result("load")
        return data

    @property
    def cell_errors(self) -> tuple[Floats, NDArray[np.uint8]]:
        """Estimated error (m) and support of each cell of the core; needs the source files."""
        options = self.graph.nodes[self.state.nodes["assess"]].options
        assert isinstance(options, assess.Options)
        return assess.cell_errors(self.data, self.road, self.clusters, self.surface, options)

    @cached_property
    def graph(self) -> TileGraph:
        """The graph of the tile, made again from the files that it had when it was finished.

        Raises
        ------
        ConfigError
            If the tile has another graph now.
        """
        return self.place.graph(self.tile, self.state)

    def check_unchanged(self) -> None:
        """Check that the run has not written the tile again since its state was checked.

        Raises
        ------
        ConfigError
            If it has.
        """
        if self.place.marker(self.id) != self.state.marker:
            raise ConfigError(f"{self.label}: {COMPUTED_AGAIN}")

    @cached_property
    def _results(self) -> dict[str, Any]:
        return {}

    @cached_property
    def _evaluator(self) -> Evaluator:
        return Evaluator(self.graph, self.place.artefacts)

    def _result(self, stage: str) -> Any:
        """Return the result of a stage: from the store, or computed if it is missing or damaged there."""
        name = self.state.nodes[stage]
        if stage not in self._results:
            stored = self.place.artefacts.find(stage, name)
            self._results[stage] = self._computed(name) if stored is None else stored.value
        return self._results[stage]

    def _computed(self, name: str) -> Any:
        try:
            return self._evaluator(name)
        except StageError as error:
            raise ConfigError(f"{self.label}: {error}") from error


@dataclass(frozen=True, eq=False)
class OfTile:
    """What has the id and the name of a finished tile; sent to a worker."""

    tile: FinishedTile

    @property
    def id(self) -> str:
        """Id of the tile."""
        return self.tile.id

    @property
    def label(self) -> str:
        """Its name in messages."""
        return self.tile.label


def layer_state(tile: Tile, name: str) -> str:
    """Return the files of a tile's layer with their sizes and versions; empty if the tile has none."""
    layer = tile.layer(name)
    reaching = layer.reaching(tile.grid.bounds) if layer else None
    return str([(str(path), stat(path)) for path in tile.paths(reaching)]) if reaching else ""


@dataclass(frozen=True, eq=False)
class Source:
    """The finished tiles of a run that an export contains."""

    run: Run
    variant: str
    tiles: tuple[Tile, ...]
    """In the order of the catalog."""
    left_out: tuple[str, ...]
    """Ids of selected tiles that are not finished."""
    states: tuple[TileState, ...]
    """The state of each tile when the tiles were selected."""

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
        """Yield the tiles one by one, as they were when they were selected.

        Only sizes and times of their files are compared, so that each format can have a pass of its own.

        Raises
        ------
        ConfigError
            If a tile is no longer finished, as its sources have changed in the meantime, or has a new result.
        """
        files, place = FileStates(self.run), RunPlace.of(self.run)
        for tile, state in zip(self.tiles, self.states, strict=True):
            current = state if files(tile) == state.files else self._checked(tile, state)
            yield FinishedTile(tile, self.variant, current, place)

    def _checked(self, tile: Tile, before: TileState) -> TileState:
        """Return the state of a tile of which a file has another size or time than before."""
        ((_, state),) = tile_states(self.run, [tile], self.variant)
        if state is None:
            raise ConfigError(
                f"{self.run.path}: tile {tile.id} is no longer finished; "
                f"run `flexroad rerun {self.run.path}`, then export again"
            )
        if state.fingerprint != before.fingerprint:
            raise ConfigError(f"tile {tile.id}: {COMPUTED_AGAIN}")
        return state


def select(
    location: Location,
    ids: Sequence[str] = (),
    bbox: Bounds | None = None,
    variant: str | None = None,
    allow: Sequence[str] = (),
    area: Area | None = None,
    track: Track = untracked,
) -> Source:
    """Return the finished tiles of a run, of all or of the selected tiles.

    The state of each selected tile is checked here, once for all formats.

    Parameters
    ----------
    track : callable
        Shows the progress of that.

    Raises
    ------
    ConfigError
        If the folder is no run, the variant has no meshes in the store, no selected tile is finished, or
        tiles have different CRSs.
    CatalogError
        If an id is not in the run, or no tile touches the box or the area.
    """
    run = Run.open(location, allow)
    variants = run.config.export.variants
    variant = variant or variants[0]
    if variant not in variants:
        raise ConfigError(f"{location} exports no variant {variant!r}; it has {', '.join(variants)}")
    wanted = run.catalog.select(ids, bbox, area).tiles
    checked = track(tile_states(run, wanted, variant), "checking tiles", len(wanted))
    done = {tile.id: state for tile, state in checked if state}
    tiles = tuple(tile for tile in wanted if tile.id in done)
    if not tiles:
        raise ConfigError(f"{location} has no finished tile to export; see `flexroad status {location}`")
    systems = {tile.grid.crs for tile in tiles}
    if len(systems) > 1:
        raise ConfigError(f"{location} has tiles in {len(systems)} CRSs; select tiles of one with --bbox")
    left_out = tuple(tile.id for tile in wanted if tile.id not in done)
    return Source(run, variant, tiles, left_out, tuple(done[tile.id] for tile in tiles))
