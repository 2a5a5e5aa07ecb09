"""Tiles that share their borders against tiles fitted alone, and against one fit of all tiles together.

``PYTHONPATH=. python experiments/mosaic.py 1 2 3`` gives the tables of docs/archive/mosaic.md. The arguments
are seeds; each one makes a block of 3 x 3 tiles of 250 m: urban for seed 1, suburban for 2, rural for 3, and
so on. Each block is computed once more without data within `VOID_M` of one of its inner corners. If
FLEXROAD_REAL_DATA is set, tiles of 150 m of the Barbican follow. Stages and options are those of
configs/production.yaml. Each tile is fitted in three ways:

- alone: with its halo, on control points of its own, without regard to the neighbours;
- lattice: the same on the control points that all tiles have in common;
- shared: with the corners and edges that it shares with its neighbours.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import sys
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from flexroad.catalog import Grid
from flexroad.catalog.sources.rasters import index
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.graph.borders import BorderStages
from flexroad.pipeline.graph.stages import stage_function
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.load import load
from flexroad.tasks.roads.dtm_validity import without_invalid_dtm
from flexroad.tasks.sample import sample
from flexroad.tasks.spline.space import clamped_space, points_at_spacing, start_heights, surface_on
from flexroad.tasks.synthetic import make_scene
from flexroad.tasks.types import Bools, Floats, Mesh, RoadClusters, RoadMask, Surface, TileData

CHAIN = load_config("production").chains["flexroad"]
STAGES = BorderStages.of(CHAIN)
MARGIN_M = 100.0
"""Ground around the block (m): what its borders are computed from."""
TILE_M, SIDE = 250, 3
"""Side of the synthetic tiles (m), and of their block (tiles)."""
STRATA = ("urban", "suburban", "rural")
VOID_M = 70.0
"""Radius of the void around a corner (m); its middle is farther from all ground than a halo of 50 m."""
KINDS = ("alone", "lattice", "shared")
METRICS = ("l2_road_m", "l2_terrain_m", "mad_road_deg", "mad_terrain_deg", "triangles")
POINTS = 2001
"""Points along an edge at which surfaces are compared."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """A surface of one tile, its mesh, and the metrics of the mesh."""

    surface: Surface
    mesh: Mesh
    metrics: dict[str, float]


def made(seed: int) -> tuple[TileData, list[Grid]]:
    """Return the rasters of a made block in one piece, and the grids of its tiles."""
    side, margin = SIDE * TILE_M, int(MARGIN_M)
    west, south = 500_000.0, 5_600_000.0
    grid = Grid("EPSG:25832", west - margin, south + side + margin, 1.0, side + 2 * margin, side + 2 * margin)
    scene = make_scene(grid, seed, STRATA[(seed - 1) % len(STRATA)])
    # Heights of rasters are float32.
    dsm, dtm = (heights.astype(np.float32).astype(np.float64) for heights in (scene.dsm, scene.dtm))
    data = TileData("", grid, grid, dsm, dtm, scene.road_mask, scene.reference, scene.reference_road)
    tiles = [
        Grid(grid.crs, west + TILE_M * i, south + TILE_M * (j + 1), 1.0, TILE_M, TILE_M)
        for j in range(SIDE)
        for i in range(SIDE)
    ]
    return data, tiles


def without_corner(data: TileData) -> TileData:
    """Return the block without data around the north-eastern corner of its first tile."""
    east, north = data.grid.west + MARGIN_M + TILE_M, data.grid.south + MARGIN_M + TILE_M
    void = np.hypot(data.grid.eastings - east, (data.grid.northings - north)[:, None]) < VOID_M
    dsm, dtm = (np.where(void, np.nan, heights) for heights in (data.dsm, data.dtm))
    return replace(data, dsm=dsm, dtm=dtm)


def barbican(archive: Path, scratch: Path) -> tuple[TileData, list[Grid]]:
    """Return the rasters of the Barbican, and the grids of its tiles of 150 m."""
    zipfile.ZipFile(archive).extractall(scratch)
    layers = {"dsm": "dsm_barb*.tif", "dtm": "dem_barb*.tif", "road_mask": "landcover*.tif"}
    catalog = index(scratch / archive.stem, layers, road_values=(1,), tile_size_m=150.0)
    grids = [tile.grid for tile in catalog.tiles]
    west, south = min(g.west for g in grids), min(g.south for g in grids)
    east, north = max(g.east for g in grids), max(g.north for g in grids)
    block = Grid(grids[0].crs, west, north, 1.0, round(east - west), round(north - south))
    options = CHAIN["load"].model_copy(update={"halo_m": MARGIN_M, "min_valid": 0.0})
    return load(replace(catalog.tiles[0], grid=block), options), grids


def cut(data: TileData, core: Grid, halo_m: float) -> TileData:
    """Return the rasters of one tile with a halo."""
    grid = core.buffered(halo_m)
    part = data.grid.window(grid)
    layers = ("dsm", "dtm", "road_mask", "reference", "reference_road")
    parts = {name: values[part] for name in layers if (values := getattr(data, name)) is not None}
    return replace(data, grid=grid, core=core, **parts)


def filtered(data: TileData) -> tuple[RoadMask, RoadClusters]:
    """Return the road mask before and after the filter."""
    road = stage_function("segment", STAGES.segment)(data, STAGES.segment)
    return road, stage_function("ecsrc", STAGES.ecsrc)(data, road, STAGES.ecsrc)


def fitted(world: TileData, core: Grid, kind: str) -> Fitted:
    """Return surface, mesh and metrics of one tile."""
    data = cut(world, core, CHAIN["load"].halo_m)
    road, clusters = filtered(data)
    frame = STAGES.frame(cut(world, core, STAGES.reach_m), core) if kind == "shared" else None
    if kind == "alone":
        surface = alone(data, clusters)
    else:
        ground = data if frame else replace(data, core=data.grid)
        surface = smoothing_spline.fit(ground, clusters, STAGES.fit, frame)
    mesh = sample(surface, road, clusters, CHAIN["sample"], frame)
    metrics = stage_function("evaluate", CHAIN["evaluate"])(mesh, data, road, CHAIN["evaluate"])
    return Fitted(surface, mesh, {name: getattr(metrics, name) for name in METRICS})


def alone(data: TileData, clusters: RoadClusters) -> Surface:
    """Return the surface of a tile with its halo on control points of its own."""
    options, road = STAGES.fit, clusters.mask
    space = clamped_space(data.grid, 3, points_at_spacing(data.grid, 3, options.spacing_m))
    dtm = without_invalid_dtm(data, clusters).dtm
    first, datum = start_heights(data.dsm, dtm, road, space)
    z = smoothing_spline._minimum(
        space,
        np.where(road, data.dsm, dtm) - datum,
        np.where(road, 1.0, options.lambda_terrain),
        options.bending_m3 * np.where(road, 1.0, options.bending_terrain),
        first - datum,
        np.zeros(first.shape, np.bool_),
        options,
    )
    return surface_on(space, data.grid, data.grid.hull, z, np.ones_like(z), datum)


def together(world: TileData, tile: Grid) -> Surface:
    """Return one surface of the complete block with its margin, on the lattice of the tiles."""
    _, clusters = filtered(replace(world, core=world.grid))
    points = smoothing_spline._lattice(tile.shape[::-1], tile.cell, STAGES.fit)
    options = STAGES.fit.model_copy(update={"spacing_m": points.unit_m[0], "stop_tolerance": 1e-8})
    return smoothing_spline.fit(replace(world, core=world.grid), clusters, options)


def shared_edges(tiles: Sequence[Grid]) -> Iterator[tuple[Grid, Grid, Floats, Floats]]:
    """Yield each pair of neighbours, with eastings and northings of points along their common edge."""
    by_corner = {(grid.west, grid.south): grid for grid in tiles}
    for grid in tiles:
        along = np.linspace(0, grid.width * grid.cell, POINTS)
        if other := by_corner.get((grid.east, grid.south)):
            yield grid, other, np.full_like(along, grid.east), grid.south + along
        if other := by_corner.get((grid.west, grid.north)):
            yield grid, other, grid.west + along, np.full_like(along, grid.north)


def steps(tiles: Mapping[Grid, Fitted], known: Bools, whole: Grid) -> dict[str, float]:
    """Return the differences of neighbouring surfaces along their common edges, where the ground is known."""
    heights, angles = [], []
    for one, other, x, y in shared_edges(list(tiles)):
        here, there = tiles[one].surface, tiles[other].surface
        inside = known[whole.cells(x, y)]
        a, b = here.normal(x, y), there.normal(x, y)
        angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
        heights.append(np.abs(here.height(x, y) - there.height(x, y))[inside])
        angles.append(np.degrees(angle)[inside])
    step, angle = np.concatenate(heights), np.concatenate(angles)
    return {"mean step (m)": step.mean(), "largest step (m)": step.max(), "largest angle (°)": angle.max()}


def open_edges(tiles: Mapping[Grid, Fitted]) -> int:
    """Return the number of triangle edges on common edges of tiles that only one triangle has."""
    meshes = [result.mesh for result in tiles.values()]
    points = np.concatenate([mesh.vertices + mesh.origin for mesh in meshes])
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first, strict=False)])
    unique, number = np.unique(points, axis=0, return_inverse=True)
    corners = number.reshape(-1)[faces]
    edges = np.sort(np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    x, y = np.moveaxis(unique[edges[count == 1], :2], -1, 0)
    common = np.zeros(len(x), np.bool_)
    for _, _, easting, northing in shared_edges(list(tiles)):
        on_x = (x >= easting[0]) & (x <= easting[-1])
        on_y = (y >= northing[0]) & (y <= northing[-1])
        common |= (on_x & on_y).all(axis=1)
    return int(np.count_nonzero(common))


def distances(world: TileData, tiles: Mapping[Grid, Surface], one: Surface, where: Bools) -> Floats:
    """Return the distances of the tiles from one surface at the given cells of the block (m)."""
    parts = []
    for grid, surface in tiles.items():
        error = np.abs(
            surface.lattice(grid.eastings, grid.northings) - one.lattice(grid.eastings, grid.northings)
        )
        parts.append(error[where[world.grid.window(grid)]])
    return np.concatenate(parts)


def in_mm(values: Floats) -> str:
    """Return mean, 99th percentile and maximum as text."""
    mean, high, most = 1e3 * values.mean(), 1e3 * np.percentile(values, 99), 1e3 * values.max()
    return f"mean {mean:.3f}, p99 {high:.2f}, max {most:.1f} mm"


def compare(name: str, world: TileData, tiles: list[Grid]) -> Iterator[dict[str, float | str]]:
    """Print how well the tiles of a block meet; yield the metrics of each tile."""
    known = np.isfinite(world.dsm) | np.isfinite(world.dtm)
    for kind in KINDS:
        results = {tile: fitted(world, tile, kind) for tile in tiles}
        found = steps(results, known, world.grid)
        print(f"{name}, {kind}:", *(f"{key} {value:.3g}," for key, value in found.items()), end=" ")
        print("open edges of triangles", open_edges(results), flush=True)
        for number, result in enumerate(results.values()):
            yield {"name": name, "kind": kind, "tile": number, **result.metrics}


def against_one(name: str, world: TileData, tiles: list[Grid], void: Bools) -> None:
    """Print the distances of the tiles from one fit of the block."""
    one = together(world, tiles[0])
    road = world.reference_road & ~void
    areas = {"roads": road, "all ground": ~void, **({"the void": void} if void.any() else {})}
    for kind in KINDS:
        surfaces = {tile: fitted(world, tile, kind).surface for tile in tiles}
        for area, where in areas.items():
            print(f"{name}, {kind}, from one fit, {area}:", in_mm(distances(world, surfaces, one, where)))


def show(rows: pd.DataFrame) -> None:
    """Print the change of each metric: of the means, and on the tiles with the least and the most."""
    before = rows[rows.kind == "alone"].set_index(["name", "tile"])
    for kind in KINDS[1:]:
        now = rows[rows.kind == kind].set_index(["name", "tile"])
        for metric in METRICS:
            old, new = before[metric].mean(), now[metric].mean()
            change = 100 * (now[metric] / before[metric] - 1)
            print(
                f"  {metric}, alone {old:.4f}, {kind} {new:.4f}: {100 * (new / old - 1):+.2f}%, "
                f"tiles {change.min():+.2f}% to {change.max():+.2f}%",
                flush=True,
            )


def main() -> None:
    rows: list[dict[str, float | str]] = []
    for seed in map(int, sys.argv[1:] or ("1",)):
        world, tiles = made(seed)
        rows += compare(f"seed {seed}", world, tiles)
        against_one(f"seed {seed}", world, tiles, np.zeros(world.grid.shape, np.bool_))
        holed = without_corner(world)
        against_one(f"seed {seed}, void", holed, tiles, np.isnan(holed.dtm) & np.isfinite(world.dtm))
    show(pd.DataFrame(rows))
    if folder := os.environ.get("FLEXROAD_REAL_DATA"):
        with tempfile.TemporaryDirectory() as scratch:
            world, tiles = barbican(Path(folder) / "umep" / "London_BNG.zip", Path(scratch))
            show(pd.DataFrame(compare("Barbican", world, tiles)))


if __name__ == "__main__":
    main()
