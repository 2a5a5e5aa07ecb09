"""A run that the tests of tools share."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks.spline.stepped import without_steps
from flexroad.tools.export.source import select
from flexroad.tools.synthetic.scenes import write_scenes


@dataclass(frozen=True)
class Town:
    """A run with one surface over its tiles; the last tile is not computed."""

    path: Path

    @property
    def tiles(self):
        return Catalog.read(self.path / "catalog.parquet").tiles

    def at(self, x, y):
        """Heights and normals of the fitted surfaces at places, NaN elsewhere."""
        x, y = np.broadcast_arrays(x, y)
        heights, normals = np.full(x.shape, np.nan), np.full((*x.shape, 3), np.nan)
        for tile in select(self.path).finished():
            west, south, east, north = tile.tile.grid.bounds
            inside = (west <= x) & (x <= east) & (south <= y) & (y <= north)
            heights[inside] = tile.surface.height(x[inside], y[inside])
            normals[inside] = tile.surface.normal(x[inside], y[inside])
        return heights, normals

    def is_smooth(self, x, y, around_m):
        """Whether the surfaces have no step at places, nor at the corners of a square around them."""
        smooth = np.ones(np.shape(x), bool)
        corners = [(0, 0), *((i, j) for i in (-around_m, around_m) for j in (-around_m, around_m))]
        for tile in select(self.path).finished():
            spline = without_steps(tile.surface)
            for east, north in corners:
                place = x + east, y + north
                smooth &= tile.surface.height(*place) == spline.height(*place)
        return smooth


@pytest.fixture(scope="session")
def town(tmp_path_factory):
    """A run of four tiles of 60 m, in two rows; the last one is not computed."""
    folder = tmp_path_factory.mktemp("town")
    catalog = Catalog.read(write_scenes(folder / "survey", 4, seed=3, size_m=60))
    run = Run.create(folder / "town", load_config("production"), catalog)
    run_tiles(run, SerialExecutor(), only=lambda tile: tile != catalog.tiles[3])
    return Town(run.path)
