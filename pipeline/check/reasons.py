"""Why a run computes a tile, or does not."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

from flexroad.catalog.text import count, some
from flexroad.pipeline.config.stages import STAGE_NAMES
from flexroad.pipeline.graph.graph import TileGraph, own_files_missing
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import TileStatus
from flexroad.pipeline.store.records import TileRecord

UP_TO_DATE = "up to date"


def reason(run: Run, status: TileStatus) -> str:
    """Return why the next run computes a tile: a kind, and after a colon the file, stage or error if known.

    The reason is `UP_TO_DATE` if the run does not compute the tile. If sources and options have both changed,
    the sources are named.
    The marker is read only if neither a source nor a product differs.
    """
    record, graph = status.last_record, status.graph
    if record is None:
        return "new"
    if record.state == "failed":
        return _line("failed last time", record.failures[0].line if record.failures else "")
    if status.done and status.sources_present:
        return UP_TO_DATE
    if missing := own_files_missing(graph):
        return _line("file missing", _first(missing))
    # If a file around the tile cannot be used, the tile is computed without it.
    if missing := [path for path, file in graph.file_stats.items() if file is None]:
        return _line("source changed", _first(missing, ", which is missing"))
    if status.done:
        return _line("file left out", _first(record.left_out, " could not be used"))
    if record.fingerprint == graph.fingerprint:
        return "product missing"
    if _compared_otherwise(record, graph):
        return "settings or version changed: --checksum"
    if changed := _changed_sources(record, graph):
        return _line("source changed", changed)
    return _line("settings or version changed", _changed_stage(run, graph))


def why_pending(run: Run, statuses: Iterable[TileStatus]) -> list[str]:
    """Return why tiles without a result for the present files and options are computed, a line per reason."""
    tiles: dict[str, list[str]] = defaultdict(list)
    for status in statuses:
        tiles[reason(run, status)].append(status.graph.tile.id)
    return [f"{some(ids)}: {line}" for line, ids in tiles.items()]


def _line(kind: str, detail: str) -> str:
    return f"{kind}: {detail}" if detail else kind


def _first(names: Sequence[str], what: str = "") -> str:
    """Return the first of some files with a remark on it, and the number of the other files."""
    if len(names) == 1:
        return f"{names[0]}{what}"
    return f"{names[0]}{what}{',' * what.startswith(',')} and {count(len(names) - 1, 'more file')}"


def _compared_otherwise(record: TileRecord, graph: TileGraph) -> bool:
    """Return whether files were compared by size and time then and are by content now, or vice versa."""
    before, now = _files(record.sources), _files(graph.sources)
    shared = [(before[name], now[name]) for name in now if name in before]
    # Neither size nor content of a missing file is known.
    return any(len(one) != len(other) for one, other in shared if None not in (one[1], other[1]))


def _changed_sources(record: TileRecord, graph: TileGraph) -> str:
    """Return the layers that are newly read or no longer read, or the first file that differs, or "".

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
        ([name for name in changed if before[name][1] is None], ", which was missing"),
        (changed, ""),
        ([name for name in now if name not in before], ", which was not read before"),
        ([name for name in before if name not in now], ", which is no longer read"),
    ):
        if names:
            return _first([name for _, name in names], what)
    # The catalog gives the road values and the CRS of layers.
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
