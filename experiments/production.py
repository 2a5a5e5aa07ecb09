"""The production settings against the paper's: on the benchmark, in two real towns, on a real survey.

``PYTHONPATH=. python experiments/production.py 240`` for docs/fit.md; 4 tiles of the benchmark without
a number. Stages and options are those of configs/paper.yaml and configs/nightly.yaml, tile by tile as a run
does them; only the benchmark's tiles, which are islands, have no halo.

With FLEXROAD_REAL_DATA follow Barbican and Gothenburg, their canopies laid over the DSM and their DTM spoiled
(noise and scars; truth is the DTM as it was), and the north of Autzen with roads drawn by hand against ground
points of another classification. Intervals are 95% of a bootstrap over tiles, squares of `BLOCK_M`, points.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import sys
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
import pandas as pd
import rasterio
from filter import NOISE_M, PAVED, Case, with_scars

from flexroad.catalog import Catalog, Tile
from flexroad.catalog.sources.rasters import index
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.cli.main import main as flexroad
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.graph.stages import STAGE_NAMES, STAGES, stage_function
from flexroad.tasks.synthetic import gerod, make_scene
from flexroad.tasks.synthetic.spoilers import Kind
from flexroad.tasks.types import Bools, Floats, RoadMask, TileData

TILES, SEED = 4, 1
OVER_M = 2.0
"""Where the DSM is this much over a true road, something hides it."""
BLOCK_M = 50
FOOT_M = 0.3048
CHAINS = {name: load_config(name).chains["flexroad"] for name in ("paper", "nightly")}


@dataclass(frozen=True, eq=False)
class Made:
    """What a chain made of a tile."""

    data: TileData
    road: RoadMask
    figures: dict[str, float]
    heights: Floats
    """Of the surface at the cells of the core (m)."""


def made(tile: Tile, name: str, halo: bool = True) -> Made:
    """Take a tile through the stages of a configuration."""
    chain = dict(CHAINS[name])
    if not halo:
        chain["load"] = chain["load"].model_copy(update={"halo_m": 0.0})
    found: dict[str, object] = {}
    for stage in STAGES[: STAGE_NAMES.index("evaluate") + 1]:
        inputs = [found[i] for i in stage.inputs] or [tile]
        found[stage.name] = stage_function(stage.name, chain[stage.name])(*inputs, chain[stage.name])
    data, core = found["load"], tile.grid
    surface, metrics = found["fit"], found["evaluate"]
    figures = {
        "road L2 (m)": metrics.l2_road_m,
        "road RMSE (m)": metrics.rmse_road_m,
        "road MAD (deg)": metrics.mad_road_deg,
        "terrain L2 (m)": metrics.l2_terrain_m,
        "T": metrics.triangles,
    }
    return Made(data, found["segment"], figures, surface.lattice(core.eastings, core.northings))


def interval(paper: Floats, ours: Floats) -> str:
    """Return the mean of paired differences with its interval, and how many there are."""
    off = (ours - paper)[np.isfinite(ours - paper)]
    means = np.random.default_rng(0).choice(off, (2000, off.size)).mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return f"{off.mean():+.4f} [{low:+.4f}, {high:+.4f}], n = {off.size}, lower on {np.mean(off < 0):.0%}"


def show(rows: pd.DataFrame) -> None:
    """Print the mean figures of each configuration, and the intervals of their differences."""
    print(rows.groupby("config", sort=False).mean(numeric_only=True).round(4).to_string())
    paper, ours = (rows[rows.config == name].reset_index() for name in CHAINS)
    for figure in rows.columns.drop(["config", "T"]):
        print(f"  {figure}: {interval(paper[figure].to_numpy(), ours[figure].to_numpy())}")


def benchmark(tiles: int, scratch: Path) -> None:
    """Compare on made tiles: all road, and the road below crowns and below anything high."""
    catalog = Catalog.read(write_scenes(scratch, tiles, SEED, preset="gerod"))
    scenes = {name: place for name, *place in gerod.survey(tiles, SEED)}
    rows, hidden = [], []
    for tile in catalog.tiles:
        grid, stratum, options = scenes[tile.id]
        kind = make_scene(grid, SEED, stratum, options).kind
        for name in CHAINS:
            found = made(tile, name, halo=False)
            off = np.abs(found.heights - found.data.reference)
            below = {
                "below crowns": found.data.reference_road & (kind == Kind.CROWN),
                "below anything high": found.data.reference_road
                & (found.data.dsm - found.data.reference > OVER_M),
            }
            rows.append({"config": name, **found.figures})
            hidden += [
                {"config": name, "cells": k, "sum": off[m].sum(), "n": m.sum()} for k, m in below.items()
            ]
    print(f"{tiles} tiles of the benchmark, seed {SEED}")
    show(pd.DataFrame(rows))
    sums = pd.DataFrame(hidden).groupby(["cells", "config"])[["sum", "n"]].sum()
    mean = (sums["sum"] / sums["n"]).unstack()
    print("road L2 (m), mean over cells")
    print(
        mean.assign(ratio=mean["nightly"] / mean["paper"], n=sums["n"].unstack()["paper"])
        .round(4)
        .to_string()
    )


def town(name: str, archive: Path, crs: str, patterns: dict[str, str], scratch: Path) -> None:
    """Compare in a real town, cell by cell of its tiles' cores."""
    zipfile.ZipFile(archive).extractall(scratch)
    folder = scratch / archive.stem
    spoil(folder, patterns)
    layers = {"dsm": "spoiled_dsm.tif", "dtm": "spoiled_dtm.tif", "reference": patterns["dtm"]}
    found = index(folder, {**layers, "road_mask": patterns["cover"]}, road_values=(PAVED,), crs=crs)
    rows, blocks = [], []
    for tile in found.tiles:
        for config in CHAINS:
            m = made(tile, config)
            core = m.data.grid.window(m.data.core)
            off = np.abs(m.heights - m.data.reference[core])
            road = m.road.mask[core] & np.isfinite(off)
            rows.append({"config": config, **m.figures})
            blocks += [{"config": config, **b} for b in squares(off, road, int(BLOCK_M / tile.grid.cell))]
    print(f"\n{name}: {len(found.tiles)} tiles; roads are all that is paved")
    print(pd.DataFrame(rows).groupby("config", sort=False).mean().round(4).to_string())
    table = pd.DataFrame(blocks)
    paper, ours = (table[table.config == c].mean_m.to_numpy() for c in CHAINS)
    print(f"  road L2 by squares of {BLOCK_M} m: {interval(paper, ours)}")


def squares(off: Floats, road: Bools, side: int) -> Iterator[dict[str, float]]:
    """Yield the mean distance on the road in each square that has some."""
    for r in range(0, off.shape[0], side):
        for c in range(0, off.shape[1], side):
            here = np.s_[r : r + side, c : c + side]
            if road[here].sum() >= side:
                yield {"mean_m": float(off[here][road[here]].mean())}


def spoil(folder: Path, patterns: dict[str, str]) -> None:
    """Write a DSM with the canopies laid over it and a DTM with noise and scars beside the files."""
    paths = {layer: next(folder.glob(pattern)) for layer, pattern in patterns.items()}
    with rasterio.open(paths["dtm"]) as raster:
        profile = {**raster.profile, "driver": "GTiff", "dtype": "float64", "nodata": -9999.0}
    dsm, dtm, canopy = (_read(paths[layer]) for layer in ("dsm", "dtm", "canopy"))
    scarred = with_scars(_as_case(dtm), np.random.default_rng(0))
    crowned = np.fmax(dsm, dtm + np.nan_to_num(canopy))
    for name, heights in (("spoiled_dsm.tif", crowned), ("spoiled_dtm.tif", scarred)):
        with rasterio.open(folder / name, "w", **profile) as raster:
            raster.write(np.nan_to_num(heights, nan=-9999.0), 1)


def _as_case(dtm: Floats) -> Case:
    from flexroad.catalog import Grid

    grid = Grid("EPSG:25832", 0.0, float(dtm.shape[0]), 1.0, dtm.shape[1], dtm.shape[0])
    nothing = np.zeros(dtm.shape, bool)
    return Case(TileData("", grid, grid, dtm, dtm), RoadMask(grid, grid, nothing, nothing), nothing)


def _read(path: Path) -> Floats:
    with rasterio.open(path) as raster:
        values: Floats = raster.read(1, masked=True).astype(np.float64).filled(np.nan)
        return values


ROADS = "class = 'road' AND certainty <> 'low' AND visible_in IS NOT 'rgb'"


def autzen(folder: Path, scratch: Path) -> None:
    """Compare on the roads of an unclassified scan, at ground points of another classification."""
    out = scratch / "autzen"
    words = ["prepare", "points", folder / "autzen_north.laz", "--crs", "EPSG:2994", "-o", out]
    words += ["--roads", folder / "roads" / "autzen_north_roads.gpkg", "--roads-layer", "road_polygons"]
    call([*map(str, words), "--roads-where", ROADS])
    cloud = laspy.read(folder / "autzen-thin.las")
    ground = np.asarray(cloud.classification) == 2
    x, y, z = (np.asarray(axis)[ground] * FOOT_M for axis in (cloud.x, cloud.y, cloud.z))
    off: dict[str, list[Floats]] = {name: [] for name in CHAINS}
    for tile in Catalog.read(out / "catalog.parquet").tiles:
        west, south, east, north = tile.grid.bounds
        inside = (x >= west) & (x < east) & (y > south) & (y <= north)
        for name in CHAINS:
            found = made(tile, name)
            row, col = tile.grid.cells(x[inside], y[inside])
            on_road = found.road.mask[found.data.grid.window(tile.grid)][row, col]
            off[name].append(np.abs(found.heights[row, col] - z[inside])[on_road])
    paper, ours = (np.concatenate(off[name]) for name in CHAINS)
    print(
        f"\nAutzen north: paper {paper.mean():.4f} m, nightly {ours.mean():.4f} m off ground points on roads"
    )
    print(f"  {interval(paper, ours)}")


def call(words: list[str]) -> None:
    """Give a command of the program."""
    before, sys.argv = sys.argv, ["flexroad", *words]
    try:
        flexroad()
    except SystemExit as end:
        if end.code:
            raise
    finally:
        sys.argv = before


TOWNS = {
    "Barbican": ("London_BNG", "EPSG:27700", {
        "dsm": "dsm_barb*.tif", "dtm": "dem_barb*.tif", "canopy": "cdsm_barb*.tif", "cover": "landcover*.tif",
    }),
    "Gothenburg": ("Goteborg_SWEREF99_1200", "EPSG:3007", {
        "dsm": "DSM_KR*.tif", "dtm": "DEM_KR*.tif", "canopy": "CDSM_KR*.asc", "cover": "landcover.tif",
    }),
}  # fmt: skip


def main() -> None:
    tiles = int(sys.argv[1]) if len(sys.argv) > 1 else TILES
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        if tiles:
            benchmark(tiles, scratch / "made")
        if folder := os.environ.get("FLEXROAD_REAL_DATA"):
            print(f"\nCanopies laid over the DSM; DTM with {NOISE_M} m of noise and scars")
            for place, (archive, crs, patterns) in TOWNS.items():
                town(place, Path(folder) / "umep" / f"{archive}.zip", crs, patterns, scratch)
            autzen(Path(folder) / "autzen", scratch)


if __name__ == "__main__":
    main()
