"""The paper as a graph of tile x variant x stage; each node is identified by a fingerprint.

`STAGES` and the files it refers to follow the order of the paper::

    Tile -> load -> segment -> ecsrc -> fit -> sample -> evaluate -> row

In addition, `assess` rates the fitted surface without ground truth; it is not part of the paper.

A node's fingerprint is ``hash(stage, VERSION, options, fingerprints of its inputs)``; the method is one of
the options. Module names are not part of it, so stores stay valid when files move. A stage that lists a
source layer in its module's `READS` also hashes the layer's files: (path relative to the catalog, size,
mtime), or their bytes. Files that only the options name, such as a model (the module's `files`), are
hashed by their bytes. Rasters that `load` reads are hashed only if they reach the tile or its halo. Variants
with equal options up to a stage share its node, so it is computed once. A node whose artefact is in the store
is not computed.

If a result was computed without an unusable file, it gets another name, and so do the results computed from
it (`TileGraph.renamed`). They are used again only while the file cannot be used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from flexroad.catalog import Tile
from flexroad.catalog.guard.source_files import source_stat
from flexroad.catalog.storage.paths import FileStat, Location
from flexroad.pipeline.config.models import Chain, Config, Export
from flexroad.pipeline.config.stages import STAGE_NAMES, STAGES, model_files, stage_head
from flexroad.pipeline.graph.borders import STAGE, BorderPattern, has_borders
from flexroad.pipeline.graph.sources import (
    Recorded,
    SourceFiles,
    Stat,
    grid_json,
    hashed,
    names_json,
    to_json,
)
from flexroad.tasks.border import ENDS, BorderTask
from flexroad.tasks.options import Options, stage_module
from flexroad.tasks.products import cog, glb, npz, ply

ITEM_VERSION = 3
"""Raised when the STAC item of a tile changes for the same result."""
PHOTO = "texture"
"""Start of the names of the options for the photo on the mesh."""
FORMATS = {"glb": glb, "ply": ply, "cog": cog, "npz": npz}


@dataclass(frozen=True)
class Node:
    """One stage of one tile with one set of options."""

    fingerprint: str
    stage: str
    options: Options
    inputs: tuple[str, ...]
    """Fingerprints of the nodes whose results it uses."""
    stored: bool
    """Whether its result is stored; false for `load`, for rasters and for meshes that are not exported."""
    frame: tuple[str, ...] = ()
    """Fingerprints of the corners and edges that it also uses, in the order of `Frame`'s fields."""
    border: BorderTask | None = None
    """Its computation if it is a corner or edge; ``options`` are then the options of the fit."""
    refit: Options | None = None
    """The options of the fit if `assess` makes a second fit without a part of the road."""


@dataclass(frozen=True)
class TileGraph:
    """The graph of one tile: the union of its variants' chains."""

    tile: Tile
    """The tile with only the raster files that reach it or its halo (`Tile.within`)."""
    around: Tile
    """The tile of the catalog, with all its files: for the ground along its border."""
    nodes: dict[str, Node]
    """Nodes by fingerprint; each node comes after its inputs."""
    variants: dict[str, dict[str, str]]
    """Variant -> stage -> fingerprint."""
    export: Export
    sources: list[Any]
    """The source layers as hashed in the fingerprints: name, files, values and CRS of each."""
    file_stats: dict[str, FileStat | None]
    """Size and version of each file when the graph was made, by path. None if the file was missing, or could
    not be read to be hashed."""
    fingerprint: str
    """Fingerprint of all requested results; the tile is done when its item has this fingerprint."""

    @property
    def reads(self) -> frozenset[str]:
        """Names of the source layers from which its stages and its products are made."""
        return self._stage_reads.union(product_layers(self.export))

    @property
    def _stage_reads(self) -> frozenset[str]:
        return _reads(node.options for node in self.nodes.values())

    @property
    def readable(self) -> Tile:
        """The tile with only the layers that its stages read: files of other layers need no permission."""
        reads = self._stage_reads
        return replace(self.tile, layers=tuple(layer for layer in self.tile.layers if layer.name in reads))

    def renamed(self, names: Mapping[str, str]) -> TileGraph:
        """Return the graph with the names of results that were computed without an unusable file.

        - `names`: the new names by fingerprint (`Evaluator.renamed`).
        """
        if not names:
            return self

        def new(fingerprints: Iterable[str]) -> tuple[str, ...]:
            return tuple(names.get(name, name) for name in fingerprints)

        nodes = [
            replace(node, fingerprint=name, inputs=new(node.inputs), frame=new(node.frame))
            for name, node in zip(new(self.nodes), self.nodes.values(), strict=True)
        ]
        return replace(
            self,
            nodes={node.fingerprint: node for node in nodes},
            variants={
                variant: dict(zip(stages, new(stages.values()), strict=True))
                for variant, stages in self.variants.items()
            },
            fingerprint=hashed(to_json([self.fingerprint, names])),
        )

    def in_catalog(self, path: str) -> str:
        """Return layer and name in the catalog of a source file, by its full name."""
        tile, reads = self.around, self.reads
        names = (
            f"{layer.name} {file}"
            for layer in tile.all_layers
            if layer.name in reads
            for file in layer.files
            if str(tile.path(layer.name, file)) == path
        )
        return next(names, path)

    def chain(self, variant: str) -> list[Node]:
        """Return the variant's nodes in the paper's order."""
        return [self.nodes[self.variants[variant][stage]] for stage in STAGE_NAMES]


@dataclass(frozen=True)
class Step:
    """The part of a node that is the same for all tiles."""

    stage: str
    options: Options
    head: str
    """Stage, `VERSION` and options as JSON, the part of the hashed text that all tiles share."""
    inputs: tuple[int, ...]
    """Indices of the steps whose results it uses."""
    reads: tuple[str, ...]
    """Names of the source layers that it reads."""
    files: tuple[Path, ...]
    """Files named by its options, such as a model."""
    stored: bool
    borders: BorderPattern | None = None
    """The stages of the border nodes that it uses, or None."""
    framed: int | None = None
    """Index of the step whose frame it uses, or None."""
    refit: Options | None = None
    """See `Node.refit`."""


@dataclass(frozen=True)
class Pattern:
    """The part of the graph that is the same for all tiles of a run, computed once."""

    steps: tuple[Step, ...]
    variants: dict[str, dict[str, int]]
    """Variant -> stage -> index of its step."""
    export: Export
    exported: str
    """The export options and the versions of the products as the JSON that is hashed."""
    halo_m: float
    """The largest halo of the variants (m)."""

    @classmethod
    def of(cls, config: Config) -> Pattern:
        """Return the pattern of a configuration; variants with equal options up to a stage share its step."""
        steps: dict[tuple[str, tuple[int, ...]], Step] = {}
        numbers: dict[tuple[str, tuple[int, ...]], int] = {}
        variants: dict[str, dict[str, int]] = {}
        for variant, chain in config.chains.items():
            by_stage: dict[str, int] = {}
            for stage, before in STAGES.items():
                inputs = tuple(by_stage[name] for name in before)
                step = _step(stage, chain, inputs, variant in config.export.variants)
                key = step.head, inputs
                by_stage[stage] = numbers.setdefault(key, len(numbers))
                if key not in steps or step.stored:
                    steps[key] = step
            variants[variant] = by_stage
        options = config.export.model_dump(mode="json")
        if not config.export.texture:
            # Without a texture, products do not depend on the texture's options.
            options = {name: value for name, value in options.items() if not name.startswith(PHOTO)}
        versions = {"item": ITEM_VERSION} | {name: FORMATS[name].VERSION for name in config.export.formats}
        exported = to_json([options, versions])
        halo_m = max(chain["load"].halo_m for chain in config.chains.values())
        return cls(tuple(steps[key] for key in numbers), variants, config.export, exported, halo_m)

    @cached_property
    def reads(self) -> frozenset[str]:
        """Names of the source layers that any stage reads; files of other layers are not looked up."""
        return frozenset(layer for step in self.steps for layer in step.reads)

    def graph(
        self, tile: Tile, checksum: bool = False, stat_file: Stat = source_stat, recorded: Recorded = ()
    ) -> TileGraph:
        """Return the graph of one tile.

        - `checksum`: hash the bytes of the source files instead of size and time.
        - `recorded`: `TileGraph.sources` of an earlier graph, used for files that no longer exist.
        """
        own = tile.within(tile.grid.buffered(self.halo_m).bounds)
        sources = SourceFiles(tile, stat_file, checksum, recorded)
        layers_read = [layer for layer in own.layers if layer.name in self.reads]
        texts = [(layer.name, sources.text(layer)) for layer in layers_read]
        grid = grid_json(tile.grid)
        names: list[str] = []
        nodes: dict[str, Node] = {}
        for step in self.steps:
            inputs = tuple(names[number] for number in step.inputs)
            frame: tuple[str, ...] = ()
            if step.borders:
                shared = _border_nodes(tile, step, sources, grid)
                nodes |= {node.fingerprint: node for node in shared}
                frame = tuple(node.fingerprint for node in shared)
            elif step.framed is not None:
                frame = nodes[names[step.framed]].frame
            # The input of the first stage is the tile, hashed by its grid.
            hashed_inputs = names_json((*inputs, *frame)) if inputs else grid
            layers = ",".join(text for layer, text in texts if layer in step.reads)
            name = hashed(f"[{step.head},{hashed_inputs},[{layers}],{sources.models(step.files)}]")
            names.append(name)
            nodes[name] = Node(name, step.stage, step.options, inputs, step.stored, frame, refit=step.refit)
        variants = {
            variant: {stage: names[number] for stage, number in numbers.items()}
            for variant, numbers in self.variants.items()
        }
        fingerprint = self._fingerprint(tile, variants, sources)
        missing = frozenset(path for path, file in sources.stats.items() if file is None)
        own, tile = replace(own, missing=missing), replace(tile, missing=missing)
        return TileGraph(own, tile, nodes, variants, self.export, sources.entries, sources.stats, fingerprint)

    def _fingerprint(
        self, tile: Tile, variants: Mapping[str, Mapping[str, str]], sources: SourceFiles
    ) -> str:
        requested: list[Any] = [
            tile.id,
            tile.stratum,
            [[variant, names["evaluate"], names["assess"]] for variant, names in variants.items()],
            [variants[variant]["sample"] for variant in self.export.variants],
        ]
        layers = [sources.text(layer) for layer in tile.layers_on(product_layers(self.export))]
        return hashed(f"{','.join([to_json(requested)[:-1], *layers, self.exported])}]")


def product_layers(export: Export) -> tuple[str, ...]:
    """Return the names of the source layers from which the products are made."""
    return ("dop",) if export.texture else ()


def _step(stage: str, chain: Chain, inputs: tuple[int, ...], keep_mesh: bool) -> Step:
    options = chain[stage]
    module = stage_module(options)
    stored = {"load": False, "sample": keep_mesh}.get(stage, getattr(module, "STORED", True))
    reads = getattr(module, "READS", ())
    head = to_json(stage_head(stage, options))[1:-1]
    shared = has_borders(chain["fit"])
    borders = BorderPattern.of(chain) if shared and stage == "fit" else None
    # A second fit and the mesh of a tile use the frame of its surface.
    refit = chain["fit"] if getattr(options, "holdout", 0) else None
    framed = inputs[STAGES[stage].index("fit")] if shared and (refit or stage == "sample") else None
    return Step(stage, options, head, inputs, reads, model_files(options), stored, borders, framed, refit)


def _border_nodes(tile: Tile, step: Step, sources: SourceFiles, grid: str) -> list[Node]:
    """Return the nodes of a tile's corners and edges, in the order of `Frame`'s fields; ``grid`` is JSON."""
    assert step.borders
    pattern, nodes = step.borders, list[Node]()
    models = sources.models(pattern.files)
    for number, (task, place, layers) in enumerate(pattern.parts(tile)):
        ends = tuple(nodes[end].fingerprint for end in ENDS[number - 4]) if number >= 4 else ()
        # Without extents a border cannot tell which files it needs: the node then also depends on the tile.
        core = "null" if all(layer.extents for layer, _ in layers) else grid
        text = ",".join([sources.text(layer, numbers) for layer, numbers in layers])
        name = hashed(f"[{pattern.head},{place},{core}],{names_json(ends)},[{text}],{models}]")
        nodes.append(Node(name, STAGE, step.options, ends, stored=True, border=task))
    return nodes


def files_read(graph: TileGraph, node: Node) -> list[Location]:
    """Return the files that a stage reads: files of its source layers and files named by its options."""
    if node.border:
        ground = node.border.ground(graph.around)
        options = node.border.stages.by_name.values()
        paths = [path for layer in ground.layers for path in ground.paths(layer)]
        return [*paths, *(file for chosen in options for file in model_files(chosen))]
    reads = getattr(stage_module(node.options), "READS", ())
    paths = [path for layer in graph.tile.layers if layer.name in reads for path in graph.tile.paths(layer)]
    return [*paths, *model_files(node.options)]


def layers_read(config: Config) -> frozenset[str]:
    """Return the names of the layers read by any stage of any variant, or for the products."""
    stages = _reads(options for chain in config.chains.values() for options in chain.values())
    return stages.union(product_layers(config.export))


def _reads(chosen: Iterable[Options]) -> frozenset[str]:
    return frozenset(name for options in chosen for name in getattr(stage_module(options), "READS", ()))


def any_file_missing(graph: TileGraph) -> bool:
    """Return whether a source or model file of the tile did not exist when its graph was made."""
    return None in graph.file_stats.values()


def own_files_missing(graph: TileGraph) -> list[str]:
    """Return the files that did not exist when the graph was made: source files on the tile, and models.

    Source files that lie only around the tile are left out.
    """
    missing = [path for path, file in graph.file_stats.items() if file is None]
    if not missing:
        return []
    tile, reads = graph.around, graph.reads
    read = [layer for layer in tile.all_layers if layer.name in reads]
    listed = {str(path) for layer in read for path in tile.paths(layer)}
    own = {str(path) for layer in tile.layers_on(reads) for path in tile.paths(layer)}
    return [path for path in missing if path in own or path not in listed]
