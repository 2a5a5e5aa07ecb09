import gzip
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import box

from flexroad.catalog import CatalogError
from flexroad.catalog.sources.nrw import index, parse
from flexroad.tasks.load import Options, load
from tests.make_clouds import write_cloud
from tests.make_rasters import UTM, write, write_xyz
from tests.make_roads import write as write_roads

WEST, NORTH = 356000, 5700000


def heights(rows=500, columns=500):
    return np.random.default_rng(0).uniform(87, 168, (rows, columns)).astype(np.float32)


SQUARE = (356e3, 5699e3, 357e3, 5700e3)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("dom1_32_356_5699_1_nw_2020.tif", ("dsm", SQUARE, 2020)),
        ("dom1_32_356_5699_1_nw.xyz.gz", ("dsm", SQUARE, 0)),
        ("dgm1_32_280_5652_2_nw.xyz", ("dtm", (280e3, 5652e3, 282e3, 5654e3), 0)),
        ("dop10rgbi_32_356_5699_1_nw_2021.jp2", ("dop", SQUARE, 2021)),
        ("3dm_32_356_5699_1_nw.laz", (None, SQUARE, 0)),
        ("DGM1_32_356_5699_1_NW_2022.TIF", ("dtm", SQUARE, 2022)),
        ("dom1_32_356_5699_1_nw_2020.tif.aux.xml", None),
        ("dom1_33_356_5699_1_nw_2020.tif", None),
        ("dom1_32_356_5699_1_he_2020.tif", None),
        ("dom1_32_356_5699_1_nw_2020.csv", None),
        ("dom_356.tif", None),
    ],
)
def test_parse_name_gives_layer_square_and_year(name, expected):
    download = parse(Path("below") / name)
    assert (download and (download.layer, download.square, download.year)) == expected


@given(st.integers(100, 999), st.integers(1000, 9999), st.sampled_from(["dom1", "dgm1", "dop10rgbi", "3dm"]))
def test_parse_any_square_gives_its_bounds(east, north, product):
    download = parse(Path(f"{product}_32_{east}_{north}_1_nw_2019.tif"))
    assert download.square == (east * 1000, north * 1000, east * 1000 + 1000, north * 1000 + 1000)


def test_index_square_gives_tiles_of_250_m(tmp_path):
    """DSM as GeoTIFF, DTM as gzipped XYZ without a CRS, DOP as JP2 of four bands."""
    dom, dgm = heights(), heights() - 10
    write(tmp_path / "dom" / "dom1_32_356_5699_1_nw_2020.tif", dom, WEST, NORTH)
    plain = write_xyz(tmp_path / "dgm1_32_356_5699_1_nw.xyz", dgm, WEST, NORTH)
    Path(f"{plain}.gz").write_bytes(gzip.compress(plain.read_bytes()))
    plain.unlink()
    photo = tmp_path / "dop10rgbi_32_356_5699_1_nw_2021.jp2"
    write(photo, np.ones((500, 500), np.uint8), WEST, NORTH, driver="JP2OpenJPEG", count=4)
    (tmp_path / "dom" / "dom1_nw.csv").write_text("metadata")
    before = sorted(tmp_path.rglob("*"))
    result = index(tmp_path)
    assert [tile.id for tile in result.tiles] == [
        "356000_5699500", "356000_5699750", "356250_5699500", "356250_5699750",
    ]  # fmt: skip
    assert result.notes == ()
    tile = result.tiles[1]
    assert (tile.datetime, tile.datetime_assumed) == (datetime(2020, 1, 1, tzinfo=UTC), False)
    assert (tile.dataset, tile.grid.crs) == ("Geobasis NRW", UTM)
    assert [(layer.name, layer.files, layer.crs) for layer in tile.layers] == [
        ("dsm", ("dom/dom1_32_356_5699_1_nw_2020.tif",), None),
        ("dtm", ("dgm1_32_356_5699_1_nw.xyz.gz",), UTM),
        ("dop", ("dop10rgbi_32_356_5699_1_nw_2021.jp2",), None),
    ]
    data = load(tile, Options())
    assert data.notes == ("the DSM lies 10.0 m above the DTM: ellipsoidal heights?",)
    assert np.array_equal(data.dsm, dom[:250, :250].astype(np.float64))
    assert np.allclose(data.dtm, dgm[:250, :250], atol=0.0051)
    assert sorted(tmp_path.rglob("*")) == before


def test_index_date_tag_in_year_of_name_is_used(tmp_path):
    square = np.zeros((250, 250), np.float32)
    name = "dom1_32_356_5699_1_nw_2020.tif"
    write(tmp_path / name, square, WEST, NORTH, tags={"TIFFTAG_DATETIME": "2020:03:07 00:00:00"})
    assert index(tmp_path).tiles[0].datetime == datetime(2020, 3, 7, tzinfo=UTC)
    write(tmp_path / name, square, WEST, NORTH, tags={"TIFFTAG_DATETIME": "2023:03:07 00:00:00"})
    assert index(tmp_path).tiles[0].datetime == datetime(2020, 1, 1, tzinfo=UTC)
    assert index(tmp_path, date=datetime(2019, 5, 1)).tiles[0].datetime == datetime(2019, 5, 1, tzinfo=UTC)


def test_index_unusable_files_are_left_out(tmp_path):
    write(tmp_path / "dom1_32_356_5699_1_nw_2020.tif", heights(250, 250), WEST, NORTH)
    write(tmp_path / "dom1_32_400_5699_1_nw_2020.tif", heights(250, 250), WEST, NORTH)
    (tmp_path / "dgm1_32_356_5699_1_nw_2020.tif").write_bytes(b"cut short")
    (tmp_path / "3dm_32_356_5699_1_nw.laz").write_bytes(b"points")
    result = index(tmp_path)
    assert result.notes == (
        "point clouds were not read, so the reference lacks the bridges in 3dm_32_356_5699_1_nw.laz",
        "no dgm1 file under 356000_5699750: these tiles will fail; download the terrain model as well",
    )
    assert result.left_out == (
        "skipped dom1_32_400_5699_1_nw_2020.tif (dsm): its centre 356125 5699875 in EPSG:25832 "
        "does not match its name; download it again",
        "skipped dgm1_32_356_5699_1_nw_2020.tif (dtm): not a raster that GDAL can read",
    )
    assert result.tiles[0].layer("dsm").files == ("dom1_32_356_5699_1_nw_2020.tif",)


def test_index_road_mask_and_roads_add_layers(tmp_path):
    write(tmp_path / "dom1_32_356_5699_1_nw_2020.tif", heights(250, 250), WEST, NORTH)
    write(tmp_path / "atkis.tif", np.full((250, 250), 3, np.uint8), WEST, NORTH)
    mask = index(tmp_path, road_mask="atkis.tif", road_values=(3, 4)).tiles[0].layer("road_mask")
    assert (mask.files, mask.values) == (("atkis.tif",), (3, 4))
    write_roads(tmp_path / "r.gpkg", [box(WEST, NORTH - 200, WEST + 100, NORTH - 100)], UTM)
    assert index(tmp_path, roads="r.gpkg").tiles[0].layer("roads").files == ("r.gpkg",)
    with pytest.raises(CatalogError, match="no file matches --road-mask 'osm.tif'"):
        index(tmp_path, road_mask="osm.tif")


def test_index_folder_without_dsm_raises_error(tmp_path):
    with pytest.raises(CatalogError, match=r"no usable dom1_32_E_N_1_nw\*.tif.*the folder is empty"):
        index(tmp_path)
    (tmp_path / "dom.tif").write_bytes(b"x")
    with pytest.raises(CatalogError, match="there are dom.tif"):
        index(tmp_path)
    with pytest.raises(CatalogError, match="nowhere does not exist"):
        index(tmp_path / "nowhere")


def test_index_bridge_points_extend_reference(tmp_path):
    """The reference is the DTM with the newest mean of class 17 per cell; the DTM itself does not change."""
    root, derived = tmp_path / "nrw", tmp_path / "derived"
    dgm = heights(250, 250)
    write(root / "dom1_32_356_5699_1_nw_2020.tif", dgm + 5, WEST, NORTH)
    write(root / "dgm1_32_356_5699_1_nw_2020.tif", dgm, WEST, NORTH)
    x = WEST + np.array([10.2, 10.8, 20.5, 30.5])
    y = NORTH - np.array([5.5, 5.5, 7.5, 8.5])
    points = np.stack([x, y, [200.0, 201.0, 202.0, 203.0]], axis=1)
    write_cloud(root / "3dm_32_356_5699_1_nw.laz", points + np.array([0, 0, 9]), [17, 17, 2, 17])
    write_cloud(root / "3dm_32_356_5699_1_nw_2022.laz", points, [17, 17, 2, 17])
    result = index(root, derived=derived)
    assert result.notes == ()
    (tile,) = result.tiles
    raster = derived / "3dm_32_356_5699_1_nw_2022_bridges.tif"
    assert tile.layer("bridges").files == (str(raster), str(derived / "3dm_32_356_5699_1_nw_bridges.tif"))
    data = load(tile, Options())
    truth = dgm.astype(np.float64)
    truth[5, 10], truth[8, 30] = 200.5, 203.0
    assert np.allclose(data.reference, truth, atol=1e-5)
    assert np.array_equal(data.dtm, dgm)
    before = raster.stat().st_mtime_ns
    index(root, derived=derived)
    assert raster.stat().st_mtime_ns == before


def test_index_cloud_without_bridges_or_broken_keeps_tile(tmp_path):
    write(tmp_path / "dom1_32_356_5699_1_nw_2020.tif", heights(250, 250), WEST, NORTH)
    write(tmp_path / "dgm1_32_356_5699_1_nw_2020.tif", heights(250, 250), WEST, NORTH)
    write_cloud(tmp_path / "3dm_32_356_5699_1_nw_2020.laz", [WEST + 1.0, NORTH - 1.0, 100.0], 2)
    bad = tmp_path / "3dm_32_356_5699_1_nw_2021.laz"
    bad.write_bytes(b"points")
    result = index(tmp_path, derived=tmp_path / "derived")
    (line,) = result.left_out
    assert line.startswith(f"skipped {bad} cannot be read as a point cloud: ")
    (tile,) = result.tiles
    assert tile.layer("bridges") is None
    assert load(tile, Options()).reference is None
