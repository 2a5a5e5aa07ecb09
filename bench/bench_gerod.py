"""Plane and RGT rows of the synthetic benchmark beside the paper's, and the time to make its tiles.

Plane, RGT and FlexRoad's T depend only on the data and the mask. The preset was tuned only to them. Heights
are compared with the DTM extended by bridges, as in the paper. Usage: ``PYTHONPATH=. python
bench/bench_gerod.py [TILES SEED]``; the default is 48 tiles of seed 0, the complete survey of seed 1 is ``240
1``.
"""

import sys
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks import sample
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.fit import plane, raster
from flexroad.tasks.metrics import evaluate
from flexroad.tasks.types import RoadMask, Surface, TileData
from flexroad.tools.synthetic import SceneOptions, make_scene
from flexroad.tools.synthetic.gerod import survey

PAPER = {
    "true road share": 0.18,
    "mask share": 0.26,
    "T": 33447,
    "height range (m)": 54.7,
    "Plane road L2 (m)": 2.05,
    "Plane terrain L2 (m)": 2.343,
    "RGT road L2 (m)": 0.415,
    "RGT terrain L2 (m)": 1.773,
    "RGT road MAD (deg)": 15.55,
    "RGT terrain MAD (deg)": 22.191,
}
CLASSES = evaluate.Options(classes="segmented")

Place = tuple[str, Grid, str, SceneOptions, int]


def measure(place: Place) -> Mapping[str, float]:
    """Return the figures of one tile and the time to make it (s)."""
    tile_id, grid, stratum, options, seed = place
    start = time.perf_counter()
    scene = make_scene(grid, seed, stratum, options)
    seconds = time.perf_counter() - start
    data = TileData(tile_id, grid, grid, scene.dsm, scene.dtm, scene.road_mask, scene.extended_dtm)
    road = RoadMask(grid, grid, scene.road_mask, np.zeros(grid.shape, np.bool_))
    clusters = ecsrc.ecsrc(data, road, ecsrc.Options())
    grid_surface = raster.fit(data, clusters, raster.Options())
    figures = {
        "true road share": float(scene.reference_road.mean()),
        "mask share": float(scene.road_mask.mean()),
        # The heights do not matter to the number of triangles.
        "T": len(sample.sample(grid_surface, road, clusters, sample.Options(mask="raw")).faces),
        "height range (m)": float(np.ptp(scene.dsm)),
    }
    surfaces: dict[str, tuple[Surface, sample.Options]] = {
        "Plane": (plane.fit(data, clusters, plane.Options()), sample.Options(method="corners")),
        "RGT": (grid_surface, sample.Options(method="uniform")),
    }
    for name, (surface, sampling) in surfaces.items():
        mesh = sample.sample(surface, road, clusters, sampling)
        metrics = evaluate.evaluate(mesh, data, road, surface, CLASSES)
        figures |= {
            f"{name} road L2 (m)": metrics.l2_road_m,
            f"{name} terrain L2 (m)": metrics.l2_terrain_m,
            f"{name} road MAD (deg)": metrics.mad_road_deg,
            f"{name} terrain MAD (deg)": metrics.mad_terrain_deg,
        }
    return figures | {"making (s)": seconds}


def main() -> None:
    numbers = [int(word) for word in sys.argv[1:]]
    tiles, seed = numbers if len(numbers) == 2 else (48, 0)
    with ProcessPoolExecutor(2) as pool:
        rows = list(pool.map(measure, [(*place, seed) for place in survey(tiles, seed)], chunksize=4))
    print(f"{tiles} tiles, seed {seed}: {np.mean([row['making (s)'] for row in rows]):.2f} s a tile to make")
    print(f"{'':24}{'paper':>10}{'ours':>10}{'ratio':>8}")
    for name, paper in PAPER.items():
        ours = float(np.nanmean([row[name] for row in rows]))
        print(f"{name:24}{paper:10.3f}{ours:10.3f}{ours / paper:8.2f}")


if __name__ == "__main__":
    main()
