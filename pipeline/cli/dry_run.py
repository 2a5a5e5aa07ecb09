"""Text of ``--dry-run``: why each tile is computed, and what is still to do."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Collection, Iterator

from flexroad.catalog import Tile
from flexroad.catalog.skipped import lines
from flexroad.catalog.text import Notify, count
from flexroad.pipeline.check.failures import expected_failures
from flexroad.pipeline.check.reasons import UP_TO_DATE, reason
from flexroad.pipeline.config.stages import STAGE_NAMES
from flexroad.pipeline.execute.executor import decision, workers_of
from flexroad.pipeline.graph.borders import STAGE as BORDER
from flexroad.pipeline.graph.graph import Node, TileGraph, layers_read, own_files_missing
from flexroad.pipeline.run.finished import RunPlace
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import refuse_incomplete
from flexroad.pipeline.run.status import TileStatus, peek_statuses

STORED, TO_DO, DONE = "stored", "to do", "done"


def plan(
    run: Run, tiles: Collection[Tile], say: Notify, workers: int | None = None, verbose: bool = False
) -> int:
    """Print a line per tile with the reason why it is computed, the totals, and the expected failures.

    The line with the number of tiles also says whether worker processes would be started.

    In the totals, a node of the graph is ``done`` if its tile is up to date, ``stored`` if its result is in
    the store, else ``to do``. Nodes that are never stored (the rasters that `load` reads) are computed again
    when a later node needs them.

    - `run`: the run, which may not exist yet (`Run.planned`).
    - `tiles`: the selected tiles.
    - `workers`: largest number of worker processes; by default the number in the configuration.
    - `verbose`: whether each tile also has a line per node of its graph.
    - result: expected exit code of the run; the last line prints it with its reasons.
    """
    place, totals, reasons = RunPlace.of(run), Counter[tuple[str, str]](), Counter[str]()
    todo: list[Tile] = []
    times: list[float] = []
    counted: set[str] = set()
    borders: dict[str, str] = {}
    failing, pending = set[str](), set[str]()
    for status in _selected(run, {tile.id for tile in tiles}, failing, pending):
        graph, why = status.graph, reason(run, status)
        say(f"{graph.tile.id}: {why}")
        reasons[why.partition(":")[0]] += 1
        done = why == UP_TO_DATE
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
            _say_nodes(graph, states, say)
    numbers = ", ".join(f"{number} {kind}" for kind, number in reasons.most_common())
    say(f"{count(reasons.total(), 'tile')}: {numbers}")
    if todo and not run.config.cluster.needs_workers:
        tile_s = statistics.median(times) if times else None
        say(f"  {decision(len(todo), workers_of(workers or run.config.cluster.workers), tile_s)}")
    for line in _totals(totals):
        say(line)
    for finding in expected_failures(todo, run.config, layers_read(run.config)):
        failing |= finding.failing
        say(f"warning: {finding.text}")
    for line in lines(run.catalog.skipped):
        say(f"warning: {line}")
    code, told = _verdict(len(failing), len(pending), len(run.catalog.skipped))
    say(told)
    return code


def _totals(totals: Counter[tuple[str, str]]) -> Iterator[str]:
    """Yield a line per stage with the number of its nodes in each state."""
    for stage in (*STAGE_NAMES, BORDER):
        counts = ", ".join(f"{n} {state}" for (name, state), n in sorted(totals.items()) if name == stage)
        if counts:
            yield f"  {stage:9}{counts}"


def _verdict(failing: int, pending: int, skipped: int) -> tuple[int, str]:
    """Return the expected exit code, and a line with its reasons."""
    parts = (
        (failing, "tile", "would fail"),
        (pending, "other tile", "pending or failed"),
        (skipped, "file", "skipped by the catalog"),
    )
    reasons = ", ".join(f"{count(number, noun)} {what}" for number, noun, what in parts if number)
    code = 1 if reasons else 0
    return code, f"expected exit code: {code}{f' ({reasons})' if reasons else ''}"


def _selected(run: Run, selected: set[str], failing: set[str], pending: set[str]) -> Iterator[TileStatus]:
    """Yield the state of each selected tile.

    - `failing`: gets the selected tiles that would fail.
    - `pending`: gets the other tiles without a result for the present files and options.
    """
    incomplete, last_incomplete = 0, None
    for status in peek_statuses(run, run.catalog.tiles):
        if own_files_missing(status.graph):
            incomplete, last_incomplete = incomplete + 1, status.graph
        tile_id = status.graph.tile.id
        if tile_id not in selected:
            pending |= set() if status.done else {tile_id}
            continue
        # The same files and options give the same error.
        failing |= {tile_id} if status.failed else set()
        yield status
    refuse_incomplete(run, incomplete, last_incomplete)


def _state(node: Node, place: RunPlace, borders: dict[str, str]) -> str:
    """Return whether a node is stored; corners and edges are looked up once, and added to ``borders``."""
    state = borders.get(node.fingerprint) or (STORED if node.stored and place.artefacts.has(node) else TO_DO)
    if node.border:
        borders[node.fingerprint] = state
    return state


def _say_nodes(graph: TileGraph, states: dict[str, str], say: Notify) -> None:
    """Print a line per node of a tile: stage, fingerprint, state, inputs and variants."""
    users: dict[str, list[str]] = {}
    for variant, nodes in graph.variants.items():
        for name in (*nodes.values(), *graph.nodes[nodes["fit"]].frame):
            users.setdefault(name, []).append(variant)
    for name, node in graph.nodes.items():
        inputs = ", ".join(f"{graph.nodes[i].stage}:{i[:8]}" for i in (*node.inputs, *node.frame)) or "files"
        say(f"  {node.stage:9}{name[:8]}  {states[name]:7} <- {inputs}  ({', '.join(users[name])})")
