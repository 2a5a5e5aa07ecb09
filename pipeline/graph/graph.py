"""The paper as a graph of tile x variant x stage; each node is identified by a fingerprint.

`STAGES` and the files it refers to follow the order of the paper::

    Tile -> load -> segment -> ecsrc -> fit -> sample -> evaluate -> row

In addition, `assess` rates the fitted surface without ground truth; it is not part of the paper.

A node's fingerprint is ``hash(stage, VERSION, options, fingerprints of its inputs)``; the method is one of
the options. Module names are not part of it, so stores stay valid when files move. A stage that lists a
source layer in its module's `READS` also hashes the layer's files as (path relative to the catalog, size,
mtime), or by their bytes; files that only the options name, such as a model (the module's `files`), are
hashed by their bytes. Variants with equal options up to a stage share its node, so it is computed once; a
node whose artefact is in the store is not computed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from flexroad.catalog import Catalog, Layer, Tile
from flexroad.catalog.storage.paths import FileStat, Location, read, stat
from flexroad.pipeline.config.models import Config, Export
from flexroad.pipeline.graph.stages import (
    STAGE_NAMES,
    STAGES,
    Stage,
    model_files,
    stage_function,
    stage_module,
)
from flexroad.tasks.options import Options

Stat = Callable[[Location], FileStat | None]
"""Returns size and version of a file, None if it does not exist."""


Recorded = Sequence[Any]
"""`TileGraph.sources` of an earlier graph."""


@dataclass(frozen=True)
class Node:
    """One stage of one tile with one set of options."""

    fingerprint: str
    stage: str
    options: Options
    inputs: tuple[str, ...]
    """Fingerprints of the nodes whose results it takes."""
    stored: bool
    """Whether its result is stored; false for `load`, for rasters and for meshes that are not exported."""

    @property
    def function(self) -> Callable[..., Any]:
        """The function that computes the node."""
        return stage_function(self.stage, self.options)


@dataclass(frozen=True)
class TileGraph:
    """The graph of one tile: the union of its variants' chains."""

    tile: Tile
    nodes: dict[str, Node]
    """Nodes by fingerprint; each node comes after its inputs."""
    variants: dict[str, dict[str, str]]
    """Variant -> stage -> fingerprint."""
    export: Export
    sources: list[Any]
    """The source layers as hashed in the fingerprints: name, files, values and CRS of each."""
    file_stats: dict[str, FileStat | None]
    """Size and version of each file when the graph was made, by path; None if the file was missing."""
    fingerprint: str
    """Fingerprint of all requested results; the tile is done when its item has this fingerprint."""

    def chain(self, variant: str) -> list[Node]:
        """Return the variant's nodes in the paper's order."""
        return [self.nodes[self.variants[variant][stage]] for stage in STAGE_NAMES]


_json = json.JSONEncoder(sort_keys=True, separators=(",", ":")).encode


def _hash(text: str) -> str:
    """Return the first 32 hexadecimal digits of the SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@dataclass(frozen=True)
class Step:
    """The part of a node that is the same for all tiles."""

    stage: str
    options: Options
    head: str
    """Stage, `VERSION` and options as JSON, the part of the hashed text that all tiles share."""
    inputs: tuple[int, ...]
    """Indices of the steps whose results it takes."""
    reads: tuple[str, ...]
    """Names of the source layers that it reads."""
    files: tuple[Path, ...]
    """Files named by its options, such as a model."""
    stored: bool


@dataclass(frozen=True)
class Pattern:
    """The part of the graph that is the same for all tiles of a run, computed once."""

    steps: tuple[Step, ...]
    variants: dict[str, dict[str, int]]
    """Variant -> stage -> index of its step."""
    export: Export
    exported: str
    """The export options as the JSON that is hashed."""

    @classmethod
    def of(cls, config: Config) -> Pattern:
        """Return the pattern of a configuration; variants with equal options up to a stage share its step."""
        steps: dict[tuple[str, tuple[int, ...]], Step] = {}
        numbers: dict[tuple[str, tuple[int, ...]], int] = {}
        variants: dict[str, dict[str, int]] = {}
        for variant, chain in config.chains.items():
            by_stage: dict[str, int] = {}
            for stage in STAGES:
                inputs = tuple(by_stage[name] for name in stage.inputs)
                step = _step(stage, chain[stage.name], inputs, variant in config.export.variants)
                key = step.head, inputs
                by_stage[stage.name] = numbers.setdefault(key, len(numbers))
                if key not in steps or step.stored:
                    steps[key] = step
            variants[variant] = by_stage
        exported = _json(config.export.model_dump(mode="json"))
        return cls(tuple(steps[key] for key in numbers), variants, config.export, exported)

    def graph(
        self, tile: Tile, checksum: bool = False, stat_file: Stat = stat, recorded: Recorded = ()
    ) -> TileGraph:
        """Return the graph of one tile.

        Parameters
        ----------
        checksum : bool
            Hash the bytes of the source files instead of size and time.
        stat_file : callable
            Returns size and version of a source file, None if it does not exist.
        recorded : sequence
            `TileGraph.sources` of an earlier graph, used for files that no longer exist.
        """
        stats = {str(path): stat_file(path) for layer in tile.layers for path in tile.paths(layer)}
        sources = [_layer(tile, layer, stats, checksum) for layer in tile.layers]
        if recorded:
            sources = _with_recorded(sources, recorded)
        names: list[str] = []
        nodes: dict[str, Node] = {}
        texts = [(source[0], _json(source)) for source in sources]
        for step in self.steps:
            inputs = tuple(names[number] for number in step.inputs)
            # The input of the first stage is the tile, hashed by its grid.
            hashed_inputs = _json(inputs) if inputs else _json(asdict(tile.grid))
            layers = ",".join(text for layer, text in texts if layer in step.reads)
            stats |= {str(path): stat(path) for path in step.files}
            files = _json([_checksum(path, stats[str(path)]) for path in step.files])
            name = _hash(f"[{step.head},{hashed_inputs},[{layers}],{files}]")
            names.append(name)
            nodes[name] = Node(name, step.stage, step.options, inputs, step.stored)
        variants = {
            variant: {stage: names[number] for stage, number in numbers.items()}
            for variant, numbers in self.variants.items()
        }
        fingerprint = self._fingerprint(tile, variants)
        return TileGraph(tile, nodes, variants, self.export, sources, stats, fingerprint)

    def _fingerprint(self, tile: Tile, variants: Mapping[str, Mapping[str, str]]) -> str:
        requested = [
            tile.id,
            tile.stratum,
            [[variant, names["evaluate"], names["assess"]] for variant, names in variants.items()],
            [variants[variant]["sample"] for variant in self.export.variants],
        ]
        return _hash(f"{_json(requested)[:-1]},{self.exported}]")


def _step(stage: Stage, options: Options, inputs: tuple[int, ...], keep_mesh: bool) -> Step:
    module = stage_module(options)
    head = [stage.name, module.VERSION, options.model_dump(mode="json")]
    stored = {"load": False, "sample": keep_mesh}.get(stage.name, getattr(module, "STORED", True))
    reads = getattr(module, "READS", ())
    return Step(stage.name, options, _json(head)[1:-1], inputs, reads, model_files(options), stored)


def tile_graphs(catalog: Catalog, config: Config, checksum: bool = False) -> Iterator[TileGraph]:
    """Yield the graph of every tile, in the catalog's order."""
    pattern = Pattern.of(config)
    for tile in catalog.tiles:
        yield pattern.graph(tile, checksum)


def tile_graph(tile: Tile, config: Config, checksum: bool = False) -> TileGraph:
    """Return the graph of one tile; for many tiles `Pattern.graph` is faster."""
    return Pattern.of(config).graph(tile, checksum)


def files_read(graph: TileGraph, node: Node) -> list[Location]:
    """Return the files that a stage reads: those of its source layers and those named by its options."""
    reads = getattr(stage_module(node.options), "READS", ())
    paths = [path for layer in graph.tile.layers if layer.name in reads for path in graph.tile.paths(layer)]
    return [*paths, *model_files(node.options)]


def layers_read(config: Config) -> frozenset[str]:
    """Return the names of the layers read by any stage of any variant."""
    chosen = (options for chain in config.chains.values() for options in chain.values())
    return frozenset(name for options in chosen for name in getattr(stage_module(options), "READS", ()))


def any_file_missing(graph: TileGraph) -> bool:
    """Return whether a source or model file of the tile did not exist when its graph was made."""
    return None in graph.file_stats.values()


def _layer(tile: Tile, layer: Layer, stats: Mapping[str, FileStat | None], checksum: bool) -> list[Any]:
    """Return name, files, values and CRS of a layer; a file is (name, size, version) or (name, checksum)."""
    files: list[list[str | int | None]] = []
    for name, path in zip(layer.files, tile.paths(layer), strict=True):
        file = stats[str(path)]
        if checksum or file is None:
            # `load` reports a missing file; the fingerprint changes when the file is restored.
            files.append([name, _checksum(path, file)])
        else:
            files.append([name, file.size, file.version])
    return [layer.name, files, list(layer.values), layer.crs]


def _with_recorded(sources: list[Any], recorded: Recorded) -> list[Any]:
    """Return the sources with the recorded entries for files that no longer exist."""
    entries = {(name, file[0]): file for name, files, *_ in recorded for file in files}
    return [
        [name, [file if file[1] is not None else entries.get((name, file[0]), file) for file in files], *rest]
        for name, files, *rest in sources
    ]


def _checksum(path: Location, file: FileStat | None) -> str | None:
    """Return the SHA-256 of a file, None if it does not exist or cannot be read."""
    if file is None:
        return None
    try:
        return _sha256(path, file.size, file.version)
    except OSError:
        return None


@lru_cache(maxsize=65536)
def _sha256(path: Location, size: int, version: int | str) -> str:
    """Return the SHA-256 of a file; cached by path, size and version."""
    if not isinstance(path, Path):
        return hashlib.sha256(read(path)).hexdigest()
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
