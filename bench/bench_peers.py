"""Production's fit beside other libraries on the same filtered cells: CPU time, and error of roads.

A peer gets the cells with a height of one tile (DSM on the filtered road, valid DTM elsewhere) and returns
heights at the tile's cells; these are meshed and evaluated against the true surface like ours. Peers that are
not installed are left out: ``pip install verde``, ``apt install gmt grass-core``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.gis_peers import installed
from bench.timing import cpu_s, one_cpu_s, one_thread
from flexroad.catalog import Catalog, Grid
from flexroad.pipeline.config.loading import load_config
from flexroad.tasks import load, sample
from flexroad.tasks.fit.raster import RasterSurface
from flexroad.tasks.metrics import evaluate
from flexroad.tasks.options import stage_function
from flexroad.tasks.roads.dtm_validity import ground_to_fit
from flexroad.tasks.types import Floats, RoadClusters, RoadMask, Surface, TileData
from flexroad.tools.synthetic.scenes import write_scenes

SEED = 11
NEIGHBOURS, SMOOTHING = 30, 3.0
"""Cells around a place and smoothing of scipy's thin plate spline."""
NOISE_M = 0.05
"""Standard deviation of heights, from which scipy's spline on a grid chooses its knots."""
BLOCK_M, DAMPING = 3.6, 1e-8
"""Cells are averaged in blocks as wide as the distance of our control points: verde's spline is dense."""

Peer = Callable[[Floats, Floats, Floats], Floats]
"""Takes x, y ``(n,)`` and heights ``(H, W)`` with NaN; returns heights at all cells ``(H, W)``, m."""


@dataclass(frozen=True, eq=False)
class Case:
    """One tile, filtered."""

    data: TileData
    road: RoadMask
    clusters: RoadClusters
    ground: Floats
    """Heights to fit on the tile's core, ``(H, W)``, m; NaN where there is no height."""

    @property
    def core(self) -> Grid:
        """The tile."""
        return self.data.core


def main() -> None:
    one_thread()
    case = made_case()
    options = load_config("production").chains["flexroad"]["fit"]
    fit = stage_function("fit", options)
    ours = fit(case.data, case.clusters, options)
    seconds = cpu_s(lambda: fit(case.data, case.clusters, options))
    print(f"{'fit of one tile':34}{'CPU s':>8}{'ratio':>8}{'road L2 m':>11}{'road MAD deg':>14}")
    show("FlexRoad, production", seconds, seconds, case, ours)
    for name, peer in {**of_scipy(), **of_verde()}.items():
        heights: list[Floats] = []
        spent = one_cpu_s(lambda peer=peer, out=heights: out.append(heights_by(peer, case)))
        show(name, spent, seconds, case, surface_of(heights[0], case.core))
    for name, program in installed().items():
        x, y = places_of(case.core)
        raster, spent = program(x, y, np.column_stack(scattered(x, y, case.ground)))
        show(name, spent, seconds, case, surface_of(raster, case.core))


def made_case() -> Case:
    """Return a synthetic tile of 250 m after production's filter."""
    chain = load_config("production").chains["flexroad"]
    with tempfile.TemporaryDirectory() as folder:
        tile = Catalog.read(write_scenes(Path(folder), 1, seed=SEED)).tiles[0]
        data = load.load(tile, chain["load"])
        road = stage_function("segment", chain["segment"])(data, chain["segment"])
        clusters = stage_function("ecsrc", chain["ecsrc"])(data, road, chain["ecsrc"])
    ground = ground_to_fit(data, clusters)
    return Case(data, road, clusters, ground[data.grid.window(data.core)])


def heights_by(peer: Peer, case: Case) -> Floats:
    return peer(*places_of(case.core), case.ground)


def places_of(core: Grid) -> tuple[Floats, Floats]:
    """Return x and y of the cells, ``(W,)`` and ``(H,)``, from the tile's south-west corner (m)."""
    return core.eastings - core.west, core.northings - core.south


def surface_of(heights: Floats, core: Grid) -> RasterSurface:
    return RasterSurface(core.crs, core.hull, core, heights)


def show(name: str, seconds: float, ours: float, case: Case, surface: Surface) -> None:
    """Print one row; the surface is meshed and evaluated."""
    mesh = sample.sample(surface, case.road, case.clusters, sample.Options())
    metrics = evaluate.evaluate(mesh, case.data, case.road, surface, evaluate.Options())
    print(
        f"{name:34}{seconds:8.3f}{seconds / ours:8.1f}{metrics.l2_road_m:11.4f}{metrics.mad_road_deg:14.2f}",
        flush=True,
    )


def scattered(x: Floats, y: Floats, heights: Floats) -> tuple[Floats, Floats]:
    """Return places ``(n, 2)`` and heights ``(n,)`` of the cells that have one."""
    known = np.isfinite(heights)
    places = np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1)
    return places[known], heights[known]


def filled(heights: Floats) -> Floats:
    """Return heights with voids filled by the nearest cell."""
    from scipy.ndimage import distance_transform_edt

    nearest: Any = distance_transform_edt(np.isnan(heights), return_distances=False, return_indices=True)
    return heights[tuple(nearest)]


def of_scipy() -> dict[str, Peer]:
    from scipy.interpolate import RBFInterpolator, RectBivariateSpline

    def thin_plate(x: Floats, y: Floats, heights: Floats) -> Floats:
        spline = RBFInterpolator(*scattered(x, y, heights), NEIGHBOURS, SMOOTHING)
        return spline(np.stack(np.broadcast_arrays(x, y[:, None]), axis=-1).reshape(-1, 2)).reshape(
            heights.shape
        )

    def on_grid(x: Floats, y: Floats, heights: Floats) -> Floats:
        upward = filled(heights)[::-1]
        return RectBivariateSpline(y[::-1], x, upward, s=heights.size * NOISE_M**2)(y[::-1], x)[::-1]

    return {"scipy, thin plate, 30 neighbours": thin_plate, "scipy, spline on a grid": on_grid}


def of_verde() -> dict[str, Peer]:
    try:
        import verde
    except ImportError:
        return {}

    def spline(x: Floats, y: Floats, heights: Floats) -> Floats:
        places, known = scattered(x, y, heights)
        blocks = verde.BlockReduce(np.mean, spacing=BLOCK_M)
        chain = verde.Chain([("mean", blocks), ("spline", verde.Spline(damping=DAMPING))])
        chain.fit(tuple(places.T), known)
        return np.asarray(chain.predict(np.broadcast_arrays(x, y[:, None])))

    return {"verde, spline of block means": spline}


if __name__ == "__main__":
    main()
