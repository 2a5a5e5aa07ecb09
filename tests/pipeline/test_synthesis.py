import re

import numpy as np
import pytest
import rasterio

from catalog import Catalog
from pipeline.errors import ConfigError
from pipeline.synthesis import write_scenes
from tasks.synthetic import make_scene
from tasks.synthetic.gerod import survey


@pytest.fixture(scope="module")
def benchmark(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("gerod"), 5, seed=2, preset="gerod")


def test_the_preset_s_tiles_are_in_the_catalog_under_its_name(benchmark):
    tiles = {tile.id: tile for tile in Catalog.read(benchmark).tiles}
    asked = survey(5, 2)
    assert sorted(tiles) == sorted(tile_id for tile_id, *_ in asked)
    for tile_id, grid, stratum, _ in asked:
        assert tiles[tile_id].grid == grid
        assert tiles[tile_id].stratum == stratum
        assert tiles[tile_id].dataset == "synthetic benchmark gerod, seed 2"


def test_the_preset_s_files_hold_its_scenes(benchmark):
    tile_id, grid, stratum, options = survey(5, 2)[-1]
    scene = make_scene(grid, 2, stratum, options)
    for name, layer in scene.layers.items():
        with rasterio.open(benchmark.parent / name / f"{tile_id}.tif") as file:
            assert np.array_equal(file.read(1), layer.astype(file.dtypes[0]))


def test_what_a_preset_cannot_do_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=re.escape("--preset paper: there is gerod")):
        write_scenes(tmp_path, 1, seed=0, preset="paper")
    with pytest.raises(ConfigError, match="--tile-size 60: tiles of gerod have 250 m; leave it out"):
        write_scenes(tmp_path, 1, seed=0, size_m=60, preset="gerod")
    assert not list(tmp_path.iterdir())
