"""Errors at kerbs, walls and hump bridges on synthetic tiles: no steps, `fit.steps`, and `sample.breaklines`.

``PYTHONPATH=. python tests/bench/bench_steps.py`` prints the table of docs/archive/fit.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

from flexroad.catalog.grid import Grid
from flexroad.tasks import sample
from flexroad.tasks.filter import planar
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.metrics.vertical_distance import drape
from flexroad.tasks.segment import mask
from flexroad.tasks.synthetic import SceneOptions, make_scene
from flexroad.tasks.types import Bools, Floats, TileData

CELLS, SEEDS, NOISE_M = 200, (1, 2), 0.04
GRID = Grid("EPSG:25832", 500000.0, 5600000.0 + CELLS, 1.0, CELLS, CELLS)
SCENES: Mapping[str, dict[str, Any]] = {
    "no kerbs": {},
    "kerbs": {"curb_m": 0.12},
    "walls up": {"wall_m": 4.0},
    "walls down": {"wall_m": -4.0},
    "hump bridges": {"hump_m": 1.0, "stream_share": 0.6},
}
"""Options of the scenes by name."""
FILTER = planar.Options(verge_m=5)
NEAR_CELLS = 1.5
"""Cells nearer than this to the other side are at the edge."""


def tiles(name: str, mask_errors: float) -> Iterator[TileData]:
    """Yield the tiles of one kind."""
    stratum = "rural" if name == "hump bridges" else "urban"
    for seed in SEEDS:
        options = {"density": 0.5, "dsm_noise_m": (NOISE_M, NOISE_M), "slope": 0.06, **SCENES[name]}
        scene = make_scene(GRID, seed, stratum, SceneOptions(mask_errors=mask_errors, **options))
        layers = scene.dsm, scene.dtm, scene.road_mask, scene.reference, scene.reference_road
        yield TileData(name, GRID, GRID, *layers)


def errors(heights: Floats, truth: Floats, road: Bools) -> dict[str, float]:
    """Return mean absolute errors (m) at the edge on both sides, on the road, and on the terrain."""
    off = np.abs(heights - truth)
    sides = (cells & (distance_transform_edt(cells) < NEAR_CELLS) for cells in (road, ~road))
    inside, beyond = (float(np.nanmean(off[side])) for side in sides)
    return {
        "edge": (inside + beyond) / 2,
        "road": float(np.nanmean(off[road])),
        "terrain": float(np.nanmean(off[~road])),
    }


def figures(data: TileData, steps: bool, lines: bool) -> dict[str, float]:
    """Return the errors of the surface and of its mesh on one tile."""
    if data.reference is None or data.reference_road is None:
        raise ValueError("the tile has no truth")
    road = mask.segment(data, mask.Options())
    clusters = planar.ecsrc(data, road, FILTER)
    surface = smoothing_spline.fit(data, clusters, smoothing_spline.Options(steps=steps))
    mesh = sample.sample(surface, road, clusters, sample.Options(breaklines=lines))
    heights = surface.lattice(GRID.eastings, GRID.northings), drape(mesh, GRID) + mesh.origin[2]
    of_surface, of_mesh = (errors(z, data.reference, data.reference_road) for z in heights)
    return of_surface | {f"{key}, mesh": value for key, value in of_mesh.items()} | {"T": len(mesh.faces)}


def main() -> None:
    for name in SCENES:
        for mask_errors in (0.0, 1.0):
            for steps, lines in ((False, False), (True, False), (True, True)):
                found = [figures(data, steps, lines) for data in tiles(name, mask_errors)]
                means = {key: np.mean([part[key] for part in found]) for key in found[0]}
                text = "  ".join(f"{key} {value:.4g}" for key, value in means.items())
                kind = "breaklines" if lines else "steps" if steps else "smooth"
                print(f"{name:12}  mask errors {mask_errors:.0f}  {kind:10}  {text}", flush=True)


if __name__ == "__main__":
    main()
