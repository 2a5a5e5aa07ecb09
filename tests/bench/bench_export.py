"""Cost of exports: time and bytes per tile and format, and the memory for many tiles against that for few.

The tiles are tiny, so that a thousand take minutes; roads are close to each other, so that meshes are as
dense as real ones. Each export is a process of its own, with the serial executor: its peak of memory has the
client and the encoding of a tile. The time is that of the processor per tile beyond the first tenth, without
the start. Formats that are added to `FORMATS` are measured without a change here.

Usage: ``python tests/bench/bench_export.py [TILES] [FORMAT,...]``
"""

from __future__ import annotations

import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import geopandas
import shapely

from flexroad.catalog import Catalog
from flexroad.catalog.ellipsoidal import Datum
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import DaskExecutor, SerialExecutor
from flexroad.pipeline.export.driver import export
from flexroad.pipeline.export.formats import FORMATS
from flexroad.pipeline.export.options import Options
from flexroad.pipeline.export.source import select
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from tests.bench.bench_scale import LAYERS, TILE_M, WORKERS, survey

TILES = 1000
"""Default number of tiles; a tenth of them is the other number."""
GROWTH_MB = 25.0
"""Largest growth of memory from a tenth of the tiles to all of them: an export holds 2 KB per tile, not its
graph or its mesh."""
OPTIONS = Options(Datum("offset", "45"))


def main(tiles: int = TILES, formats: Sequence[str] = ()) -> None:
    with tempfile.TemporaryDirectory(prefix="export-") as scratch:
        folder = Path(scratch)
        start = time.perf_counter()
        run = made_run(folder, math.ceil(math.sqrt(tiles)))
        print(f"{len(run.catalog.tiles)} tiles of {TILE_M} m made in {time.perf_counter() - start:.0f} s")
        measure(run, formats or list(FORMATS), tiles, folder)


def made_run(folder: Path, side: int) -> Run:
    """Return a finished run of ``side`` x ``side`` tiles, with the lines of a few roads over all of them."""
    survey(folder, side)
    west, north, size = 300_000, 5_700_000, side * TILE_M
    middles = range(TILE_M // 2, size, 200)
    lines = [[(west, north - y), (west + size, north - y)] for y in middles]
    shapes = [shapely.LineString(line) for line in lines]
    columns = {"width_m": [6.0] * len(lines)}
    geopandas.GeoDataFrame(columns, geometry=shapes, crs="EPSG:25832").to_file(folder / "roads.gpkg")
    index = rasters.index(folder, LAYERS | {"roads": "roads.gpkg"}, tile_size_m=TILE_M)
    run = Run.create(folder / "RUN", load_config("production"), Catalog(index.tiles))
    run_tiles(run, DaskExecutor(WORKERS))
    return run


def measure(run: Run, formats: Sequence[str], tiles: int, folder: Path) -> None:
    """Print a line per format; end with an error if the memory of one grows with the number of tiles."""
    print(f"{'format':14}{'CPU ms a tile':>15}{'again':>8}{'KB a tile':>11}{'MB peak':>9}{'with all':>10}")
    grown = []
    for name in formats:
        few, many = (one_export(run, name, number, folder) for number in (tiles // 10, tiles))
        if "refused" in many:
            print(f"{name:14}left out: {many['refused']}")
            continue
        first, again = (
            1000 * (many[step] - few[step]) / (tiles - tiles // 10) for step in ("seconds", "again")
        )
        print(
            f"{name:14}{first:15.1f}{again:8.1f}"
            f"{many['bytes'] / tiles / 1e3:11.1f}{few['peak_mb']:9.0f}{many['peak_mb']:10.0f}",
            flush=True,
        )
        if many["peak_mb"] > few["peak_mb"] + GROWTH_MB:
            grown.append(name)
    if grown:
        raise SystemExit(f"the memory of {', '.join(grown)} grows by more than {GROWTH_MB:g} MB")


def one_export(run: Run, name: str, tiles: int, folder: Path) -> dict[str, float]:
    """Return what a process of its own prints about an export of the first tiles of a run."""
    out = folder / "out" / f"{name}-{tiles}"
    words = [sys.executable, __file__, "--one", str(run.path), name, str(tiles), str(out)]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    measured: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return measured


def export_one(run: Path, name: str, tiles: int, out: Path) -> None:
    """Export the first tiles of a run twice; print seconds, bytes and the peak of memory as JSON."""
    ids = [tile.id for tile in Catalog.read(run / "catalog.parquet").tiles[:tiles]]
    seconds = []
    for _ in range(2):
        start = time.process_time()
        source = select(run, ids, allow=[str(run.parent)])
        try:
            manifest = export(source, out, [name], OPTIONS, SerialExecutor())
        except ConfigError as error:
            print(json.dumps({"refused": str(error)}))
            return
        seconds.append(time.process_time() - start)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    size = manifest["formats"][name]["bytes"]
    print(json.dumps({"seconds": seconds[0], "again": seconds[1], "bytes": size, "peak_mb": peak_mb}))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        export_one(Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]), Path(sys.argv[5]))
    else:
        main(
            int(sys.argv[1]) if len(sys.argv) > 1 else TILES,
            sys.argv[2].split(",") if len(sys.argv) > 2 else (),
        )
