"""Memory of one process over 2,000 tiles, all stages of each: it reaches its height early and stays there.

Usage: ``python tests/bench/bench_memory.py [TILES]``
"""

from __future__ import annotations

import resource
import sys
import tempfile
from pathlib import Path

from flexroad.catalog import Catalog
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.graph.stages import STAGE_NAMES
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.worker.tile import process_tile
from tests.bench.measure_stages import one_variant
from tests.bench.timing import resident_mb

TILES = 8
"""Different tiles, which are repeated."""
MANY = 2000
LIMIT_MB = 700


def main(many: int = MANY) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        catalog = Catalog.read(write_scenes(Path(scratch) / "survey", TILES, seed=11))
        run = Run.create(Path(scratch) / "run", one_variant("paper"), catalog)
        graphs = [run.graph(tile) for tile in run.catalog.tiles]
        print(f"memory of one process over {many} tiles (resident, MB)")
        interval = max(1, many // 10)
        for done in range(many):
            if done % interval == 0:
                print(f"  {done:6} {resident_mb():8.0f}", flush=True)
            process_tile(run.job(graphs[done % len(graphs)], frozenset(STAGE_NAMES)))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"  {many:6} {resident_mb():8.0f}   peak {peak:.0f} MB: {peak / LIMIT_MB:.2f} of the limit")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else MANY)
