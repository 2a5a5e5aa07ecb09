"""All stages of a tile: time per stage, and memory of one process over 2,000 tiles."""

from __future__ import annotations

import resource
import statistics
import sys
import tempfile
import time
from pathlib import Path

from flexroad.catalog import Catalog
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.graph.stages import STAGE_NAMES
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.worker.tile import process_tile

TILES = 8
MANY = 2000
"""Tiles of the memory test."""


def main(many: int = MANY) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        catalog = Catalog.read(write_scenes(folder / "survey", TILES, seed=11))
        paper = load_config("paper")
        flexroad = compose({**paper.raw, "variants": {"flexroad": {}}}, "flexroad alone")
        for config in (flexroad, paper):
            table(config, catalog, folder / config.name)
        growth(flexroad, catalog, folder / "growth", many)


def table(config: Config, catalog: Catalog, folder: Path) -> None:
    run = Run.create(folder, config, catalog)
    # The first tile compiles code, or loads compiled code; it is not timed.
    process_tile(run.job(run.graph(run.catalog.tiles[0]), frozenset(STAGE_NAMES)))
    totals, stages = [], []
    for graph in map(run.graph, run.catalog.tiles):
        start = time.perf_counter()
        stages.append(process_tile(run.job(graph, frozenset(STAGE_NAMES))).seconds)
        totals.append(time.perf_counter() - start)
    names = [*STAGE_NAMES, "export"]
    medians = {name: statistics.median(seconds[name] for seconds in stages) for name in names}
    total = statistics.median(totals)
    print(f"\n{config.name}: {', '.join(config.chains)}; median over {TILES} urban to rural tiles, one core")
    for name in names:
        print(f"  {name:10}{1000 * medians[name]:8.1f} ms{medians[name] / total:7.0%}")
    rest = total - sum(medians.values())
    print(f"  {'store':10}{1000 * rest:8.1f} ms{rest / total:7.0%}")
    print(f"  {'tile':10}{1000 * total:8.1f} ms; the limit is 400 ms: {total / 0.4:.2f} of it")


def growth(config: Config, catalog: Catalog, folder: Path, many: int) -> None:
    """Process the same tiles repeatedly, all stages each time, and print the memory of this process."""
    run = Run.create(folder, config, catalog)
    graphs = [run.graph(tile) for tile in run.catalog.tiles]
    print(f"\nmemory of one process over {many} tiles (resident, MB)")
    interval = max(1, many // 10)
    for done in range(many):
        if done % interval == 0:
            print(f"  {done:6} {resident_mb():8.0f}")
        process_tile(run.job(graphs[done % len(graphs)], frozenset(STAGE_NAMES)))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"  {many:6} {resident_mb():8.0f}   peak {peak:.0f} MB; the limit is 700 MB: {peak / 700:.2f} of it"
    )


def resident_mb() -> float:
    import psutil

    return float(psutil.Process().memory_info().rss / 2**20)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else MANY)
