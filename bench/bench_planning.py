"""CPU time and memory of commands that look at every tile of a finished survey.

The tiles are computed with `production`, with borders. They are 250 m wide with cells of 5 m, on four layers
of rasters in sheets of 1 km. Only the first tile is computed. The other tiles get its stored results, moved
to their places, and its row. Their markers have no products: writing and reading of meshes is not measured.

Usage: ``python bench/bench_planning.py [TILES] [--only COMMAND ...]``
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import math
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray

from flexroad.catalog import Catalog, Grid
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.execute.executor import Probe
from flexroad.pipeline.graph.graph import Node
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.artefacts import HEADER
from flexroad.pipeline.store.database import NAME as DATABASE
from flexroad.pipeline.store.records import DONE, from_item, load_checked
from flexroad.pipeline.worker.tile import TileJob, TileResult, marker_stat
from flexroad.tasks.io.archive import npz
from flexroad.tools.synthetic import SceneOptions, make_scene

TILES = 1000
CELL_M, TILE_M, SHEET_M = 5, 250, 1000
CORNER = 300_000, 5_700_000
"""South-west corner of the survey."""
CONFIG = "extends: production\nfit: {spacing_m: 15}\n"
LAYERS = ("dsm", "dtm", "road_mask", "dop")
STORED = ("segment", "ecsrc", "fit", "evaluate", "assess")
"""Stages whose results each tile has in the store; meshes of the few tiles with pictures are made again."""
POINTS = 1000
"""Number of points of the query, all over the survey."""
WRITTEN = ["--config", "config.yaml", "--catalog", "catalog.parquet", "--out"]
PATTERNS = [word for layer in LAYERS for word in (f"--{layer.replace('_', '-')}", f"{layer}/*.tif")]
COMMANDS: dict[str, tuple[list[str], ...]] = {
    "rasters": (["catalog", "rasters", ".", *PATTERNS, "--output", "again.parquet"],),
    "run": (["run", *WRITTEN, "RUN"], ["run", *WRITTEN, "RUN", "--dry-run"]),
    "status": (["status", "RUN"],),
    "report": (["report", "RUN", "--format", "md"], ["report", "RUN", "--format", "html"]),
    "query": (["query", "RUN", "--points", "points.csv", "-o", "heights.csv"],),
    "export": (["export", "RUN", "--format", "mosaic", "-o", "exported"],),
    "lost": (["run", *WRITTEN, "RUN"],),
}
"""The commands by name; before ``lost`` the database of the run is deleted."""
LAUNCHER = """
import json, os, sys
child = os.spawnv(os.P_NOWAIT, sys.executable, [sys.executable, *sys.argv[1:]])
_, status, used = os.wait4(child, 0)
print(json.dumps([os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss / 1024]))
"""
"""Measures a command. Its own process is small, since a process has at least the peak of its parent."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tiles", type=int, nargs="?", default=TILES)
    parser.add_argument("--only", nargs="*", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--folder", type=Path, help="survey and run are kept here, and used again")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="planning-") as scratch:
        folder = chosen.folder or Path(scratch)
        if not (folder / "RUN" / "summary.json").exists():
            make(folder, math.isqrt(chosen.tiles))
        for name in chosen.only:
            if name == "lost":
                (folder / "RUN" / DATABASE).unlink()
            for words in COMMANDS[name]:
                measure(folder, words)


def make(folder: Path, side: int) -> None:
    """Make a survey of ``side`` x ``side`` tiles, its catalog, a run of which all are done, and points."""
    folder.mkdir(exist_ok=True)
    survey(folder, side)
    index = rasters.index(folder, {layer: f"{layer}/*.tif" for layer in LAYERS}, tile_size_m=TILE_M)
    Catalog(index.tiles).write(folder / "catalog.parquet")
    (folder / "config.yaml").write_text(CONFIG)
    catalog = Catalog.read(folder / "catalog.parquet")
    run = Run.create(folder / "RUN", load_config(folder / "config.yaml"), catalog)
    first = catalog.tiles[0].id
    run_tiles(run, SerialExecutor(), only=lambda tile: tile.id == first)
    run_tiles(run, Copied(run, first))
    places = np.random.default_rng(0).uniform(0, side * TILE_M, (POINTS, 2)) + CORNER
    np.savetxt(folder / "points.csv", places, "%.3f", ",", header="easting,northing", comments="")
    print(f"{len(catalog.tiles):,} tiles made", flush=True)


def survey(folder: Path, side: int) -> None:
    """Write sheets of rasters over ``side`` x ``side`` tiles, all with the same scene."""
    cells, sheets = SHEET_M // CELL_M, math.ceil(side * TILE_M / SHEET_M)
    scene = make_scene(Grid("EPSG:25832", 0, 0, CELL_M, cells, cells), 7, options=SceneOptions(block_m=150))
    road = scene.reference_road.astype(np.uint8)
    data = {
        "dsm": scene.dsm.astype(np.float32),
        "dtm": scene.dtm.astype(np.float32),
        "road_mask": road,
        "dop": np.repeat(100 * road[None], 3, 0),
    }
    for layer, values in data.items():
        (folder / layer).mkdir()
        for row in range(sheets):
            for column in range(sheets):
                west, south = CORNER[0] + SHEET_M * column, CORNER[1] + SHEET_M * row
                write(folder / layer / f"{west}_{south}.tif", values, west, south + SHEET_M)


def write(path: Path, values: NDArray[Any], west: float, north: float) -> None:
    """Write a sheet of one layer."""
    bands = values.reshape(-1, *values.shape[-2:])
    layout = {"driver": "GTiff", "tiled": True, "blockxsize": 256, "blockysize": 256, "compress": "deflate"}
    place = {"crs": "EPSG:25832", "transform": rasterio.transform.from_origin(west, north, CELL_M, CELL_M)}
    count, height, width = bands.shape
    shape = {"count": count, "height": height, "width": width, "dtype": bands.dtype}
    with rasterio.open(path, "w", **shape, **layout, **place) as raster:
        raster.write(bands)


class Copied:
    """An executor that gives each tile the results of one computed tile, moved to its place.

    Only results that the commands read are stored: no meshes, and no borders. The arrays of a result are
    compressed once, because only the header names the place.
    """

    def __init__(self, run: Run, tile_id: str) -> None:
        graph = run.graph(next(tile for tile in run.catalog.tiles if tile.id == tile_id))
        self.grid, self.store = graph.tile.grid, run.store
        self.item = load_checked((run.folder(tile_id).path / DONE).read_bytes())
        nodes = (graph.nodes[graph.variants["flexroad"][stage]] for stage in STORED)
        self.stored = {node.stage: separated(path(self.store, node).read_bytes()) for node in nodes}

    def map(
        self,
        function: Callable[..., Any],
        jobs: Iterable[TileJob],
        lost: Callable[..., Any],
        probe: Probe | None = None,
    ) -> Iterator[TileResult]:
        for job in jobs:
            graph = job.graph
            east, north = graph.tile.grid.west - self.grid.west, graph.tile.grid.north - self.grid.north
            for stage, (arrays, header) in self.stored.items():
                file = path(self.store, graph.nodes[graph.variants["flexroad"][stage]])
                file.parent.mkdir(parents=True, exist_ok=True)
                file.write_bytes(joined(arrays, moved(header, east, north)))
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


def path(store: Path, node: Node) -> Path:
    """Return the file of a stage's result."""
    return store / node.stage / node.fingerprint[:2] / f"{node.fingerprint}.npz"


def separated(stored: bytes) -> tuple[bytes, Any]:
    """Return the archive of a result's arrays, and its header."""
    with np.load(io.BytesIO(stored)) as archive:
        arrays = dict(archive)
    header = json.loads(arrays.pop(HEADER).tobytes())
    return npz(arrays), header


def joined(arrays: bytes, header: Any) -> bytes:
    """Return a result as the store writes it, from an archive of arrays and a header."""
    buffer = io.BytesIO(arrays)
    archive = zipfile.ZipFile(buffer, "a", zipfile.ZIP_DEFLATED)
    with archive, archive.open(f"{HEADER}.npy", "w") as entry:
        np.lib.format.write_array(entry, np.frombuffer(json.dumps(header).encode(), np.uint8))
    payload = buffer.getvalue()
    return payload + hashlib.sha256(payload).digest()


def moved(header: Any, east: float, north: float) -> Any:
    """Return a part of a header with all places in it moved (m)."""
    shifts = {"west": east, "north": north}
    if not isinstance(header, dict):
        return header
    changed = {name: moved(value, east, north) for name, value in header.items()}
    changed |= {name: header[name] + shift for name, shift in shifts.items() if name in header}
    for name in changed.keys() & {"bounds", "origin"}:
        changed[name] = [number + (east, north)[axis % 2] for axis, number in enumerate(header[name])]
    return changed


def measure(folder: Path, words: list[str]) -> None:
    """Run a command in its own process; print its CPU time and its peak memory."""
    code = "from flexroad.pipeline.cli.main import main; main()"
    output = subprocess.run(
        [sys.executable, "-S", "-c", LAUNCHER, "-c", code, *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        check=True,
    )
    status, cpu, peak = json.loads(output.stdout.splitlines()[-1])
    if status:
        raise SystemExit(f"{' '.join(words)}: exit code {status}\n{output.stderr.decode()}")
    label = " ".join(word for word in words if word not in WRITTEN and word not in PATTERNS)
    print(f"{label:50}{cpu:8.1f} s of CPU{peak:8.0f} MB", flush=True)


if __name__ == "__main__":
    main()
