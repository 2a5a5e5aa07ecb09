import errno
import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexroad.catalog import Catalog, CatalogError, Grid
from flexroad.tools.synthetic.prepared import with_neighbours, write_tile

GRID = Grid("EPSG:25832", 500_000.0, 5_600_250.0, 1.0, 25, 20)
TAKEN = datetime(2024, 5, 1, 12, 30, tzinfo=timezone(timedelta(hours=2)))


def heights(grid: Grid = GRID) -> np.ndarray:
    z = np.random.default_rng(0).uniform(100, 400, grid.shape)
    z[0, 0] = np.nan
    return z


def road(grid: Grid = GRID) -> np.ndarray:
    return np.random.default_rng(1).random(grid.shape) < 0.3


def test_write_tile_returns_the_tile_of_its_files(tmp_path):
    layers = {"dsm": heights(), "road_mask": road()}
    second = write_tile(tmp_path, "b", GRID, layers, "urban", TAKEN, "made")
    before = datetime.now(UTC) - timedelta(seconds=5)
    first = write_tile(tmp_path, "a", GRID, {"reference_road": road().astype(np.uint8)})
    # Tiles of the same ground.
    assert with_neighbours([second, first]) == [first, second]
    assert (first.id, second.id) == ("a", "b")
    assert (second.grid, second.stratum, second.dataset) == (GRID, "urban", "made")
    assert first.dataset == ""
    # Without a date, it is the file's.
    assert first.datetime_assumed
    assert before < first.datetime < datetime.now(UTC) + timedelta(seconds=5)
    assert second.datetime == TAKEN
    assert not second.datetime_assumed
    assert second.root == str(tmp_path)
    dsm, mask = second.layers
    assert (dsm.name, dsm.files) == ("dsm", ("dsm/b.tif",))
    with rasterio.open(second.paths(dsm)[0]) as file:
        assert np.array_equal(file.read(1), heights().astype(np.float32), equal_nan=True)
        assert np.isnan(file.nodata)
        assert file.crs.to_epsg() == 25832
        assert file.tags()["TIFFTAG_DATETIME"] == "2024:05:01 10:30:00"
        tags = {name: text for name, text in file.tags().items() if name.startswith("FLEXROAD_")}
    assert tags == {
        "FLEXROAD_TILE": "b",
        "FLEXROAD_LAYER": "dsm",
        "FLEXROAD_STRATUM": "urban",
        "FLEXROAD_DATASET": "made",
    }
    for layer, tile in ((mask, second), (first.layers[0], first)):
        with rasterio.open(tile.paths(layer)[0]) as file:
            assert np.array_equal(file.read(1), road())
            assert file.dtypes == ("uint8",)
            assert file.nodata is None


def test_write_tile_layers_follow_catalog_order(tmp_path):
    names = ("reference_road", "reference", "dtm", "road_mask", "dsm")
    layers = {name: road() if "road" in name else heights() for name in names}
    tile = write_tile(tmp_path, "a", GRID, layers, "rural", TAKEN)
    assert [layer.name for layer in tile.layers] == ["dsm", "dtm", "road_mask", "reference", "reference_road"]
    Catalog((tile,)).write(tmp_path / "catalog.parquet")
    assert Catalog.read(tmp_path / "catalog.parquet").tiles == (tile,)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    cell=st.sampled_from([0.1, 0.2, 0.3, 1 / 3, 0.7, 2.5, 10.0]),
    west=st.floats(0, 1e6, allow_subnormal=False),
    north=st.floats(0, 1e7, allow_subnormal=False),
)
def test_write_tile_odd_lattice_is_exact(tmp_path, cell, west, north):
    grid = Grid("EPSG:25832", west, north, cell, 7, 5)
    tile = write_tile(tmp_path, "a", grid, {"dsm": heights(grid)})
    assert tile.grid == grid
    with rasterio.open(tmp_path / "dsm" / "a.tif") as file:
        assert (file.transform, file.shape) == (grid.transform, grid.shape)


def test_write_tile_failed_keeps_old_file(tmp_path):
    write_tile(tmp_path, "a", GRID, {"dsm": heights()})
    before = (tmp_path / "dsm" / "a.tif").read_bytes()
    nowhere = Grid("EPSG:999999", GRID.west, GRID.north, 1.0, 25, 20)
    with pytest.raises(CatalogError, match="EPSG"):
        write_tile(tmp_path, "a", nowhere, {"dsm": heights()})
    assert [path.name for path in (tmp_path / "dsm").iterdir()] == ["a.tif"]
    assert (tmp_path / "dsm" / "a.tif").read_bytes() == before


@pytest.mark.parametrize("shape", [(40, 50), (28, 35)])
def test_write_tile_photo_keeps_its_pixels(tmp_path, shape):
    photo = np.random.default_rng(2).integers(0, 256, (3, *shape), dtype=np.uint8)
    tile = write_tile(tmp_path, "a", GRID, {"dop": photo, "road_mask": road()}, "urban", TAKEN)
    assert tile.grid == GRID
    dop, mask = tile.layers
    assert (dop.name, dop.files, mask.name) == ("dop", ("dop/a.tif",), "road_mask")
    with rasterio.open(tile.paths(dop)[0]) as file:
        assert np.array_equal(file.read(), photo)
        assert file.bounds == pytest.approx(GRID.bounds)
        assert [band.name for band in file.colorinterp] == ["red", "green", "blue"]


def block(folder, names, size=60, gap=0.0, **options):
    """Write tiles side by side, three to a row, all with the heights of the same ground."""
    tiles = []
    for number, name in enumerate(names):
        west, north = 500_000.0 + (size + gap) * (number % 3), 5_600_000.0 - (size + gap) * (number // 3)
        grid = Grid("EPSG:25832", west, north, 1.0, size, size)
        z = np.add.outer(np.sin(grid.northings), grid.eastings / 1e4)
        tiles.append(write_tile(folder, name, grid, {"dsm": z, "dtm": z - 1}, **options))
    return {tile.id: tile for tile in with_neighbours(tiles)}


def alone(tile):
    """Return a tile with only its own files, as `write_tile` returns it."""
    return replace(tile, layers=tuple(layer.part([0]) for layer in tile.layers), nearby=())


def test_tile_lists_files_of_neighbours_after_its_own(tmp_path):
    tiles = block(tmp_path, "abcdefghi")
    dsm = tiles["e"].layer("dsm")
    assert dsm.files == tuple(f"dsm/{name}.tif" for name in "eabcdfghi")
    assert dsm.extents == tuple(tiles[name].grid.bounds for name in "eabcdfghi")
    assert tiles["e"].nearby == ()
    Catalog(tuple(tiles.values())).write(tmp_path / "catalog.parquet")
    assert Catalog.read(tmp_path / "catalog.parquet").tiles == tuple(tiles.values())


def test_tiles_out_of_reach_or_of_other_data_are_not_neighbours(tmp_path):
    assert {len(t.layers[0].files) for t in block(tmp_path / "far", "abcd", gap=201.0).values()} == {1}
    assert {len(t.layers[0].files) for t in block(tmp_path / "near", "ab", gap=200.0).values()} == {2}
    written = [alone(tile) for tile in block(tmp_path / "mixed", "abc").values()]
    beside = Grid("EPSG:25832", 500_000.0, 5_600_030.0, 1.0, 30, 30)
    for name, grid, dataset in (
        ("dataset", beside, "other"),
        ("cell", replace(beside, cell=0.5), ""),
        ("crs", replace(beside, crs="EPSG:25833"), ""),
        # Over the southern half of tile a.
        ("overlap", replace(beside, north=5_599_970.0, width=60), ""),
    ):
        written.append(write_tile(tmp_path / "mixed", name, grid, {"dsm": heights(grid)}, dataset=dataset))
    tiles = {tile.id: tile.layers[0].files for tile in with_neighbours(written)}
    assert tiles["a"] == ("dsm/a.tif", "dsm/b.tif", "dsm/c.tif")
    assert tiles["b"] == ("dsm/b.tif", "dsm/a.tif", "dsm/c.tif", "dsm/overlap.tif")
    assert [tiles[name] for name in ("dataset", "cell", "crs")] == [
        (f"dsm/{name}.tif",) for name in ("dataset", "cell", "crs")
    ]
    left_out = with_neighbours(tile for tile in written if tile.id in ("a", "c"))
    assert [tile.layers[0].files for tile in left_out] == [
        ("dsm/a.tif", "dsm/c.tif"),
        ("dsm/c.tif", "dsm/a.tif"),
    ]


def test_layer_of_a_neighbour_alone_is_nearby(tmp_path):
    ground = block(tmp_path, "ab")
    mask = Grid("EPSG:25832", 500_060.0, 5_600_000.0, 1.0, 60, 60)
    (only,) = write_tile(tmp_path, "b", mask, {"road_mask": road(mask)}).layers
    first, second = (alone(tile) for tile in ground.values())
    first, second = with_neighbours([first, replace(second, layers=(*second.layers, only))])
    assert [layer.name for layer in first.layers] == ["dsm", "dtm"]
    assert first.nearby == (second.layer("road_mask"),)
    strip = Grid("EPSG:25832", 500_050.0, 5_600_000.0, 1.0, 20, 60)
    assert first.around(strip, strip.bounds).layers == second.around(strip, strip.bounds).layers
    assert len(first.around(strip, strip.bounds).layers) == 3


def test_write_tile_on_full_disk_names_the_file_and_leaves_none(tmp_path, monkeypatch):
    """GDAL itself says nothing when a disk is full as it closes a file."""

    def full(self, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(CatalogError, match=r"^cannot write .*/dsm/a\.tif: No space left on device$"):
        write_tile(tmp_path, "a", GRID, {"dsm": heights()})
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
