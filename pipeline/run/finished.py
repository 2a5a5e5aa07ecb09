"""The results of finished tiles: the only reader of a run's stored results.

The state of tiles is checked once, for all formats of an export. Later, only sizes and times of files are
compared, because a check of a tile makes its graph and takes longer. Only fingerprints are kept of a tile:
10,000 graphs would be large.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Grid, Tile
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.guard.source_files import source_stat
from flexroad.catalog.storage.paths import Location, parse_location
from flexroad.catalog.text import count, some
from flexroad.pipeline.config.stages import STAGE_NAMES
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.graph import Pattern, TileGraph, any_file_missing, product_layers
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import TileStatus, last_record, peek_statuses, tile_files
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.store.records import MarkerStat, distances_of
from flexroad.pipeline.worker.evaluator import Evaluator, StageError
from flexroad.pipeline.worker.tile import marker_stat
from flexroad.tasks.metrics.evaluate import FIGURES
from flexroad.tasks.quality import assess
from flexroad.tasks.quality.estimate import compare
from flexroad.tasks.quality.flagged import Bits, Place, places
from flexroad.tasks.types import Floats, Mesh, Metrics, Quality, RoadClusters, RoadMask, Surface, TileData

ESTIMATES = 32
"""Number of tiles of which a process keeps the error estimates (0.6 MB each)."""
SURFACES = 128
"""Number of tiles of which a process keeps surface and road mask (some 0.7 MB each)."""
NO_DISTANCES = (math.nan,) * len(FIGURES)
"""Distances of a tile without a mesh (m)."""
SEE_REPORT = "`flexroad report` says what is wrong there"
COMPUTED_AGAIN = "it was computed again while it was exported; export again"


def open_variant(
    path: Location | str, variant: str | None = None, allow: Sequence[str | Path] = ()
) -> tuple[Run, str]:
    """Return an opened run with the variant whose results are used; by default the first exported variant."""
    run = Run.open(path, allow)
    variant = variant or run.config.export.variants[0]
    if variant not in run.config.chains:
        raise ConfigError(f"{path} has no variant {variant!r}; it has {', '.join(run.config.chains)}")
    return run, variant


@dataclass(frozen=True, slots=True)
class Snapshot:
    """A tile when its state was checked; small, because an export has a snapshot of each of its tiles."""

    fingerprint: str
    """Fingerprint of all requested results."""
    digests: bytes
    """Fingerprints of the stages of the variant that is read, joined (`nodes`)."""
    marker: MarkerStat | None
    """Name, size and version of its marker, or None."""
    files: bytes = b""
    """Hash of the sizes and times of all its files (`file_states`); empty if they are not compared."""
    distances: tuple[float, ...] = NO_DISTANCES
    """Distances of its mesh from its surface (m) in the order of `FIGURES`; NaN if unknown."""

    @classmethod
    def of(cls, status: TileStatus, variant: str, files: bytes = b"") -> Snapshot:
        """Return the snapshot of a tile whose state has just been checked."""
        graph, record = status.graph, status.last_record
        digests = _digests(graph, variant)
        if record is None:
            return cls(graph.fingerprint, digests, None, files)
        own = next((distances_of(row) for row in record.rows if row["variant"] == variant), {})
        distances = tuple(own.get(name, math.nan) for name in FIGURES)
        return cls(graph.fingerprint, digests, record.marker, files, distances)

    @property
    def nodes(self) -> dict[str, str]:
        """Fingerprint of each stage."""
        names, size = self.digests.hex(), 2 * len(self.digests) // len(STAGE_NAMES)
        return {stage: names[size * i : size * (i + 1)] for i, stage in enumerate(STAGE_NAMES)}


def _digests(graph: TileGraph, variant: str) -> bytes:
    return bytes.fromhex("".join(node.fingerprint for node in graph.chain(variant)))


def file_states(run: Run) -> Callable[[Tile], bytes]:
    """Return a function from a tile to a hash of names, sizes and times of its results, sources and models.

    It is for one pass over tiles: sources in a bucket are looked up once.
    """
    files_of, stat_file = tile_files(run.path), run.stat_cache()
    layers = run.pattern.reads.union(product_layers(run.pattern.export))
    models = [(str(file), source_stat(file)) for step in run.pattern.steps for file in step.files]

    def state(tile: Tile) -> bytes:
        sources = []
        for layer in (layer for layer in tile.all_layers if layer.name in layers):
            try:
                sources += [(str(path), stat_file(path)) for path in tile.paths(layer)]
            except CatalogError as error:
                # A layer is looked up only if the tile needs it: files of other layers may be forbidden.
                sources.append((str(error), None))
        products = sorted(files_of(tile.id).items())
        return blake2b(repr((products, sources, models)).encode(), digest_size=16).digest()

    return state


def snapshots(run: Run, tiles: Iterable[Tile], variant: str) -> Iterator[tuple[Tile, Snapshot | None]]:
    """Yield each tile with its snapshot, None if it is not finished; checks its sources and products."""
    state, seen = file_states(run), b""

    def looked_at() -> Iterator[Tile]:
        nonlocal seen
        for tile in tiles:
            # Files are hashed before the state is checked, so that a later change is noticed.
            seen = state(tile)
            yield tile

    for status in peek_statuses(run, looked_at()):
        finished = status.done and status.last_record and status.last_record.marker
        yield status.graph.around, Snapshot.of(status, variant, seen) if finished else None


@dataclass(frozen=True)
class RunPlace:
    """The data with which workers read results of a run."""

    path: str
    store: str
    pattern: Pattern
    checksum: bool

    @classmethod
    def of(cls, run: Run) -> RunPlace:
        """Return the place of a run."""
        return cls(str(run.path), str(run.store), run.pattern, run.checksum)

    @cached_property
    def artefacts(self) -> ArtefactStore:
        """The run's store of stage results."""
        return ArtefactStore(parse_location(self.store))

    def stored(self, fit: str, segment: str) -> tuple[Surface, RoadMask] | None:
        """Return surface and road mask by their fingerprints, None if the store lacks one of them."""
        surface, road = self.artefacts.find("fit", fit), self.artefacts.find("segment", segment)
        return (surface.value, road.value) if surface and road else None

    def marker(self, tile_id: str) -> MarkerStat | None:
        """Return name, size and version of the marker of a finished tile, or None."""
        return marker_stat(self._folder(tile_id), "done")

    def graph(self, tile: Tile, snapshot: Snapshot) -> TileGraph:
        """Return the graph of a finished tile; recorded values are used for sources that no longer exist."""
        graph = self.pattern.graph(tile, self.checksum)
        folder = self._folder(tile.id)
        changed = graph.fingerprint != snapshot.fingerprint
        if changed and (record := last_record(folder, None, folder.files())):
            if any_file_missing(graph):
                graph = self.pattern.graph(tile, self.checksum, source_stat, record.sources)
            graph = graph.renamed(record.renamed)
        if graph.fingerprint != snapshot.fingerprint:
            raise ConfigError(
                f"its sources have changed; run `flexroad rerun {self.path}`, then export again"
            )
        return graph

    def _folder(self, tile_id: str) -> TileProducts:
        return TileProducts.of(parse_location(self.path), tile_id)


@dataclass(frozen=True, eq=False)
class FinishedTile:
    """One tile of a run in one variant; its results are read from the store when they are used.

    Results that are missing or damaged there are computed and not stored.
    """

    tile: Tile
    variant: str
    snapshot: Snapshot
    place: RunPlace
    evaluator: Evaluator | None = None
    """Reads and computes the results if the graph is known (`of`); None: it is made when it is needed."""

    @classmethod
    def of(cls, run: Run, status: TileStatus, variant: str) -> FinishedTile:
        """Return a tile whose state has just been checked; results of an unfinished tile are computed."""
        place = RunPlace.of(run)
        evaluator = Evaluator(status.graph, place.artefacts)
        return cls(status.graph.around, variant, Snapshot.of(status, variant), place, evaluator)

    @classmethod
    def last(cls, run: Run, status: TileStatus, variant: str) -> FinishedTile:
        """Return the last finished state of a tile; a result that the store no longer has is an error."""
        nodes = run.folder(status.graph.tile.id).nodes(variant)
        try:
            digests = bytes.fromhex("".join(nodes[stage] for stage in STAGE_NAMES))
        except (KeyError, TypeError, ValueError):
            digests = b""  # The marker is damaged.
        return cls(status.graph.around, variant, Snapshot("", digests, None), RunPlace.of(run))

    def in_variant(self, variant: str) -> FinishedTile:
        """Return the tile in another variant; common results are read or computed once."""
        snapshot = replace(self.snapshot, digests=_digests(self.graph, variant))
        return replace(self, variant=variant, snapshot=snapshot, evaluator=self._evaluator)

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
        """Name of the mesh that depends on all of its inputs."""
        return self.snapshot.nodes["sample"]

    @property
    def mesh(self) -> Mesh:
        """The mesh of road and terrain."""
        return cast(Mesh, self._result("sample"))

    @property
    def metrics(self) -> Metrics:
        """The errors of the mesh."""
        return cast(Metrics, self._result("evaluate"))

    @property
    def surface(self) -> Surface:
        """The fitted surface."""
        return cast(Surface, self._result("fit"))

    @property
    def road(self) -> RoadMask:
        """The road mask before the filter, with the cells beyond the survey."""
        return cast(RoadMask, self._result("segment"))

    @property
    def clusters(self) -> RoadClusters:
        """The road after the filter."""
        return cast(RoadClusters, self._result("ecsrc"))

    @property
    def quality(self) -> Quality:
        """Figures and height source of the surface."""
        return cast(Quality, self._result("assess"))

    @property
    def data(self) -> TileData:
        """The rasters; read from the source files."""
        return cast(TileData, self._result("load"))

    @property
    def assessment(self) -> assess.Options:
        """The options of `quality`."""
        return cast(assess.Options, self.graph.nodes[self.snapshot.nodes["assess"]].options)

    def level_errors(self, number: int) -> tuple[Floats, NDArray[np.uint8]]:
        """Return estimated error (m) and height source of each cell of the core; needs the source files.

        If the tile does not have the level, level 0 is used.
        """
        inputs = self.data, self.road, self.clusters, self.surface
        return assess.cell_errors(*inputs, self.assessment, number)

    @property
    def top_errors(self) -> tuple[Floats, NDArray[np.uint8]]:
        """Estimated error (m) and height source of each cell on its highest level."""
        return assess.top_errors(self.data, self.road, self.clusters, self.surface, self.assessment)

    @property
    def flag_places(self) -> dict[str, Place]:
        """Easting and northing (m) by raised flag, for flags with a place; needs the source files."""
        flags = self.quality.flags
        if not flags:
            return {}
        data = self.data
        cells = compare(
            data, self.road, self.clusters, self.surface, self.assessment.dsm_dtm_tolerance_m, only_road=True
        )
        found = places(cells, data.core, self.assessment.dsm_dtm_tolerance_m)
        return {flag: found[flag] for flag in flags if flag in found}

    @cached_property
    def graph(self) -> TileGraph:
        """The graph of the tile, made again from the files when it was finished."""
        return self.evaluator.graph if self.evaluator else self.place.graph(self.tile, self.snapshot)

    def check_unchanged(self) -> None:
        """Check that the run has not written the tile again since its state was checked."""
        if self.place.marker(self.id) != self.snapshot.marker:
            raise ConfigError(f"{self.label}: {COMPUTED_AGAIN}")

    @cached_property
    def _results(self) -> dict[str, Any]:
        return {}

    @cached_property
    def _evaluator(self) -> Evaluator:
        return self.evaluator or Evaluator(self.graph, self.place.artefacts)

    def _result(self, stage: str) -> Any:
        """Return the result of a stage: from the store, or computed if it is missing or damaged there."""
        name = self.snapshot.nodes[stage]
        if stage not in self._results:
            # An evaluator searches the store itself. Without an evaluator, a stored result needs no graph.
            stored = None if self.evaluator else self.place.artefacts.find(stage, name)
            try:
                self._results[stage] = stored.value if stored else self._evaluator(name)
            except StageError as error:
                raise ConfigError(f"{self.label}: {error}") from error
        return self._results[stage]


@dataclass(frozen=True)
class GroundTile:
    """A finished tile, identified by the fingerprint of its assessment: it covers surface and input."""

    id: str
    name: str
    tile: FinishedTile = field(compare=False, repr=False)
    earlier: bool = field(default=False, repr=False)
    """Whether its results are from earlier sources or options (`FinishedTile.last`)."""

    @classmethod
    def of(cls, tile: FinishedTile, earlier: bool = False) -> GroundTile:
        """Return the ground tile of a tile."""
        return cls(tile.id, tile.snapshot.nodes["assess"], tile, earlier)

    @property
    def grid(self) -> Grid:
        """The cells of the tile."""
        return self.tile.tile.grid

    @property
    def unread(self) -> FinishedTile:
        """The tile without the results that were read, to free their memory."""
        own = self.tile.evaluator
        return replace(self.tile, evaluator=own and Evaluator(own.graph, own.store))


@lru_cache(maxsize=SURFACES)
def surface_and_road(tile: GroundTile) -> tuple[Surface, RoadMask]:
    """Return the surface and the road mask of a tile."""
    finished = tile.unread
    return finished.surface, finished.road


@lru_cache(maxsize=ESTIMATES)
def estimate(tile: GroundTile, number: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]] | None:
    """Return `FinishedTile.level_errors`; None if the tile's input cannot be read any more."""
    try:
        error, height_source = tile.unread.level_errors(number)
    except ConfigError:
        return None
    return error.astype(np.float32), height_source


@lru_cache(maxsize=ESTIMATES)
def flagged(tile: GroundTile, number: int) -> Bits:
    """Return the flags of each cell of a tile on a level, ``(H, W)``; level 0 if it has no other level."""
    return tile.unread.quality.at(number).flagged


def passing(flags: Mapping[str, str], noun: str) -> str:
    """Return a line about the roads or features that pass flagged places, from their flags by name."""
    number = len(flags)
    verb = "passes" if number == 1 else "pass"
    named = some([f"{name}: {own}" for name, own in flags.items()])
    return f"{count(number, noun)} {verb} flagged places ({named}); {SEE_REPORT}"
