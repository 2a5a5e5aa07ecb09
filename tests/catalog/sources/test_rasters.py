import os
from datetime import UTC, datetime
from itertools import combinations

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS

from flexroad.catalog import CatalogError, Grid
from flexroad.catalog.scan.rasters import date_of
from flexroad.catalog.sources import nrw
from flexroad.catalog.sources.rasters import index
from tests.make_rasters import UTM, write, write_xyz

FLAT = np.full((250, 250), 100, dtype=np.float32)
"""One tile of the paper's size."""


def ids(indexed):
    return [tile.id for tile in indexed.tiles]


def files(indexed, layer="dsm"):
    return [tile.layer(layer).files if tile.layer(layer) else None for tile in indexed.tiles]


def test_index_file_of_a_kilometre_gives_sixteen_tiles(tmp_path):
    write(tmp_path / "dom" / "a.tif", np.ones((1000, 1000), np.float32), 356000, 5700000)
    result = index(tmp_path, {"dsm": "dom/*.tif"}, date=datetime(2020, 5, 1))
    assert len(result.tiles) == 16
    assert ids(result)[0] == "356000_5699000"
    assert ids(result)[-1] == "356750_5699750"
    assert result.tiles[0].grid.bounds == (356000, 5699000, 356250, 5699250)
    assert result.tiles[0].grid.crs == UTM
    assert set(files(result)) == {("dom/a.tif",)}
    assert result.tiles[0].root == str(tmp_path.resolve())
    assert result.notes == ()


def test_voids_in_heights_and_other_values_of_masks_are_noted(tmp_path):
    heights = np.arange(6400.0).reshape(80, 80)
    heights[:8] = -9999
    for name, values in (("dsm", heights), ("road_mask", np.full((80, 80), 5, np.uint8))):
        write(tmp_path / f"{name}.tif", values)
    layers = {"dsm": "dsm.tif", "road_mask": "road_mask.tif", "reference_road": "road_mask.tif"}
    result = index(tmp_path, layers, road_values=(99,), tile_size_m=40)
    values = [(layer.name, layer.values) for layer in result.tiles[0].layers]
    assert values == [("dsm", ()), ("road_mask", (99,)), ("reference_road", (99,))]
    for start in (
        "dsm: many cells have the exact height -9999: dsm.tif (10.0%); if they are voids",
        "road_mask: no cell has --road-value 99 but 5, in the parts read of road_mask.tif",
    ):
        assert any(note.startswith(start) for note in result.notes)


def test_tile_lists_every_file_in_reach(tmp_path):
    """Four files meet in the middle of a tile; a file 190 m away is in reach, one 210 m away is not."""
    for name, west, north in [("d", 0, 300), ("c", 125, 300), ("b", 0, 125), ("a", 125, 125)]:
        write(tmp_path / f"{name}.tif", np.ones((175, 125), np.float32), west, north)
    write(tmp_path / "near.tif", np.ones((5, 5), np.float32), 440, 100)
    write(tmp_path / "off.tif", np.ones((5, 5), np.float32), 460, 100)
    result = index(tmp_path, {"dsm": "*.tif"}, min_cover=0.5)
    assert dict(zip(ids(result), files(result), strict=True)) == {
        "0_0": ("a.tif", "b.tif", "c.tif", "d.tif", "near.tif")
    }


@pytest.mark.parametrize(
    ("pattern", "file"),
    [
        ("{}/heights/dt*.tif", "{}/heights/dtm.tif"),
        ("../heights/dtm.tif", "{}/heights/dtm.tif"),
        ("../data/../heights/*.tif", "{}/heights/dtm.tif"),
        ("{}/data/dsm/*.tif", "dsm/a.tif"),
        ("../data/dsm/a.tif", "dsm/a.tif"),
        ("dsm/../dsm/a.tif", "dsm/a.tif"),
    ],
)
def test_pattern_gives_full_names_outside_root_and_relative_ones_in_it(tmp_path, pattern, file):
    write(tmp_path / "data" / "dsm" / "a.tif", FLAT)
    write(tmp_path / "heights" / "dtm.tif", FLAT)
    result = index(tmp_path / "data", {"dsm": pattern.format(tmp_path)})
    assert files(result) == [(file.format(tmp_path),)]


def test_file_only_in_halo_is_a_layer_nearby(tmp_path):
    write(tmp_path / "dsm.tif", FLAT)
    write(tmp_path / "dtm.tif", FLAT, west=295750)
    (tile,) = index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm.tif"}).tiles
    assert tile.layer("dtm") is None
    (dtm,) = tile.nearby
    assert (dtm.name, dtm.files, dtm.extents) == ("dtm", ("dtm.tif",), ((295750, 5629250, 296000, 5629500),))


def test_ground_along_a_border_has_the_same_files_from_both_sides(tmp_path):
    """Four tiles; of the photo only the east is there, and only the mask of the west lacks a CRS."""
    write(tmp_path / "dsm" / "west.tif", np.ones((500, 300), np.float32))
    write(tmp_path / "dsm" / "east.tif", np.ones((500, 200), np.float32), west=295800)
    write(tmp_path / "dop.tif", np.ones((500, 300), np.uint8), west=295800)
    write(tmp_path / "mask" / "west.tif", np.ones((500, 10), np.uint8), crs=None)
    write(tmp_path / "mask" / "east.tif", np.ones((500, 390), np.uint8), west=295610)
    layers = {"dsm": "dsm/*.tif", "dop": "dop.tif", "road_mask": "mask/*.tif"}
    result = index(tmp_path, layers, road_values=(3,), crs=UTM)
    tiles = result.tiles
    assert ids(result) == ["295500_5629000", "295500_5629250", "295750_5629000", "295750_5629250"]
    for first, second in combinations(tiles, 2):
        for column, row in ((295740, 5629250), (295760, 5629260), (295700, 5629300)):
            strip = Grid(UTM, column, row, 1.0, 20, 20)
            reach = strip.buffered(56).bounds
            assert first.around(strip, reach).layers == second.around(strip, reach).layers
    (dsm, dop, mask) = (
        tiles[0].around(Grid(UTM, 295740.0, 5629260.0, 1.0, 20, 20), (295700, 0, 295810, 1e7)).layers
    )
    assert (dsm.files, dop.files) == (("dsm/west.tif",), ("dop.tif",))
    assert (mask.files, mask.values, mask.crs) == (("mask/east.tif",), (3,), UTM)


def test_newest_file_stays_first_on_ground_along_a_border(tmp_path):
    for year in (2018, 2020):
        heights = np.full((500, 500), year - 2000, np.float32)
        write(tmp_path / f"dom1_32_295_5629_1_nw_{year}.tif", heights)
    result = nrw.index(tmp_path, min_cover=0)
    assert result.tiles[0].datetime.year == 2020
    assert [note.partition(";")[0] for note in result.notes if "same ground" in note] == [
        "dsm: 1 pair of files cover the same ground"
    ]
    strip = Grid(UTM, 295740.0, 5629260.0, 1.0, 20, 20)
    (dsm,) = result.tiles[0].around(strip, (0, 0, 1, 1)).layers
    assert dsm.files == ("dom1_32_295_5629_1_nw_2020.tif", "dom1_32_295_5629_1_nw_2018.tif")


def test_tiles_below_min_cover_are_left_out_with_note(tmp_path):
    write(tmp_path / "a.tif", np.ones((250, 300), np.float32))
    result = index(tmp_path, {"dsm": "a.tif"})
    assert ids(result) == ["295500_5629250"]
    (note,) = (note for note in result.notes if note.startswith("left out"))
    assert note == (
        "left out 1 tile with a DSM height in less than 25% of the cells (--min-cover 0 keeps them): "
        "295750_5629250"
    )
    assert len(index(tmp_path, {"dsm": "a.tif"}, min_cover=0).tiles) == 2
    # Overlapping files count once.
    for name in ("a.tif", "b.tif"):
        write(tmp_path / name, FLAT[:, :100])
    with pytest.raises(CatalogError, match=r"no tile is left: .*--min-cover 0 keeps"):
        index(tmp_path, {"dsm": "*.tif"}, min_cover=0.5)
    assert len(index(tmp_path, {"dsm": "*.tif"}, min_cover=0.4).tiles) == 1


@pytest.mark.parametrize("declared", [-9999.0, None])
def test_cover_counts_cells_with_heights_and_not_extents(declared, tmp_path):
    heights = np.full((250, 750), -9999.0, np.float32)
    heights[:, :250] = heights[:50, 250:500] = 7
    write(tmp_path / "a.tif", heights, nodata=declared)
    result = index(tmp_path, {"dsm": "a.tif"})
    assert ids(result) == ["295500_5629250"]
    assert [note.partition(" (")[0] for note in result.notes if note.startswith("left out")] == [
        "left out 1 tile with a DSM height in less than 25% of the cells",
        "left out 1 tile where the DSM has only nodata: 296000_5629250",
    ]
    result = index(tmp_path, {"dsm": "a.tif"}, min_cover=0.1)
    assert len(result.tiles) == 2
    (note,) = (note for note in result.notes if "will fail" in note)
    assert note.startswith("1 tile with a DSM height in less than 25%")
    assert note.endswith("load: {min_valid: 0.1}: 295750_5629250")
    write(tmp_path / "a.tif", heights[:, 500:], nodata=declared)
    with pytest.raises(CatalogError, match="no tile is left: left out 1 tile where the DSM has only nodata"):
        index(tmp_path, {"dsm": "a.tif"})


@settings(max_examples=25)
@given(
    west=st.integers(-300, 300),
    north=st.integers(-300, 300),
    width=st.integers(1, 600),
    height=st.integers(1, 600),
    cut=st.floats(0, 1),
)
def test_tiles_do_not_depend_on_file_boundaries(tmp_path_factory, west, north, width, height, cut):
    """Each cell of the survey lies in one tile, and splitting the file in two changes no tile."""
    root = tmp_path_factory.mktemp("cut")
    values = np.ones((height, width), np.uint8)
    write(root / "whole" / "a.tif", values, west, north)
    at = round(cut * width)
    if at > 0:
        write(root / "halves" / "a.tif", values[:, :at], west, north)
    if at < width:
        write(root / "halves" / "b.tif", values[:, at:], west + at, north)
    whole = index(root / "whole", {"dsm": "*.tif"}, min_cover=0).tiles
    halves = index(root / "halves", {"dsm": "*.tif"}, min_cover=0).tiles
    assert [t.id for t in whole] == [t.id for t in halves]
    assert len({t.id for t in whole}) == len(whole)
    touched = {
        (250 * int(e // 250), 250 * int(n // 250))
        for e in {west, west + width - 1, *range(west, west + width, 250)}
        for n in {north - 1, north - height, *range(north - height, north, 250)}
    }
    assert {t.grid.bounds[:2] for t in whole} == touched


def test_cell_size_is_rounded(tmp_path):
    write(tmp_path / "a.tif", FLAT, cell=0.99999999)
    (tile,) = index(tmp_path, {"dsm": "a.tif"}).tiles
    assert tile.grid.cell == 1.0
    assert tile.grid.shape == (250, 250)


def test_index_reads_ascii_grid_and_xyz(tmp_path):
    write(tmp_path / "a.asc", FLAT, driver="AAIGrid", crs=None)
    write_xyz(tmp_path / "down.xyz", FLAT[:20, :30], 295500, 5629500)
    write_xyz(tmp_path / "up.xyz", FLAT[:20, :30], 295500, 5629500, northward=True)
    for name in ("a.asc", "down.xyz", "up.xyz"):
        (tile,) = index(tmp_path, {"dsm": name}, crs=UTM, min_cover=0).tiles
        assert (tile.id, tile.grid.cell) == ("295500_5629250", 1.0), name


def test_file_without_crs_needs_option(tmp_path):
    write(tmp_path / "dsm.tif", FLAT)
    write(tmp_path / "dtm.asc", FLAT, driver="AAIGrid", crs=None)
    layers = {"dsm": "dsm.tif", "dtm": "dtm.asc"}
    with pytest.raises(CatalogError, match=r"skipped dtm.asc \(dtm\): it has no CRS; give it with --crs"):
        index(tmp_path, layers)
    (tile,) = index(tmp_path, layers, crs=UTM).tiles
    assert [layer.crs for layer in tile.layers] == [None, UTM]


def test_crs_without_code_is_stored_as_wkt_and_a_compound_one_in_plan(tmp_path):
    own = CRS("+proj=tmerc +lat_0=51 +lon_0=6.1 +x_0=300000 +y_0=5600000 +ellps=GRS80 +units=m")
    write(tmp_path / "a.tif", FLAT, crs=own.to_wkt())
    (tile,) = index(tmp_path, {"dsm": "a.tif"}).tiles
    assert CRS.from_user_input(tile.grid.crs).equals(own, ignore_axis_order=True)
    write(tmp_path / "a.tif", FLAT, crs="EPSG:5555")
    assert index(tmp_path, {"dsm": "a.tif"}).tiles[0].grid.crs == UTM


def test_index_broken_file_is_left_out_with_line(tmp_path):
    write(tmp_path / "dsm" / "good.tif", FLAT)
    (tmp_path / "dsm" / "broken.tif").write_bytes(b"no raster at all")
    turned = Affine.translation(295500, 5629500) @ Affine.rotation(10) @ Affine.scale(1, -1)
    write(tmp_path / "dsm" / "turned.tif", FLAT, transform=turned)
    write(
        tmp_path / "dsm" / "bare.png",
        FLAT.astype(np.uint8),
        driver="PNG",
        crs=None,
        transform=Affine.identity(),
    )
    result = index(tmp_path, {"dsm": "dsm/*.[tp][in][fg]"})
    assert files(result) == [("dsm/good.tif",)]
    assert result.left_out == (
        "skipped dsm/bare.png (dsm): no georeference; give it a world file or `gdal_translate -a_ullr`",
        "skipped dsm/broken.tif (dsm): not a raster that GDAL can read",
        "skipped dsm/turned.tif (dsm): a rotated raster; turn it north up with gdalwarp",
    )
    with pytest.raises(CatalogError, match="no usable file .* skipped dsm/broken.tif"):
        index(tmp_path, {"dsm": "dsm/broken.tif"})


def test_tile_date_from_tag_file_time_or_option(tmp_path):
    write(tmp_path / "a.tif", FLAT, tags={"TIFFTAG_DATETIME": "2020:05:01 10:30:00"})
    write(tmp_path / "b.tif", FLAT, west=295750)
    os.utime(tmp_path / "b.tif", (0, 0))
    write(tmp_path / "c.tif", FLAT, west=296000, tags={"TIFFTAG_DATETIME": "2022:01:01 00:00:00"})
    with rasterio.open(tmp_path / "c.tif", "r+") as dst:
        dst.update_tags(ns="IMAGERY", ACQUISITIONDATETIME="2020-05-01 10:30:00")
    result = index(tmp_path, {"dsm": "*.tif"})
    assert [(t.datetime, t.datetime_assumed) for t in result.tiles] == [
        (datetime(2020, 5, 1, 10, 30, tzinfo=UTC), False),
        (datetime(1970, 1, 1, tzinfo=UTC), True),
        (datetime(2020, 5, 1, 10, 30, tzinfo=UTC), False),
    ]
    assert result.notes == (
        "no date in the dsm of 1 tile: the files' times are used instead (--date sets it)",
    )
    dated = index(tmp_path, {"dsm": "*.tif"}, date=datetime(2019, 3, 4))
    assert {(t.datetime, t.datetime_assumed) for t in dated.tiles} == {
        (datetime(2019, 3, 4, tzinfo=UTC), False)
    }


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"ACQUISITIONDATE": "2020-05-01"}, "2020-05-01"),
        ({"ACQUISITION_DATE": "20200501", "TIFFTAG_DATETIME": "2022:01:01 00:00:00"}, "2020-05-01"),
        ({"ACQUISITIONDATE": "spring", "TIFFTAG_DATETIME": "2022:01:01 00:00:00"}, "2022-01-01"),
        ({"TIFFTAG_DATETIME": "0000:00:00 00:00:00"}, None),
        ({}, None),
    ],
)
def test_date_of_a_raster_is_that_of_its_tags(tags, expected):
    date = date_of(tags)
    assert (date and f"{date:%Y-%m-%d}") == expected


@pytest.mark.parametrize(
    ("patterns", "message"),
    [
        ({"road_mask": "*.png"}, r"no file matches --road-mask '\*.png' .*; there are dom/a.tif"),
        ({"dtm": "{}/no/*.tif"}, "below {}/no; the folder does not exist$"),
        ({"dtm": "../data/no*.tif"}, "below {}/data; there are dom/a.tif$"),
        ({"dtm": "{}/heights/no.tif"}, "below {}/heights; there are dtm.tif$"),
        ({"dsm": "dom/**.tif"}, "is no pattern below"),
        ({"dom": "*"}, "unknown layer 'dom'"),
        ({"dsm": "", "dtm": "dom/*.tif"}, "--dsm"),
    ],
)
def test_index_wrong_pattern_or_layer_raises_error(tmp_path, patterns, message):
    write(tmp_path / "data" / "dom" / "a.tif", FLAT)
    write(tmp_path / "heights" / "dtm.tif", FLAT)
    given = {"dsm": "dom/*.tif"} | patterns
    patterns = {name: text.format(tmp_path) for name, text in given.items() if text}
    with pytest.raises(CatalogError, match=message.format(tmp_path)):
        index(tmp_path / "data", patterns)


def test_index_wrong_folder_or_size_raises_error(tmp_path):
    with pytest.raises(CatalogError, match="nowhere does not exist"):
        index(tmp_path / "nowhere", {"dsm": "*"})
    write(tmp_path / "a.tif", FLAT)
    with pytest.raises(CatalogError, match="whole number"):
        index(tmp_path, {"dsm": "a.tif"}, tile_size_m=250.5)
