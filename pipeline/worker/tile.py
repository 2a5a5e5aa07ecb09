"""Processing of one tile: evaluate its graph, write its products and marker, return a small result.

`process_tile` runs in a worker process; arrays stay there, only rows are returned.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from flexroad.catalog.index import item
from flexroad.catalog.storage.paths import parse_location, stat
from flexroad.pipeline.config.stages import STAGE_NAMES, stage_version
from flexroad.pipeline.graph.graph import TileGraph
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.store.records import (
    LEVELS,
    MARKERS,
    Failure,
    MarkerStat,
    MetricsRow,
    TileRecord,
    TileState,
    from_item,
    no_nan,
    to_failed,
    utc_now,
)
from flexroad.pipeline.worker.evaluator import Evaluator, StageCost, StageError, failure_of
from flexroad.pipeline.worker.exports import (
    COLLECTION,
    EXTENSIONS,
    JSON,
    Product,
    assets,
    product_names,
    products,
    tile_texture,
)
from flexroad.tasks.errors import recorded
from flexroad.tasks.types import Metrics, Quality

QUALITY = tuple(name for name, kind in Quality.__annotations__.items() if kind == "float")
"""Columns of a row that are computed without ground truth."""


@dataclass(frozen=True)
class TileJob:
    """One tile to process and the paths of its results; sent to a worker."""

    graph: TileGraph
    run: str
    store: str
    origin: tuple[float, float]
    """Origin of the run: whole-metre (easting, northing) that mesh translations are relative to."""
    collection: str
    """Id of the run's STAC collection."""
    force: frozenset[str] = frozenset()
    """Stages to compute even if their results are in the store."""
    flushed: bool = False
    """Whether products and marker are written to the disk before the tile is done or failed."""

    @property
    def key(self) -> str:
        """Name of the job on Dask's dashboard."""
        return f"tile-{self.graph.tile.id}"

    @property
    def folder(self) -> TileProducts:
        """The folder of the tile's products."""
        return TileProducts.of(parse_location(self.run), self.graph.tile.id)


@dataclass(frozen=True)
class TileResult:
    """The result of one tile in this run, as returned by a worker."""

    entry: TileRecord
    status: TileState
    """``cached`` if the tile was up to date before."""
    spans: dict[str, StageCost] = field(default_factory=dict)
    """Cost of each stage."""
    notes: tuple[str, ...] = ()
    host: str = ""
    pid: int = 0

    @property
    def tile_id(self) -> str:
        """Id of the tile."""
        return self.entry.tile_id

    @property
    def rows(self) -> tuple[MetricsRow, ...]:
        """Metrics, one row per variant."""
        return self.entry.rows

    @property
    def failures(self) -> tuple[Failure, ...]:
        """Errors that left the tile without a result; empty if it is done."""
        return self.entry.failures

    @property
    def computed(self) -> dict[str, int]:
        """Stage -> number of nodes computed in this run."""
        return {stage: span.computed for stage, span in self.spans.items() if span.computed}


def process_tile(job: TileJob) -> TileResult:
    """Bring one tile up to date with its graph; errors of the tile are returned as failures, not raised."""
    graph = job.graph
    evaluator = Evaluator(graph, ArtefactStore(parse_location(job.store)), job.force, keep=True)
    rows, failures = [], []
    for variant in graph.variants:
        try:
            rows.append(_row(graph, variant, evaluator))
        except StageError as error:
            rows.append(failed_row(graph, variant, error.failure.line))
            failures.append(error.failure)
    failures = list(dict.fromkeys(failures))
    notes = tuple(dict.fromkeys(note for name in graph.nodes for note in evaluator.notes.get(name, ())))
    entry = None
    if not failures:
        try:
            entry, notes = _finish(job, evaluator, rows, notes)
        except StageError as error:
            failures.append(error.failure)
        except Exception as error:
            failures.append(failure_of(graph.tile, "export", error))
        if failures:
            rows = [failed_row(graph, row["variant"], failures[0].line) for row in rows]
    if entry is None:
        entry = record_failure(job, rows, failures, _seconds(evaluator))
    return TileResult(entry, entry.state, dict(evaluator.spans), notes, socket.gethostname(), os.getpid())


def record_failure(
    job: TileJob, rows: Sequence[MetricsRow], failures: Sequence[Failure], seconds: float = 0.0
) -> TileRecord:
    """Write the tile's failed.json and return the record of the failure.

    Products of an earlier result stay, and failed.json names them as stale.
    """
    tile_id, fingerprint = job.graph.tile.id, job.graph.fingerprint
    marker, stale = None, tuple[str, ...]()
    with contextlib.suppress(OSError):
        stale = product_names(tile_id, job.folder.files())
    entry = TileRecord(
        tile_id,
        "failed",
        fingerprint,
        tuple(rows),
        tuple(failures),
        finished=utc_now(),
        seconds=seconds,
        stale=stale,
    )
    # If the marker cannot be written (disk full), the returned record still has the failure.
    with contextlib.suppress(OSError):
        job.folder.fail(to_failed(entry), job.flushed)
        marker = marker_stat(job.folder, "failed")
    return replace(entry, marker=marker)


def marker_stat(folder: TileProducts, state: TileState) -> MarkerStat | None:
    """Return name, size and version of a tile's marker, None if it does not exist."""
    file = stat(folder.path / MARKERS[state])
    return (MARKERS[state], file.size, file.version) if file else None


def failed_row(graph: TileGraph, variant: str, error: str) -> MetricsRow:
    """Return the row of a failed variant: all metrics None, with the error."""
    return _failed(_head(graph, variant, "failed"), error)


def _failed(head: MetricsRow, error: str) -> MetricsRow:
    head = {name: value for name, value in head.items() if name != LEVELS}
    nothing = dict.fromkeys((*Metrics.__annotations__, *QUALITY, "seconds"))
    return {**head, **nothing, "status": "failed", "error": error, "flags": ""}


def without_results(record: TileRecord, failure: Failure) -> TileRecord:
    """Return the record of a done tile whose results are gone; it is not in a marker."""
    rows = tuple(_failed(row, failure.line) for row in record.rows)
    return replace(record, state="failed", rows=rows, failures=(failure,), sources=[], sizes={}, marker=None)


def _row(graph: TileGraph, variant: str, evaluator: Evaluator) -> MetricsRow:
    node = graph.variants[variant]["evaluate"]
    metrics = asdict(evaluator(node))
    quality: Quality = evaluator(graph.variants[variant]["assess"])
    metrics |= {name: getattr(quality, name) for name in QUALITY}
    seconds = sum(evaluator.chain_seconds[node].values())
    status = {"seconds": seconds, "error": "", "flags": ", ".join(quality.flags)}
    levels = _of_levels(quality)
    return no_nan(_head(graph, variant, "done") | metrics | status | ({LEVELS: levels} if levels else {}))


def _of_levels(quality: Quality) -> list[dict[str, Any]]:
    """Return the figures of the decks and tunnels of a tile, for each level with decks or tunnels."""
    return [
        no_nan(
            {"level": number}
            | asdict(of_level.structures)
            | {name: getattr(of_level, name) for name in QUALITY if not name.startswith("holdout")}
            | {"flags": ", ".join(of_level.flags)}
        )
        for number, of_level in quality.levels
        if of_level.structures
    ]


def _head(graph: TileGraph, variant: str, status: TileState) -> MetricsRow:
    fit = graph.chain(variant)[STAGE_NAMES.index("fit")]
    return {
        "tile_id": graph.tile.id,
        "variant": variant,
        "method": fit.options.model_dump()["method"],
        "stratum": graph.tile.stratum,
        "status": status,
    }


def _seconds(evaluator: Evaluator) -> float:
    return sum(span.seconds for span in evaluator.spans.values())


def _finish(
    job: TileJob, evaluator: Evaluator, rows: list[MetricsRow], notes: tuple[str, ...]
) -> tuple[TileRecord, tuple[str, ...]]:
    """Write the products and the item of a finished tile; return its record and all notes."""
    span = evaluator.spans["export"]
    with span.measure():
        with recorded() as left_out:
            texture, note = tile_texture(job.graph)
        evaluator.rename("export", left_out)
        files = products(job.graph, evaluator, job.origin, texture)
        notes = tuple(dict.fromkeys((*notes, *left_out.values(), *([note] if note else ()))))
        seconds = round(_seconds(evaluator), 4)
        written = _item(job, evaluator, rows, files, notes, seconds)
        job.folder.finish(written, {name: file.data for name, file in files.items()}, job.flushed)
    span.computed += 1
    span.bytes += sum(len(file.data) for file in files.values())
    return from_item(written, marker_stat(job.folder, "done")), notes


def _item(
    job: TileJob,
    evaluator: Evaluator,
    rows: list[MetricsRow],
    files: Mapping[str, Product],
    notes: tuple[str, ...],
    seconds: float,
) -> dict[str, Any]:
    graph = job.graph.renamed(evaluator.renamed)
    content = item(graph.tile)
    content["collection"] = job.collection
    to_collection = {"href": f"../../{COLLECTION}", "type": JSON, "title": job.collection}
    content["links"] = [{"rel": rel} | to_collection for rel in ("root", "parent", "collection")]
    content["stac_extensions"] += EXTENSIONS
    content["assets"] = assets(files, graph.export.variants, graph.tile.grid)
    content["properties"] |= {
        "created": utc_now(),
        "gsd": graph.tile.grid.cell,
        "flexroad:fingerprint": graph.fingerprint,
        "flexroad:rows": rows,
        "flexroad:notes": list(notes),
        "flexroad:nodes": graph.variants,
        "flexroad:sources": graph.sources,
        "flexroad:left_out": list(evaluator.left_out),
        "flexroad:renamed": evaluator.renamed,
        "flexroad:versions": dict(stage_version(node.stage, node.options) for node in graph.nodes.values()),
        "flexroad:seconds": seconds,
    }
    return content
