"""What happens to one tile: do what its graph asks for, keep it, say how it went.

Runs in a worker process; only small rows go back.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from flexroad.catalog.index import item
from flexroad.catalog.storage.paths import parse_location, stat
from flexroad.pipeline.graph.graph import Node, TileGraph
from flexroad.pipeline.graph.stages import STAGE_NAMES, stage_version
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.store.products import TileProducts, file_entry, no_nan
from flexroad.pipeline.store.records import (
    MARKERS,
    Failure,
    MarkerStat,
    MetricsRow,
    State,
    TileRecord,
    from_item,
    to_failed,
)
from flexroad.pipeline.worker.evaluator import Evaluator, StageError, failure_of
from flexroad.pipeline.worker.exports import products
from flexroad.pipeline.worker.profiling import StageCost, now
from flexroad.tasks.types import Metrics, Quality

QUALITY = tuple(name for name, kind in Quality.__annotations__.items() if kind == "float")
"""Figures of a row that need no ground truth."""
Status = Literal["done", "failed", "cached"]


@dataclass(frozen=True)
class TileJob:
    """One tile to do, and where its results go; travels to a worker."""

    graph: TileGraph
    run: str
    store: str
    origin: tuple[float, float]
    """Whole-metre (easting, northing) that all meshes of the run are placed against."""
    force: frozenset[str] = frozenset()
    """Stages to compute even if the store has them."""

    @property
    def key(self) -> str:
        """What the job is called on Dask's dashboard."""
        return f"tile-{self.graph.tile.id}"

    @property
    def folder(self) -> TileProducts:
        """Where the tile's products go."""
        return TileProducts.of(parse_location(self.run), self.graph.tile.id)


@dataclass(frozen=True)
class TileResult:
    """How one tile went now; what travels back."""

    entry: TileRecord
    status: Status
    """Cached if its result was there and nothing had to be done."""
    spans: dict[str, StageCost] = field(default_factory=dict)
    """What each stage cost."""
    notes: tuple[str, ...] = ()
    host: str = ""
    pid: int = 0

    @property
    def tile_id(self) -> str:
        """Which tile."""
        return self.entry.tile_id

    @property
    def rows(self) -> tuple[MetricsRow, ...]:
        """One per variant."""
        return self.entry.rows

    @property
    def failures(self) -> tuple[Failure, ...]:
        """Why it has no result."""
        return self.entry.failures

    @property
    def computed(self) -> dict[str, int]:
        """Stage -> how many of its nodes were computed now."""
        return {stage: span.computed for stage, span in self.spans.items() if span.computed}

    @property
    def reused(self) -> dict[str, int]:
        """Stage -> how many of its nodes came from the store."""
        return {stage: span.reused for stage, span in self.spans.items() if span.reused}

    @property
    def seconds(self) -> dict[str, float]:
        """Stage -> time spent computing now."""
        return {stage: span.seconds for stage, span in self.spans.items() if span.computed}

    @property
    def peak_mb(self) -> float:
        """Most memory that the worker held meanwhile."""
        return max((span.peak_mb for span in self.spans.values()), default=0.0)


def process_tile(job: TileJob) -> TileResult:
    """Bring one tile up to date with its graph; never raises for what is one tile's own fault."""
    graph = job.graph
    pull = Evaluator(graph, ArtefactStore(parse_location(job.store)), job.force, keep=True)
    rows, failures = [], []
    for variant in graph.variants:
        try:
            rows.append(_row(graph, variant, pull))
        except StageError as error:
            rows.append(failed_row(graph, variant, error.failure.line))
            failures.append(error.failure)
    failures = list(dict.fromkeys(failures))
    notes = tuple(dict.fromkeys(note for fp, node in graph.nodes.items() for note in _noted(fp, node, pull)))
    entry = None
    if not failures:
        try:
            entry = _finish(job, pull, rows, notes)
        except StageError as error:
            failures.append(error.failure)
        except Exception as error:
            failures.append(failure_of(graph.tile, "export", error))
        if failures:
            rows = [failed_row(graph, row["variant"], failures[0].line) for row in rows]
    if entry is None:
        entry = record_failure(job, rows, failures, _seconds(pull))
    return TileResult(entry, entry.state, dict(pull.spans), notes, socket.gethostname(), os.getpid())


def record_failure(
    job: TileJob, rows: Sequence[MetricsRow], failures: Sequence[Failure], seconds: float = 0.0
) -> TileRecord:
    """Write down that the tile failed, and why."""
    tile_id, fingerprint = job.graph.tile.id, job.graph.fingerprint
    entry = TileRecord(
        tile_id, "failed", fingerprint, tuple(rows), tuple(failures), finished=now(), seconds=seconds
    )
    marker = None
    # Where even this cannot be written (disk full), the entry that goes back still tells.
    with contextlib.suppress(OSError):
        job.folder.fail(to_failed(entry))
        marker = marker_of(job.folder, "failed")
    return replace(entry, marker=marker)


def marker_of(folder: TileProducts, state: State) -> MarkerStat | None:
    """Return how the marker that was just written looks."""
    seen = stat(folder.path / MARKERS[state])
    return (MARKERS[state], seen.size, seen.version) if seen else None


def failed_row(graph: TileGraph, variant: str, error: str) -> MetricsRow:
    """Return the row of a variant without figures."""
    return (
        _head(graph, variant, "failed")
        | dict.fromkeys((*Metrics.__annotations__, *QUALITY))
        | {"seconds": None, "error": error, "flags": ""}
    )


def _row(graph: TileGraph, variant: str, pull: Evaluator) -> MetricsRow:
    evaluated = graph.variants[variant]["evaluate"]
    figures = asdict(pull(evaluated))
    quality: Quality = pull(graph.variants[variant]["assess"])
    figures |= {name: getattr(quality, name) for name in QUALITY}
    seconds = sum(pull.chain_seconds[evaluated].values())
    told = {"seconds": seconds, "error": "", "flags": ", ".join(quality.flags)}
    return no_nan(_head(graph, variant, "done") | figures | told)


def _head(graph: TileGraph, variant: str, status: Status) -> MetricsRow:
    fit = graph.chain(variant)[STAGE_NAMES.index("fit")]
    return {
        "tile_id": graph.tile.id,
        "variant": variant,
        "method": fit.options.model_dump()["method"],
        "stratum": graph.tile.stratum,
        "status": status,
    }


def _seconds(pull: Evaluator) -> float:
    return sum(span.seconds for span in pull.spans.values())


def _noted(fingerprint: str, node: Node, pull: Evaluator) -> tuple[str, ...]:
    """Return what a stage that reads sources had to say of them, as far as it was asked."""
    if node.stage not in ("load", "segment") or fingerprint not in pull.results:
        return ()
    notes: tuple[str, ...] = pull.results[fingerprint].notes
    return notes


def _finish(job: TileJob, pull: Evaluator, rows: list[MetricsRow], notes: tuple[str, ...]) -> TileRecord:
    span = pull.spans["export"]
    with span.measured():
        made = products(job.graph, pull, job.origin)
        seconds = round(_seconds(pull), 4)
        written = _item(job.graph, rows, made, notes, seconds)
        job.folder.finish(written, {name: data for name, (data, _) in made.items()})
    span.computed += 1
    span.bytes += sum(len(data) for data, _ in made.values())
    return from_item(written, marker_of(job.folder, "done"))


def _item(
    graph: TileGraph,
    rows: list[MetricsRow],
    made: Mapping[str, tuple[bytes, str]],
    notes: tuple[str, ...],
    seconds: float,
) -> dict[str, Any]:
    found = item(graph.tile)
    found["stac_extensions"].append("https://stac-extensions.github.io/file/v2.1.0/schema.json")
    found["assets"] = {name: file_entry(name, data, kind) for name, (data, kind) in made.items()}
    found["properties"] |= {
        "created": now(),
        "flexroad:fingerprint": graph.fingerprint,
        "flexroad:rows": rows,
        "flexroad:notes": list(notes),
        "flexroad:nodes": graph.variants,
        "flexroad:sources": graph.sources,
        "flexroad:versions": _versions(graph),
        "flexroad:seconds": seconds,
    }
    return found


def _versions(graph: TileGraph) -> dict[str, int]:
    return dict(stage_version(node.stage, node.options) for node in graph.nodes.values())
