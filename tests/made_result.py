"""The result of a tile that was not computed, with the marker that the client looks for."""

from flexroad.catalog.storage import paths
from flexroad.pipeline.store.records import DONE, TileRecord
from flexroad.pipeline.worker.tile import TileJob, TileResult, failed_row, marker_stat


def done(job: TileJob) -> TileResult:
    """Write an empty marker and return as much data as a real tile."""
    graph = job.graph
    paths.write(job.folder.path / DONE, b"")
    rows = tuple(failed_row(graph, variant, "") | {"status": "done"} for variant in graph.variants)
    marker = marker_stat(job.folder, "done")
    record = TileRecord(graph.tile.id, "done", graph.fingerprint, rows, sources=graph.sources, marker=marker)
    return TileResult(record, "done")
