"""The paper as a graph: tile x variant x stage, every node named by what makes it.

Read `STAGES` and then the files it names, in that order, and you have read the paper::

    Tile -> load -> segment -> ecsrc -> fit -> sample -> evaluate -> row

Beside them, `assess` says without ground truth how far the fitted surface can be trusted: not the paper's.

A node's fingerprint is ``hash(stage, VERSION, options, fingerprints of its inputs)``. A source layer counts
by (path relative to the catalog, size, mtime), or by its bytes, for the stages whose module names it in
`READS`; a file that only the options name (a model), told by the module's `files`, counts by its bytes.
Variants that agree up to a stage share its node, so it is computed once; a node whose artefact lies in the
store is not computed at all.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

from catalog import Catalog, Layer, Tile
from pipeline.config import Config, Export
from tasks.options import Options


@dataclass(frozen=True)
class Stage:
    """One step of the paper."""

    name: str
    inputs: tuple[str, ...]
    """Stages whose results it takes, in the order of its arguments."""


STAGES = (
    Stage("load", ()),
    Stage("segment", ("load",)),
    Stage("ecsrc", ("load", "segment")),
    Stage("fit", ("load", "ecsrc")),
    Stage("sample", ("fit", "segment", "ecsrc")),
    Stage("evaluate", ("sample", "load", "segment")),
    Stage("assess", ("load", "segment", "ecsrc", "fit")),
)
STAGE_NAMES = tuple(stage.name for stage in STAGES)


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
    fingerprint: str
    """Of everything asked for; the tile is done when its item carries it."""

    def chain(self, variant: str) -> list[Node]:
        """Return the variant's nodes in the paper's order."""
        return [self.nodes[self.variants[variant][stage]] for stage in STAGE_NAMES]


def stage_module(options: Options) -> ModuleType:
    """Return the file that does the work: where the options' model is defined, with its `VERSION`."""
    return sys.modules[type(options).__module__]


def stage_function(stage: str, options: Options) -> Callable[..., Any]:
    """Return what computes a stage with such options: the function of that name beside their model."""
    function: Callable[..., Any] = getattr(stage_module(options), stage)
    return function


def digest(value: Any) -> str:
    """Return a name for anything that JSON can hold."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def tile_graphs(catalog: Catalog, config: Config, checksum: bool = False) -> Iterator[TileGraph]:
    """Yield the graph of every tile, in the catalog's order."""
    for tile in catalog.tiles:
        yield tile_graph(tile, config, checksum)


def tile_graph(
    tile: Tile,
    config: Config,
    checksum: bool = False,
    recorded: Callable[[], list[Any] | None] = lambda: None,
) -> TileGraph:
    """Build one tile's graph.

    Parameters
    ----------
    checksum : bool
        Name sources by their bytes instead of size and time.
    recorded : callable
        Gives the `TileGraph.sources` of earlier, for files that are gone.
    """
    sources = [_layer(tile, layer, checksum) for layer in tile.layers]
    if any(size is None for _, files, *_ in sources for _, size, *_ in files):
        sources = _as_they_were(sources, recorded())
    nodes: dict[str, Node] = {}
    variants: dict[str, dict[str, str]] = {}
    for variant, chain in config.chains.items():
        made: dict[str, str] = {}
        for stage in STAGES:
            inputs = tuple(made[name] for name in stage.inputs)
            node = _node(stage, chain[stage.name], inputs, tile, sources, variant in config.export.variants)
            known = nodes.get(node.fingerprint)
            if known is None or (node.stored and not known.stored):
                nodes[node.fingerprint] = node
            made[stage.name] = node.fingerprint
        variants[variant] = made
    exported = [variants[variant]["sample"] for variant in config.export.variants]
    asked = [tile.id, tile.stratum, _names(variants), exported, config.export.model_dump(mode="json")]
    return TileGraph(tile, nodes, variants, config.export, sources, digest(asked))


def _names(variants: Mapping[str, Mapping[str, str]]) -> list[list[str]]:
    return [[variant, made["evaluate"], made["assess"]] for variant, made in variants.items()]


def _node(
    stage: Stage,
    options: Options,
    inputs: tuple[str, ...],
    tile: Tile,
    sources: list[Any],
    keep_mesh: bool,
) -> Node:
    module = stage_module(options)
    made_of = [
        stage.name,
        module.__name__,
        module.VERSION,
        options.model_dump(mode="json"),
        # The first stage takes the tile itself.
        list(inputs) if stage.inputs else asdict(tile.grid),
        [source for source in sources if source[0] in getattr(module, "READS", ())],
        [_bytes(path) for path in model_files(options)],
    ]
    stored = {"load": False, "sample": keep_mesh}.get(stage.name, getattr(module, "STORED", True))
    return Node(digest(made_of), stage.name, options, inputs, stored)


def model_files(options: Options) -> tuple[Path, ...]:
    """Return the files that only the options name, as their module's `files` tells them."""
    files: Callable[[Options], tuple[Path, ...]] = getattr(stage_module(options), "files", lambda _: ())
    return files(options)


def _bytes(path: Path) -> str | None:
    try:
        stat = path.stat()
    except OSError:
        # A missing file is its stage's to report; when it comes back the name changes.
        return None
    return _digest_of(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=64)
def _digest_of(path: Path, size: int, mtime_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _as_they_were(sources: list[Any], recorded: list[Any] | None) -> list[Any]:
    """Return the sources with what is on record of files that are gone."""
    known = {(name, file[0]): file for name, files, *_ in recorded or () for file in files}
    return [
        [name, [file if file[1] is not None else known.get((name, file[0]), file) for file in files], *rest]
        for name, files, *rest in sources
    ]


def _layer(tile: Tile, layer: Layer, checksum: bool) -> list[Any]:
    files: list[list[str | int | None]] = []
    for name, path in zip(layer.files, tile.paths(layer), strict=True):
        try:
            stat = path.stat()
            if checksum:
                files.append([name, _digest_of(path, stat.st_size, stat.st_mtime_ns)])
            else:
                files.append([name, stat.st_size, stat.st_mtime_ns])
        except OSError:
            # A missing file is `load`'s to report; when it comes back the name changes.
            files.append([name, None])
    return [layer.name, files, list(layer.values), layer.crs]
