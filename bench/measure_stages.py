"""CPU time of the stages of tiles, in a process that measures one round for each line of its input.

It imports no module of its folder, so that the interpreter of another checkout can run it (`compare.py`).

Usage: ``python bench/measure_stages.py CATALOG CONFIG FOLDER``; prints a JSON object for each round.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.graph.borders import STAGE as BORDER
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import StageCost
from flexroad.pipeline.worker.tile import process_tile

VARIANT = "flexroad"


def main(catalog: Path, config: str, folder: Path) -> None:
    by_cpu_time()
    tiles = Catalog.read(catalog).tiles
    alone = one_variant(config)
    for number, _ in enumerate(sys.stdin):
        measured = []
        for tile in tiles:
            # With a fresh store, a tile computes its corners and edges itself. Earlier rounds are removed.
            shutil.rmtree(folder / tile.id, ignore_errors=True)
            measured.append(measure(folder / tile.id, alone, Catalog((tile,))))
        print(json.dumps({"round": number, "tiles": measured}), flush=True)


def by_cpu_time() -> None:
    """Let stages measure themselves by CPU time, because other programs may use the machine."""
    # Checkouts may bind the clock in different modules.
    sys.modules[StageCost.__module__].perf_counter = time.process_time  # type: ignore[attr-defined]


def one_variant(name: str) -> Config:
    """Return a configuration with FlexRoad as its only variant, without baselines."""
    config = load_config(name)
    return compose({**config.raw, "variants": {VARIANT: {}}}, f"{name}, {VARIANT}")


def measure(folder: Path, config: Config, catalog: Catalog) -> dict[str, Any]:
    """Process one tile; return the CPU time of each stage and of all (s), memory (MB), row and products."""
    run = Run.create(folder, config, catalog)
    start = time.process_time()
    result = process_tile(run.job(run.graph(run.catalog.tiles[0])))
    total = time.process_time() - start
    if result.failures:
        raise SystemExit(f"tile {result.tile_id}: {result.failures[0].line}")
    seconds = {
        **borders(run),
        **{stage: span.seconds for stage, span in result.spans.items() if span.computed},
    }
    if seconds.keys() >= {"corners", "edges"}:
        del seconds[BORDER]
    # Reading and writing of the store, the item, and the graph.
    seconds["rest"] = total - sum(seconds.values())
    products = sorted(path for path in (folder / "tiles").glob("*/*") if path.suffix != ".json")
    return {
        "tile": result.tile_id,
        "seconds": seconds,
        "total": total,
        "peak_mb": max(span.peak_mb for span in result.spans.values()),
        "row": {name: value for name, value in result.rows[0].items() if isinstance(value, int | float)},
        "products": {path.name: path.stat().st_size for path in products},
        "stored": sum(path.stat().st_size for path in (folder / "store").rglob("*.npz")),
        "height": str(next((path for path in products if path.name.endswith("_height.tif")), "")),
    }


def borders(run: Run) -> dict[str, float]:
    """Return the CPU time of the four corners and of the four edges of a run's tile (s), from its store."""
    graph, store = run.graph(run.catalog.tiles[0]), ArtefactStore(run.store)
    parts = {"corners": 0.0, "edges": 0.0}
    nodes = [node for node in graph.nodes.values() if node.stage == BORDER]
    for node in nodes:
        stored = store.get(node)
        if stored is None:
            return {}
        # An edge takes the corners at its ends.
        parts["edges" if node.inputs else "corners"] += stored[1][BORDER]
    return parts if nodes else {}


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
