"""What commands cost that look at every tile of a finished survey: CPU time and memory of each process.

The tiles are as with `production`: with borders, 250 m wide with cells of 5 m, on four layers of rasters in
sheets of 1 km. They have no products: writing and reading of meshes is not measured. CPU time counts, not the
time on the wall.

Usage: ``python bench/bench_planning.py [TILES] [--only COMMAND ...]``
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from flexroad.catalog import Catalog, Grid
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import AdaptiveExecutor, DaskExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.database import NAME as DATABASE
from flexroad.tools.synthetic import SceneOptions, make_scene
from tests.make_rasters import write

TILES = 1000
CELL_M, TILE_M, SHEET_M = 5, 250, 1000
CORNER = 300_000, 5_700_000
"""South-west corner of the survey."""
CONFIG = "extends: production\nfit: {spacing_m: 15}\nexport: {formats: []}\n"
LAYERS = ("dsm", "dtm", "road_mask", "dop")
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
    run_tiles(run, AdaptiveExecutor(None, DaskExecutor(), print))
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
        "dop": 100 * road,
    }
    for layer, values in data.items():
        for row in range(sheets):
            for column in range(sheets):
                west, south = CORNER[0] + SHEET_M * column, CORNER[1] + SHEET_M * row
                write(folder / layer / f"{west}_{south}.tif", values, west, south + SHEET_M, cell=CELL_M)


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
