"""Plane and RGT rows of the DSC3D stand-in beside the paper's, and the time to make its scenes.

Plane, RGT and FlexRoad's T depend only on the data and the mask. The scenes were tuned only to these rows.
Usage: ``PYTHONPATH=. python bench/bench_dsc3d.py [SEED]``; the default seed is 0.
"""

import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from flexroad.catalog import Catalog, Tile
from flexroad.tasks import load, sample
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.fit import plane, raster
from flexroad.tasks.metrics import evaluate
from flexroad.tasks.segment import mask
from flexroad.tasks.types import Surface
from flexroad.tools.synthetic.dsc3d import SITES
from flexroad.tools.synthetic.scenes import write_stand_in

PAPER = {
    "mesh triangles, least": 35_000,
    "mesh triangles, most": 101_000,
    "ground range (m), least": 4.5,
    "ground range (m), most": 33.9,
    "Plane road L2 (m)": 1.163,
    "Plane terrain L2 (m)": 2.727,
    "RGT road L2 (m)": 0.195,
    "RGT terrain L2 (m)": 15.411,
    "RGT road MAD (deg)": 7.185,
    "RGT terrain MAD (deg)": 15.78,
    "RGT T": 45_000,
    "T": 40_000,
}
CLASSES = evaluate.Options(classes="segmented")


def measure(tile: Tile) -> Mapping[str, float]:
    """Return the figures of one scene."""
    data = load.load(tile, load.Options())
    road = mask.segment(data, mask.Options())
    clusters = ecsrc.ecsrc(data, road, ecsrc.Options())
    cells = raster.fit(data, clusters, raster.Options())
    figures = {
        "ground range (m)": float(np.nanmax(data.dtm) - np.nanmin(data.dtm)),
        # The heights do not matter to the number of triangles.
        "T": float(len(sample.sample(cells, road, clusters, sample.Options(mask="raw")).faces)),
    }
    surfaces: dict[str, tuple[Surface, sample.Options]] = {
        "Plane": (plane.fit(data, clusters, plane.Options()), sample.Options(method="corners")),
        "RGT": (cells, sample.Options(method="uniform")),
    }
    for name, (surface, sampling) in surfaces.items():
        mesh = sample.sample(surface, road, clusters, sampling)
        metrics = evaluate.evaluate(mesh, data, road, surface, CLASSES)
        figures |= {
            f"{name} road L2 (m)": metrics.l2_road_m,
            f"{name} terrain L2 (m)": metrics.l2_terrain_m,
            f"{name} road MAD (deg)": metrics.mad_road_deg,
            f"{name} terrain MAD (deg)": metrics.mad_terrain_deg,
            f"{name} T": metrics.triangles,
        }
    return figures


def main() -> None:
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 0
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        tiles = Catalog.read(write_stand_in(Path(folder), None, seed)).tiles
        print(f"{len(tiles)} scenes, seed {seed}: {(time.perf_counter() - start) / len(tiles):.1f} s a scene")
        rows = [measure(tile) for tile in tiles]
    ours = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    triangles = [site.triangles for site in SITES]
    ranges = [row["ground range (m)"] for row in rows]
    ours |= {"mesh triangles, least": min(triangles), "mesh triangles, most": max(triangles)}
    ours |= {"ground range (m), least": min(ranges), "ground range (m), most": max(ranges)}
    print(f"{'':26}{'paper':>11}{'ours':>11}{'ratio':>8}")
    for name, paper in PAPER.items():
        print(f"{name:26}{paper:11,.3f}{ours[name]:11,.3f}{ours[name] / paper:8.2f}")


if __name__ == "__main__":
    main()
