"""What commands cost that look at every tile of a finished survey: planning, checks and reports.

The tiles are those of `production`, with borders, 250 m wide, on rasters in sheets of 1 km. Only the first
one is computed; the others get its stored surface and mask and a marker without products: they count as done.
CPU time of a command, with its start, can be compared on a busy machine, wall time on a quiet one only.

Usage: ``python tests/bench/bench_planning.py [TILES]``
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flexroad.catalog import Catalog, Grid
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.checked_json import loads
from flexroad.pipeline.store.database import NAME as DATABASE
from flexroad.pipeline.store.records import DONE, from_item
from flexroad.pipeline.worker.tile import TileJob, TileResult, marker_stat
from flexroad.tasks.synthetic import SceneOptions, make_scene
from tests.bench.bench_scale import write

TILES = 2500
CELL_M, SHEET_M = 5, 1000
CONFIG = "extends: production\nfit: {spacing_m: 15}\n"
LAYERS = ("dsm", "dtm", "road_mask", "dop")


def main(tiles: int = TILES) -> None:
    with tempfile.TemporaryDirectory(prefix="planning-") as scratch:
        folder = Path(scratch)
        survey(folder, math.isqrt(tiles))
        catalog = Catalog.read(folder / "catalog.parquet")
        (folder / "config.yaml").write_text(CONFIG)
        run = Run.create(folder / "RUN", load_config(folder / "config.yaml"), catalog)
        first = catalog.tiles[0].id
        run_tiles(run, SerialExecutor(), only=lambda tile: tile.id == first)
        start = time.process_time()
        for tile in catalog.tiles:
            run.graph(tile)
        graph_ms = 1000 * (time.process_time() - start) / len(catalog.tiles)
        print(f"{len(catalog.tiles):,} tiles: a graph takes {graph_ms:.2f} ms of CPU", flush=True)
        run_tiles(run, Copied(run, first))
        arguments = ["--config", "config.yaml", "--catalog", "catalog.parquet", "--out"]
        command(folder, "run, nothing to do", ["run", *arguments, "RUN"])
        command(folder, "run --dry-run, nothing to do", ["run", *arguments, "RUN", "--dry-run"])
        command(folder, "run --dry-run of a new run", ["run", *arguments, "NEW", "--dry-run"])
        command(folder, "catalog check", ["catalog", "check", "catalog.parquet"])
        command(folder, "status", ["status", "RUN"])
        command(folder, "report --format md", ["report", "RUN", "--format", "md"])
        command(folder, "report --format html", ["report", "RUN", "--format", "html"])
        (run.path / DATABASE).unlink()
        command(folder, "run, nothing to do, database deleted", ["run", *arguments, "RUN"])


def survey(folder: Path, side: int) -> None:
    """Write sheets of rasters, all with the same scene, of ``side`` x ``side`` tiles, and their catalog."""
    cells = SHEET_M // CELL_M
    scene = make_scene(Grid("EPSG:25832", 0, 0, CELL_M, cells, cells), 7, options=SceneOptions(block_m=150))
    road = scene.reference_road.astype(np.uint8)
    data = {"dsm": scene.dsm, "dtm": scene.dtm, "road_mask": road, "dop": 100 * road}
    for layer in LAYERS:
        (folder / layer).mkdir()
        for number in range(math.ceil(side / 4) ** 2):
            row, column = divmod(number, math.ceil(side / 4))
            corner = 300_000 + SHEET_M * column, 5_700_000 + SHEET_M * row
            write(folder / layer / f"{corner[0]}_{corner[1]}.tif", data[layer], cells, corner, CELL_M)
    index = rasters.index(folder, {layer: f"{layer}/*.tif" for layer in LAYERS})
    Catalog(index.tiles).write(folder / "catalog.parquet")


class Copied:
    """An executor that gives each tile the results of one that was computed, at once."""

    def __init__(self, run: Run, tile_id: str) -> None:
        graph = run.graph(next(tile for tile in run.catalog.tiles if tile.id == tile_id))
        self.store = run.store
        self.nodes = [node for node in graph.nodes.values() if node.stage in ("fit", "segment")]
        self.item = loads((run.folder(tile_id).path / DONE).read_bytes())

    def map(
        self,
        function: Callable[..., Any],
        jobs: Iterable[TileJob],
        lost: Callable[..., Any],
        probe: Callable[[], None] | None = None,
    ) -> Iterator[TileResult]:
        for job in jobs:
            graph = job.graph
            for old in self.nodes:
                new = graph.nodes[graph.variants["flexroad"][old.stage]].fingerprint
                path = self.store / old.stage / new[:2] / f"{new}.npz"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.hardlink_to(self.store / old.stage / old.fingerprint[:2] / f"{old.fingerprint}.npz")
            name = graph.tile.id
            item, rows = self.item | {"id": name, "assets": {}}, self.item["properties"]["flexroad:rows"]
            item["properties"] = self.item["properties"] | {
                "flexroad:fingerprint": graph.fingerprint,
                "flexroad:rows": [row | {"tile_id": name} for row in rows],
                "flexroad:nodes": graph.variants,
                "flexroad:sources": graph.sources,
            }
            job.folder.finish(item, {})
            yield TileResult(from_item(item, marker_stat(job.folder, "done")), "done")


def command(folder: Path, label: str, words: list[str]) -> None:
    """Run a command in its own process; print its CPU and wall time."""
    code = "from flexroad.pipeline.cli.main import main; main()"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-c", code, *words],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(process.pid, 0)
    # `catalog check` finds that the photo is none.
    if os.waitstatus_to_exitcode(status) not in (0, 1):
        raise SystemExit(f"{label}: the command failed")
    wall, cpu = time.perf_counter() - start, used.ru_utime + used.ru_stime
    print(f"{label:40}{cpu:8.1f} s of CPU{wall:8.1f} s", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else TILES)
