"""A small synthetic city, and centre lines on it, for tests of exports along roads."""

from pathlib import Path

import numpy as np
import shapely

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tools.synthetic.scenes import write_scenes
from tests import make_roads

TILE_M = 100
CRS = "EPSG:25832"


def make_city(folder: Path, without: int = 0, roads: bool = True) -> Path:
    """Return a run of four tiles of 100 m with one surface, 2 x 2; the last ones are not computed.

    Without ``roads`` the catalog has no roads layer.
    """
    path = write_scenes(folder / "survey", 4, seed=0, size_m=TILE_M)
    catalog = Catalog.read(path)
    if not roads:
        catalog = Catalog(tuple(_without_roads(tile) for tile in catalog.tiles))
    run = Run.create(folder / "city", load_config("production"), catalog)
    done = catalog.tiles[: 4 - without]
    run_tiles(run, SerialExecutor(), only=lambda tile: tile in done)
    return run.path


def _without_roads(tile):
    from dataclasses import replace

    layers, nearby = ([each for each in part if each.name != "roads"] for part in (tile.layers, tile.nearby))
    return replace(tile, layers=tuple(layers), nearby=tuple(nearby))


def south_west(run: Path) -> np.ndarray:
    bounds = np.array([tile.grid.bounds for tile in Catalog.read(run / "catalog.parquet").tiles])
    return bounds[:, :2].min(axis=0)


def write_lines(path: Path, run: Path, *lines, crs: str = CRS, layer: str | None = None, **columns) -> Path:
    """Write centre lines, given as places (m) from the south-west corner of a run."""
    corner = south_west(run)
    shapes = [shapely.LineString(np.array(line) + corner) for line in lines]
    make_roads.write(path, shapes, CRS, layer, **columns)
    if crs != CRS:
        import geopandas

        geopandas.read_file(path).to_crs(crs).to_file(path)
    return path


def bend(*ends: tuple[float, float], sag: float = 12.0) -> list[tuple[float, float]]:
    """Return a curve between two places that leaves the straight line by ``sag`` (m)."""
    (x0, y0), (x1, y1) = ends
    t = np.linspace(0, 1, 25)
    length = np.hypot(x1 - x0, y1 - y0)
    away = sag * np.sin(np.pi * t)
    x = x0 + t * (x1 - x0) - away * (y1 - y0) / length
    y = y0 + t * (y1 - y0) + away * (x1 - x0) / length
    return list(zip(x.tolist(), y.tolist(), strict=True))
