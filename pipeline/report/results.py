"""The stored results of finished tiles that a report compares and draws."""

from __future__ import annotations

from collections.abc import Iterable

from flexroad.catalog import Tile
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import TileStatus, peek_statuses

Results = dict[str, dict[str, tuple[str, str]]]
"""Finished tile -> exported variant -> fingerprints of its surface and of its road mask: not graphs, of which
thousands would be large."""


def add_results(results: Results, status: TileStatus) -> None:
    """Add the results of a tile if it is finished."""
    if status.done:
        graph = status.graph
        exported = ((variant, graph.variants[variant]) for variant in graph.export.variants)
        results[graph.tile.id] = {name: (stages["fit"], stages["segment"]) for name, stages in exported}


def find_results(run: Run, tiles: Iterable[Tile]) -> Results:
    """Return the results of those tiles that are finished; checks each of them."""
    results: Results = {}
    for status in peek_statuses(run, tiles):
        add_results(results, status)
    return results
