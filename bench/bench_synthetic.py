"""Plane and RGT rows of the synthetic data sets beside the paper's, and the time to make their tiles.

Plane, RGT and FlexRoad's T depend only on the data and the mask. The presets were tuned to these rows and to
nothing else. Heights are compared with the DTM extended by bridges, as in the paper.
Usage: ``python bench/bench_synthetic.py [gerod|dsc3d TILES SEED]``; the default is ``gerod 48 0``. The
complete surveys of seed 1 are ``gerod 240 1`` and ``dsc3d 5 1``.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd

from flexroad.catalog import Catalog, Tile
from flexroad.tasks import load, sample
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.fit import plane, raster
from flexroad.tasks.metrics import evaluate
from flexroad.tasks.segment import mask
from flexroad.tools.synthetic.scenes import TRUE_CATALOG, write_scenes

PAPER = {
    "gerod": {
        "true road share": 0.18,
        "mask share": 0.26,
        "T": 33_447,
        "height range (m)": 54.7,
        "Plane road L2 (m)": 2.05,
        "Plane terrain L2 (m)": 2.343,
        "RGT road L2 (m)": 0.415,
        "RGT terrain L2 (m)": 1.773,
        "RGT road MAD (deg)": 15.55,
        "RGT terrain MAD (deg)": 22.191,
    },
    "dsc3d": {
        "least ground range (m)": 4.5,
        "largest ground range (m)": 33.9,
        "Plane road L2 (m)": 1.163,
        "Plane terrain L2 (m)": 2.727,
        "RGT road L2 (m)": 0.195,
        "RGT terrain L2 (m)": 15.411,
        "RGT road MAD (deg)": 7.185,
        "RGT terrain MAD (deg)": 15.78,
        "RGT T": 45_000,
        "T": 40_000,
    },
}


def measure(tile: Tile, true: Tile) -> dict[str, float]:
    """Return the figures of a tile; `true` is the same one with the true roads as reference."""
    data = load.load(tile, load.Options())
    road = mask.segment(data, mask.Options())
    clusters = ecsrc.ecsrc(data, road, ecsrc.Options())
    cells = raster.fit(data, clusters, raster.Options())
    true_road = load.load(true, load.Options()).reference_road
    figures = {
        "true road share": np.nan if true_road is None else float(true_road.mean()),
        "mask share": float(road.mask.mean()),
        # The heights do not matter to the number of triangles.
        "T": len(sample.sample(cells, road, clusters, sample.Options(mask="raw")).faces),
        "height range (m)": float(np.nanmax(data.dsm) - np.nanmin(data.dsm)),
        "ground range (m)": float(np.nanmax(data.dtm) - np.nanmin(data.dtm)),
    }
    surfaces = {
        "Plane": (plane.fit(data, clusters, plane.Options()), sample.Options(method="corners")),
        "RGT": (cells, sample.Options(method="uniform")),
    }
    for name, (surface, sampling) in surfaces.items():
        mesh = sample.sample(surface, road, clusters, sampling)
        metrics = evaluate.evaluate(mesh, data, road, surface, evaluate.Options(classes="segmented"))
        figures |= {
            f"{name} road L2 (m)": metrics.l2_road_m,
            f"{name} terrain L2 (m)": metrics.l2_terrain_m,
            f"{name} road MAD (deg)": metrics.mad_road_deg,
            f"{name} terrain MAD (deg)": metrics.mad_terrain_deg,
            f"{name} T": metrics.triangles,
        }
    return figures


def main(preset: str = "gerod", tiles: str = "48", seed: str = "0") -> None:
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        path = write_scenes(Path(folder), int(tiles), int(seed), preset=preset)
        seconds = (time.perf_counter() - start) / int(tiles)
        print(f"{preset}, {tiles} tiles, seed {seed}: {seconds:.2f} s a tile to make")
        pairs = zip(Catalog.read(path).tiles, Catalog.read(path.with_name(TRUE_CATALOG)).tiles, strict=True)
        rows = pd.DataFrame([measure(tile, true) for tile, true in pairs])
    ours = rows.mean()
    ours["least ground range (m)"] = rows["ground range (m)"].min()
    ours["largest ground range (m)"] = rows["ground range (m)"].max()
    table = pd.DataFrame({"paper": pd.Series(PAPER[preset]), "ours": ours[[*PAPER[preset]]]})
    print(table.assign(ratio=table.ours / table.paper).round(3).to_string())


if __name__ == "__main__":
    main(*sys.argv[1:])
