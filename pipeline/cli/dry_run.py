"""Text of ``--dry-run``: why each tile is computed, and what is still to do."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

from flexroad.catalog import Tile
from flexroad.catalog.skipped import lines
from flexroad.catalog.text import count
from flexroad.pipeline.check.failures import expected_failures
from flexroad.pipeline.check.reasons import Kind, reason
from flexroad.pipeline.config.stages import STAGE_NAMES
from flexroad.pipeline.execute.executor import decision, workers_of
from flexroad.pipeline.graph.borders import STAGE as BORDER
from flexroad.pipeline.graph.graph import Node, layers_read, own_files_missing
from flexroad.pipeline.run.finished import RunPlace
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import refuse_incomplete
from flexroad.pipeline.run.status import TileStatus, peek_statuses

STORED, TO_DO, DONE = "stored", "to do", "done"


@dataclass
class Verdict:
    """How the run would end; filled in by `plan`."""

    failing: set[str] = field(default_factory=set)
    """Tiles that would fail."""
    pending: int = 0
    """Tiles that are not selected and have no result of the present files and options."""
    skipped: int = 0
    """Files that the catalog skipped."""

    @property
    def exit_code(self) -> int:
        """Exit code of the run."""
        return int(len(self.failing) + self.pending + self.skipped > 0)

    @property
    def line(self) -> str:
        """The exit code with its reasons."""
        reasons = [
            f"{count(number, noun)} {what}"
            for number, noun, what in (
                (len(self.failing), "tile", "would fail"),
                (self.pending, "other tile", "pending or failed"),
                (self.skipped, "file", "skipped by the catalog"),
            )
            if number
        ]
        told = f" ({', '.join(reasons)})" if reasons else ""
        return f"expected exit code: {self.exit_code}{told}"


def plan(run: Run, tiles: Collection[Tile], verdict: Verdict, workers: int | None = None) -> Iterator[str]:
    """Yield one line per tile with the reason why it is computed, the totals, what would fail, the verdict.

    After the number of tiles follows whether worker processes would be started.

    In the totals, a node of the graph is ``done`` if its tile is up to date, ``stored`` if its result is in
    the store, else ``to do``. Nodes that are never stored (the rasters that `load` reads) are computed again
    when a later node needs them.

    - `run`: the run, which need not exist yet (`Run.planned`).
    - `tiles`: the selected tiles.
    - `verdict`: is filled in.
    - `workers`: largest number of worker processes; by default that of the configuration.
    """
    place, totals, reasons = RunPlace.of(run), Counter[tuple[str, str]](), Counter[Kind]()
    todo: list[Tile] = []
    times: list[float] = []
    counted: set[str] = set()
    borders: dict[str, str] = {}
    for status in _selected(run, {tile.id for tile in tiles}, verdict):
        graph, why = status.graph, reason(run, status)
        yield f"{graph.tile.id}: {why.line}"
        reasons[why.kind] += 1
        done = why.kind == "up to date"
        if status.last_record and status.last_record.state == "done":
            times.append(status.last_record.seconds)
        todo += [] if done else [graph.tile]
        states = {name: DONE if done else _state(node, place, borders) for name, node in graph.nodes.items()}
        for name, node in graph.nodes.items():
            if name not in counted:
                totals[node.stage, states[name]] += 1
            # Corners and edges are nodes of several tiles.
            counted |= {name} if node.border else set()
    numbers = ", ".join(f"{number} {kind}" for kind, number in reasons.most_common())
    yield f"{count(reasons.total(), 'tile')}: {numbers}"
    if todo and not run.config.cluster.needs_workers:
        tile_s = statistics.median(times) if times else None
        yield f"  {decision(len(todo), workers_of(workers or run.config.cluster.workers), tile_s)}"
    for stage in (*STAGE_NAMES, BORDER):
        counts = ", ".join(f"{n} {state}" for (name, state), n in sorted(totals.items()) if name == stage)
        if counts:
            yield f"  {stage:9}{counts}"
    for finding in expected_failures(todo, run.config, layers_read(run.config)):
        verdict.failing |= finding.failing
        yield f"warning: {finding.text}"
    yield from (f"warning: {line}" for line in lines(run.catalog.skipped))
    yield verdict.line


def _selected(run: Run, selected: set[str], verdict: Verdict) -> Iterator[TileStatus]:
    """Yield the state of each selected tile, and fill in what the states of all tiles tell of the verdict."""
    verdict.skipped = len(run.catalog.skipped)
    incomplete, last_incomplete = 0, None
    for status in peek_statuses(run, run.catalog.tiles):
        if own_files_missing(status.graph):
            incomplete, last_incomplete = incomplete + 1, status.graph
        if status.graph.tile.id not in selected:
            verdict.pending += not status.done
            continue
        if status.failed:
            # The same files and options give the same error.
            verdict.failing.add(status.graph.tile.id)
        yield status
    refuse_incomplete(run, incomplete, last_incomplete)


def _state(node: Node, place: RunPlace, borders: dict[str, str]) -> str:
    """Return whether a node is stored; corners and edges are looked up once, and added to ``borders``."""
    state = borders.get(node.fingerprint) or (STORED if node.stored and place.artefacts.has(node) else TO_DO)
    if node.border:
        borders[node.fingerprint] = state
    return state
