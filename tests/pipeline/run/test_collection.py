"""The STAC collection and items of a run, as other programs read them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pystac
import pytest
import rasterio
from pystac.validation.local_validator import LocalValidator

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.collection import write_collection
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from tests.builders import LIGHT

RASTERS = ("height", "road", "height_source")


@pytest.fixture(scope="module")
def done(made_survey, tmp_path_factory) -> Run:
    """A finished run of four tiles with two exported variants, moved after it was made."""
    folder = tmp_path_factory.mktemp("made")
    config = compose(LIGHT | {"export": {"variants": ["flexroad", "rgt"]}}, "light")
    run = Run.create(folder / "city", config, Catalog.read(made_survey / "catalog.parquet"))
    run_tiles(run, SerialExecutor())
    return Run.open(shutil.move(run.path, folder / "moved"))


@pytest.fixture
def copy(done, tmp_path) -> Run:
    return Run.open(shutil.copytree(done.path, tmp_path / "copy"))


def collection_of(run: Run) -> pystac.Collection:
    return pystac.Collection.from_file(str(run.path / "collection.json"))


def test_collection_leads_to_all_items(done):
    collection = collection_of(done)
    items = list(collection.get_items())
    assert [item.id for item in items] == [tile.id for tile in done.catalog.tiles]
    for item in items:
        assert item.get_collection() is collection
        assert item.collection_id == collection.id == "city"
        (west, south, east, north), outer = item.bbox, collection.extent.spatial.bboxes[0]
        assert outer[0] <= west < east <= outer[2]
        assert outer[1] <= south < north <= outer[3]
    assert collection.license == "other"
    assert collection.summaries.get_list("proj:code") == ["EPSG:25832"]


def test_collection_and_items_are_valid_stac(done):
    validator = LocalValidator()
    found = json.loads((done.path / "collection.json").read_text())
    assert [error.message for error in validator.collection_validator("1.1.0").iter_errors(found)] == []
    for path in done.path.glob("tiles/*/item.json"):
        item = json.loads(path.read_text())
        assert [error.message for error in validator.item_validator("1.1.0").iter_errors(item)] == []


def test_all_links_and_assets_exist(done):
    collection = collection_of(done)
    for owner in (collection, *collection.get_items()):
        hrefs = [link.get_absolute_href() for link in owner.links if link.rel != "self"]
        for asset in owner.get_assets().values():
            hrefs.append(asset.get_absolute_href())
            assert asset.media_type
            assert asset.title
        assert hrefs
        assert all(Path(href).is_relative_to(done.path) and Path(href).is_file() for href in hrefs)
    assert set(collection.assets) == {"metrics", *RASTERS}


def test_items_have_the_same_keys_and_describe_their_bands(done):
    first = {"mesh", "ply", "surface", *RASTERS}
    for item in collection_of(done).get_items():
        # The variant rgt has no NURBS surface.
        assert set(item.assets) == first | {f"{key}_rgt" for key in first - {"surface"}}
        assert item.assets["height"].href.endswith(f"{item.id}_flexroad_height.tif")
        assert item.assets["height_rgt"].href.endswith("_rgt_height.tif")
        for key in RASTERS:
            asset = item.assets[key]
            assert asset.roles == ["data"]
            (band,) = asset.to_dict()["bands"]
            with rasterio.open(asset.get_absolute_href()) as raster:
                assert (band["name"], band["data_type"]) == (key, raster.dtypes[0])
                assert band.get("unit") == raster.units[0]
                assert str(band.get("nodata")) == str(raster.nodata).removesuffix(".0")
                assert band["raster:spatial_resolution"] == raster.res[0]
                assert item.ext.proj.shape == list(raster.shape)
                assert item.ext.proj.transform == list(raster.transform)[:6]
                assert item.ext.proj.code == f"EPSG:{raster.crs.to_epsg()}"
                for one in band.get("classification:classes", []):
                    red, green, blue, _ = raster.colormap(1)[one["value"]]
                    assert one["color_hint"] == f"{red:02X}{green:02X}{blue:02X}"


def test_collection_describes_the_assets_of_its_items(done):
    collection = collection_of(done)
    described = collection.to_dict()["item_assets"]
    for item in collection.get_items():
        for key, asset in item.assets.items():
            found = asset.to_dict()
            assert {name: found[name] for name in described[key]} == described[key]


def test_odc_stac_loads_all_tiles_without_holes(done):
    import odc.stac

    items = list(collection_of(done).get_items())
    loaded = odc.stac.load(items, bands=[*RASTERS, "height_rgt"]).isel(time=0)
    for key in RASTERS:
        for item in items:
            with rasterio.open(item.assets[key].get_absolute_href()) as raster:
                west, south, east, north = raster.bounds
                part = loaded[key].sel(x=slice(west, east), y=slice(north, south))
                np.testing.assert_array_equal(part, raster.read(1))
    assert loaded.height.shape == (120, 120)
    assert loaded.height.notnull().all()
    assert not loaded.height.equals(loaded.height_rgt)
    assert np.isnan(loaded.height.nodata)


def test_tile_that_is_not_done_is_not_in_the_collection(copy):
    tile = copy.catalog.tiles[1]
    write_collection(copy, [other for other in copy.catalog.tiles if other is not tile])
    assert tile.id not in {item.id for item in collection_of(copy).get_items()}
    assert "3 tiles" in collection_of(copy).description


def test_run_without_a_done_tile_has_no_collection(copy):
    write_collection(copy, [])
    assert not (copy.path / "collection.json").exists()
    assert not list(copy.path.glob("*.vrt"))


def test_failed_tile_leaves_the_collection(survey, tmp_path):
    run = Run.create(tmp_path / "run", compose(LIGHT, "light"), Catalog.read(survey))
    run_tiles(run, SerialExecutor())
    tile = run.catalog.tiles[0]
    tile.paths(tile.layer("dsm"))[0].write_bytes(b"no raster")
    assert run_tiles(run, SerialExecutor()).failed == 1
    assert {item.id for item in collection_of(run).get_items()} == {
        other.id for other in run.catalog.tiles[1:]
    }


def test_heights_of_a_known_datum_load_in_place(survey, tmp_path):
    import odc.stac

    catalog = Catalog.read(survey)
    for tile in catalog.tiles:
        for layer in ("dsm", "dtm"):
            for path in tile.paths(tile.layer(layer)):
                with rasterio.open(path, "r+") as raster:
                    raster.crs = rasterio.CRS.from_user_input("EPSG:25832+7837")
    run = Run.create(tmp_path / "run", compose(LIGHT, "light"), catalog)
    assert run_tiles(run, SerialExecutor()).done == 4
    items = list(collection_of(run).get_items())
    heights = odc.stac.load(items, bands=["height"]).height.isel(time=0)
    with rasterio.open(run.path / "height.vrt") as mosaic:
        np.testing.assert_array_equal(heights, mosaic.read(1))
    for item in items:
        asset = item.assets["height"]
        assert asset.extra_fields["flexroad:vertical_crs"] == "EPSG:7837"
        with rasterio.open(asset.get_absolute_href()) as raster:
            assert "DHHN2016" in raster.crs.to_wkt()
        with rasterio.open(item.assets["road"].get_absolute_href()) as raster:
            assert raster.crs.to_epsg() == 25832
