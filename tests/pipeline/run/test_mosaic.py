"""The mosaics of a run: one VRT per raster over all done tiles."""

import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
import rasterio

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.collection import write_mosaics
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from tests.builders import LIGHT


@pytest.fixture(scope="module")
def done(made_survey, tmp_path_factory) -> Run:
    """A finished run of four tiles."""
    folder = tmp_path_factory.mktemp("made") / "run"
    run = Run.create(folder, compose(LIGHT, "light"), Catalog.read(made_survey / "catalog.parquet"))
    run_tiles(run, SerialExecutor())
    return run


@pytest.mark.parametrize("name", ["height", "road", "height_source"])
def test_mosaic_in_a_moved_run_has_the_cells_of_all_tiles(name, done, tmp_path):
    moved = shutil.copytree(done.path, tmp_path / "elsewhere")
    with rasterio.open(moved / f"{name}.vrt") as mosaic:
        whole = mosaic.read(1)
        assert mosaic.crs.to_epsg() == 25832
        assert whole.shape == (120, 120)
        for tile in done.catalog.tiles:
            with rasterio.open(moved / "tiles" / tile.id / f"{tile.id}_flexroad_{name}.tif") as raster:
                window = mosaic.window(*tile.grid.bounds)
                np.testing.assert_array_equal(mosaic.read(1, window=window), raster.read(1))
                assert mosaic.dtypes == raster.dtypes
                assert mosaic.descriptions == raster.descriptions == (name,)
                assert mosaic.units == raster.units
                assert str(mosaic.nodata) == str(raster.nodata)
                assert mosaic.colorinterp == raster.colorinterp
    assert np.ptp(whole) > 0


def test_mosaic_names_the_classes(done):
    names = [category.text for category in ET.parse(done.path / "height_source.vrt").iter("Category")]
    assert names == ["outside", "measured", "dtm", "inferred"]


def test_each_mosaic_has_its_style_beside_it(done):
    """QGIS takes the style of the same name: heights as hillshade, classes with their meanings."""
    styles = {path.stem: ET.parse(path).find("pipe/rasterrenderer") for path in done.path.glob("*.qml")}
    assert {name: style.get("type") for name, style in styles.items()} == {
        "height": "hillshade", "road": "paletted", "height_source": "paletted"
    }  # fmt: skip
    entries = {entry.get("value"): entry.get("label") for entry in styles["road"].iter("paletteEntry")}
    assert entries["1"] == "Road that the surface follows"
    assert {path.stem for path in done.path.glob("*.vrt")} == set(styles)


def test_mosaic_of_some_tiles_has_nodata_elsewhere(done, tmp_path):
    moved = Run.open(shutil.copytree(done.path, tmp_path / "part"))
    tiles = [done.catalog.tiles[0], done.catalog.tiles[3]]
    assert [kind.key for kind in write_mosaics(moved, tiles)] == ["height", "road", "height_source"]
    with rasterio.open(moved.path / "height.vrt") as mosaic:
        assert np.isnan(mosaic.read(1)).mean() == 0.5


def test_tiles_of_different_lattices_have_no_mosaic(done, tmp_path):
    moved = Run.open(shutil.copytree(done.path, tmp_path / "mixed"))
    tiles = done.catalog.tiles
    shifted = replace(tiles[1], grid=replace(tiles[1].grid, west=tiles[1].grid.west + 0.5))
    assert write_mosaics(moved, [tiles[0], shifted]) == []
    assert not [*moved.path.glob("*.vrt"), *moved.path.glob("*.qml")]
