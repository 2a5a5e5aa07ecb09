"""Rasters of a block of points, one thread: total time and time per step.

The block is 250 m wide plus a rim, with 4 million coloured points, a quarter of them on houses and trees.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import cProfile
import pstats
import time

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points.to_rasters import Options, rasterise, reach_m
from flexroad.tasks.acquire.types import Points

POINTS = 4_000_000
GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 250, 250)
DOP_CELL = 0.5
STEPS = {
    "surface": ("max_height.py", "highest"),
    "spikes": ("max_height.py", "spikes"),
    "voids": ("fill_voids.py", "fill"),
    "ground filter": ("ground_filter.py", "ground"),
    "terrain": ("dtm.py", "triangulated"),
    "photo": ("orthophoto.py", "photo"),
}
METHODS = {
    "classes": Options(despike_m=5),
    "slope filter": Options(despike_m=5, ground="filter"),
}


def land(rim_m: float) -> Points:
    """Return points on hilly ground, houses and trees."""
    rng = np.random.default_rng(1)
    west, south, east, north = GRID.buffered(rim_m).bounds
    easting, northing = rng.uniform(west, east, POINTS), rng.uniform(south, north, POINTS)
    x, y = easting - west, northing - south
    height = 150 + 5 * np.sin(x / 40) * np.cos(y / 55) + rng.normal(0, 0.03, POINTS)
    house, tree = (x % 40 < 15) & (y % 40 < 15), rng.random(POINTS) < 0.1
    height += np.where(house, 8.0, np.where(tree, rng.uniform(1, 12, POINTS), 0.0))
    kind = np.where(house, 6, np.where(tree, 5, 2)).astype(np.uint8)
    return Points(easting, northing, height, kind, rng.integers(0, 256, (POINTS, 3), dtype=np.uint8))


def main() -> None:
    for name, options in METHODS.items():
        points = land(reach_m(options, GRID.cell))
        rasterise(points[:100_000], GRID, options, DOP_CELL)
        profile = cProfile.Profile()
        start = time.perf_counter()
        profile.runcall(rasterise, points, GRID, options, DOP_CELL)
        total = time.perf_counter() - start
        print(
            f"\nground by {name}: {POINTS / 1e6:g} M points with a rim of {reach_m(options, GRID.cell):g} m"
        )
        for step, seconds in steps(profile).items():
            print(f"  {step:14}{seconds:8.2f} s{seconds / total:7.0%}")
        print(f"  {'block':14}{total:8.2f} s, {POINTS / total / 1e6:.1f} M points/s")


def steps(profile: cProfile.Profile) -> dict[str, float]:
    """Return the time spent in each step's function (s)."""
    spent = {
        (file.rpartition("/")[2], function): stats[3]
        for (file, _, function), stats in pstats.Stats(profile).stats.items()
    }
    return {step: spent[place] for step, place in STEPS.items() if place in spent}


if __name__ == "__main__":
    main()
