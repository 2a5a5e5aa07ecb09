"""Tiles that return at once: CPU time of client, scheduler and workers per tile, and the client's memory.

The tiles are tiny parts of two large rasters and a mask. Usage:
``python bench/bench_simulated.py [TILES]``; 100,000 tiles take an hour.
"""

from __future__ import annotations

import argparse
import gc
import math
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from bench.timing import resident_mb
from flexroad.catalog import Catalog, Grid
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import DaskExecutor
from flexroad.pipeline.execute.executor import Probe
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tools.synthetic import SceneOptions, make_scene
from tests.made_result import done
from tests.make_rasters import write

TILES = 2000
"""Default number of tiles."""
TILE_M = 20
PATCH_M = 400
"""Size of the synthetic scene of which the rasters are repeated copies."""
WORKERS = 2
STARTED = 0.3
"""Share of the tiles after which CPU time is measured, because code is then loaded."""
LAYERS = {"dsm": "dsm.tif", "dtm": "dtm.tif", "road_mask": "road.tif"}
CONFIG = {
    "fit": {"control_points": [12, 12], "iterations": 30},
    "export": {"variants": ["flexroad"], "formats": ["glb", "npz"]},
    "variants": {"flexroad": {}},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tiles", type=int, nargs="?", default=TILES)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="simulated-") as scratch:
        simulated(Path(scratch), options.tiles)


def survey(folder: Path, side: int) -> None:
    """Write three rasters of ``side`` x ``side`` tiles: repeated copies of one synthetic scene."""
    grid = Grid("EPSG:25832", 300_000, 5_700_000, 1.0, PATCH_M, PATCH_M)
    # Dense streets, so that every tile has one.
    scene = make_scene(grid, 7, options=SceneOptions(block_m=20))
    cells = side * TILE_M
    repeat = math.ceil(cells / PATCH_M)
    layout = {"tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate"}
    for name, patch in (
        ("dsm", scene.dsm.astype(np.float32)),
        ("dtm", scene.dtm.astype(np.float32)),
        ("road", scene.reference_road.astype(np.uint8)),
    ):
        write(folder / f"{name}.tif", np.tile(patch, (repeat, repeat))[:cells, :cells], **layout)


def busy(processes: list[psutil.Process]) -> float:
    times = [process.cpu_times() for process in processes]
    return float(sum(time.user + time.system for time in times))


@dataclass
class Simulated:
    """A Dask executor whose workers return at once; records CPU time and memory at ten times."""

    total: int
    samples: list[dict[str, float]] = field(default_factory=list)

    def map(
        self,
        function: Callable[..., Any],
        jobs: Iterable[Any],
        lost: Callable[..., Any],
        probe: Probe | None = None,
    ) -> Iterator[Any]:
        for number, result in enumerate(DaskExecutor(WORKERS).map(done, jobs, lost, probe), 1):
            yield result
            if number % max(1, self.total // 10) == 0:
                self.sample(number)

    def sample(self, number: int) -> None:
        gc.collect()
        children = psutil.Process().children(recursive=True)
        self.samples.append(
            {
                "tiles": number,
                "client_s": time.process_time(),
                "worker_s": busy(children),
                "wall_s": time.perf_counter(),
                "client_mb": resident_mb(),
                "worker_mb": max(map(resident_mb, children), default=0.0),
            }
        )


def simulated(folder: Path, tiles: int) -> dict[str, Any]:
    """Run simulated tiles on two workers; print and return the figures per tile."""
    side = math.isqrt(tiles)
    survey(folder, side)
    Catalog(rasters.index(folder, LAYERS, tile_size_m=TILE_M).tiles).write(folder / "catalog.parquet")
    catalog = Catalog.read(folder / "catalog.parquet")
    executor = Simulated(len(catalog.tiles))
    run_tiles(Run.create(folder / "RUN", compose(CONFIG, "simulated"), catalog), executor)
    at_start = next(s for s in executor.samples if s["tiles"] >= STARTED * len(catalog.tiles))
    end = executor.samples[-1]
    number = end["tiles"] - at_start["tiles"]
    per_tile = {name: (end[name] - at_start[name]) / number for name in end if name != "tiles"}
    print(
        f"{len(catalog.tiles):,} tiles that return at once, {WORKERS} workers: "
        f"client and scheduler {1000 * per_tile['client_s']:.2f} ms of CPU a tile, "
        f"a tile costs a worker {1000 * per_tile['worker_s']:.2f} ms; wall {1000 * per_tile['wall_s']:.1f} ms"
    )
    for sample in executor.samples:
        print(
            f"  {sample['tiles']:9,.0f} tiles: client {sample['client_mb']:6.0f} MB, "
            f"largest worker {sample['worker_mb']:6.0f} MB"
        )
    # The growth is measured from the middle on, because Dask fills logs before; the end of the run is left
    # out.
    middle, late = executor.samples[len(executor.samples) // 2], executor.samples[-2]
    grown = (late["client_mb"] - middle["client_mb"]) * 2**20 / (late["tiles"] - middle["tiles"])
    print(f"  growth of the client in the second half: {grown:.0f} bytes a tile", flush=True)
    return {"tiles": len(catalog.tiles), "per_tile": per_tile, "samples": executor.samples}


if __name__ == "__main__":
    main()
