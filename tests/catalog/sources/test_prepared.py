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
from flexroad.catalog.sources.prepared import index, write_tile
from flexroad.tasks.load import Options, load

GRID = Grid("EPSG:25832", 500_000.0, 5_600_250.0, 1.0, 25, 20)
TAKEN = datetime(2024, 5, 1, 12, 30, tzinfo=timezone(timedelta(hours=2)))


def heights(grid: Grid = GRID) -> np.ndarray:
    z = np.random.default_rng(0).uniform(100, 400, grid.shape)
    z[0, 0] = np.nan
    return z


def road(grid: Grid = GRID) -> np.ndarray:
    return np.random.default_rng(1).random(grid.shape) < 0.3


def test_write_tile_and_index_round_trip(tmp_path):
    write_tile(tmp_path, "b", GRID, {"dsm": heights(), "road_mask": road()}, "urban", TAKEN, "made")
    write_tile(tmp_path, "a", GRID, {"reference_road": road().astype(np.uint8)})
    first, second = index(tmp_path)
    assert (first.id, second.id) == ("a", "b")
    assert (second.grid, second.stratum, second.dataset) == (GRID, "urban", "made")
    assert first.dataset == ""
    assert second.datetime == TAKEN
    assert not second.datetime_assumed
    assert second.root == str(tmp_path)
    dsm, mask = second.layers
    assert (dsm.name, dsm.files) == ("dsm", ("dsm/b.tif",))
    with rasterio.open(second.paths(dsm)[0]) as file:
        assert np.array_equal(file.read(1), heights().astype(np.float32), equal_nan=True)
        assert np.isnan(file.nodata)
        assert file.crs.to_epsg() == 25832
    for layer, tile in ((mask, second), (first.layers[0], first)):
        with rasterio.open(tile.paths(layer)[0]) as file:
            assert np.array_equal(file.read(1), road())
            assert file.dtypes == ("uint8",)
            assert file.nodata is None


def test_write_tile_heights_are_exact_to_a_tenth_of_a_millimetre(tmp_path):
    write_tile(tmp_path, "a", GRID, {"dtm": heights()})
    with rasterio.open(tmp_path / "dtm" / "a.tif") as file:
        assert np.nanmax(np.abs(file.read(1) - heights())) < 1e-4


def test_index_layers_follow_catalog_order(tmp_path):
    names = ("reference_road", "reference", "dtm", "road_mask", "dsm")
    write_tile(tmp_path, "a", GRID, {n: road() if "road" in n else heights() for n in names}, "rural", TAKEN)
    (tile,) = index(tmp_path)
    assert [layer.name for layer in tile.layers] == [
        "dsm",
        "dtm",
        "road_mask",
        "reference",
        "reference_road",
    ]
    Catalog((tile,)).write(tmp_path / "catalog.parquet")
    assert Catalog.read(tmp_path / "catalog.parquet").tiles == (tile,)


def test_index_without_date_uses_file_time(tmp_path):
    before = datetime.now(UTC) - timedelta(seconds=5)
    write_tile(tmp_path, "a", GRID, {"dsm": heights()})
    (tile,) = index(tmp_path)
    assert tile.datetime_assumed
    assert before < tile.datetime < datetime.now(UTC) + timedelta(seconds=5)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    cell=st.sampled_from([0.1, 0.2, 0.3, 1 / 3, 0.7, 2.5, 10.0]),
    west=st.floats(0, 1e6, allow_subnormal=False),
    north=st.floats(0, 1e7, allow_subnormal=False),
)
def test_index_odd_lattice_is_exact(tmp_path, cell, west, north):
    grid = Grid("EPSG:25832", west, north, cell, 7, 5)
    write_tile(tmp_path, "a", grid, {"dsm": heights(grid)})
    assert index(tmp_path)[0].grid == grid


def test_index_id_is_read_from_tag(tmp_path):
    write_tile(tmp_path, "500000_5600000", GRID, {"dsm": heights()})
    (tmp_path / "dsm" / "500000_5600000.tif").rename(tmp_path / "dsm" / "1_2.tif")
    (tile,) = index(tmp_path)
    assert tile.id == "500000_5600000"
    assert tile.layers[0].files == ("dsm/1_2.tif",)


def test_write_tile_again_replaces_files(tmp_path):
    write_tile(tmp_path, "a", GRID, {"dsm": heights()})
    write_tile(tmp_path, "a", GRID, {"dsm": heights() + 1})
    with rasterio.open(tmp_path / "dsm" / "a.tif") as file:
        assert file.read(1)[1, 1] == np.float32(heights()[1, 1] + 1)


def test_write_tile_failed_keeps_old_file(tmp_path):
    write_tile(tmp_path, "a", GRID, {"dsm": heights()})
    before = (tmp_path / "dsm" / "a.tif").read_bytes()
    nowhere = Grid("EPSG:999999", GRID.west, GRID.north, 1.0, 25, 20)
    with pytest.raises(CatalogError, match="EPSG"):
        write_tile(tmp_path, "a", nowhere, {"dsm": heights()})
    assert [path.name for path in (tmp_path / "dsm").iterdir()] == ["a.tif"]
    assert (tmp_path / "dsm" / "a.tif").read_bytes() == before


@pytest.mark.parametrize(
    ("tile_id", "layers", "line"),
    [
        ("a/b", {}, r"'a/b' is not a valid file name.*slashes"),
        ("", {}, "'' is not a valid file name"),
        ("a", {"dem": heights()}, "no layer 'dem'.*layers are dsm, dtm"),
        ("a", {"dsm": heights()[:-1]}, r"dsm of tile a is \(19, 25\), but its grid is \(20, 25\)"),
    ],
)
def test_write_tile_invalid_input_writes_nothing(tmp_path, tile_id, layers, line):
    with pytest.raises(CatalogError, match=line):
        write_tile(tmp_path, tile_id, GRID, {"dtm": heights(), **layers})
    assert not list(tmp_path.iterdir())


def test_index_empty_folder_raises_error(tmp_path):
    with pytest.raises(CatalogError, match=f"no LAYER/.*{tmp_path.name}.*dsm"):
        index(tmp_path)


def test_index_file_without_tags_raises_error(tmp_path):
    write_tile(tmp_path, "a", GRID, {"dsm": heights()})
    with rasterio.open(tmp_path / "dsm" / "a.tif", "r+") as file:
        file.update_tags(FLEXROAD_TILE="")
    with pytest.raises(CatalogError, match=r"dsm/a.tif has no FLEXROAD_TILE; .*catalog it as rasters"):
        index(tmp_path)


def test_index_broken_file_raises_error(tmp_path):
    (tmp_path / "dsm").mkdir()
    (tmp_path / "dsm" / "a.tif").write_bytes(b"II*\0 nothing")
    with pytest.raises(CatalogError, match=r"dsm/a.tif is not a GeoTIFF"):
        index(tmp_path)


def test_index_invalid_date_raises_error(tmp_path):
    write_tile(tmp_path, "a", GRID, {"dsm": heights()}, date=TAKEN)
    with rasterio.open(tmp_path / "dsm" / "a.tif", "r+") as file:
        file.update_tags(TIFFTAG_DATETIME="May 2024")
    with pytest.raises(CatalogError, match=r"dsm/a.tif has TIFFTAG_DATETIME 'May 2024'"):
        index(tmp_path)


def test_index_contradicting_files_raise_error(tmp_path):
    moved = Grid(GRID.crs, GRID.west + 1, GRID.north, 1.0, 25, 20)
    write_tile(tmp_path, "a", GRID, {"dsm": heights()}, "urban")
    write_tile(tmp_path, "a", moved, {"dtm": heights()}, "urban")
    with pytest.raises(CatalogError, match=r"dsm/a.tif and .*dtm/a.tif of tile a differ in grid"):
        index(tmp_path)
    write_tile(tmp_path, "a", GRID, {"dtm": heights()}, "rural")
    with pytest.raises(CatalogError, match="differ in stratum: urban and rural"):
        index(tmp_path)


def test_index_two_files_of_one_layer_raise_error(tmp_path):
    write_tile(tmp_path, "a", GRID, {"dsm": heights()})
    (tmp_path / "dsm" / "b.tif").write_bytes((tmp_path / "dsm" / "a.tif").read_bytes())
    with pytest.raises(CatalogError, match=r"a.tif and .*b.tif are both tagged as layer dsm of tile a"):
        index(tmp_path)


def photo(rows: int = 40, columns: int = 50) -> np.ndarray:
    return np.random.default_rng(2).integers(0, 256, (3, rows, columns), dtype=np.uint8)


def test_write_tile_photo_keeps_its_pixels(tmp_path):
    write_tile(tmp_path, "a", GRID, {"dop": photo(), "road_mask": road()}, "urban", TAKEN)
    (tile,) = index(tmp_path)
    assert tile.grid == GRID
    dop, mask = tile.layers
    assert (dop.name, dop.files, mask.name) == ("dop", ("dop/a.tif",), "road_mask")
    with rasterio.open(tile.paths(dop)[0]) as file:
        assert np.array_equal(file.read(), photo())
        assert file.res == (0.5, 0.5)
        assert tuple(file.bounds) == GRID.bounds
        assert [band.name for band in file.colorinterp] == ["red", "green", "blue"]


def test_write_tile_photo_with_odd_pixel_size_fits(tmp_path):
    write_tile(tmp_path, "a", GRID, {"dsm": heights(), "dop": photo(28, 35)})
    assert index(tmp_path)[0].layer("dop") is not None


@pytest.mark.parametrize("wrong", [photo()[0], photo()[:2], photo().astype(float), photo(40, 40)])
def test_write_tile_invalid_photo_raises_error(tmp_path, wrong):
    with pytest.raises(CatalogError, match="layer dop of tile a is .* over 25 x 20 cells"):
        write_tile(tmp_path, "a", GRID, {"dop": wrong})


def test_index_photo_alone_or_misplaced_raises_error(tmp_path):
    write_tile(tmp_path, "a", GRID, {"dop": photo()})
    with pytest.raises(CatalogError, match="dop/a.tif is the only file of tile a"):
        index(tmp_path)
    moved = Grid(GRID.crs, GRID.west + 1, GRID.north, 1.0, 25, 20)
    write_tile(tmp_path, "a", moved, {"dsm": heights()})
    with pytest.raises(CatalogError, match=r"dsm/a.tif and .*dop/a.tif of tile a differ in grid"):
        index(tmp_path)


def block(folder, names, size=60, gap=0.0, **options):
    """Write tiles side by side, three to a row, all with the heights of the same ground, and index them."""
    for number, name in enumerate(names):
        west, north = 500_000.0 + (size + gap) * (number % 3), 5_600_000.0 - (size + gap) * (number // 3)
        grid = Grid("EPSG:25832", west, north, 1.0, size, size)
        z = np.add.outer(np.sin(grid.northings), grid.eastings / 1e4)
        write_tile(folder, name, grid, {"dsm": z, "dtm": z - 1}, **options)
    return {tile.id: tile for tile in index(folder)}


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
    block(tmp_path / "mixed", "abc")
    beside = Grid("EPSG:25832", 500_000.0, 5_600_030.0, 1.0, 30, 30)
    for name, grid, dataset in (
        ("dataset", beside, "other"),
        ("cell", replace(beside, cell=0.5), ""),
        ("crs", replace(beside, crs="EPSG:25833"), ""),
        # Over the southern half of tile a.
        ("overlap", replace(beside, north=5_599_970.0, width=60), ""),
    ):
        write_tile(tmp_path / "mixed", name, grid, {"dsm": heights(grid)}, dataset=dataset)
    tiles = {tile.id: tile.layers[0].files for tile in index(tmp_path / "mixed")}
    assert tiles["a"] == ("dsm/a.tif", "dsm/b.tif", "dsm/c.tif")
    assert tiles["b"] == ("dsm/b.tif", "dsm/a.tif", "dsm/c.tif", "dsm/overlap.tif")
    assert [tiles[name] for name in ("dataset", "cell", "crs")] == [
        (f"dsm/{name}.tif",) for name in ("dataset", "cell", "crs")
    ]
    left_out = index(tmp_path / "mixed", only={"a", "c"})
    assert [tile.layers[0].files for tile in left_out] == [
        ("dsm/a.tif", "dsm/c.tif"),
        ("dsm/c.tif", "dsm/a.tif"),
    ]


def test_layer_of_a_neighbour_alone_is_nearby(tmp_path):
    block(tmp_path, "ab")
    mask = Grid("EPSG:25832", 500_060.0, 5_600_000.0, 1.0, 60, 60)
    write_tile(tmp_path, "b", mask, {"road_mask": road(mask)})
    first, second = index(tmp_path)
    assert [layer.name for layer in first.layers] == ["dsm", "dtm"]
    assert first.nearby == (second.layer("road_mask"),)
    strip = Grid("EPSG:25832", 500_050.0, 5_600_000.0, 1.0, 20, 60)
    assert first.around(strip, strip.bounds).layers == second.around(strip, strip.bounds).layers
    assert len(first.around(strip, strip.bounds).layers) == 3


def test_halo_has_the_heights_of_the_neighbours(tmp_path):
    tiles = block(tmp_path, "abcdefghi")
    own = {name: load(tile, Options()) for name, tile in tiles.items()}
    data = load(tiles["e"], Options(halo_m=50))
    assert data.grid.shape == (160, 160)
    assert not np.isnan(data.dsm).any()
    assert not np.isnan(data.dtm).any()
    assert data.notes == ()
    for row, names in enumerate(("abc", "def", "ghi")):
        for column, name in enumerate(names):
            part = (
                slice(max(0, 60 * row - 10), 60 * row + 50),
                slice(max(0, 60 * column - 10), 60 * column + 50),
            )
            seen = data.dsm[part]
            size = slice(-seen.shape[0], None) if row == 0 else slice(seen.shape[0])
            width = slice(-seen.shape[1], None) if column == 0 else slice(seen.shape[1])
            assert np.array_equal(seen, own[name].dsm[size, width]), name
    # The corner tile has no neighbours in the north and west.
    corner = load(tiles["a"], Options(halo_m=50)).dsm
    assert np.isnan(corner[:50]).all()
    assert np.isnan(corner[:, :50]).all()
    assert not np.isnan(corner[50:, 50:]).any()


def test_write_tile_on_full_disk_names_the_file_and_leaves_none(tmp_path, monkeypatch):
    """GDAL itself says nothing when a disk is full as it closes a file."""

    def full(self, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(CatalogError, match=r"^cannot write .*/dsm/a\.tif: No space left on device$"):
        write_tile(tmp_path, "a", GRID, {"dsm": heights()})
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
