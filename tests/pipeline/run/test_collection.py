"""The STAC collection, mosaics and map of a run, as other programs read them."""

import json
import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyogrio
import pystac
import pytest
import rasterio
from pyproj import Transformer
from pystac.validation.local_validator import LocalValidator

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.collection import outlines, write_collection, write_mosaics, write_states
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.database import NAME, RunDatabase
from flexroad.pipeline.store.records import Failure, TileRecord
from tests.builders import LIGHT, finish_run

RASTERS = ("height", "road", "height_source")


@pytest.fixture(scope="module")
def done(made_survey, tmp_path_factory) -> Run:
    """A finished run of four tiles with two exported variants, moved after it was made."""
    folder = tmp_path_factory.mktemp("made")
    config = compose(LIGHT | {"export": {"variants": ["flexroad", "rgt"]}}, "light")
    run = finish_run(folder / "city", made_survey, config)
    return Run.open(shutil.move(run.path, folder / "moved"))


@pytest.fixture
def copy(done, tmp_path) -> Run:
    return Run.open(shutil.copytree(done.path, tmp_path / "copy"))


def collection_of(run: Run) -> pystac.Collection:
    return pystac.Collection.from_file(str(run.path / "collection.json"))


def test_collection_and_items_are_valid_stac(done):
    validator = LocalValidator()
    found = json.loads((done.path / "collection.json").read_text())
    assert [error.message for error in validator.collection_validator("1.1.0").iter_errors(found)] == []
    for path in done.path.glob("tiles/*/item.json"):
        item = json.loads(path.read_text())
        assert [error.message for error in validator.item_validator("1.1.0").iter_errors(item)] == []


def test_collection_leads_to_all_items_and_describes_their_assets(done):
    collection = collection_of(done)
    items, described = list(collection.get_items()), collection.to_dict()["item_assets"]
    assert [item.id for item in items] == [tile.id for tile in done.catalog.tiles]
    for item in items:
        assert item.get_collection() is collection
        assert item.collection_id == collection.id == "city"
        (west, south, east, north), outer = item.bbox, collection.extent.spatial.bboxes[0]
        assert outer[0] <= west < east <= outer[2]
        assert outer[1] <= south < north <= outer[3]
        for key, asset in item.assets.items():
            found = asset.to_dict()
            assert {name: found[name] for name in described[key]} == described[key]
    assert collection.license == "other"
    assert collection.summaries.get_list("proj:code") == ["EPSG:25832"]


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
    write_collection(copy, [])
    assert not (copy.path / "collection.json").exists()
    assert not list(copy.path.glob("*.vrt"))


def test_failed_tile_leaves_the_collection(own_run):
    tile, *others = own_run.catalog.tiles
    tile.paths(tile.layer("dsm"))[0].write_bytes(b"no raster")
    assert run_tiles(own_run, SerialExecutor()).failed == 1
    assert {item.id for item in collection_of(own_run).get_items()} == {other.id for other in others}


def test_heights_of_a_known_datum_load_in_place(survey, tmp_path):
    import odc.stac

    catalog = Catalog.read(survey)
    for tile in catalog.tiles:
        for layer in ("dsm", "dtm"):
            for path in tile.paths(tile.layer(layer)):
                with rasterio.open(path, "r+") as raster:
                    raster.crs = rasterio.CRS.from_user_input("EPSG:25832+7837")
    run = finish_run(tmp_path / "run", survey.parent)
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


# --- mosaics: one VRT per raster over all done tiles --------------------------------------------------


@pytest.mark.parametrize("name", RASTERS)
def test_mosaic_in_a_moved_run_has_the_cells_of_all_tiles(name, done):
    with rasterio.open(done.path / f"{name}.vrt") as mosaic:
        whole = mosaic.read(1)
        assert mosaic.crs.to_epsg() == 25832
        assert whole.shape == (120, 120)
        for tile in done.catalog.tiles:
            with rasterio.open(done.path / "tiles" / tile.id / f"{tile.id}_flexroad_{name}.tif") as raster:
                window = mosaic.window(*tile.grid.bounds)
                np.testing.assert_array_equal(mosaic.read(1, window=window), raster.read(1))
                assert mosaic.dtypes == raster.dtypes
                assert mosaic.descriptions == raster.descriptions == (name,)
                assert mosaic.units == raster.units
                assert str(mosaic.nodata) == str(raster.nodata)
                assert mosaic.colorinterp == raster.colorinterp
                if name != "height":
                    assert mosaic.colormap(1)[1] == raster.colormap(1)[1]
    assert np.ptp(whole) > 0


def test_each_mosaic_has_its_classes_and_its_style_beside_it(done):
    """QGIS takes the style of the same name: heights as hillshade, classes with their meanings."""
    names = [category.text for category in ET.parse(done.path / "height_source.vrt").iter("Category")]
    assert names == ["outside", "measured", "dtm", "inferred"]
    styles = {path.stem: ET.parse(path).find("pipe/rasterrenderer") for path in done.path.glob("*.qml")}
    assert {name: style.get("type") for name, style in styles.items()} == {
        "height": "hillshade", "road": "paletted", "height_source": "paletted"
    }  # fmt: skip
    entries = {entry.get("value"): entry.get("label") for entry in styles["road"].iter("paletteEntry")}
    assert entries["1"] == "Road that the surface follows"
    assert {path.stem for path in done.path.glob("*.vrt")} == set(styles)


def test_mosaic_of_some_tiles_has_nodata_elsewhere(copy):
    one, two, _, four = copy.catalog.tiles
    assert [kind.key for kind in write_mosaics(copy, [one, four])] == list(RASTERS)
    with rasterio.open(copy.path / "height.vrt") as mosaic:
        assert np.isnan(mosaic.read(1)).mean() == 0.5
    # Tiles of different lattices have no mosaic.
    shifted = replace(two, grid=replace(two.grid, west=two.grid.west + 0.5))
    assert write_mosaics(copy, [one, shifted]) == []
    assert not [*copy.path.glob("*.vrt"), *copy.path.glob("*.qml")]


# --- the map of the states of tiles -------------------------------------------------------------------


def test_map_of_states_is_read_by_gdal(copy, tmp_path):
    one, two, three, four = (tile.id for tile in copy.catalog.tiles)
    states = [(one, "done"), (two, "cached"), (three, "failed"), (four, "pending")]
    figures = tuple(
        {"variant": name, "error_estimate_m": estimate, "flags": "patch" if name == "flexroad" else ""}
        for name, estimate in (("rgt", 9.0), ("flexroad", 0.25))
    )
    shutil.rmtree(copy.path / "tiles")
    (copy.path / NAME).unlink()
    with RunDatabase(copy.path / NAME, writable=True) as database:
        database.set_states(states)
        finished = "2026-11-21T02:00:00+00:00"
        database.record(TileRecord(one, "done", "f", figures, finished=finished, seconds=1.5))
        fault = Failure(three, "load", "TaskError", "no, file")
        database.record(TileRecord(three, "failed", "f", (), (fault,)))
        database.set_states(states)
    write_states(copy, tmp_path / "tiles.geojson")
    table = pyogrio.read_dataframe(tmp_path / "tiles.geojson")
    assert table.crs.to_epsg() == 4326
    assert table["id"].tolist() == [one, two, three, four]
    assert table.state.tolist() == ["done", "cached", "failed", "pending"]
    done, _, failed, pending = table.itertuples()
    # The error estimate is of the exported surface, not of the baselines.
    assert (done.error_estimate_m, done.flags, done.seconds) == (0.25, "patch", 1.5)
    assert done.finished.isoformat() == finished
    assert failed.error == "load: TaskError: no, file"
    assert table.loc[pending.Index, ["error", "seconds", "error_estimate_m", "finished"]].isna().all()
    crs = copy.catalog.tiles[0].grid.crs
    for tile, outline in zip(copy.catalog.tiles, table.to_crs(crs).geometry, strict=True):
        assert outline.bounds == pytest.approx(tile.grid.bounds, abs=0.02)
        assert outline.exterior.is_ccw
    write_states(replace(copy, catalog=Catalog(())), tmp_path / "tiles.geojson")
    assert pyogrio.read_info(tmp_path / "tiles.geojson")["features"] == 0


def test_outlines_of_several_crs_are_transformed(made_survey):
    one, two, *_ = Catalog.read(made_survey / "catalog.parquet").tiles
    other = replace(two, grid=replace(two.grid, crs="EPSG:32633"))
    rings = np.array([polygon.exterior.coords for polygon in outlines([one, other, one])])
    assert rings.shape == (3, 5, 2)
    assert np.array_equal(rings[0], rings[2])
    to_wgs84 = Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True)
    west, south, east, north = other.grid.bounds
    corners = (east, south), (east, north), (west, north), (west, south)
    expected = [to_wgs84.transform(*corner) for corner in corners]
    assert rings[1, :4] == pytest.approx(np.array(expected), abs=1e-7)
