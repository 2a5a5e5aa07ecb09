"""Four adjacent tiles that list each other's files: what a fault of one file costs, and its message."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.warp import transform_bounds

from flexroad.catalog.borders import border_of
from flexroad.catalog.sources import rasters
from flexroad.catalog.storage.paths import parse_location
from flexroad.tasks import TaskError
from flexroad.tasks.io.mosaic import SourceFile
from flexroad.tasks.load import Options, load, load_border
from tests.make_rasters import UTM, write

SIZE = 60
WEST, NORTH = 295500.0, 5629500.0
FIRST = "295500_5629440"
"""The tile in the north-west."""


def relief(seed=0):
    return np.random.default_rng(seed).uniform(100, 130, (SIZE, SIZE))


@pytest.fixture
def survey(tmp_path):
    """Return the tiles by id; ``nw.tif`` and so on hold one tile each."""
    corners = {"nw": (0, 0), "ne": (1, 0), "sw": (0, 1), "se": (1, 1)}
    for name, (col, row) in corners.items():
        for layer in ("dsm", "dtm"):
            write(tmp_path / layer / f"{name}.tif", relief(), WEST + SIZE * col, NORTH - SIZE * row)
    patterns = {"dsm": "dsm/*.tif", "dtm": "dtm/*.tif"}
    tiles = rasters.index(tmp_path, patterns, tile_size_m=SIZE).tiles
    assert len(tiles) == 4
    assert all(len(layer.files) == 4 for tile in tiles for layer in tile.layers)
    return {tile.id: tile for tile in tiles}


def message(tile, options=None):
    with pytest.raises(TaskError) as caught:
        load(tile, options or Options())
    assert "\n" not in str(caught.value)
    return str(caught.value), caught.value.file


def two_bands(path):
    with rasterio.open(path, "w", driver="GTiff", count=2, dtype="float32", width=SIZE, height=SIZE, crs=UTM,
                       transform=Affine(1, 0, WEST, 0, -1, NORTH)) as raster:  # fmt: skip
        raster.write(np.ones((2, SIZE, SIZE), np.float32))


def turned(path):
    turn = Affine.translation(WEST, NORTH) @ Affine.rotation(30) @ Affine.scale(1, -1)
    write(path, relief(), transform=turn)


def other_crs(path):
    bounds = transform_bounds(UTM, "EPSG:25833", WEST, NORTH - SIZE, WEST + SIZE, NORTH)
    write(path, relief(), bounds[0], bounds[3], crs="EPSG:25833")


FAULTS = [
    (lambda path: write(path, relief(), WEST, NORTH, crs=None), "has no CRS; build the catalog again"),
    (turned, "is rotated; turn it north up"),
    (two_bands, "has 2 bands"),
    (lambda path: write(path, relief().astype(np.complex64), WEST, NORTH), "has complex numbers"),
    (lambda path: write(path, relief(), WEST, NORTH, unit="fathom"), "has the unit 'fathom'"),
    (other_crs, "is in EPSG:25833, the tile in EPSG:25832"),
    (lambda path: write(path, relief(), WEST, NORTH, crs="EPSG:2994"), "does not reach the tile now"),
    (lambda path: write(path, relief(), WEST + 5000, NORTH), "does not reach the tile now"),
    (lambda path: path.write_bytes(b""), "cannot be read"),
    (lambda path: None, "is missing"),
]
NAMES = ["bare", "turned", "bands", "complex", "fathoms", "other_crs", "feet", "moved", "empty", "missing"]


@pytest.mark.parametrize(("damage", "fault"), FAULTS, ids=NAMES)
@pytest.mark.parametrize("halo_m", [0, 20])
def test_file_that_cannot_be_used_fails_only_its_tile(damage, fault, halo_m, survey, tmp_path):
    path = tmp_path / "dsm" / "nw.tif"
    path.unlink()
    damage(path)
    options = Options(halo_m=halo_m)
    for tile_id, tile in survey.items():
        if tile_id != FIRST:
            loaded = load(tile, options)
            assert np.isfinite(loaded.dsm[loaded.grid.window(loaded.core)]).all()
            continue
        text, file = message(tile, options)
        assert text.startswith(f"dsm dsm/nw.tif {fault}")
        assert file == str(path)


def test_file_left_out_is_noted(survey, tmp_path):
    two_bands(tmp_path / "dsm" / "nw.tif")
    del survey[FIRST]
    for tile in survey.values():
        notes = load(tile, Options(halo_m=20)).notes
        assert [note.partition(":")[0] for note in notes] == [
            "a file that the tile does not need was left out"
        ]


@pytest.mark.parametrize(("damage", "fault"), FAULTS, ids=NAMES)
def test_border_is_the_same_for_all_tiles_that_share_it(damage, fault, survey, tmp_path):
    path = tmp_path / "dsm" / "nw.tif"
    path.unlink()
    damage(path)
    seen = {}
    for tile in survey.values():
        for border in border_of(tile.grid, 30):
            ground = load_border(tile.around(border.grid, border.within(200)), tile.grid, Options())
            first = seen.setdefault(border.grid, ground)
            np.testing.assert_array_equal(ground.dsm, first.dsm)
    assert len(seen) < 8 * len(survey)


def test_file_without_georeference_lies_at_its_extent(survey, tmp_path):
    """Tiles of the same size list it, too, and must not take it for theirs."""
    (tmp_path / "dsm" / "nw.tif").unlink()
    heights = relief(seed=3)
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        write(tmp_path / "dsm" / "nw.tif", heights, crs=None, transform=Affine.identity())
    np.testing.assert_array_equal(load(survey[FIRST], Options()).dsm, heights)
    east = load(survey["295560_5629440"], Options(halo_m=10))
    np.testing.assert_array_equal(east.dsm[10:70, :10], heights[:, -10:])


def test_moved_file_names_its_place_and_the_remedy(survey, tmp_path):
    write(tmp_path / "dtm" / "nw.tif", relief(), WEST + 5000, NORTH)
    text, file = message(survey[FIRST], Options(halo_m=20))
    assert text == (
        "dtm dtm/nw.tif does not reach the tile now: it lies at 300500 5629440 300560 5629500 in EPSG:25832, "
        "elsewhere than the catalog says; build the catalog again"
    )
    assert file == str(tmp_path / "dtm" / "nw.tif")


def test_file_moved_into_the_halo_does_not_reach_its_tile(survey, tmp_path):
    write(tmp_path / "dsm" / "nw.tif", relief(), WEST - SIZE, NORTH)
    assert "dsm dsm/nw.tif does not reach the tile now" in message(survey[FIRST], Options(halo_m=20))[0]


@pytest.mark.parametrize("tile_id", ["295500_5629380", "295560_5629380", "295560_5629440", FIRST])
def test_tile_of_nodata_names_the_file_on_the_tile(tile_id, survey, tmp_path):
    name = {"295500_5629380": "sw", "295560_5629380": "se", "295560_5629440": "ne", FIRST: "nw"}[tile_id]
    path, bounds = tmp_path / "dsm" / f"{name}.tif", survey[tile_id].grid.bounds
    write(path, np.full((SIZE, SIZE), np.nan), bounds[0], bounds[3])
    text, file = message(survey[tile_id], Options(halo_m=20))
    assert text == f"dsm dsm/{name}.tif has only nodata on this tile; leave the tile out"
    assert file == str(path)


@pytest.mark.parametrize(
    ("factor", "units"), [(100, "cm or mm, divide them by 100 or 1000"), (60_000, "mm, divide them by 1000")]
)
def test_heights_in_a_smaller_unit_are_named_with_the_remedy(factor, units, survey, tmp_path):
    heights = (relief() * factor).astype(np.int32)
    write(tmp_path / "dsm" / "nw.tif", heights, WEST, NORTH)
    text, _ = message(survey[FIRST], Options(halo_m=20))
    assert text == (
        f"dsm dsm/nw.tif: all 3600 heights on this tile are outside -500 to 9000 m "
        f"({heights.min()} to {heights.max()}); if they are in {units}, "
        "or declare that unit with gdal_edit.py -units"
    )


@pytest.mark.parametrize("undeclared", [-9999, 1e30])
def test_undeclared_nodata_is_no_smaller_unit(undeclared, survey, tmp_path):
    write(tmp_path / "dsm" / "nw.tif", np.full((SIZE, SIZE), undeclared, np.float64), WEST, NORTH)
    assert message(survey[FIRST])[0] == "dsm dsm/nw.tif has only nodata on this tile; leave the tile out"


@pytest.mark.parametrize(("unit", "metres"), [("cm", 0.01), ("mm", 0.001)])
def test_declared_smaller_unit_is_converted(unit, metres, survey, tmp_path):
    heights = (relief() / metres).astype(np.int32)
    for layer in ("dsm", "dtm"):
        write(tmp_path / layer / "nw.tif", heights, WEST, NORTH, unit=unit)
    np.testing.assert_allclose(load(survey[FIRST], Options()).dsm, heights * metres, rtol=1e-12)


def test_broken_file_beside_a_tile_that_the_survey_covers_in_part_costs_only_its_own(tmp_path):
    write(tmp_path / "dsm" / "a.tif", relief(), WEST, NORTH)
    write(tmp_path / "dsm" / "b.tif", relief()[:, :40], WEST + SIZE, NORTH)
    write(tmp_path / "dtm.tif", np.full((SIZE, 2 * SIZE), 100.0), WEST, NORTH)
    patterns = {"dsm": "dsm/*.tif", "dtm": "dtm.tif"}
    first, second = rasters.index(tmp_path, patterns, tile_size_m=SIZE).tiles
    (tmp_path / "dsm" / "a.tif").write_bytes(b"")
    assert "dsm dsm/a.tif cannot be read" in message(first, Options(halo_m=20))[0]
    data = load(second, Options(halo_m=20))
    assert np.isfinite(data.dsm[data.grid.window(data.core)]).sum() == 40 * SIZE


def test_main_file_without_extents_is_the_one_that_was_read_on_the_tile(survey, tmp_path):
    tile = survey[FIRST]
    layers = tuple(replace(layer, files=layer.files[::-1], extents=()) for layer in tile.layers)
    write(tmp_path / "dsm" / "nw.tif", np.full((SIZE, SIZE), np.nan), WEST, NORTH)
    text, _ = message(replace(tile, layers=layers), Options(halo_m=20))
    assert text.startswith("dsm dsm/nw.tif has only nodata")


def test_file_of_unknown_extent_may_lie_on_every_tile(survey):
    path = parse_location("a.tif")
    grid = survey[FIRST].grid
    assert SourceFile("dsm a.tif", path, None).may_lie_on(grid)
    assert not SourceFile("dsm a.tif", path, (0, 0, 1, 1)).may_lie_on(grid)
