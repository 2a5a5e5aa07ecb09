import json
import shutil
import tracemalloc
from dataclasses import replace
from datetime import UTC, datetime

import geopandas
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pystac
import pytest
import shapely
from pyproj import CRS

from flexroad.catalog import LAYERS, Catalog, CatalogError, Grid, Layer, Tile, geoparquet
from flexroad.catalog.area import Area
from flexroad.catalog.skipped import Skipped, lines, lost


def tile(east: int, root, layers=("dsm", "dtm"), crs="EPSG:25832") -> Tile:
    grid = Grid(crs, east, 5629500.0, 1.0, 250, 250)
    tile_layers = tuple(
        Layer(name, (f"{name}/a.tif", f"{name}/b.tif"), (1, 3) if name == "road_mask" else ())
        for name in LAYERS
        if name in layers
    )
    return Tile(
        f"{east}_5629250",
        grid,
        tile_layers,
        str(root),
        datetime(2020, 5, 1, 10, tzinfo=UTC),
        True,
        "urban",
        "made",
    )


@pytest.mark.parametrize("name", ["catalog.parquet", "catalog.json", "catalog.geojson"])
def test_catalog_round_trip_keeps_tiles(tmp_path, name):
    wkt = CRS("+proj=tmerc +lat_0=1 +lon_0=7 +x_0=300000 +y_0=5000000 +ellps=GRS80 +units=m").to_wkt()
    whole = (tile(295500, tmp_path), tile(295750, tmp_path, layers=LAYERS), tile(296000, tmp_path, crs=wkt))
    for tiles in (whole, ()):
        Catalog(tiles).write(tmp_path / name)
        assert Catalog.read(tmp_path / name).tiles == tiles


def with_extents(made: Tile) -> Tile:
    """Return the tile with the extents of its files: the first one on the tile, the second one east of it."""
    west, south, east, north = made.grid.bounds
    extents = ((west - 0.1, south, east, north), (east, south, east + 1 / 3, north))
    return replace(made, layers=tuple(replace(layer, extents=extents) for layer in made.layers))


@pytest.mark.parametrize("name", ["catalog.parquet", "catalog.json"])
def test_catalog_round_trip_keeps_extents_and_nearby_layers(tmp_path, name):
    first = with_extents(tile(295500, tmp_path / "data", layers=LAYERS))
    *layers, photo = sorted(first.layers, key=lambda layer: layer.name == "dop")
    (_, beyond) = photo.extents
    photo = replace(photo, files=photo.files[1:], extents=(beyond,))
    first = replace(first, layers=tuple(layers), nearby=(photo,))
    # A road is wider than the line in its file: roads beyond a tile cover it.
    dsm, roads = with_extents(tile(296250, tmp_path / "data", layers=("dsm", "roads"))).layers
    roads = replace(roads, files=roads.files[1:], extents=roads.extents[1:])
    beside = replace(tile(296250, tmp_path / "data"), layers=(dsm, roads))
    # Layers of known and of unknown extents, and no layers.
    without = with_extents(tile(296000, tmp_path / "data", layers=()))
    tiles = (first, tile(295750, tmp_path / "data"), without, beside)
    Catalog(tiles).write(tmp_path / "run" / name, movable=False)
    assert Catalog.read(tmp_path / "run" / name).tiles == tiles
    assert str(tmp_path / "data" / "dsm" / "a.tif").encode() in (tmp_path / "run" / name).read_bytes()
    Catalog(tiles).write(tmp_path / name)
    moved = Catalog.read(tmp_path / name).select(ids=["295500_5629250"]).tiles[0]
    assert moved.nearby == (replace(photo, files=("data/dop/b.tif",)),)
    assert moved.layers[0].extents == first.layers[0].extents


def test_catalog_in_parts_and_row_groups_is_the_same(tmp_path, monkeypatch):
    """Objects are made of a part of the rows at a time."""
    tiles = tuple(with_extents(tile(295500 + 250 * k, tmp_path, layers=LAYERS[: k + 1])) for k in range(7))
    path = tmp_path / "a.parquet"
    Catalog(tiles).write(path)
    whole, schema = path.read_bytes(), pq.read_schema(path)
    for rows in (1, 3, 7):
        monkeypatch.setattr(geoparquet, "AT_ONCE", rows)
        Catalog(tiles).write(path)
        assert path.read_bytes() == whole
        assert Catalog.read(path).tiles == tiles
    monkeypatch.setattr(geoparquet, "GROUP", 4)
    monkeypatch.setattr(geoparquet, "AT_ONCE", 3)
    Catalog(tiles).write(path)
    assert pq.ParquetFile(path).metadata.num_row_groups == 2
    assert Catalog.read(path).tiles == tiles
    Catalog(tiles[:1]).write(path)
    assert pq.read_schema(path).equals(schema)


def test_damage_in_a_later_row_group_names_the_catalog(tmp_path, monkeypatch):
    tiles = tuple(with_extents(tile(295500 + 250 * k, tmp_path)) for k in range(6))
    monkeypatch.setattr(geoparquet, "GROUP", 3)
    monkeypatch.setattr(geoparquet, "AT_ONCE", 3)
    Catalog(tiles).write(path := tmp_path / "a.parquet")
    last = pq.ParquetFile(path).metadata.row_group(1)
    columns = [last.column(number) for number in range(last.num_columns)]
    ids = next(column for column in columns if column.path_in_schema == "id")
    data = bytearray(path.read_bytes())
    data[ids.data_page_offset + ids.total_compressed_size // 2] ^= 255
    path.write_bytes(data)
    with pytest.raises(CatalogError, match=r"a\.parquet is not a FlexRoad catalog: "):
        Catalog.read(path)


def test_equal_layers_of_tiles_are_read_as_one_object(tmp_path):
    """A survey of a state is larger in memory than a client has otherwise."""
    one, other = (with_extents(tile(295500, tmp_path)) for _ in range(2))
    Catalog((one, replace(other, id="next"))).write(tmp_path / "a.parquet")
    first, second = Catalog.read(tmp_path / "a.parquet").tiles
    assert first.layers == one.layers
    assert all(a is b for a, b in zip(first.layers, second.layers, strict=True))
    assert first.datetime is second.datetime


def test_objects_exist_of_a_part_of_the_rows_at_a_time(tmp_path, monkeypatch):
    tiles = tuple(with_extents(tile(295500 + 250 * k, tmp_path, layers=LAYERS)) for k in range(300))
    path = tmp_path / "a.parquet"
    Catalog(tiles[:1]).write(path)

    def largest_bytes(function):
        tracemalloc.start()
        function()
        largest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return largest

    whole = [largest_bytes(lambda: Catalog(tiles).write(path)), largest_bytes(lambda: Catalog.read(path))]
    monkeypatch.setattr(geoparquet, "AT_ONCE", 10)
    parts = [largest_bytes(lambda: Catalog(tiles).write(path)), largest_bytes(lambda: Catalog.read(path))]
    assert parts[0] < whole[0] / 2
    assert parts[1] < whole[1] / 1.5


def test_catalog_of_another_program_may_lack_extents_and_dataset(tmp_path):
    tiles = (tile(295500, tmp_path, layers=LAYERS), tile(295750, tmp_path))
    Catalog(tuple(map(with_extents, tiles))).write(tmp_path / "c.json")
    items = json.loads((tmp_path / "c.json").read_text())
    for item in items["features"]:
        del item["properties"]["flexroad:dataset"]
        for asset in item["assets"].values():
            del asset["flexroad:extents"]
    (tmp_path / "c.json").write_text(json.dumps(items))
    expected = tuple(replace(one, dataset="") for one in tiles)
    assert Catalog.read(tmp_path / "c.json").tiles == expected
    Catalog(expected).write(tmp_path / "c.parquet")
    table = pq.read_table(tmp_path / "c.parquet")
    kinds, at = table.schema, table.schema.get_field_index("assets")
    rows = table.to_pylist()
    for asset in (asset for row in rows for asset in row["assets"].values() if asset):
        del asset["flexroad:extents"]
    assets = pa.struct(
        (kind.name, pa.struct([field for field in kind.type if field.name != "flexroad:extents"]))
        for kind in kinds.field(at).type
    )
    pq.write_table(
        pa.Table.from_pylist(rows, kinds.set(at, pa.field("assets", assets))), tmp_path / "c.parquet"
    )
    assert Catalog.read(tmp_path / "c.parquet").tiles == expected


def test_files_below_catalog_move_with_it_and_others_are_absolute(tmp_path):
    home, outside = tmp_path / "home", tile(295750, tmp_path / "data")
    Catalog((tile(295500, home), outside)).write(home / "c.json")
    shutil.move(home, tmp_path / "away")
    moved, other = Catalog.read(tmp_path / "away" / "c.json").tiles
    assert moved.layer("dsm").files == ("dsm/a.tif", "dsm/b.tif")
    assert moved.paths(moved.layer("dsm"))[0] == tmp_path / "away" / "dsm" / "a.tif"
    assert other.layer("dsm").files[0] == str(tmp_path / "data" / "dsm" / "a.tif")


def test_catalog_is_valid_stac_and_geoparquet(tmp_path):
    Catalog((tile(295500, tmp_path),)).write(tmp_path / "c.json")
    Catalog((tile(295500, tmp_path),)).write(tmp_path / "c.parquet")
    (feature,) = json.loads((tmp_path / "c.json").read_text())["features"]
    item = pystac.Item.from_dict(feature)
    assert item.ext.proj.code == "EPSG:25832"
    assert item.assets["dsm"].href == "dsm/a.tif"
    frame = geopandas.read_parquet(tmp_path / "c.parquet")
    assert frame.crs == "EPSG:4326"
    west, south, east, north = frame.to_crs("EPSG:25832").total_bounds
    # The outline in degrees has straight edges and is exact only at the corners, hence 1 cm.
    assert (west, south, east, north) == pytest.approx((295500, 5629250, 295750, 5629500), abs=0.01)


def test_select_by_id_and_bbox_returns_matching_tiles(tmp_path):
    catalog = Catalog((tile(295500, tmp_path), tile(295750, tmp_path), tile(296000, tmp_path)))
    assert [t.id for t in catalog.select(ids=["295750_5629250"]).tiles] == ["295750_5629250"]
    assert [t.id for t in catalog.select(bbox=(295600, 5629300, 295750, 5629310)).tiles] == ["295500_5629250"]
    with pytest.raises(CatalogError, match="did you mean 295750_5629250"):
        catalog.select(ids=["295751_5629250"])
    within = "the tiles lie within 295500 5629250 296250 5629500 in EPSG:25832"
    with pytest.raises(CatalogError, match=rf"no tile touches --bbox 0 0 1 1; {within}$"):
        catalog.select(bbox=(0, 0, 1, 1))
    order = "is empty; the order is west south east north"
    for box in ((10, 10, 1, 11), (10, 10, 11, 1)):
        with pytest.raises(CatalogError, match=rf"--bbox 10 10 \d+ \d+ {order}; {within}$"):
            catalog.select(bbox=box)


def test_select_by_area_returns_the_tiles_on_it(tmp_path):
    lost = replace(tile(295750, tmp_path), fault="its position is lost")
    catalog = Catalog((tile(295500, tmp_path), lost, tile(296000, tmp_path)))
    area = Area("area.gpkg", "EPSG:25832", np.array([shapely.box(295700, 5629300, 296100, 5629400)]))
    assert [t.id for t in catalog.select(area=area).tiles] == ["295500_5629250", "296000_5629250"]
    assert [t.id for t in catalog.select(["296000_5629250"], area=area).tiles] == ["296000_5629250"]
    with pytest.raises(
        CatalogError, match="no tile touches --area area.gpkg; check its CRS, EPSG:25832, and its place"
    ):
        catalog.select(
            bbox=(295500, 5629250, 295600, 5629260), area=replace(area, polygons=area.polygons[:0])
        )


def test_unusable_catalog_is_named(tmp_path):
    with pytest.raises(CatalogError, match="missing.parquet does not exist"):
        Catalog.read(tmp_path / "missing.parquet")
    with pytest.raises(CatalogError, match=r"ends in .parquet"):
        Catalog(()).write(tmp_path / "catalog.csv")
    with pytest.raises(CatalogError, match="295500_5629250 occur more than once"):
        Catalog((tile(295500, tmp_path), tile(295500, tmp_path)))


def test_parquet_rows_equal_those_of_stac_geoparquet(tmp_path):
    """stac-geoparquet's own conversion is many times slower; it is the oracle here."""
    from stac_geoparquet.arrow import parse_stac_items_to_arrow, stac_table_to_items, to_parquet

    from flexroad.catalog.entries import TileReader
    from flexroad.catalog.index import _full_item, item
    from flexroad.catalog.trust import AllowedFolders

    whole = with_extents(tile(295750, tmp_path, layers=LAYERS))
    tiles = (tile(295500, tmp_path), whole, tile(296000, tmp_path, layers=()))
    Catalog(tiles).write(tmp_path / "c.parquet")
    table = pq.read_table(tmp_path / "c.parquet")
    items = [_full_item(), *(item(tile) for tile in tiles)]
    oracle = parse_stac_items_to_arrow(items).read_all().slice(1).combine_chunks()
    assert table.equals(oracle)
    to_parquet(oracle, tmp_path / "oracle.parquet", write_page_checksum=True)
    assert (tmp_path / "c.parquet").read_bytes() == (tmp_path / "oracle.parquet").read_bytes()
    allowed = AllowedFolders.of(tmp_path)
    expected = TileReader(str(tmp_path), allowed, "row", "c.parquet").tiles(stac_table_to_items(table))
    assert Catalog.read(tmp_path / "c.parquet").tiles == expected
    assert not any(tile.fault for tile in expected)


@pytest.mark.parametrize("name", ["c.parquet", "c.json"])
def test_skipped_files_round_trip_and_move_with_the_catalog(tmp_path, name):
    file = Skipped("dsm/a.tif", "dsm", "not a raster", f"{tmp_path}/data")
    outside = Skipped("/else/b.tif", "dtm", "not a raster", str(tmp_path), ("one", "two"))
    catalog = Catalog((tile(295500, tmp_path),), (file, outside))
    catalog.write(tmp_path / "run" / name, movable=False)
    assert Catalog.read(tmp_path / "run" / name) == catalog
    catalog.write(tmp_path / "data" / name)
    moved = shutil.move(tmp_path / "data", tmp_path / "moved") / name
    read = Catalog.read(moved)
    assert read.skipped == (
        replace(file, root=f"{tmp_path}/moved"),
        replace(outside, root=f"{tmp_path}/moved"),
    )
    assert [one.path for one in read.skipped] == [f"{tmp_path}/moved/dsm/a.tif", "/else/b.tif"]
    assert read.select(ids=[read.tiles[0].id]).skipped == read.skipped
    Catalog(catalog.tiles).write(moved)
    assert Catalog.read(moved).skipped == ()
    assert b"flexroad:skipped" not in moved.read_bytes()


@pytest.mark.parametrize(
    "damaged", ["x", [1], [{"file": "a"}], [{"file": "", "layer": "", "reason": "", "root": "", "tiles": []}]]
)
def test_damaged_list_of_skipped_files_is_no_catalog(tmp_path, damaged):
    Catalog((tile(295500, tmp_path),)).write(path := tmp_path / "c.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"flexroad:skipped": damaged}))
    with pytest.raises(CatalogError, match=r"c\.json is not a .* its list of skipped files cannot be read"):
        Catalog.read(path)


def test_tiles_lost_with_a_skipped_file_or_folder_are_those_it_lay_on(tmp_path):
    """Another tile left the area: no skipped file lay on it, only near it."""
    dsm = (("a/1.tif", 295500.0), ("b/2.tif", 295750.0), ("3.tif", 296000.0))
    extents = tuple((west, 5629250.0, west + 250, 5629500.0) for _, west in dsm)
    layer = Layer("dsm", tuple(name for name, _ in dsm), extents=extents)
    before = [replace(tile(int(west), tmp_path), layers=(layer,)) for _, west in dsm]
    one, two, three = (tile.id for tile in before)
    skipped = [Skipped("a/1.tif", "dsm", "bad", str(tmp_path)), Skipped("b/", "dsm", "shut", str(tmp_path))]
    found = lost(before, set(), skipped)
    assert [file.tiles for file in found] == [(one,), (two,)]
    assert [file.tiles for file in lost(before, {one, three}, skipped)] == [(), (two,)]
    assert lines(found) == [
        f"skipped a/1.tif (dsm): bad; the run lost 1 tile with that: {one}",
        f"skipped folder b (dsm): shut; the run lost 1 tile with that: {two}",
    ]
