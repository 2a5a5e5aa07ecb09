"""Samplings of the same surfaces: size, CPU time and smoothness of meshes, and their distance from them.

Usage: ``PYTHONPATH=. python bench/bench_sampling.py CATALOG...``; each catalog gives a table, the mean over
its tiles. Surfaces, masks and frames come from production. Distances are computed as in
`tasks.metrics.evaluate`, with the 99th percentile on roads. On terrain the surface has no steps, because a
mesh without breaklines leaves them out.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.config.stages import STAGES
from flexroad.pipeline.graph.graph import Pattern
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator, StageError
from flexroad.tasks.metrics.dihedral import mean_angles
from flexroad.tasks.metrics.evaluate import OFF_CENTRE, mesh_distances
from flexroad.tasks.metrics.mesh_check import check
from flexroad.tasks.metrics.mesh_distance import drape
from flexroad.tasks.sample import SMOOTH_M, Options, sample
from flexroad.tasks.spline.frame import Frame
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.types import Mesh, RoadClusters, RoadMask, Surface

SAMPLINGS = {
    "production: 1 m, 10 m": {},
    "1 m, 5 m": {"terrain_m": 5},
    "1.1 m, 5.5 m": {"road_m": 1.1, "terrain_m": 5.5},
    "1.25 m, 5 m": {"road_m": 1.25, "terrain_m": 5},
    "1 m, 10 m, breaklines": {"breaklines": True},
    "1 m, 5 m, breaklines": {"terrain_m": 5, "breaklines": True},
}
Inputs = tuple[Surface, RoadMask, RoadClusters, Frame | None]


def inputs(catalog: Path, store: ArtefactStore) -> Iterator[Inputs]:
    """Yield the arguments of `sample` for each tile that can be fitted."""
    pattern = Pattern.of(load_config("production"))
    for tile in Catalog.read(catalog, [Path("/")]).tiles:
        graph = pattern.graph(tile)
        result, names = Evaluator(graph, store), graph.variants["flexroad"]
        try:
            surface, road, clusters = (result(names[stage]) for stage in STAGES["sample"])
        except StageError as error:
            print(error)
            continue
        parts = graph.nodes[names["sample"]].frame
        yield surface, road, clusters, Frame(*map(result, parts)) if parts else None


def p99_road_m(mesh: Mesh, surface: Surface, road: RoadMask) -> float:
    """Return the 99th percentile of the distances in `mesh_distances` (m)."""
    core, shift = road.core, OFF_CENTRE * road.core.cell
    places = replace(core, west=core.west + shift, north=core.north + shift)
    heights = surface.lattice(places.eastings, places.northings) - mesh.origin[2]
    on_road = np.abs(drape(mesh, places) - heights)[road.mask[road.grid.window(core)]]
    return float(np.nanpercentile(on_road, 99)) if on_road.size else float("nan")


def measure(surface: Surface, road: RoadMask, clusters: RoadClusters, frame: Frame | None) -> list[dict]:
    """Return one row per sampling of a tile."""
    rows, smoothed = [], surface
    if isinstance(surface, SteppedSurface):
        on_road = road.mask[road.grid.window(road.core)]
        smoothed = surface.without_steps_near(on_road, SMOOTH_M, frame)
    for name, chosen in SAMPLINGS.items():
        start = time.process_time()
        mesh = sample(surface, road, clusters, Options(**chosen), frame)
        seconds = time.process_time() - start
        check(mesh)
        angles, distances = mean_angles(mesh), mesh_distances(mesh, surface, road)
        rows.append(
            {
                "sampling": name,
                "T": len(mesh.faces),
                "T road": int(mesh.road.sum()),
                "CPU ms": 1e3 * seconds,
                "MAD road": np.mean(angles[mesh.road & np.isfinite(angles)]),
                "MAD terrain": np.mean(angles[~mesh.road & np.isfinite(angles)]),
                "road p95 mm": 1e3 * distances["mesh_p95_road_m"],
                "road p99 mm": 1e3 * p99_road_m(mesh, surface, road),
                "terrain p95 m": distances["mesh_p95_terrain_m"],
                "terrain max m": distances["mesh_max_terrain_m"],
                "p95 without steps m": mesh_distances(mesh, smoothed, road)["mesh_p95_terrain_m"],
            }
        )
    return rows


def main() -> None:
    for catalog in map(Path, sys.argv[1:]):
        with tempfile.TemporaryDirectory() as scratch:
            tiles = list(inputs(catalog, ArtefactStore(Path(scratch))))
        measure(*tiles[0])  # compiles the kernels
        table = pd.DataFrame([row for tile in tiles for row in measure(*tile)])
        print(f"{catalog}, {len(tiles)} tiles")
        print(table.groupby("sampling", sort=False).mean().round(3).to_string(), flush=True)


if __name__ == "__main__":
    main()
