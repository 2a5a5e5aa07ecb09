"""Small objects for tests: grids, tiles, masks, clusters, surfaces, finished runs and special files."""

import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from flexroad.catalog import Catalog, Grid
from flexroad.catalog.borders import border_of
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks.border import ENDS
from flexroad.tasks.filter import planar
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.spline.frame import Frame
from flexroad.tasks.spline.surface import NurbsSurface, clamped_knots, uniform_knots
from flexroad.tasks.types import Mesh, RoadClusters, RoadMask, TileData

CRS = "EPSG:25832"
WEST, NORTH = 295500.0, 5629500.0

LIGHT = {
    "extends": "defaults",
    "fit": {"method": "nurbs", "control_points": [8, 8], "iterations": 3},
    "variants": {"rgt": {"fit": "raster", "sample": "uniform"}, "flexroad": {}},
}
"""A configuration that takes a fraction of a second for a tile of 60 m."""


def make_grid(
    width: int = 60,
    height: int = 50,
    cell: float = 1.0,
    west: float = WEST,
    north: float = NORTH,
    crs: str = CRS,
) -> Grid:
    return Grid(crs, west, north, cell, width, height)


def grid_of(values: np.ndarray, cell: float = 1.0) -> Grid:
    """Return a grid that has the shape of an array."""
    return make_grid(values.shape[1], values.shape[0], cell)


def make_tile(dsm: np.ndarray, dtm: np.ndarray | None = None, cell: float = 1.0, **layers: Any) -> TileData:
    """Return the data of a tile; without a DTM the DSM is both."""
    grid = layers.pop("grid", None) or grid_of(dsm, cell)
    return TileData("made", grid, grid, dsm.copy(), (dsm if dtm is None else dtm).copy(), **layers)


def make_mask(road: np.ndarray, cell: float = 1.0, outside: np.ndarray | None = None) -> RoadMask:
    grid = grid_of(road, cell)
    return RoadMask(grid, grid, road, np.zeros(road.shape, bool) if outside is None else outside)


def make_clusters(road: np.ndarray, cell: float = 1.0, **cells: Any) -> RoadClusters:
    """Return the road as one cluster."""
    return RoadClusters(grid_of(road, cell), road.astype(np.int32), **cells)


def make_surface(
    shape: tuple[int, int] = (12, 14),
    degree: tuple[int, int] = (3, 3),
    knots: Literal["clamped", "uniform"] = "clamped",
    weights: bool = True,
    seed: int = 0,
    bounds: tuple[float, float, float, float] = (295500.5, 5629250.5, 295749.5, 5629499.5),
    relief_m: float = 2.0,
) -> NurbsSurface:
    """Return a NURBS surface with random heights and weights. ``shape`` counts rows and columns."""
    rng = np.random.default_rng(seed)
    rows, columns = shape
    w = np.exp(rng.uniform(-1, 1, shape)) if weights else np.ones(shape)
    along_u, along_v = (
        clamped_knots(n, p) if knots == "clamped" else uniform_knots(0, n - p, p)
        for n, p in ((columns, degree[0]), (rows, degree[1]))
    )
    heights = rng.normal(0, relief_m, shape)
    return NurbsSurface(CRS, bounds, degree, along_u, along_v, w * heights, w, 150.25, (WEST, 5629250.0))


def finish_run(folder: Path, survey: Path, config: Config | None = None, tiles: int = 4) -> Run:
    """Run the first tiles of a survey in this process, with ``LIGHT`` unless a configuration is given."""
    catalog = Catalog(Catalog.read(survey / "catalog.parquet").tiles[:tiles])
    run = Run.create(folder, config or compose(LIGHT, "light"), catalog)
    run_tiles(run, SerialExecutor())
    return run


def copy_run(made: Run, survey: Path, folder: Path) -> Run:
    """Return a copy of a finished run with a survey of its own, both in a folder."""
    own = shutil.copytree(survey, folder / "survey")
    shutil.copytree(made.path, folder / "run")
    ids = {tile.id for tile in made.catalog.tiles}
    tiles = [tile for tile in Catalog.read(own / "catalog.parquet").tiles if tile.id in ids]
    return Run.create(folder / "run", made.config, Catalog(tuple(tiles)))


def given_heights(heights: np.ndarray, grid: Grid) -> Any:
    """Return a surface with these heights at the cells of a grid."""
    return SimpleNamespace(bounds=grid.hull, lattice=lambda eastings, northings: heights)


def make_frame(
    part: Callable[[Grid], tuple[TileData, RoadMask, RoadClusters]],
    tile: Grid,
    around_m: float,
    options: smoothing_spline.Options,
) -> Frame:
    """Fit the corners and edges of a tile, as in a run. ``part`` returns what a grid has."""
    parts: list[Any] = []
    for number, border in enumerate(border_of(tile, around_m)):
        if number < 4:
            parts.append(smoothing_spline.corner(*part(border.grid), border, options))
        else:
            ends = [parts[end] for end in ENDS[number - 4]]
            parts.append(smoothing_spline.edge(*part(border.grid), border, ends, options))
    return Frame(*parts)


def filtered(
    world: TileData, grid: Grid, core: Grid | None = None
) -> tuple[TileData, RoadMask, RoadClusters]:
    """Return a part of the data of an area, with its road and the filtered road."""
    cut = world.grid.window(grid)
    layers = {name: getattr(world, name) for name in ("dsm", "dtm", "road_mask", "road_height")}
    part = {name: layer[cut] for name, layer in layers.items() if layer is not None}
    data = TileData("part", grid, core or grid, **part, offset_dsm=world.offset_dsm)
    road = RoadMask(grid, data.core, data.road_mask, data.beyond_extent())
    return data, road, planar.ecsrc(data, road, planar.Options(shoulder_m=5))


def make_street(
    ground: Callable[[Any, Any], Any], shape: tuple[int, int] = (100, 100), noise: float = 0.0
) -> tuple[TileData, RoadClusters, np.ndarray]:
    """Return a tile with a road 10 m wide along its middle rows, the filtered road, and the true heights.

    ``ground`` returns the heights at metres to the east and to the south.
    """
    height, width = shape
    truth = ground(*np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))
    rng = np.random.default_rng(0)
    dsm, dtm = (truth + rng.normal(0, noise, truth.shape) for _ in range(2))
    road = np.zeros(truth.shape, bool)
    road[height // 2 - 5 : height // 2 + 5] = True
    return make_tile(dsm, dtm), make_clusters(road), truth


def make_special(path: Path, kind: str) -> None:
    """Put something that is no regular file at a path; never a real device."""
    path.unlink(missing_ok=True)
    if kind == "folder":
        path.mkdir()
    elif kind == "link to itself":
        path.symlink_to(path)
    elif kind == "link to a pipe":
        os.mkfifo(path.with_name("pipe"))
        path.symlink_to(path.with_name("pipe"))
    elif kind == "socket":
        # The name of a socket may have about 100 characters.
        folder = os.open(path.parent, os.O_RDONLY)
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(f"/proc/self/fd/{folder}/{path.name}")
        os.close(folder)
    else:
        os.mkfifo(path)


def make_mesh(column: int = 0, row: int = 0, n: int = 5, size: float = 10.0, road_from: float = 4.0) -> Mesh:
    """Return a square tile of hills. Faces east of ``road_from`` (m, over all tiles) are road."""
    x, y = np.meshgrid(np.linspace(0, size, n), np.linspace(0, size, n))
    origin = (WEST + column * size, 5629250.0 + row * size, 150.0 + column)
    z = 163.2 + np.sin((x + column * size) / 3) + 0.1 * (y + row * size) - origin[2]
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.c_[a, b, c], np.c_[a, c, d]]).astype(np.int32)
    vertices = np.c_[x.ravel(), y.ravel(), z.ravel()]
    road = vertices[faces].mean(axis=1)[:, 0] + column * size > road_from
    return Mesh(CRS, origin, vertices, faces, road)
