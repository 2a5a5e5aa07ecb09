"""Lazy evaluation of a tile's graph: a node is computed only if its result is needed and not in the store.

After a stage that reads files, size and version of the files are compared with those in the graph. If a file
has changed, the stage fails, so that no result is stored under a wrong fingerprint.
"""

from __future__ import annotations

import contextlib
import resource
import traceback
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

from flexroad.catalog import Tile
from flexroad.catalog.guard.source_files import source_stat
from flexroad.catalog.storage.paths import Location
from flexroad.pipeline.graph.borders import STAGE
from flexroad.pipeline.graph.graph import Node, TileGraph, files_read
from flexroad.pipeline.graph.sources import hashed, to_json
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.store.records import Failure, utc_now
from flexroad.tasks.errors import TaskError, recorded
from flexroad.tasks.options import Options, stage_function
from flexroad.tasks.spline.frame import Frame
from flexroad.tasks.types import RoadClusters, Surface, TileData

PROC = Path("/proc/self")
WITH_NOTES = ("load", "segment")
"""Stages whose results have notes on their sources."""


@dataclass
class StageCost:
    """The cost of one stage over all variants of a tile."""

    time: str = ""
    """Start of the first computation, ISO 8601 in UTC; empty if nothing was computed."""
    seconds: float = 0.0
    """Computing time (s)."""
    bytes: int = 0
    """Bytes written to the store or as products."""
    peak_mb: float = 0.0
    """Peak memory of the process during the stage (MB)."""
    computed: int = 0
    """Number of nodes computed."""
    reused: int = 0
    """Number of nodes read from the store."""

    @contextlib.contextmanager
    def measure(self) -> Iterator[None]:
        """Add time and peak memory of the ``with`` block, even if it raises an error."""
        self.time = self.time or utc_now()
        _reset_peak()
        start = perf_counter()
        try:
            yield
        finally:
            self.seconds += perf_counter() - start
            self.peak_mb = max(self.peak_mb, peak_mb())


def peak_mb() -> float:
    """Return the peak memory of this process (MB) since `_reset_peak`; outside Linux since its start."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _reset_peak() -> None:
    # Only Linux can reset the peak.
    with contextlib.suppress(OSError):
        (PROC / "clear_refs").write_text("5")


class StageError(Exception):
    """A stage failed; ``failure`` is its row in the table of failures."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.line)
        self.failure = failure


class SourceChanged(Exception):
    """A source file changed after the tile's graph was made."""

    def __init__(self, file: str) -> None:
        super().__init__("changed while the tile was processed; run the same command again")
        self.file = file


@dataclass
class Evaluator:
    """The results of one tile's nodes; each node is computed or read from the store at most once."""

    graph: TileGraph
    store: ArtefactStore
    force: frozenset[str] = frozenset()
    keep: bool = False
    """Whether computed results are stored; false when a run is only read."""
    results: dict[str, Any] = field(default_factory=dict)
    """Results by fingerprint."""
    chain_seconds: dict[str, dict[str, float]] = field(default_factory=dict)
    """Fingerprint -> stage -> computing time (s) of the node and the nodes it depends on."""
    notes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Fingerprint -> notes on the sources of the node and of the nodes it depends on."""
    renamed: dict[str, str] = field(default_factory=dict)
    """Fingerprint -> name of the result, if a file was left out of the result or of its inputs."""
    left_out: dict[str, None] = field(default_factory=dict)
    """Files that were left out, by layer and name in the catalog."""
    spans: defaultdict[str, StageCost] = field(default_factory=lambda: defaultdict(StageCost))
    """Cost of each stage in this process."""
    errors: dict[str, StageError] = field(default_factory=dict)
    """Errors by fingerprint."""

    def __call__(self, fingerprint: str) -> Any:
        """Return the result of a node."""
        if fingerprint in self.errors:
            raise self.errors[fingerprint]
        if fingerprint not in self.results:
            node = self.graph.nodes[fingerprint]
            if not self._restore(node):
                self._compute(node)
        return self.results[fingerprint]

    def _restore(self, node: Node) -> bool:
        """Read a result from the store, by its name; return whether the store has it."""
        if not node.stored or node.stage in self.force:
            return False
        artefact = self.store.get(self._named(node))
        if artefact is None:
            return False
        name = node.fingerprint
        self.results[name], self.chain_seconds[name], self.notes[name] = artefact
        self.spans[node.stage].reused += 1
        return True

    def _named(self, node: Node) -> Node:
        """Return a node with the name of its result."""
        name = self.renamed.get(node.fingerprint)
        return replace(node, fingerprint=name) if name else node

    def rename(self, name: str, left_out: Iterable[tuple[str, str]], inputs: Iterable[str] = ()) -> None:
        """Add the files that are left out of a result (`LeftOut`) and of its inputs to its name.

        Missing files are left out of the name, because the fingerprint itself depends on them.
        """
        missing = self.graph.tile.missing or ()
        own = sorted((self.graph.in_catalog(file), cells) for file, cells in left_out if file not in missing)
        self.left_out |= dict.fromkeys(file for file, _ in own)
        before = [[other, self.renamed[other]] for other in inputs if other in self.renamed]
        if own or before:
            self.renamed[name] = hashed(to_json([name, own, before]))

    def _compute(self, node: Node) -> None:
        inputs = [self(fingerprint) for fingerprint in node.inputs]
        frame = [self(fingerprint) for fingerprint in node.frame]
        self.rename(node.fingerprint, (), (*node.inputs, *node.frame))
        if node.fingerprint in self.renamed and self._restore(node):
            return
        span = self.spans[node.stage]
        spent = span.seconds
        try:
            with span.measure(), recorded() as left_out:
                result = self._run_stage(node, inputs, frame)
        except Exception as error:
            failed = StageError(failure_of(self.graph.tile, node.stage, error))
            self.errors[node.fingerprint] = failed
            raise failed from error
        span.computed += 1
        seconds = self._seconds_before(node)
        seconds[node.stage] = span.seconds - spent
        self.results[node.fingerprint], self.chain_seconds[node.fingerprint] = result, seconds
        self.rename(node.fingerprint, left_out, (*node.inputs, *node.frame))
        own = (*(result.notes if node.stage in WITH_NOTES else ()), *left_out.values())
        before = (note for name in node.inputs for note in self.notes[name])
        self.notes[node.fingerprint] = tuple(dict.fromkeys((*before, *own)))
        if node.stored and self.keep:
            self._store(node, result, seconds)

    def _seconds_before(self, node: Node) -> dict[str, float]:
        """Return the computing time of each stage before a node (s); for a border only its own time."""
        if node.border:
            return {}
        seconds = {stage: value for name in node.inputs for stage, value in self.chain_seconds[name].items()}
        if node.frame:
            seconds[STAGE] = sum(self.chain_seconds[name][STAGE] for name in node.frame)
        return seconds

    def _run_stage(self, node: Node, inputs: list[Any], frame: list[Any]) -> Any:
        try:
            if node.border:
                return node.border(self.graph.around, inputs)
            framed: dict[str, Any] = {"frame": Frame(*frame)} if frame else {}
            if node.refit:
                framed = {"refit": partial(_refit, options=node.refit, framed=framed)}
            function = stage_function(node.stage, node.options)
            return function(*(inputs or [self.graph.readable]), node.options, **framed)
        finally:
            # This check also runs after an error: a file that is being replaced may be unreadable.
            check_unchanged(self.graph, files_read(self.graph, node))

    def _store(self, node: Node, result: Any, seconds: Mapping[str, float]) -> None:
        try:
            self.spans[node.stage].bytes += self.store.put(
                self._named(node), result, seconds, self.notes[node.fingerprint]
            )
        except OSError as error:
            # The error names the store, not the file, so that a full disk is one failure for all variants.
            full = OSError(error.errno, error.strerror, str(self.store.root))
            failed = StageError(failure_of(self.graph.tile, "store", full))
            self.errors[node.fingerprint] = failed
            raise failed from error


def _refit(data: TileData, clusters: RoadClusters, options: Options, framed: Mapping[str, Any]) -> Surface:
    surface: Surface = stage_function("fit", options)(data, clusters, options, **framed)
    return surface


def check_unchanged(graph: TileGraph, files: Iterable[Location]) -> None:
    """Compare files with their state when the tile's graph was made."""
    for file in files:
        if source_stat(file) != graph.file_stats[str(file)]:
            raise SourceChanged(str(file))


def failure_of(tile: Tile, stage: str, error: BaseException) -> Failure:
    """Return the row of an error in the table of failures."""
    message = " ".join(str(error).split()) or repr(error)
    expected = isinstance(error, TaskError | OSError | SourceChanged)
    trace = "" if expected else "".join(traceback.format_exception(error))
    return Failure(tile.id, stage, type(error).__name__, message, _file_of(tile, error), trace)


def _file_of(tile: Tile, error: BaseException) -> str:
    """Return the file that caused an error, or ``""``."""
    if isinstance(error, TaskError):
        layer = tile.layer(error.layer)
        return error.file or (str(tile.paths(layer)[0]) if layer else "")
    if isinstance(error, SourceChanged):
        return error.file
    return str(getattr(error, "filename", "") or "")
