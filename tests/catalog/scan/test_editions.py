"""Two years of a sheet in one folder: the newest by name, tags or time is used, with a note."""

import os

import numpy as np
import pytest

from flexroad.catalog import CatalogError
from flexroad.catalog.sources.rasters import index
from flexroad.tasks.load import Options, load
from tests.make_rasters import write

WEST, NORTH = 500_000.0, 5_600_060.0
PLANE = np.tile(100 + 0.02 * np.arange(60, dtype=np.float32), (60, 1))


def catalog(root, dsm="dsm/**/*.tif"):
    write(root / "dtm.tif", PLANE, WEST, NORTH)
    return index(root, {"dsm": dsm, "dtm": "dtm.tif"}, tile_size_m=20)


def edition(path, above=0.0, days=0, **more):
    """Write the plane, ``above`` m higher, with a time ``days`` after a fixed one."""
    write(path, PLANE + np.float32(above), WEST, NORTH, **more)
    os.utime(path, (1.7e9 + 86_400 * days,) * 2)
    return path


def used(result):
    """Return how far the surface of the tile in the middle is above the plane."""
    tile = result.tiles[4]
    data = load(tile, Options())
    return float(np.median(data.dsm - data.dtm))


def of_editions(result):
    return [note for note in result.notes if "same ground" in note]


@pytest.mark.parametrize(
    ("older", "newer"),
    [
        ("a_2016", "b_2022"),
        ("b_2016", "a_2022"),
        ("x_20220301", "x_20220401"),
        ("x_2022-03", "x_2022-04"),
        ("2016/sheet", "2022/sheet"),
        ("x_15.01.2022", "x_03.12.2022"),
        ("sheet_356_2021_2016", "sheet_356_2021_2022"),
    ],
)
def test_newest_by_the_date_in_the_name_is_used(tmp_path, older, newer):
    """Although the time of the older file is later."""
    edition(tmp_path / "dsm" / f"{older}.tif", 0.5, days=100)
    edition(tmp_path / "dsm" / f"{newer}.tif")
    result = catalog(tmp_path)
    assert used(result) == 0
    assert of_editions(result) == [
        "dsm: 1 pair of files cover the same ground; by the dates in their names, "
        f"dsm/{newer}.tif is used before dsm/{older}.tif, and their heights differ by -0.50 in the median, "
        "by more than 0.05 in 100% of the cells"
    ]


@pytest.mark.parametrize(("tagged", "what"), [(True, "in their tags"), (False, "of the files")])
def test_newest_by_tag_or_else_by_time_is_used_if_names_do_not_tell(tmp_path, tagged, what):
    older, newer = ({"tags": {"ACQUISITIONDATE": f"{year}-05-01"}} if tagged else {} for year in (2016, 2022))
    edition(tmp_path / "dsm" / "a.tif", 0.5, days=100 if tagged else 0, **older)
    edition(tmp_path / "dsm" / "b.tif", days=2, **newer)
    result = catalog(tmp_path)
    assert used(result) == 0
    assert f"by the dates {what}, dsm/b.tif is used before dsm/a.tif" in of_editions(result)[0]
    assert result.tiles[0].datetime.year == (2022 if tagged else 2023)


def test_files_of_unknown_age_that_differ_are_refused(tmp_path):
    edition(tmp_path / "dsm" / "a.tif", 0.5)
    edition(tmp_path / "dsm" / "b.tif")
    with pytest.raises(CatalogError) as error:
        catalog(tmp_path)
    assert str(error.value) == (
        "dsm: dsm/a.tif and dsm/b.tif cover the same ground, their heights differ by 0.50 in the median, "
        "by more than 0.05 in 100% of the cells, and no date in their names, tags or times tells which is "
        "newer; leave one out, or write the year into their names"
    )
    # Equal ones are used without a word.
    edition(tmp_path / "dsm" / "a.tif")
    assert of_editions(catalog(tmp_path)) == []


def test_older_edition_fills_the_voids_of_the_newest(tmp_path):
    newest = edition(tmp_path / "dsm" / "x_2022.tif")
    values = PLANE.copy()
    values[:, :30] = -9999
    write(newest, values, WEST, NORTH, nodata=-9999)
    edition(tmp_path / "dsm" / "x_2016.tif", 0.5)
    tile = catalog(tmp_path).tiles[4]
    above = load(tile, Options()).dsm - load(tile, Options()).dtm
    np.testing.assert_allclose(above[:, :10], 0.5, atol=1e-4)
    np.testing.assert_array_equal(above[:, 10:], 0)


def test_each_sheet_of_three_years_is_in_the_order_of_its_years(tmp_path):
    for year in (2019, 2022, 2016):
        for number in range(2):
            write(tmp_path / f"dsm/{year}/{number}.tif", PLANE, WEST + 60 * number, NORTH)
    write(tmp_path / "dtm.tif", np.tile(PLANE, (1, 2)), WEST, NORTH)
    tile = index(tmp_path, {"dsm": "dsm/**/*.tif", "dtm": "dtm.tif"}, tile_size_m=60).tiles[-1]
    for number in range(2):
        own = [name for name in tile.layer("dsm").files if name.endswith(f"{number}.tif")]
        assert own == [f"dsm/{year}/{number}.tif" for year in (2022, 2019, 2016)]


def test_sheets_side_by_side_are_no_editions(tmp_path):
    """They overlap by a rim of 5 cells, and keep their order."""
    edition(tmp_path / "dsm" / "b_2016.tif")
    write(tmp_path / "dsm" / "a_2015.tif", PLANE + 9, WEST + 55, NORTH)
    result = catalog(tmp_path)
    assert of_editions(result) == []
    layers = [tile.layer("dsm") for tile in result.tiles]
    assert {layer.files for layer in layers} == {("dsm/a_2015.tif", "dsm/b_2016.tif")}


def test_masks_of_two_years_use_the_newest(tmp_path):
    edition(tmp_path / "dsm" / "a.tif")
    for year, road in ((2016, 0), (2022, 1)):
        write(tmp_path / f"mask_{year}.tif", np.full((60, 60), road, np.uint8), WEST, NORTH)
    patterns = {"dsm": "dsm/a.tif", "dtm": "dsm/a.tif", "road_mask": "mask_*.tif"}
    result = index(tmp_path, patterns, tile_size_m=20)
    assert load(result.tiles[4], Options()).road_mask.all()
    assert of_editions(result) == [
        "road_mask: 1 pair of files cover the same ground; by the dates in their names, mask_2022.tif is "
        "used before mask_2016.tif"
    ]
