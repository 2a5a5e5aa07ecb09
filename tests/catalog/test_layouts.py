"""Files of GeRoD are found in any of the layouts that the published archive may have."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import rasterio

from flexroad.catalog import CatalogError, derived, layouts
from flexroad.catalog.sources.templates import GEROD, index
from tests.make_rasters import UTM, write

IDS = {"295500_5629250": "urban", "346250_5676500": "suburban", "381250_5760000": "rural"}
SIDE = 20
LAYERS = ("dsm", "dtm", "road_mask", "reference")
LAYOUT = {"road_values": [], "crs": UTM}
LAYOUTS = {
    "folder of the tile": "{id}/{layer}.tif",
    "suffix": "{id}_{LAYER}.tif",
    "folder of the layer": "{layer}/{id}.tif",
    "stratum first": "{stratum}/{id}/{layer}.TIF",
    "archive's own folder, capitals": "GeRoD/{LAYER}/{id}_dom.tif",
    "points": "{stratum}/{id}.npz",
}


def values(layer: str, tile: str) -> np.ndarray:
    """Return heights or a mask that differ by layer and tile."""
    rows, cols = np.mgrid[:SIDE, :SIDE]
    if layer == "road_mask":
        return (np.abs(rows - 10) < 3).astype(np.uint8)
    return (100 + LAYERS.index(layer) + 0.1 * [*IDS].index(tile) + 0.01 * rows + 0.001 * cols).astype(
        np.float32
    )


def make(root: Path, template: str) -> Path:
    for tile, stratum in IDS.items():
        west, south = map(int, tile.split("_"))
        if template.endswith(".npz"):
            path = root / template.format(id=tile, stratum=stratum)
            path.parent.mkdir(parents=True, exist_ok=True)
            x, y = np.meshgrid(west + 0.5 + np.arange(SIDE), south + SIDE - 0.5 - np.arange(SIDE))
            heights = {"z" if name == "dsm" else name: values(name, tile) for name in LAYERS}
            # Points of a DSM with a void are fewer than its cells.
            kept = {name: np.delete(v, 7) for name, v in {"x": x, "y": y, **heights}.items()}
            np.savez_compressed(path, **kept)
            continue
        for layer in LAYERS:
            name = template.format(id=tile, layer=layer, LAYER=layer.upper(), stratum=stratum.capitalize())
            # The layer's folder counts only where the name of the file means none.
            file = name if layer == "dsm" else name.replace("_dom", "")
            write(root / file, values(layer, tile), west, south + SIDE)
    return root


@pytest.mark.parametrize("name", LAYOUTS)
def test_layout_is_found(tmp_path, name):
    root = make(tmp_path / "data", LAYOUTS[name])
    result = index(root, LAYOUT, GEROD, derived=tmp_path / "points")
    assert result.left_out == ()
    assert [tile.id for tile in result.tiles] == sorted(IDS)
    for tile in result.tiles:
        west, south = map(int, tile.id.split("_"))
        assert tile.grid.bounds == (west, south, west + SIDE, south + SIDE)
        assert tile.dataset == "GeRoD"
        assert {layer.name for layer in tile.layers} == {*LAYERS}
        if "{stratum}" in LAYOUTS[name]:
            assert tile.stratum == IDS[tile.id]
        for layer in tile.layers:
            (path,) = tile.paths(layer)
            cells = read(path)
            expected = values(layer.name, tile.id).astype(float)
            known = np.isfinite(cells)
            assert known.sum() == cells.size - (name == "points")
            np.testing.assert_allclose(cells[known], expected[known], atol=1e-4)


def read(path) -> np.ndarray:
    with rasterio.open(path) as raster:
        return raster.read(1).astype(float)


CSV = "tile;class\n" + "".join(f"{tile};{name}\n" for tile, name in IDS.items())
TABLES = {
    "strata.csv": CSV,
    "strata_comma.csv": CSV.replace(";", ","),
    "by_tile.json": json.dumps(IDS),
    "by_stratum.json": json.dumps({name: [tile] for tile, name in IDS.items()}),
    "list.json": json.dumps([{"id": tile, "area": name, "n": 3} for tile, name in IDS.items()]),
    "nested.json": json.dumps({tile: {"area": {"stratum": name.upper()}} for tile, name in IDS.items()}),
    "tiles.geojson": json.dumps(
        {"features": [{"properties": {"name": f"{t}.tif", "s": s}} for t, s in IDS.items()]}
    ),
}


@pytest.mark.parametrize("name", TABLES)
def test_strata_of_a_table_are_found_and_a_damaged_one_is_a_note(tmp_path, name):
    root = make(tmp_path, "{id}/{layer}.tif")
    (root / name).write_text(TABLES[name])
    found, notes = layouts.find(root)
    assert notes == []
    assert {file.tile: file.stratum for file in found} == IDS
    (root / name).unlink()
    (root / "strata.json").write_text("[" * 100_000)
    found, (note,) = layouts.find(root)
    assert {file.stratum for file in found} == {""}
    assert note.startswith("strata.json was not read: ")
    assert "\n" not in note


def test_pipes_among_the_files_are_left_out(tmp_path):
    root = make(tmp_path / "data", LAYOUTS["points"])
    for name in ("strata.csv", "rural/381250_5759750.npz", "rural/381250_5759500_dsm.tif"):
        os.mkfifo(root / name)
    result = index(root, LAYOUT, GEROD, derived=tmp_path / "points")
    assert [tile.id for tile in result.tiles] == sorted(IDS)
    assert any(note.startswith("strata.csv was not read: cannot be read: not a reg") for note in result.notes)
    assert len(result.left_out) == 2
    assert all("is not a regular file; replace it by one" in line for line in result.left_out)


def test_table_and_questions_name_what_is_there_and_what_is_missing(tmp_path):
    root = make(tmp_path, "{stratum}/{id}/{layer}.tif")
    first = next(iter(IDS))
    (root / "Urban" / first / "dtm.tif").unlink()
    for path in root.rglob("reference.tif"):
        path.unlink()
    found, _ = layouts.find(root)
    assert layouts.table(found) == [
        "layer      tiles  files",
        "dsm            3  {stratum}/{tile}/dsm.tif",
        "dtm            2  {stratum}/{tile}/dtm.tif",
        "road_mask      3  {stratum}/{tile}/road_mask.tif",
        "stratum        3  1 urban, 1 suburban, 1 rural",
    ]
    dtm, reference = layouts.questions(found)
    assert dtm == f"no dtm for 1 of 3 tiles ({first}): a tile needs its terrain model"
    assert reference.startswith("no reference for 3 of 3 tiles")


def test_two_files_of_a_layer_are_an_error_and_points_give_way_to_rasters(tmp_path):
    root = make(tmp_path, "{id}/{layer}.tif")
    tile = next(iter(IDS))
    np.savez(root / tile / "dsm.npz", x=np.zeros(3), y=np.zeros(3), z=np.zeros(3))
    assert index(root, LAYOUT, GEROD).left_out == ()
    write(root / tile / "DOM.tif", values("dsm", tile))
    with pytest.raises(
        CatalogError, match=rf"{tile}/DOM.tif and {tile}/dsm.tif are both the dsm of tile {tile}"
    ):
        index(root, LAYOUT, GEROD)


STEPS = np.arange(30.0)


@pytest.mark.parametrize(
    ("arrays", "line"),
    [
        ({"x": STEPS, "z": STEPS}, "has no array 'y'; points need x, y and z"),
        ({"x": STEPS, "y": STEPS}, "x, y and z do not belong together"),
        ({"x": STEPS, "y": STEPS, "z": np.array(["a"] * 30)}, "x, y and z do not belong together"),
        ({"x": STEPS, "y": STEPS, "z": np.array([None] * 30)}, "cannot be read: Object arrays"),
        ({"x": STEPS**1.5, "y": STEPS, "z": STEPS}, "its points lie on no lattice"),
        ({"x": np.zeros(3), "y": np.zeros(3), "z": np.zeros(3)}, "its points lie on no lattice"),
        ({"x": STEPS[:0], "y": STEPS[:0], "z": STEPS[:0]}, "x, y and z do not belong together"),
        ({"x": STEPS, "y": STEPS, "z": np.zeros(1000)}, "GB of arrays: no tile has as many points"),
    ],
)
def test_points_that_are_none_are_left_out_with_a_line(tmp_path, monkeypatch, arrays, line):
    monkeypatch.setattr(derived, "MAX_BYTES", 5000)
    root = make(tmp_path / "data", "{id}/{layer}.tif")
    (root / "296000_5629250").mkdir()
    np.savez(root / "296000_5629250" / "dsm.npz", **arrays)
    result = index(root, LAYOUT, GEROD, derived=tmp_path / "points")
    assert len(result.tiles) == 3
    (left_out,) = result.left_out
    assert left_out.startswith("skipped 296000_5629250/dsm.npz (dsm): dsm.npz")
    assert line in left_out


def test_points_from_the_corner_and_with_axes_are_read(tmp_path):
    x, heights = np.arange(SIDE) + 0.5, values("dsm", next(iter(IDS)))
    np.savez(tmp_path / "295500_5629250.npz", x=x, y=x[::-1], dsm=heights, dtm=heights - 1)
    (tile,) = index(tmp_path, LAYOUT, GEROD, derived=tmp_path / "points").tiles
    assert tile.grid.bounds == (295500, 5629250, 295500 + SIDE, 5629250 + SIDE)
    (path,) = tile.paths(tile.layer("dtm"))
    np.testing.assert_allclose(read(path), heights - 1, atol=1e-4)
    before = path.stat().st_mtime_ns
    index(tmp_path, LAYOUT, GEROD, derived=tmp_path / "points")
    assert path.stat().st_mtime_ns == before
