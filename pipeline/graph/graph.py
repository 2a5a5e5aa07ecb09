"""The paper as a graph: tile x variant x stage, every node named by what makes it.

Read `STAGES` and then the files it names, in that order, and you have read the paper::

    Tile -> load -> segment -> ecsrc -> fit -> sample -> evaluate -> row

Beside them, `assess` says without ground truth how far the fitted surface can be trusted: not the paper's.

A node's fingerprint is ``hash(stage, VERSION, options, fingerprints of its inputs)``; the method is one of
the options. No module's name is part of it, so that files may move and stores stay valid. A source layer
counts by (path relative to the catalog, size, mtime), or by its bytes, for the stages whose module names it
in `READS`; a file that only the options name (a model), told by the module's `files`, counts by its bytes.
Variants that agree up to a stage share its node, so it is computed once; a node whose artefact lies in the
store is not computed at all.
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


Recorded = Sequence[Any]


@dataclass(frozen=True)
class Node:
    """One stage of one tile with one set of options."""

    fingerprint: str
    stage: str
    options: Options
    inputs: tuple[str, ...]
    """Fingerprints of the nodes whose results it takes."""
    stored: bool
    """Whether its result is worth keeping: not what was only read or copied, nor a mesh nobody asked for."""

    @property
    def function(self) -> Callable[..., Any]:
        """What computes it."""
        return stage_function(self.stage, self.options)


@dataclass(frozen=True)
class TileGraph:
    """All that is to be known about one tile: the union of its variants' chains."""

    tile: Tile
    nodes: dict[str, Node]
    """By fingerprint; inputs come before what takes them."""
    variants: dict[str, dict[str, str]]
    """Variant -> stage -> fingerprint."""
    export: Export
    sources: list[Any]
    """The source layers as they are named in fingerprints, or were."""
    seen: dict[str, FileStat | None]
    """How each file looked when the graph was made, by its path; None if it was not there."""
    fingerprint: str
    """Of everything asked for; the tile is done when its item carries it."""

    def chain(self, variant: str) -> list[Node]:
        """Return the variant's nodes in the paper's order."""
        return [self.nodes[self.variants[variant][stage]] for stage in STAGE_NAMES]


_json = json.JSONEncoder(sort_keys=True, separators=(",", ":")).encode


def _hash(text: str) -> str:
    """Return a name for anything, told as JSON."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@dataclass(frozen=True)
class Step:
    """A node as it is in every tile: all that makes its fingerprint but for the tile's own."""

    stage: str
    options: Options
    head: str
    """What all tiles have in common, as the JSON that is hashed."""
    inputs: tuple[int, ...]
    """Numbers of the steps whose results it takes."""
    reads: tuple[str, ...]
    """Source layers that it reads."""
    files: tuple[Path, ...]
    """Files that only its options name."""
    stored: bool


@dataclass(frozen=True)
class Pattern:
    """What the graphs of all tiles of a run have in common, worked out once."""

    steps: tuple[Step, ...]
    variants: dict[str, dict[str, int]]
    """Variant -> stage -> number of its step."""
    export: Export
    exported: str
    """The export as the JSON that is hashed."""

    @classmethod
    def of(cls, config: Config) -> Pattern:
        """Work out which steps there are: variants that agree up to a stage share its step."""
        steps: dict[tuple[str, tuple[int, ...]], Step] = {}
        numbers: dict[tuple[str, tuple[int, ...]], int] = {}
        variants: dict[str, dict[str, int]] = {}
        for variant, chain in config.chains.items():
            made: dict[str, int] = {}
            for stage in STAGES:
                inputs = tuple(made[name] for name in stage.inputs)
                step = _step(stage, chain[stage.name], inputs, variant in config.export.variants)
                key = step.head, inputs
                made[stage.name] = numbers.setdefault(key, len(numbers))
                if key not in steps or step.stored:
                    steps[key] = step
            variants[variant] = made
        exported = _json(config.export.model_dump(mode="json"))
        return cls(tuple(steps[key] for key in numbers), variants, config.export, exported)

    def graph(
        self, tile: Tile, checksum: bool = False, look: Stat = stat, recorded: Recorded = ()
    ) -> TileGraph:
        """Return the graph of one tile.

        Parameters
        ----------
        checksum : bool
            Name sources by their bytes instead of size and time.
        look : callable
            Tells size and time of a source file, None if it is gone.
        recorded : sequence
            `TileGraph.sources` of earlier, which stand in for files that are gone.
        """
        seen = {str(path): look(path) for layer in tile.layers for path in tile.paths(layer)}
        sources = [_layer(tile, layer, seen, checksum) for layer in tile.layers]
        if recorded:
            sources = _as_they_were(sources, recorded)
        names: list[str] = []
        nodes: dict[str, Node] = {}
        texts = [(source[0], _json(source)) for source in sources]
        for step in self.steps:
            inputs = tuple(names[number] for number in step.inputs)
            # The first stage takes the tile itself.
            given = _json(inputs) if inputs else _json(asdict(tile.grid))
            read = ",".join(text for layer, text in texts if layer in step.reads)
            seen |= {str(path): stat(path) for path in step.files}
            files = _json([_bytes(path, seen[str(path)]) for path in step.files])
            name = _hash(f"[{step.head},{given},[{read}],{files}]")
            names.append(name)
            nodes[name] = Node(name, step.stage, step.options, inputs, step.stored)
        variants = {
            variant: {stage: names[number] for stage, number in made.items()}
            for variant, made in self.variants.items()
        }
        fingerprint = self._fingerprint(tile, variants)
        return TileGraph(tile, nodes, variants, self.export, sources, seen, fingerprint)

    def _fingerprint(self, tile: Tile, variants: Mapping[str, Mapping[str, str]]) -> str:
        asked = [
            tile.id,
            tile.stratum,
            [[variant, made["evaluate"], made["assess"]] for variant, made in variants.items()],
            [variants[variant]["sample"] for variant in self.export.variants],
        ]
        return _hash(f"{_json(asked)[:-1]},{self.exported}]")


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
    """Return the graph of one tile; for many, `Pattern.graph` is quicker."""
    return Pattern.of(config).graph(tile, checksum)


def files_read(graph: TileGraph, node: Node) -> list[Location]:
    """Return the files that a stage reads: those of its source layers, and those its options name."""
    reads = getattr(stage_module(node.options), "READS", ())
    paths = [path for layer in graph.tile.layers if layer.name in reads for path in graph.tile.paths(layer)]
    return [*paths, *model_files(node.options)]


def layers_read(config: Config) -> frozenset[str]:
    """Return the layers that some stage of some variant reads."""
    chosen = (options for chain in config.chains.values() for options in chain.values())
    return frozenset(name for options in chosen for name in getattr(stage_module(options), "READS", ()))


def any_gone(graph: TileGraph) -> bool:
    """Tell whether a file that the tile's stages might read is not there."""
    return None in graph.seen.values()


def _layer(tile: Tile, layer: Layer, seen: Mapping[str, FileStat | None], checksum: bool) -> list[Any]:
    """Return name, files, values and CRS of a layer; a file is told by name, size and time, or its bytes."""
    files: list[list[str | int | None]] = []
    for name, path in zip(layer.files, tile.paths(layer), strict=True):
        now = seen[str(path)]
        if checksum or now is None:
            # A missing file is `load`'s to report; when it comes back the name changes.
            files.append([name, _bytes(path, now)])
        else:
            files.append([name, now.size, now.version])
    return [layer.name, files, list(layer.values), layer.crs]


def _as_they_were(sources: list[Any], recorded: Recorded) -> list[Any]:
    """Return the sources with what is on record of files that are gone."""
    known = {(name, file[0]): file for name, files, *_ in recorded for file in files}
    return [
        [name, [file if file[1] is not None else known.get((name, file[0]), file) for file in files], *rest]
        for name, files, *rest in sources
    ]


def _bytes(path: Location, seen: FileStat | None) -> str | None:
    if seen is None:
        return None
    try:
        return _digest_of(path, seen.size, seen.version)
    except OSError:
        return None


@lru_cache(maxsize=65536)
def _digest_of(path: Location, size: int, version: int | str) -> str:
    if not isinstance(path, Path):
        return hashlib.sha256(read(path)).hexdigest()
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
