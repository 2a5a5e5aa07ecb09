"""Four adjacent tiles that list each other's files: what a fault of one file costs, and its message."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.warp import transform_bounds

from flexroad.catalog.borders import border_of
from flexroad.catalog.sources import rasters
from flexroad.tasks import TaskError
from flexroad.tasks.load import Options, load, load_border
from tests.builders import NORTH, WEST
from tests.make_rasters import UTM, write

SIZE = 60
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
    return {tile.id: tile for tile in tiles}


def message(tile, options=None):
    with pytest.raises(TaskError) as caught:
        load(tile, options or Options())
    assert "\n" not in str(caught.value)
    return str(caught.value), caught.value.file


def turned(path):
    turn = Affine.translation(WEST, NORTH) @ Affine.rotation(30) @ Affine.scale(1, -1)
    write(path, relief(), transform=turn)


def other_crs(path):
    bounds = transform_bounds(UTM, "EPSG:25833", WEST, NORTH - SIZE, WEST + SIZE, NORTH)
    write(path, relief(), bounds[0], bounds[3], crs="EPSG:25833")


FAULTS = {
    "bare": (
        lambda path: write(path, relief(), crs=None),
        "has no CRS; build the catalog again",
    ),
    "turned": (turned, "is rotated; turn it north up"),
    "bands": (lambda path: write(path, [relief(), relief()]), "has 2 bands"),
    "complex": (lambda path: write(path, relief().astype(np.complex64), WEST, NORTH), "has complex numbers"),
    "fathoms": (lambda path: write(path, relief(), WEST, NORTH, unit="fathom"), "has the unit 'fathom'"),
    "other_crs": (other_crs, "is in EPSG:25833, the tile in EPSG:25832"),
    "feet": (lambda path: write(path, relief(), crs="EPSG:2994"), "does not reach the tile now"),
    "moved": (lambda path: write(path, relief(), WEST + 5000, NORTH), "does not reach the tile now"),
    "empty": (lambda path: path.write_bytes(b""), "cannot be read"),
    "missing": (lambda path: None, "is missing"),
}


@pytest.mark.parametrize(("damage", "fault"), FAULTS.values(), ids=FAULTS)
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
            if fault == "has 2 bands" and halo_m:
                assert loaded.notes[0].startswith("a file that the tile does not need was left out:")
            continue
        text, file = message(tile, options)
        assert text.startswith(f"dsm dsm/nw.tif {fault}")
        assert file == str(path)


@pytest.mark.parametrize(("damage", "fault"), FAULTS.values(), ids=FAULTS)
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


def test_moved_file_does_not_reach_its_tile(survey, tmp_path):
    write(tmp_path / "dtm" / "nw.tif", relief(), WEST + 5000, NORTH)
    text, file = message(survey[FIRST], Options(halo_m=20))
    assert text == (
        "dtm dtm/nw.tif does not reach the tile now: it lies at 300500 5629440 300560 5629500 in EPSG:25832, "
        "elsewhere than the catalog says; build the catalog again"
    )
    assert file == str(tmp_path / "dtm" / "nw.tif")
    # It may lie in the halo.
    write(tmp_path / "dsm" / "nw.tif", relief(), WEST - SIZE, NORTH)
    assert "dsm dsm/nw.tif does not reach the tile now" in message(survey[FIRST], Options(halo_m=20))[0]


@pytest.mark.parametrize(
    ("tile_id", "name"),
    [("295500_5629380", "sw"), ("295560_5629380", "se"), ("295560_5629440", "ne"), (FIRST, "nw")],
)
def test_tile_of_nodata_names_the_file_on_the_tile(tile_id, name, survey, tmp_path):
    """Also if the catalog has no extents of files."""
    tile, path = survey[tile_id], tmp_path / "dsm" / f"{name}.tif"
    write(path, np.full((SIZE, SIZE), np.nan), tile.grid.west, tile.grid.north)
    layers = tuple(replace(layer, files=layer.files[::-1], extents=()) for layer in tile.layers)
    for place in (tile, replace(tile, layers=layers)):
        text, file = message(place, Options(halo_m=20))
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
    # Undeclared nodata is no smaller unit.
    write(tmp_path / "dsm" / "nw.tif", np.full((SIZE, SIZE), -9999 if factor == 100 else 1e30), WEST, NORTH)
    assert message(survey[FIRST])[0] == "dsm dsm/nw.tif has only nodata on this tile; leave the tile out"


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
