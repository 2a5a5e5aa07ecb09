"""Text of ``--dry-run``: the graph of a run and what is still to do."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from flexroad.catalog import Tile
from flexroad.catalog.storage.paths import Location
from flexroad.catalog.text import count
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.graph.borders import STAGE as BORDER
from flexroad.pipeline.graph.graph import TileGraph, layers_read
from flexroad.pipeline.graph.stages import STAGE_NAMES
from flexroad.pipeline.inspect.failures import expected_failures
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.store.products import TileProducts


def plan(graphs: Iterable[TileGraph], store: Location, run: Location, config: Config) -> Iterator[str]:
    """Yield one line per tile and stage node, then the totals, then what would fail of the tiles to do.

    A node is ``stored`` if its result is in the store, else ``to do``. Nodes that are never stored (the
    rasters that `load` reads) are computed again when a later node needs them.
    """
    artefacts, totals, tiles = ArtefactStore(store), Counter[tuple[str, str]](), 0
    todo: list[Tile] = []
    counted: set[str] = set()
    for graph in graphs:
        tiles += 1
        done = TileProducts.of(run, graph.tile.id).done(graph) is not None
        todo += [] if done else [graph.tile]
        yield f"{graph.tile.id}: {'done' if done else 'to do'}"
        users = _users(graph)
        for node in graph.nodes.values():
            state = "stored" if node.stored and artefacts.has(node) else "to do"
            if node.fingerprint not in counted:
                totals[node.stage, "done" if done else state] += 1
            # Corners and edges are nodes of several tiles.
            counted |= {node.fingerprint} if node.border else set()
            needed = (*node.inputs, *node.frame)
            inputs = ", ".join(f"{graph.nodes[i].stage}:{i[:8]}" for i in needed) or "files"
            yield (
                f"  {node.stage:9}{node.fingerprint[:8]}  {'done' if done else state:7} "
                f"<- {inputs}  ({', '.join(users[node.fingerprint])})"
            )
    yield count(tiles, "tile")
    for stage in (*STAGE_NAMES, BORDER):
        counts = ", ".join(f"{n} {state}" for (name, state), n in sorted(totals.items()) if name == stage)
        if counts:
            yield f"  {stage:9}{counts}"
    for finding in expected_failures(todo, config, layers_read(config)):
        yield f"warning: {finding.text}"


def _users(graph: TileGraph) -> dict[str, list[str]]:
    """Return the variants that use each node, by the node's fingerprint."""
    users: dict[str, list[str]] = {}
    for variant, nodes in graph.variants.items():
        shared = graph.nodes[nodes["fit"]].frame
        for fingerprint in (*nodes.values(), *shared):
            users.setdefault(fingerprint, []).append(variant)
    return users
