"""Thousands of tiles: overhead of a run, its memory, and the time to resume it.

The tiles are tiny, so that the overhead dominates; all are parts of two large rasters and a mask. Two runs:

- one whose tiles only sleep as long as a real tile takes, for the overhead of client and scheduler: wall time
  x workers compared with the sum of the sleeps;
- one that computes its tiles, for the memory of client and workers over time.

Usage: ``python tests/bench/bench_scale.py [TILES] [PLOT.png]``
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rasterio
from numpy.typing import NDArray

from flexroad.catalog import Catalog, Grid
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import DaskExecutor
from flexroad.pipeline.execute.executor import Probe
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.database import NAME as DATABASE
from flexroad.pipeline.worker.tile import TileJob, TileResult
from flexroad.tasks.synthetic import SceneOptions, make_scene
from tests.made_result import done

TILES = 1000
"""Default number of tiles; docs/archive/speed.md uses 10,000."""
TILE_M = 20
PATCH_M = 400
"""Size of the synthetic scene of which the rasters are repeated copies."""
SLEEP_S = 0.3
"""Time of a tile with configs/production.yaml."""
SLEEPERS = 4
ASLEEP = 2000
"""Tiles of the sleeping run: enough for a mean."""
WORKERS = 2
STATE = 550_000
"""Tiles of 250 m of one German state (34,100 km2)."""
CONFIG = {
    "fit": {"control_points": [12, 12], "iterations": 30},
    "export": {"variants": ["flexroad"], "formats": ["glb", "npz"]},
    "variants": {"flexroad": {}},
}


def main(tiles: int = TILES, plot: Path | None = None) -> None:
    with tempfile.TemporaryDirectory(prefix="scale-") as scratch:
        folder = Path(scratch)
        side = math.isqrt(tiles)
        survey(folder, side)
        index, seconds = timed(lambda: rasters.index(folder, LAYERS, tile_size_m=TILE_M))
        Catalog(index.tiles).write(folder / "catalog.parquet")
        report("make the catalog", seconds, side**2)
        catalog, seconds = timed(lambda: Catalog.read(folder / "catalog.parquet"))
        report("read the catalog", seconds, side**2)
        size = result_bytes(lambda: Catalog.read(folder / "catalog.parquet")) / side**2
        print(f"  in memory {size / 2**10:.1f} KB a tile, {size * STATE / 2**30:.1f} GB for {STATE:,}")
        config = compose(CONFIG, "scale")
        run, seconds = timed(lambda: Run.create(folder / "RUN", config, catalog))
        report("create the run", seconds, side**2)
        _, seconds = timed(lambda: [run.graph(tile) for tile in catalog.tiles])
        report("build the graphs", seconds, side**2)
        overhead(Run.create(folder / "ASLEEP", config, catalog))
        memory = run_and_measure(run)
        resume(folder, side**2)
        size = (run.path / DATABASE).stat().st_size
        print(f"database {size / 2**20:.1f} MB; for a state {size / side**2 * STATE / 2**30:.1f} GB")
        if plot:
            draw(memory, plot)


LAYERS = {"dsm": "dsm.tif", "dtm": "dtm.tif", "road_mask": "road.tif"}


def survey(folder: Path, side: int) -> None:
    """Write three rasters of ``side`` x ``side`` tiles: repeated copies of one synthetic scene."""
    grid = Grid("EPSG:25832", 300_000, 5_700_000, 1.0, PATCH_M, PATCH_M)
    # Dense streets, so that every tile has one.
    scene = make_scene(grid, 7, options=SceneOptions(block_m=20))
    cells = side * TILE_M
    write(folder / "dsm.tif", scene.dsm, cells)
    write(folder / "dtm.tif", scene.dtm, cells)
    write(folder / "road.tif", scene.reference_road.astype(np.uint8), cells)


def write(
    path: Path,
    patch: NDArray[Any],
    cells: int,
    corner: tuple[float, float] = (300_000, 5_700_000),
    cell_m: float = 1,
) -> None:
    """Write a raster of repeated copies of a patch; ``corner`` is its north-west."""
    repeat = math.ceil(cells / PATCH_M)
    data = np.tile(patch, (repeat, repeat))[:cells, :cells]
    data = data.astype(np.float32) if data.dtype == np.float64 else data
    layout = {"driver": "GTiff", "tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate"}
    place = {"crs": "EPSG:25832", "transform": rasterio.transform.from_origin(*corner, cell_m, cell_m)}
    with rasterio.open(
        path, "w", height=cells, width=cells, count=1, dtype=data.dtype, **layout, **place
    ) as raster:
        raster.write(data, 1)


# --- overhead -----------------------------------------------------------------------------------------


def sleep_tile(job: TileJob) -> TileResult:
    """Take as long as a real tile, and return as much data."""
    time.sleep(SLEEP_S)
    return done(job)


@dataclass
class Asleep:
    """A Dask executor whose workers sleep; records the time of every result."""

    workers: int
    times: list[float] = field(default_factory=list)
    client_cpu: list[float] = field(default_factory=list)
    """CPU time of client and scheduler (s) at these times."""
    worker_cpu: dict[int, float] = field(default_factory=dict)
    """CPU time of all workers (s), by number of results."""

    def map(
        self,
        function: Callable[..., Any],
        jobs: Iterable[Any],
        lost: Callable[..., Any],
        probe: Probe | None = None,
    ) -> Iterator[Any]:
        for result in DaskExecutor(self.workers).map(sleep_tile, jobs, lost, probe):
            self.times.append(time.perf_counter())
            self.client_cpu.append(time.process_time())
            if len(self.times) % 50 == self.workers:
                # Not for every result, because the measurement takes time.
                self.worker_cpu[len(self.times)] = busy(psutil.Process().children(recursive=True))
            yield result


def busy(processes: list[psutil.Process]) -> float:
    times = [process.cpu_times() for process in processes]
    return float(sum(time.user + time.system for time in times))


def overhead(run: Run) -> None:
    asleep = Asleep(SLEEPERS)
    selected = {tile.id for tile in run.catalog.tiles[:ASLEEP]}
    run_tiles(run, asleep, only=lambda tile: tile.id in selected)
    # Each worker's first tile is left out: only its end is recorded.
    first, tiles = SLEEPERS - 1, len(asleep.times) - SLEEPERS
    wall, slept = asleep.times[-1] - asleep.times[first], SLEEP_S * tiles
    client = (asleep.client_cpu[-1] - asleep.client_cpu[first]) / tiles
    results = max(asleep.worker_cpu) - SLEEPERS
    worker = (max(asleep.worker_cpu.values()) - asleep.worker_cpu[SLEEPERS]) / results
    print(
        f"asleep: {tiles} tiles of {SLEEP_S} s on {SLEEPERS} workers: {wall:.1f} s x {SLEEPERS} against "
        f"{slept:.1f} s: overhead {wall * SLEEPERS / slept - 1:.1%}\n"
        f"  CPU: a worker {1000 * worker:.1f} ms a tile, {worker / SLEEP_S:.1%}; client and scheduler "
        f"{1000 * client:.1f} ms a tile, enough for {SLEEP_S / client:.0f} workers",
        flush=True,
    )


# --- memory -------------------------------------------------------------------------------------------


@dataclass
class Memory:
    """Memory of client and workers (MB), measured at intervals."""

    seconds: list[float] = field(default_factory=list)
    tiles: list[int] = field(default_factory=list)
    client: list[float] = field(default_factory=list)
    worker: list[float] = field(default_factory=list)
    """Memory of the largest worker."""
    done: int = 0

    def measure(self, stop: threading.Event, interval_s: float) -> None:
        process, start = psutil.Process(), time.perf_counter()
        while not stop.wait(interval_s):
            workers = [resident_mb(child) for child in process.children(recursive=True)]
            self.seconds.append(time.perf_counter() - start)
            self.tiles.append(self.done)
            self.client.append(resident_mb(process))
            self.worker.append(max(workers, default=0.0))

    def count(self, result: TileResult) -> None:
        self.done += 1


def resident_mb(process: psutil.Process) -> float:
    try:
        return float(process.memory_info().rss / 2**20)
    except psutil.NoSuchProcess:
        return 0.0


def run_and_measure(run: Run) -> Memory:
    memory, stop = Memory(), threading.Event()
    thread = threading.Thread(target=memory.measure, args=(stop, 1.0))
    thread.start()
    try:
        summary, seconds = timed(lambda: run_tiles(run, DaskExecutor(WORKERS), watch=memory.count))
    finally:
        stop.set()
        thread.join()
    report(f"do {summary.done} tiles ({summary.failed} failed) on {WORKERS} workers", seconds, summary.tiles)
    # After a tenth of the tiles all code is loaded and compiled.
    for name, values in (("client", memory.client), ("largest worker", memory.worker)):
        tenth = next(i for i, n in enumerate(memory.tiles) if n >= summary.tiles // 10)
        print(f"  {name:15}{values[tenth]:6.0f} MB after a tenth, {values[-2]:6.0f} MB at the end")
    return memory


def draw(memory: Memory, path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 3.2), layout="constrained")
    axes.plot(memory.tiles, memory.client, label="client and scheduler")
    axes.plot(memory.tiles, memory.worker, label=f"largest of {WORKERS} workers")
    axes.set(xlabel="tiles done", ylabel="resident memory (MB)", ylim=(0, None))
    axes.set_title(f"{max(memory.tiles):,} tiles of {TILE_M} m in {memory.seconds[-1]:.0f} s", fontsize=10)
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)


# --- resume ---------------------------------------------------------------------------------------


def resume(folder: Path, tiles: int) -> None:
    """Time whole commands, with the start of Python, on a finished run."""
    (folder / "scale.yaml").write_text(str(CONFIG).replace("'", '"'))
    again = ["run", "--config", "scale.yaml", "--catalog", "catalog.parquet", "--out", "RUN"]
    commands = (again, ["status", "RUN"], ["report", "RUN"])
    for words in commands:
        _, seconds = timed(lambda words=words: flexroad(folder, words))
        report(f"flexroad {words[0]}", seconds, tiles)
    (folder / "RUN" / DATABASE).unlink()
    _, seconds = timed(lambda: flexroad(folder, again))
    report("flexroad run, database deleted", seconds, tiles)


def flexroad(folder: Path, words: list[str]) -> None:
    code = "from flexroad.pipeline.cli.main import main; main()"
    root = Path(__file__).parents[2]
    subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(root)!r}); {code}", *words],
        cwd=folder,
        check=True,
        capture_output=True,
    )


def result_bytes(function: Callable[[], Any]) -> int:
    """Return the memory of a function's result (bytes)."""
    tracemalloc.start()
    result = function()
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    del result
    return size


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """Return a function's result and its time (s)."""
    start = time.perf_counter()
    result = function()
    return result, time.perf_counter() - start


def report(label: str, seconds: float, tiles: int) -> None:
    per_tile = seconds / tiles
    state_min = per_tile * STATE / 60
    print(
        f"{label:45}{seconds:8.2f} s{1000 * per_tile:9.3f} ms a tile{state_min:9.1f} min for {STATE:,}",
        flush=True,
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else TILES, Path(sys.argv[2]) if len(sys.argv) > 2 else None)
