"""Text of ``--dry-run``: why each tile is computed, and what is still to do."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterable, Iterator

from flexroad.catalog import Tile
from flexroad.catalog.text import count
from flexroad.pipeline.check.catalog import expected_failures
from flexroad.pipeline.check.reasons import Kind, reason
from flexroad.pipeline.execute.adaptive import decision, workers_of
from flexroad.pipeline.graph.borders import STAGE as BORDER
from flexroad.pipeline.graph.graph import Node, TileGraph, layers_read
from flexroad.pipeline.graph.stages import STAGE_NAMES
from flexroad.pipeline.run.finished import RunPlace
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses

STORED, TO_DO, DONE = "stored", "to do", "done"


def plan(run: Run, tiles: Iterable[Tile], verbose: bool = False, workers: int | None = None) -> Iterator[str]:
    """Yield one line per tile with the reason why it is computed, then the totals, then what would fail.

    After the number of tiles follows whether worker processes would be started.

    In the totals, a node of the graph is ``done`` if its tile is up to date, ``stored`` if its result is in
    the store, else ``to do``. Nodes that are never stored (the rasters that `load` reads) are computed again
    when a later node needs them.

    Parameters
    ----------
    run : Run
        The run, which need not exist yet (`Run.planned`).
    tiles : iterable of Tile
        The selected tiles.
    verbose : bool
        Whether each tile also has a line per node.
    workers : int, optional
        Largest number of worker processes; by default that of the configuration.
    """
    place, totals, reasons = RunPlace.of(run), Counter[tuple[str, str]](), Counter[Kind]()
    todo: list[Tile] = []
    times: list[float] = []
    counted: set[str] = set()
    borders: dict[str, str] = {}
    for status in peek_statuses(run, tiles):
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
        if verbose:
            yield from _nodes(graph, states)
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
        yield f"warning: {finding.text}"


def _state(node: Node, place: RunPlace, borders: dict[str, str]) -> str:
    """Return whether a node is stored; corners and edges are looked up once, and added to ``borders``."""
    state = borders.get(node.fingerprint) or (STORED if node.stored and place.artefacts.has(node) else TO_DO)
    if node.border:
        borders[node.fingerprint] = state
    return state


def _nodes(graph: TileGraph, states: dict[str, str]) -> Iterator[str]:
    """Yield a line per node of a tile: stage, fingerprint, state, inputs and variants."""
    users = _users(graph)
    for name, node in graph.nodes.items():
        inputs = ", ".join(f"{graph.nodes[i].stage}:{i[:8]}" for i in (*node.inputs, *node.frame)) or "files"
        yield f"  {node.stage:9}{name[:8]}  {states[name]:7} <- {inputs}  ({', '.join(users[name])})"


def _users(graph: TileGraph) -> dict[str, list[str]]:
    """Return the variants that use each node, by the node's fingerprint."""
    users: dict[str, list[str]] = {}
    for variant, nodes in graph.variants.items():
        shared = graph.nodes[nodes["fit"]].frame
        for fingerprint in (*nodes.values(), *shared):
            users.setdefault(fingerprint, []).append(variant)
    return users
