"""Pull what is asked for through a tile's graph: a stage runs only if something needs what the store lacks.

After a stage that reads files the files are looked at again: what was read must be what the fingerprint says,
or a result would be kept under a name that is not its own.
"""

from __future__ import annotations

import traceback
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from flexroad.catalog import Tile
from flexroad.catalog.storage.paths import stat
from flexroad.pipeline.graph.graph import Node, TileGraph, files_read
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.store.records import Failure
from flexroad.pipeline.worker.profiling import StageCost
from flexroad.tasks.errors import TaskError


class StageError(Exception):
    """A stage failed; carries what the table of failures needs."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.line)
        self.failure = failure


class SourceChanged(Exception):
    """A file is no longer the one that the tile's graph was made for."""

    def __init__(self, file: str) -> None:
        super().__init__("changed while the tile was being done; the same command takes the tile up again")
        self.file = file


@dataclass
class Evaluator:
    """Results of one tile's nodes, each computed or read at most once."""

    graph: TileGraph
    store: ArtefactStore
    force: frozenset[str] = frozenset()
    keep: bool = False
    """Whether to put into the store what is computed; who only looks at a run leaves it as it is."""
    results: dict[str, Any] = field(default_factory=dict)
    chain_seconds: dict[str, dict[str, float]] = field(default_factory=dict)
    spans: defaultdict[str, StageCost] = field(default_factory=lambda: defaultdict(StageCost))
    """What each stage cost here."""
    faults: dict[str, StageError] = field(default_factory=dict)

    def __call__(self, fingerprint: str) -> Any:
        """Return the node's result.

        Raises
        ------
        StageError
            If it or something it needs failed, now or before.
        """
        if fingerprint in self.faults:
            raise self.faults[fingerprint]
        if fingerprint not in self.results:
            node = self.graph.nodes[fingerprint]
            found = self.store.get(node) if node.stored and node.stage not in self.force else None
            if found is None:
                self._compute(node)
            else:
                self.results[fingerprint], self.chain_seconds[fingerprint] = found
                self.spans[node.stage].reused += 1
        return self.results[fingerprint]

    def _compute(self, node: Node) -> None:
        inputs = [self(fingerprint) for fingerprint in node.inputs] or [self.graph.tile]
        span = self.spans[node.stage]
        before = span.seconds
        try:
            with span.measured():
                result = self._carry_out(node, inputs)
        except Exception as error:
            failed = StageError(failure_of(self.graph.tile, node.stage, error))
            self.faults[node.fingerprint] = failed
            raise failed from error
        span.computed += 1
        known = [self.chain_seconds[fingerprint] for fingerprint in node.inputs]
        spent = {stage: value for seconds in known for stage, value in seconds.items()}
        spent[node.stage] = span.seconds - before
        self.results[node.fingerprint], self.chain_seconds[node.fingerprint] = result, spent
        if node.stored and self.keep:
            self._keep(node, result, spent)

    def _carry_out(self, node: Node, inputs: list[Any]) -> Any:
        try:
            return node.function(*inputs, node.options)
        finally:
            # Also after a fault: a file that is just being replaced may well be unreadable.
            for file in files_read(self.graph, node):
                if stat(file) != self.graph.seen[str(file)]:
                    raise SourceChanged(str(file))

    def _keep(self, node: Node, result: Any, spent: Mapping[str, float]) -> None:
        try:
            self.spans[node.stage].bytes += self.store.put(node, result, spent)
        except OSError as error:
            # The same for every artefact: a full disk is one failure, not one for each variant.
            full = OSError(error.errno, error.strerror, str(self.store.root))
            failed = StageError(failure_of(self.graph.tile, "store", full))
            self.faults[node.fingerprint] = failed
            raise failed from error


def failure_of(tile: Tile, stage: str, error: BaseException) -> Failure:
    """Return an error as a line of the table of failures."""
    message = " ".join(str(error).split()) or repr(error)
    expected = isinstance(error, TaskError | OSError | SourceChanged)
    trace = "" if expected else "".join(traceback.format_exception(error))
    return Failure(tile.id, stage, type(error).__name__, message, _file(tile, error), trace)


def _file(tile: Tile, error: BaseException) -> str:
    if isinstance(error, TaskError):
        layer = tile.layer(error.layer)
        return error.file or (str(tile.paths(layer)[0]) if layer else "")
    if isinstance(error, SourceChanged):
        return error.file
    return str(getattr(error, "filename", "") or "")
