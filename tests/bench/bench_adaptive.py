"""Adaptive meshes against dynamic ones: triangles, distance from the surface, smoothness and time.

``PYTHONPATH=. python tests/bench/bench_adaptive.py [PLACE ...]`` prints the table of
docs/archive/sampling.md. Places are those of bench_heldback.py; real ones need FLEXROAD_REAL_DATA. Each
tile's fitted surface is sampled by every method. Distances are those of a mesh from the surface that it
samples, on a lattice of `CELL_M`, and a place has the means over its tiles. Cells on the outline of roads
are left out: they are partly road.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_erosion

from flexroad.catalog import Grid
from flexroad.pipeline.export.source import select
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tasks import sample
from flexroad.tasks.metrics.dihedral import mean_angles
from flexroad.tasks.metrics.vertical_distance import drape
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.types import Mesh
from tests.bench.bench_heldback import places, run

CELL_M, ROUNDS = 0.25, 3
METHODS = {
    "dynamic 1 m": sample.Options(),
    "dynamic 0.5 m": sample.Options(road_m=0.5),
    "adaptive 20 mm": sample.Options(method="adaptive", tolerance_m=0.02),
    "adaptive 5 mm": sample.Options(method="adaptive"),
}
"""The options by name; the first one is the unit of time."""


def figures(tile: FinishedTile, options: sample.Options) -> dict[str, float]:
    """Return the figures of one mesh."""
    seconds = []
    for _ in range(ROUNDS):
        start = time.process_time()
        mesh = sample.sample(tile.surface, tile.road, tile.clusters, options)
        seconds.append(time.process_time() - start)
    road, terrain = distances(tile, mesh)
    return {
        "T": len(mesh.faces),
        "T road": mesh.road.sum(),
        "road max (mm)": 1e3 * road.max(initial=0.0),
        "road RMS (mm)": 1e3 * np.sqrt(np.mean(road**2)),
        "terrain max (mm)": 1e3 * terrain.max(initial=0.0),
        "MAD road (deg)": float(np.nanmean(mean_angles(mesh)[mesh.road])),
        "CPU": min(seconds),
    }


def distances(tile: FinishedTile, mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of a mesh from its surface (m) on the road and beside it."""
    core = tile.road.core
    split = round(core.cell / CELL_M)
    fine = Grid(core.crs, core.west, core.north, CELL_M, core.width * split, core.height * split)
    on_road = tile.road.mask[tile.road.grid.window(core)]
    surface = tile.surface
    if isinstance(surface, SteppedSurface):
        surface = surface.without_steps_near(on_road, sample.SMOOTH_M)
    off = np.abs(drape(mesh, fine) + mesh.origin[2] - surface.lattice(fine.eastings, fine.northings))
    road = np.kron(on_road, np.ones((split, split), bool))
    inner, outer = (binary_erosion(cells, np.ones((3, 3))) & np.isfinite(off) for cells in (road, ~road))
    return off[inner], off[outer]


def rows(tiles: list[FinishedTile]) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield name and mean figures of each method."""
    unit = np.nan
    for name, options in METHODS.items():
        found = [figures(tile, options) for tile in tiles]
        means = {key: float(np.mean([part[key] for part in found])) for key in found[0]}
        unit = means["CPU"] if np.isnan(unit) else unit
        yield name, means | {"CPU": means["CPU"] / unit}


def main(names: list[str]) -> None:
    data = os.environ.get("FLEXROAD_REAL_DATA")
    there = places(Path(data) if data else None, Path(__file__).parents[1] / "real" / "roads")
    for name in names or there:
        with tempfile.TemporaryDirectory() as folder:
            place = there[name](Path(folder))
            run(place, "production", (), Path(folder) / "run")
            source = select(str(Path(folder) / "run"), allow=[str(place.catalog.anchor)])
            tiles = [tile for tile in source.finished() if tile.quality.measured_road > 0]
            for method, means in rows(tiles):
                text = ", ".join(f"{key} {value:,.4g}" for key, value in means.items())
                print(f"{name}, {len(tiles)} tiles, {method}: {text}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
