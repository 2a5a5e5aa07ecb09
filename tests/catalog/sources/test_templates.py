import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexroad.catalog import CatalogError
from flexroad.catalog.sources.templates import DSC3D, GEROD, Layout, index
from tests.make_rasters import UTM, write

FLAT = np.full((20, 20), 100, np.float32)
CORNERS = {"295500_5629250": (295500, 5629270), "295750_5629250": (295750, 5629270)}
"""Tiles of 20 m, by the corners of the paper's."""
TWO = {"dsm": "{stratum}/{tile}/dsm.tif", "dtm": "{stratum}/{tile}/dtm_*.tif"}


def write_tiles(root, layers=("dsm.tif", "dtm_2020.tif"), stratum="urban", crs=UTM):
    for tile, (west, north) in CORNERS.items():
        for name in layers:
            write(root / stratum / tile / name, FLAT, west, north, crs=crs)
    return root


def test_read_templates_give_id_layers_and_stratum(tmp_path):
    write_tiles(tmp_path)
    write(tmp_path / "rural" / "one" / "dsm.tif", FLAT, 1000, 2000)
    result = index(tmp_path, {"layers": TWO}, DSC3D)
    assert [(tile.id, tile.stratum, tile.dataset) for tile in result.tiles] == [
        ("295500_5629250", "urban", "DSC3D"),
        ("295750_5629250", "urban", "DSC3D"),
        ("one", "rural", "DSC3D"),
    ]
    first = result.tiles[0]
    assert first.layer("dtm").files == ("urban/295500_5629250/dtm_2020.tif",)
    assert first.grid.bounds == (295500, 5629250, 295520, 5629270)
    assert first.datetime_assumed
    assert result.notes[0] == "no dtm at '{stratum}/{tile}/dtm_*.tif' for 1 of 3 tiles: one"


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    tile=st.text("abcXYZ019_-.+()[]", min_size=1, max_size=12).filter(lambda name: name.strip(".")),
    template=st.sampled_from(
        ["dsm/{tile}.tif", "{tile}/dsm_{tile}.tif", "a.b/x_{tile}_1m.tif", "*/{tile}.tif"]
    ),
)
def test_read_any_id_is_kept(tmp_path_factory, tile, template):
    root = tmp_path_factory.mktemp("layout")
    write(root / template.replace("{tile}", tile).replace("*", "any"), FLAT)
    (result,) = index(root, {"layers": {"dsm": template, "dtm": "dtm/{tile}.tif"}}, DSC3D).tiles
    assert result.id == tile


def test_read_layout_sets_road_values_and_missing_crs(tmp_path):
    write_tiles(tmp_path, ("dsm.tif", "dtm_1.tif"))
    write_tiles(tmp_path, ("road.tif",), crs=None)
    layout = {"layers": TWO | {"road_mask": "*/{tile}/road.tif"}, "road_values": [2], "crs": UTM}
    layers = {layer.name: layer for layer in index(tmp_path, layout, DSC3D).tiles[0].layers}
    assert (layers["road_mask"].values, layers["road_mask"].crs) == ((2,), UTM)
    assert (layers["dsm"].values, layers["dsm"].crs) == ((), None)


@pytest.mark.parametrize(
    ("raw", "line"),
    [
        ({}, "no template for dsm"),
        ({"layers": {"dsm": "{tile}.tif"}}, "no template for dtm; a tile needs dsm and dtm"),
        ({"layers": {"dom": "{tile}.tif"}}, "unknown layer 'dom'; layers are dsm"),
        ({"layers": {"dsm": "dsm.tif"}}, r"dsm: 'dsm.tif' needs \{tile\}"),
        ({"layers": {"dsm": "{tile}_{year}.tif"}}, r"needs \{tile\} and may have \{stratum\}"),
        ({"layers": {"dsm": 3}}, "every template must be text"),
        ({"layers": ["dsm"]}, r"layers: expected a mapping of layers to templates, not \['dsm'\]"),
        ({"layer": {}}, "unknown key 'layer'; keys are layers"),
        ({"road_values": ["a"]}, "road_values: expected whole numbers"),
        ({"crs": 25832}, "crs: expected a CRS such as EPSG:25832, not 25832"),
    ],
)
def test_layout_invalid_raises_error(raw, line):
    with pytest.raises(CatalogError, match=line):
        Layout.of(raw)


def test_read_folder_not_matching_layout_raises_error(tmp_path):
    with pytest.raises(CatalogError, match="nowhere does not exist"):
        index(tmp_path / "nowhere", {"layers": TWO}, DSC3D)
    with pytest.raises(CatalogError, match=r"no usable file matches '\{stratum\}.*the folder is empty"):
        index(tmp_path, {"layers": TWO}, DSC3D)
    write_tiles(tmp_path)
    with pytest.raises(CatalogError, match="there are urban/.*dsm.tif.*--layout"):
        index(tmp_path, {"layers": TWO | {"dsm": "{tile}.tif"}}, DSC3D)
    with pytest.raises(CatalogError, match="is not a path below"):
        index(tmp_path, {"layers": TWO | {"dsm": "/{tile}.tif"}}, DSC3D)
    write_tiles(tmp_path / "feet", crs="EPSG:2994")
    with pytest.raises(CatalogError, match="whose unit is feet; reproject"):
        index(tmp_path / "feet", {"layers": TWO}, DSC3D)
    both = {"dsm": "urban/{tile}/d*.tif", "dtm": "urban/{tile}/dtm_*.tif"}
    with pytest.raises(CatalogError, match=r"dsm.tif and .*dtm_2020.tif are both the dsm of tile 295500"):
        index(tmp_path, {"layers": both}, DSC3D)


def test_gerod_tile_not_at_its_id_is_noted(tmp_path):
    write_tiles(tmp_path)
    result = index(tmp_path, {"layers": TWO}, GEROD)
    assert {tile.dataset for tile in result.tiles} == {"GeRoD"}
    assert result.notes[1:] == ("2 of the dataset's 240 tiles are here",)
    write(tmp_path / "rural" / "295000_5629250" / "dsm.tif", FLAT, 296000, 5629270)
    moved = index(tmp_path, {"layers": TWO}, GEROD)
    assert "not at the corner given by the tile's name: 295000_5629250; check layout and CRS" in moved.notes


def test_dsc3d_missing_reference_is_noted(tmp_path):
    write_tiles(tmp_path, ("dsm.tif", "dtm_1.tif", "truth.tif"), stratum="a")
    whole = index(tmp_path, {"layers": TWO | {"reference": "a/{tile}/truth.tif"}}, DSC3D)
    assert whole.notes[1:] == ()
    assert {tile.dataset for tile in whole.tiles} == {"DSC3D"}
    without = index(tmp_path, {"layers": TWO}, DSC3D)
    assert without.notes[1:] == (
        "no reference for 295500_5629250, 295750_5629250: the DTM is used instead, unlike in the paper",
    )
