"""Why a run computes a tile, or does not."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from flexroad.catalog.text import count, some
from flexroad.pipeline.config.stages import STAGE_NAMES
from flexroad.pipeline.graph.graph import TileGraph, own_files_missing
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import TileStatus
from flexroad.pipeline.store.records import TileRecord

Kind = Literal[
    "up to date",
    "new",
    "failed last time",
    "file missing",
    "file left out",
    "product missing",
    "source changed",
    "settings or version changed",
]


@dataclass(frozen=True)
class Reason:
    """Why a tile is computed."""

    kind: Kind
    detail: str = ""
    """The file, the stage or the error; empty if there is nothing to add."""

    @property
    def line(self) -> str:
        """Both in one line."""
        return f"{self.kind}: {self.detail}" if self.detail else self.kind


def reason(run: Run, status: TileStatus) -> Reason:
    """Return why the next run computes a tile; the kind is ``up to date`` if it does not.

    If sources and options have both changed, the sources are named. The marker is read only if neither a
    source nor a product differs.
    """
    record, graph = status.last_record, status.graph
    if record is None:
        return Reason("new")
    if record.state == "failed":
        return Reason("failed last time", record.failures[0].line if record.failures else "")
    if status.done and status.sources_present:
        return Reason("up to date")
    if missing := own_files_missing(graph):
        return Reason("file missing", _first(missing, ""))
    # A file around the tile is left out, and the tile computed without it.
    if missing := [path for path, file in graph.file_stats.items() if file is None]:
        return Reason("source changed", _first(missing, ", which is missing,").removesuffix(","))
    if status.done:
        return Reason("file left out", _first(record.left_out, " could not be used"))
    if record.fingerprint == graph.fingerprint:
        return Reason("product missing")
    if _compared_otherwise(record, graph):
        return Reason("settings or version changed", "--checksum")
    if changed := _changed_sources(record, graph):
        return Reason("source changed", changed)
    return Reason("settings or version changed", _changed_stage(run, graph))


def why_pending(run: Run, statuses: Iterable[TileStatus]) -> list[str]:
    """Return why tiles without a result of the present files and options are computed, a line per reason."""
    tiles: dict[str, list[str]] = defaultdict(list)
    for status in statuses:
        tiles[reason(run, status).line].append(status.graph.tile.id)
    return [f"{some(ids)}: {line}" for line, ids in tiles.items()]


def _first(names: Sequence[str], what: str) -> str:
    more = f" and {count(len(names) - 1, 'more file')}" if len(names) > 1 else ""
    return f"{names[0]}{what}{more}"


def _compared_otherwise(record: TileRecord, graph: TileGraph) -> bool:
    """Return whether files were compared by size and time then and are by content now, or vice versa."""
    before, now = _files(record.sources), _files(graph.sources)
    shared = [(before[name], now[name]) for name in now if name in before]
    # Of a missing file neither is known.
    return any(len(one) != len(other) for one, other in shared if None not in (one[1], other[1]))


def _changed_sources(record: TileRecord, graph: TileGraph) -> str:
    """Return the layers that are read or no longer read, or the first file that differs; empty if none does.

    Options such as ``segment.method`` and ``load.halo_m`` also change what is read.
    """
    layers, earlier = ([entry[0] for entry in sources] for sources in (graph.sources, record.sources))
    more = [layer for layer in layers if layer not in earlier]
    less = [layer for layer in earlier if layer not in layers]
    if more or less:
        parts = [("now reads", more), ("no longer reads", less)]
        return ", ".join(f"{what} {', '.join(names)}" for what, names in parts if names)
    before, now = _files(record.sources), _files(graph.sources)
    changed = [name for name in now if name in before and before[name] != now[name]]
    for names, what in (
        ([name for name in changed if before[name][1] is None], ", which was missing,"),
        (changed, ""),
        ([name for name in now if name not in before], ", which was not read before,"),
        ([name for name in before if name not in now], ", which is no longer read,"),
    ):
        if names:
            return _first([name for _, name in names], what).removesuffix(",")
    # Their values of road and their CRS are from the catalog.
    described = {entry[0]: entry[2:] for entry in record.sources}
    layers = [entry[0] for entry in graph.sources if entry[2:] != described[entry[0]]]
    return f"values or CRS of {', '.join(layers)} in the catalog" if layers else ""


def _files(sources: Sequence[Any]) -> dict[tuple[str, str], list[Any]]:
    """Return the description of each file, by layer and name."""
    return {(layer, file[0]): file for layer, files, *_ in sources for file in files}


def _changed_stage(run: Run, graph: TileGraph) -> str:
    """Return the first stage, in the order of the graph, whose options, model or version have changed."""
    folder = run.folder(graph.tile.id)
    before = {variant: folder.nodes(variant) for variant in graph.variants}
    if not any(before.values()):
        return ""
    added = [variant for variant, nodes in before.items() if not nodes]
    for stage in STAGE_NAMES:
        for variant, nodes in before.items():
            if nodes and nodes.get(stage) != graph.variants[variant][stage]:
                return stage
    return f"variant {added[0]}" if added else "export"
