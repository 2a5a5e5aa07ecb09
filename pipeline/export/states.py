"""The state of a run's tiles: checked once for all formats of an export, then compared by sizes and times.

To check a tile makes its graph; to compare the sizes and times of its files takes a part of that time. What
is kept of a tile are fingerprints, not its graph: 10,000 graphs would be large.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from hashlib import blake2b

from flexroad.catalog import Tile
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.storage.paths import parse_location, read, stat
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.graph import Pattern, TileGraph, any_file_missing
from flexroad.pipeline.graph.products import product_layers
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Folders, peek_statuses
from flexroad.pipeline.store import checked_json
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.store.records import DONE, MarkerStat, from_item

COMPUTED_AGAIN = "it was computed again while it was exported; export again"


@dataclass(frozen=True)
class TileState:
    """A finished tile, as it was when its run was checked."""

    fingerprint: str
    """Fingerprint of all requested results."""
    nodes: dict[str, str]
    """Fingerprint of each stage of the exported variant."""
    marker: MarkerStat
    files: bytes
    """Hash of the sizes and times of all its files (`FileStates`)."""


class FileStates:
    """Sizes and times of the files that the state of a tile depends on, in one pass over tiles."""

    def __init__(self, run: Run) -> None:
        self._folders, self._stat_file = Folders(run.path), run.stat_cache()
        self._layers = run.pattern.reads.union(product_layers(run.pattern.export))
        self._models = [(str(file), stat(file)) for step in run.pattern.steps for file in step.files]

    def __call__(self, tile: Tile) -> bytes:
        """Return a hash of the names, sizes and times of a tile's results, sources and models."""
        sources = []
        for layer in tile.all_layers:
            if layer.name in self._layers:
                try:
                    sources += [(str(path), self._stat_file(path)) for path in tile.paths(layer)]
                except CatalogError as error:
                    # A layer with files that may not be read is looked up only if the tile needs them.
                    sources.append((str(error), None))
        products = sorted(self._folders(tile.id).items())
        return blake2b(repr((products, sources, self._models)).encode(), digest_size=16).digest()


def tile_states(run: Run, tiles: Iterable[Tile], variant: str) -> Iterator[tuple[Tile, TileState | None]]:
    """Yield each tile with its state, None if it is not finished; checks its sources and its products."""
    files, seen = FileStates(run), b""

    def looked_at() -> Iterator[Tile]:
        nonlocal seen
        for tile in tiles:
            # Before its state is checked: a later change is noticed then.
            seen = files(tile)
            yield tile

    for status in peek_statuses(run, looked_at()):
        graph, record = status.graph, status.last_record
        state = None
        if status.done and record and record.marker:
            state = TileState(graph.fingerprint, graph.variants[variant], record.marker, seen)
        yield graph.around, state


@dataclass(frozen=True)
class RunPlace:
    """What workers need to read results of a run."""

    path: str
    store: str
    pattern: Pattern
    checksum: bool

    @classmethod
    def of(cls, run: Run) -> RunPlace:
        """Return that of a run."""
        return cls(str(run.path), str(run.store), run.pattern, run.checksum)

    @cached_property
    def artefacts(self) -> ArtefactStore:
        """The run's store of stage results."""
        return ArtefactStore(parse_location(self.store))

    def marker(self, tile_id: str) -> MarkerStat | None:
        """Return name, size and version of the marker of a finished tile, None if there is none."""
        file = stat(self._folder(tile_id).file(DONE))
        return (DONE, file.size, file.version) if file else None

    def graph(self, tile: Tile, state: TileState) -> TileGraph:
        """Return the graph of a finished tile; sources that no longer exist count as recorded.

        Raises
        ------
        ConfigError
            If the tile has another graph now.
        """
        graph = self.pattern.graph(tile, self.checksum)
        if graph.fingerprint != state.fingerprint and any_file_missing(graph):
            graph = self.pattern.graph(tile, self.checksum, stat, self._recorded(tile.id))
        if graph.fingerprint != state.fingerprint:
            raise ConfigError(
                f"its sources have changed; run `flexroad rerun {self.path}`, then export again"
            )
        return graph

    def _recorded(self, tile_id: str) -> list[object]:
        try:
            content = checked_json.loads(read(self._folder(tile_id).file(DONE)))
            return from_item(content, None).sources
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return []

    def _folder(self, tile_id: str) -> TileProducts:
        return TileProducts.of(parse_location(self.path), tile_id)
