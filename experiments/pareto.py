"""Accuracy against smoothness for several options of the fit, on the benchmark and on two real places.

The fit uses the roads that the paper's filter keeps, or those of a perfect filter: segmented cells within
0.3 m of the truth. Options are chosen on every other tile of the benchmark and reported on the rest. The real
places (FLEXROAD_REAL_DATA) have their canopies added to the DSM; their DTM is the truth with noise of 0.1 m
and a level shift under each building. An argument is the path for the figure of docs/archive/fit.md.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.ndimage import label

from flexroad.catalog import Catalog
from flexroad.catalog.sources.rasters import index
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.benchmark.truth import CATALOG
from flexroad.tasks import load, sample
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.fit import nurbs, smoothing_spline
from flexroad.tasks.metrics import evaluate
from flexroad.tasks.segment import mask
from flexroad.tasks.types import Bools, RoadClusters, RoadMask, TileData

TILES, SEED = 48, 1
SOUND_M = 0.3
NOISE_M, SCAR_M, BUILDING_M = 0.1, 0.3, 2.0


def bending(points: int, **options: float) -> smoothing_spline.Options:
    """Return options with this number of control points along both axes of a tile and an L1 loss."""
    defaults = {"bending_m3": 100, "lambda_terrain": 1, "huber_m": 0}
    return smoothing_spline.Options(spacing_m=249 / (points - 1), **(defaults | options))


TERRAIN_03 = {"lambda_terrain": 0.3}
CHOICES: dict[str, nurbs.Options | smoothing_spline.Options] = {
    "paper: free weights, Adam, 35": nurbs.Options(),
    "unit weights, Adam, 35": nurbs.Options(weights="unit"),
    **{f"bending {b} all over, 70": bending(70, bending_m3=b, bending_terrain=1) for b in (30, 100)},
    "bending 100 on roads, 70": bending(70),
    **{
        f"bending {b} on roads, 70, terrain 0.3": bending(70, **TERRAIN_03, bending_m3=b)
        for b in (30, 100, 300)
    },
    "bending 100 on roads, 50, terrain 0.3": bending(50, **TERRAIN_03),
    "bending 100 on roads, 35, terrain 0.3": bending(35, **TERRAIN_03),
    **{
        f"bending 100 on roads, {n}, terrain 0.3, Huber 0.1": bending(n, **TERRAIN_03, huber_m=0.1)
        for n in (50, 70)
    },
    "bending 100 on roads, 50, terrain 0.5, Huber 0.1": bending(50, lambda_terrain=0.5, huber_m=0.1),
}
"""Options of the fit by name. A number after the comma is that of control points along both axes."""


@dataclass(frozen=True, eq=False)
class Case:
    """A tile with its raw mask and the filtered masks to fit to."""

    place: str
    data: TileData
    road: RoadMask
    roads: dict[str, RoadClusters]


def case(place: str, data: TileData) -> Case:
    road = mask.segment(data, mask.Options())
    kept = ecsrc.ecsrc(data, road, ecsrc.Options())
    sound: Bools = road.mask & (np.abs(data.dsm - data.reference) <= SOUND_M)
    if data.reference_road is not None:
        sound &= data.reference_road
    return Case(place, data, road, {"paper": kept, "perfect": replace(kept, labels=sound.astype(np.int32))})


def benchmark_cases(scratch: Path) -> Iterator[Case]:
    catalog = Catalog.read(write_scenes(scratch, TILES, SEED, preset="gerod").with_name(CATALOG))
    for number, tile in enumerate(catalog.tiles):
        yield case(("chosen on", "reported on")[number % 2], load.load(tile, load.Options()))


def real_cases(scratch: Path) -> Iterator[Case]:
    """Yield the tiles of Barbican and Gothenburg if FLEXROAD_REAL_DATA is set."""
    root = os.environ.get("FLEXROAD_REAL_DATA")
    places = {
        "Barbican": (
            "EPSG:27700",
            "London_BNG",
            "dsm_barb*.tif",
            "dem_barb*.tif",
            "cdsm_barb*.tif",
            "landcover*.tif",
        ),
        "Gothenburg": (
            "EPSG:3007",
            "Goteborg_SWEREF99_1200",
            "DSM_KR*.tif",
            "DEM_KR*.tif",
            "CDSM_KR*.asc",
            "landcover.tif",
        ),
    }
    for place, (crs, name, dsm, dtm, crowns, cover) in places.items() if root else ():
        zipfile.ZipFile(Path(str(root)) / "umep" / f"{name}.zip").extractall(scratch)
        folder = scratch / name
        layers = {"dsm": dsm, "dtm": dtm, "road_mask": cover, "reference": crowns}
        for number, tile in enumerate(index(folder, layers, road_values=(1,), crs=crs).tiles):
            yield case(place, degraded(load.load(tile, load.Options()), number))


def degraded(data: TileData, seed: int) -> TileData:
    """Add the canopies (loaded as reference) to the DSM; degrade the DTM, whose original is the truth."""
    rng = np.random.default_rng(seed)
    with_canopies = np.fmax(data.dsm, data.dtm + np.nan_to_num(data.reference))
    buildings, count = label(data.dsm - data.dtm > BUILDING_M)
    shifts = np.append(0.0, rng.normal(0, SCAR_M, count))
    dtm = data.dtm + rng.normal(0, NOISE_M, data.dtm.shape) + shifts[buildings]
    return replace(data, dsm=with_canopies, dtm=dtm, reference=data.dtm)


def rows(tile_case: Case) -> Iterator[dict[str, float | str]]:
    for roads, kept in tile_case.roads.items():
        for name, options in CHOICES.items():
            start = time.process_time()
            method = nurbs if options.method == "nurbs" else smoothing_spline
            surface = method.fit(tile_case.data, kept, options)
            seconds = time.process_time() - start
            mesh = sample.sample(surface, tile_case.road, kept, sample.Options())
            figures = evaluate.evaluate(mesh, tile_case.data, tile_case.road, evaluate.Options())
            yield {
                "place": tile_case.place,
                "roads": roads,
                "choice": name,
                "road L2 (m)": figures.l2_road_m,
                "road RMSE (m)": figures.rmse_road_m,
                "road MAD (deg)": figures.mad_road_deg,
                "terrain L2 (m)": figures.l2_terrain_m,
                "T": figures.triangles,
                "ms": 1e3 * seconds,
            }


def picture(table: pd.DataFrame, path: Path) -> None:
    """Draw road MAD over road L2, one panel per filter; lines join options that differ in one number."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    families = {
        "paper: free weights": ["paper: free weights, Adam, 35"],
        "bending 30 / 100 m³ all over, 70": [f"bending {b} all over, 70" for b in (30, 100)],
        "bending 30 / 100 / 300 m³ on roads, 70, terrain 0.3": [
            f"bending {b} on roads, 70, terrain 0.3" for b in (30, 100, 300)
        ],
        "bending 100 m³, 35 / 50 / 70, terrain 0.3": [
            f"bending 100 on roads, {n}, terrain 0.3" for n in (35, 50, 70)
        ],
        "the same, 50 / 70, Huber 0.1": [
            f"bending 100 on roads, {n}, terrain 0.3, Huber 0.1" for n in (50, 70)
        ],
    }
    figure, axes = plt.subplots(1, 2, figsize=(10, 5.2), sharey=True, layout="constrained")
    for axis, roads in zip(axes, ("paper", "perfect"), strict=True):
        part = table.loc["reported on"].loc[roads]
        for name, choices in families.items():
            line = part.loc[choices]
            axis.plot(line["road L2 (m)"], line["road MAD (deg)"], "o-", ms=5, lw=1.4, label=name)
        axis.set(title=f"{roads} filter", xlabel="road L2 (m)")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("road MAD (degrees)")
    figure.legend(*axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        results = [row for source in (benchmark_cases, real_cases) for c in source(folder) for row in rows(c)]
    table = pd.DataFrame(results).groupby(["place", "roads", "choice"], sort=False).mean()
    print(f"{TILES} tiles of the benchmark, seed {SEED}; options chosen on one half; tile means, one thread")
    print(table.round(4).to_string())
    if len(sys.argv) > 1:
        picture(table, Path(sys.argv[1]))


if __name__ == "__main__":
    main()
