"""Thousands of tiles: what a run costs beside its tiles, what it holds in memory, and how soon it is resumed.

The tiles are tiny, so that the machinery shows; two large rasters and a mask hold them all. Two runs:

- one whose tiles only sleep as long as real ones take, on many workers, for the overhead of client and
  scheduler: wall time x workers against the sum of the sleeps;
- one whose tiles are really done, for the memory of client and workers over time.

``python tests/bench/bench_scale.py [TILES] [PLOT.png]``
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
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.database import NAME as DATABASE
from flexroad.pipeline.worker.tile import TileJob, TileResult, failed_row
from flexroad.tasks.synthetic import SceneOptions, make_scene

TILES = 1000
"""10,000 for docs/operations.md."""
TILE_M = 20
PATCH_M = 400
"""Size of the one made scene that is laid out over and over."""
SLEEP_S = 0.3
"""What a tile of configs/nightly.yaml takes."""
SLEEPERS = 4
ASLEEP = 2000
"""Tiles slept through: enough for a mean."""
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
        found, took = timed(lambda: rasters.index(folder, LAYERS, tile_size_m=TILE_M))
        Catalog(found.tiles).write(folder / "catalog.parquet")
        say("cut the catalog", took, side**2)
        catalog, took = timed(lambda: Catalog.read(folder / "catalog.parquet"))
        say("read the catalog", took, side**2)
        held = kept(lambda: Catalog.read(folder / "catalog.parquet")) / side**2
        print(f"  in memory {held / 2**10:.1f} KB a tile, {held * STATE / 2**30:.1f} GB for {STATE:,}")
        config = compose(CONFIG, "scale")
        run, took = timed(lambda: Run.create(folder / "RUN", config, catalog))
        say("make the run", took, side**2)
        _, took = timed(lambda: [run.graph(tile) for tile in catalog.tiles])
        say("build the graphs", took, side**2)
        overhead(Run.create(folder / "ASLEEP", config, catalog))
        memory = watched(run)
        resumed(folder, side**2)
        size = (run.path / DATABASE).stat().st_size
        print(f"database {size / 2**20:.1f} MB; of a state {size / side**2 * STATE / 2**30:.1f} GB")
        if plot:
            draw(memory, plot)


LAYERS = {"dsm": "dsm.tif", "dtm": "dtm.tif", "road_mask": "road.tif"}


def survey(folder: Path, side: int) -> None:
    """Write three rasters of ``side`` x ``side`` tiles: one made scene, laid out over and over."""
    grid = Grid("EPSG:25832", 300_000, 5_700_000, 1.0, PATCH_M, PATCH_M)
    # So many streets that every tile has one.
    scene = make_scene(grid, 7, options=SceneOptions(block_m=20))
    cells = side * TILE_M
    write(folder / "dsm.tif", scene.dsm, cells)
    write(folder / "dtm.tif", scene.dtm, cells)
    write(folder / "road.tif", scene.reference_road.astype(np.uint8), cells)


def write(path: Path, patch: NDArray[Any], cells: int) -> None:
    repeat = math.ceil(cells / PATCH_M)
    data = np.tile(patch, (repeat, repeat))[:cells, :cells]
    data = data.astype(np.float32) if data.dtype == np.float64 else data
    kind = {"driver": "GTiff", "tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate"}
    where = {"crs": "EPSG:25832", "transform": rasterio.transform.from_origin(300_000, 5_700_000, 1, 1)}
    with rasterio.open(
        path, "w", height=cells, width=cells, count=1, dtype=data.dtype, **kind, **where
    ) as raster:
        raster.write(data, 1)


# --- overhead -----------------------------------------------------------------------------------------


def sleep_tile(job: TileJob) -> TileResult:
    """Take as long as a real tile, and send back as much."""
    from flexroad.pipeline.store.records import TileRecord

    time.sleep(SLEEP_S)
    rows = tuple(failed_row(job.graph, v, "") | {"status": "done"} for v in job.graph.variants)
    return TileResult(
        TileRecord(job.graph.tile.id, "done", job.graph.fingerprint, rows, sources=job.graph.sources), "done"
    )


@dataclass
class Asleep:
    """Dask with workers that sleep; notes when the first and the last result came."""

    workers: int
    times: list[float] = field(default_factory=list)
    here: list[float] = field(default_factory=list)
    """CPU time of client and scheduler (s) at the same moments."""
    there: dict[int, float] = field(default_factory=dict)
    """And of all workers, by number of results."""

    def map(
        self,
        function: Callable[..., Any],
        jobs: Iterable[Any],
        lost: Callable[..., Any],
        probe: Callable[[], None] | None = None,
    ) -> Iterator[Any]:
        for result in DaskExecutor(self.workers).map(sleep_tile, jobs, lost, probe):
            self.times.append(time.perf_counter())
            self.here.append(time.process_time())
            if len(self.times) % 50 == self.workers:
                # Now and then: asking costs time, too.
                self.there[len(self.times)] = busy(psutil.Process().children(recursive=True))
            yield result


def busy(processes: list[psutil.Process]) -> float:
    times = [process.cpu_times() for process in processes]
    return float(sum(time.user + time.system for time in times))


def overhead(run: Run) -> None:
    asleep = Asleep(SLEEPERS)
    some = {tile.id for tile in run.catalog.tiles[:ASLEEP]}
    run_tiles(run, asleep, only=lambda tile: tile.id in some)
    # Of each worker's first tile one sees the end only.
    first, tiles = SLEEPERS - 1, len(asleep.times) - SLEEPERS
    wall, slept = asleep.times[-1] - asleep.times[first], SLEEP_S * tiles
    here = (asleep.here[-1] - asleep.here[first]) / tiles
    there = (max(asleep.there.values()) - asleep.there[SLEEPERS]) / (max(asleep.there) - SLEEPERS)
    print(
        f"asleep: {tiles} tiles of {SLEEP_S} s on {SLEEPERS} workers: {wall:.1f} s x {SLEEPERS} against "
        f"{slept:.1f} s: overhead {wall * SLEEPERS / slept - 1:.1%}\n"
        f"  CPU: a worker {1000 * there:.1f} ms a tile, {there / SLEEP_S:.1%}; client and scheduler "
        f"{1000 * here:.1f} ms a tile, enough for {SLEEP_S / here:.0f} workers",
        flush=True,
    )


# --- memory -------------------------------------------------------------------------------------------


@dataclass
class Memory:
    """What client and workers hold (MB), every few seconds."""

    seconds: list[float] = field(default_factory=list)
    tiles: list[int] = field(default_factory=list)
    client: list[float] = field(default_factory=list)
    worker: list[float] = field(default_factory=list)
    """The largest of them."""
    done: int = 0

    def keep_looking(self, over: threading.Event, every_s: float) -> None:
        me, start = psutil.Process(), time.perf_counter()
        while not over.wait(every_s):
            held = [resident_mb(child) for child in me.children(recursive=True)]
            self.seconds.append(time.perf_counter() - start)
            self.tiles.append(self.done)
            self.client.append(resident_mb(me))
            self.worker.append(max(held, default=0.0))

    def note(self, result: TileResult) -> None:
        self.done += 1


def resident_mb(process: psutil.Process) -> float:
    try:
        return float(process.memory_info().rss / 2**20)
    except psutil.NoSuchProcess:
        return 0.0


def watched(run: Run) -> Memory:
    memory, over = Memory(), threading.Event()
    looking = threading.Thread(target=memory.keep_looking, args=(over, 1.0))
    looking.start()
    try:
        how, took = timed(lambda: run_tiles(run, DaskExecutor(WORKERS), watch=memory.note))
    finally:
        over.set()
        looking.join()
    say(f"do {how.done} tiles ({how.failed} failed) on {WORKERS} workers", took, how.tiles)
    # From a tenth on everything is loaded and compiled.
    for name, held in (("client", memory.client), ("largest worker", memory.worker)):
        tenth = next(i for i, n in enumerate(memory.tiles) if n >= how.tiles // 10)
        print(f"  {name:15}{held[tenth]:6.0f} MB after a tenth, {held[-2]:6.0f} MB at the end")
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


# --- afterwards ---------------------------------------------------------------------------------------


def resumed(folder: Path, tiles: int) -> None:
    """Time whole commands, Python's start included, over tiles that are all done."""
    (folder / "scale.yaml").write_text(str(CONFIG).replace("'", '"'))
    again = ["run", "--config", "scale.yaml", "--catalog", "catalog.parquet", "--out", "RUN"]
    commands = (again, ["status", "RUN"], ["report", "RUN"])
    for words in commands:
        _, took = timed(lambda words=words: flexroad(folder, words))
        say(f"flexroad {words[0]}", took, tiles)
    (folder / "RUN" / DATABASE).unlink()
    _, took = timed(lambda: flexroad(folder, again))
    say("flexroad run, database lost", took, tiles)


def flexroad(folder: Path, words: list[str]) -> None:
    code = "from flexroad.pipeline.cli.main import main; main()"
    root = Path(__file__).parents[2]
    subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(root)!r}); {code}", *words],
        cwd=folder,
        check=True,
        capture_output=True,
    )


def kept(act: Callable[[], Any]) -> int:
    """Return how many bytes a result holds."""
    tracemalloc.start()
    found = act()
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    del found
    return size


def timed(act: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    found = act()
    return found, time.perf_counter() - start


def say(what: str, seconds: float, tiles: int) -> None:
    each = seconds / tiles
    print(
        f"{what:45}{seconds:8.2f} s{1000 * each:9.3f} ms a tile{each * STATE / 60:9.1f} min for {STATE:,}",
        flush=True,
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else TILES, Path(sys.argv[2]) if len(sys.argv) > 2 else None)
