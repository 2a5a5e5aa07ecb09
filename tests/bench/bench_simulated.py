"""Tiles that return at once: what client, scheduler and workers cost per tile, and the client's memory.

Then strong and weak scaling of production's tiles on one and two workers. CPU time can be trusted on a busy
machine; wall times, and so the efficiencies, need as many quiet cores as workers and one for the client.

Usage: ``python tests/bench/bench_simulated.py [TILES] [SCALED] [--json FILE]``; 100,000 tiles take an hour.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psutil

from flexroad.catalog import Catalog
from flexroad.catalog.sources import rasters
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import DaskExecutor
from flexroad.pipeline.execute.executor import Probe
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from tests.bench.bench_scale import CONFIG, LAYERS, TILE_M, busy, survey
from tests.bench.measure_stages import one_variant
from tests.bench.timing import resident_mb
from tests.made_result import done

TILES, SCALED = 2000, 8
"""Default numbers of simulated tiles, and of computed tiles on one worker."""
WORKERS = 2
STARTED = 0.3
"""Share of the tiles after which CPU time counts: code is loaded."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tiles", type=int, nargs="?", default=TILES)
    parser.add_argument("scaled", type=int, nargs="?", default=SCALED)
    parser.add_argument("--json", type=Path, help="write the figures to this file, too")
    options = parser.parse_args()
    print(
        f"load of the machine {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; wall times want quiet ones"
    )
    with tempfile.TemporaryDirectory(prefix="simulated-") as scratch:
        figures = simulated(Path(scratch), options.tiles)
        if options.scaled:
            figures["scaling"] = scaling(Path(scratch), options.scaled)
    if options.json:
        options.json.write_text(json.dumps(figures))


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
    # From the middle on, because Dask fills logs of recent messages before; without the end of the run.
    middle, late = executor.samples[len(executor.samples) // 2], executor.samples[-2]
    grown = (late["client_mb"] - middle["client_mb"]) * 2**20 / (late["tiles"] - middle["tiles"])
    print(f"  growth of the client in the second half: {grown:.0f} bytes a tile", flush=True)
    return {"tiles": len(catalog.tiles), "per_tile": per_tile, "samples": executor.samples}


def scaling(folder: Path, tiles: int) -> list[dict[str, float]]:
    """Run production's tiles: as many on two workers as on one (strong), and twice as many (weak)."""
    catalog = Catalog.read(write_scenes(folder / "scenes", 2 * tiles, seed=11))
    # Code is compiled, or compiled code read, before anything is timed.
    computed(folder / "warm", Catalog(catalog.tiles[:2]), 2)
    cases = {"one worker": (1, tiles), "strong": (2, tiles), "weak": (2, 2 * tiles)}
    rows = []
    for name, (workers, number) in cases.items():
        wall, cpu = computed(folder / name, Catalog(catalog.tiles[:number]), workers)
        rows.append({"workers": workers, "tiles": number, "wall_s": wall, "cpu_s": cpu})
        ideal = rows[0]["wall_s"] * number / tiles / workers
        print(
            f"  {name:11}{workers} workers, {number:3} tiles: {wall:6.1f} s on the wall, efficiency "
            f"{ideal / wall:5.0%}; {1000 * cpu / number:6.0f} ms of CPU a tile with the start",
            flush=True,
        )
    return rows


def computed(folder: Path, catalog: Catalog, workers: int) -> tuple[float, float]:
    """Compute tiles in a new run; return wall time and CPU time of all processes, with their start (s)."""
    run = Run.create(folder, one_variant("production"), catalog)
    start, before = time.perf_counter(), total_cpu()
    run_tiles(run, DaskExecutor(workers))
    return time.perf_counter() - start, total_cpu() - before


def total_cpu() -> float:
    """Return the CPU time of this process and of its ended children (s)."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


if __name__ == "__main__":
    main()
