import geopandas
import numpy as np
import pytest
from shapely import LineString, box

from flexroad.tasks import TaskError
from flexroad.tasks.segment.vector import VERSION, Options, segment
from tests.make_roads import GRID, in_cp1252, on_grid, tile, write

LINE = LineString(on_grid((0, 50), (100, 50)))
GOLDEN = (2, 2045, 106474, 109174, 672)
"""Version, cells of the mask, sums of their rows and columns, cells on bridges."""


def test_segment_lines_give_mask_and_bridges(tmp_path):
    lines = [LineString(on_grid((0, 50), (60, 50))), LineString(on_grid((60, 50), (100, 50)))]
    road = segment(
        tile(write(tmp_path / "r.gpkg", lines, width=["6 m"] * 2, bridge=["no", "yes"])), Options()
    )
    truth = np.zeros(GRID.shape, bool)
    truth[47:53] = True
    np.testing.assert_array_equal(road.mask, truth)
    np.testing.assert_array_equal(road.bridge, truth & (np.arange(100) >= 60))
    assert (road.grid, road.core, road.probability, road.notes) == (GRID, GRID, None, ())
    assert not road.outside.any()


def test_segment_lines_in_degrees_are_reprojected(tmp_path):
    lines = list(geopandas.GeoSeries([LINE], crs=GRID.crs).to_crs("EPSG:4326"))
    metres = write(tmp_path / "m.gpkg", [LINE], width=[6.4])
    degrees = write(tmp_path / "d.geojson", lines, "EPSG:4326", width=[6.4])
    projected, reprojected = (segment(tile(path), Options()) for path in (metres, degrees))
    np.testing.assert_array_equal(projected.mask, reprojected.mask)


def test_segment_file_without_crs_uses_that_of_catalog(tmp_path):
    with pytest.warns(UserWarning, match="'crs' was not provided"):
        path = write(tmp_path / "r.gpkg", [LINE], None, width=[6])
    with pytest.raises(
        TaskError, match="r.gpkg carries no CRS; give it one, e.g. ogr2ogr -a_srs EPSG:25832"
    ) as caught:
        segment(tile(path), Options())
    assert caught.value.file == str(path)
    assert segment(tile(path, crs=GRID.crs), Options()).mask.sum() == 600


BESIDE = LineString(on_grid((0, -10), (100, -10)))


@pytest.mark.parametrize(
    ("line", "crs", "options", "cells"),
    [
        (BESIDE, GRID.crs, {}, 600),
        (LINE, GRID.crs, {"where": "width = 7"}, 0),
        (LINE, "EPSG:3857", {}, 0),
    ],
    ids=["in the halo", "not selected", "elsewhere"],
)
def test_segment_no_road_on_tile_gives_a_note(tmp_path, line, crs, options, cells):
    path = write(tmp_path / "r.gpkg", [line], crs, width=[6])
    road = segment(tile(path, grid=GRID.buffered(20), core=GRID), Options(**options))
    assert road.mask.sum() == cells
    assert road.notes[-1].startswith("segment: no road of r.gpkg lies on this tile; ")
    assert "segment.where" in road.notes[-1]


def test_segment_several_files_are_merged(tmp_path):
    lines = write(tmp_path / "a.gpkg", [LINE], width=[6])
    areas = write(tmp_path / "b.geojson", [box(*on_grid((0, 0))[0], *on_grid((10, 10))[0])])
    assert segment(tile(lines, areas), Options()).mask.sum() == 700


@pytest.mark.parametrize(
    ("make", "options", "message"),
    [
        (lambda path: None, {}, "cannot be opened .*put it back"),
        (lambda path: path.write_text("roads"), {}, "is not a vector file"),
        (lambda path: write(path, [LINE]), {"layer": "ways"}, "has no layer 'ways'; it has r"),
        (lambda path: write(path, [LINE]), {"where": "kind = 1"}, "cannot be read as roads: .*segment.where"),
        (lambda path: path.write_bytes(b"SQLite format 3\0" + bytes(4000)), {}, "is not a vector file"),
    ],
)  # fmt: skip
def test_segment_unusable_file_raises_one_line(tmp_path, make, options, message):
    path = tmp_path / "r.gpkg"
    make(path)
    with pytest.raises(TaskError, match=message) as caught:
        segment(tile(path), Options(**options))
    assert "\n" not in str(caught.value)
    assert caught.value.layer == "roads"


def test_segment_damaged_file_raises(tmp_path):
    path = write(tmp_path / "r.geojson", [LINE] * 50)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(TaskError, match="r.geojson cannot be read"):
        segment(tile(path), Options())
    # The CRS is no text.
    path = write(tmp_path / "r.shp", [LINE])
    crs = path.with_suffix(".prj")
    crs.write_bytes(crs.read_bytes().replace(b"ETRS", b"\xd8TRS"))
    with pytest.raises(TaskError, match="cannot be read as vectors"):
        segment(tile(path), Options())


def test_segment_tile_that_no_file_reaches_has_no_road_and_a_note():
    road = segment(tile(), Options())
    assert not road.mask.any()
    assert not road.bridge.any()
    assert road.notes == (
        "segment: no file of the roads layer reaches this tile, so it counts as a tile without roads",
    )


def test_segment_golden(tmp_path):
    """After an intended change of the mask, raise VERSION, so that stored masks are recomputed."""
    lines = [
        LineString(on_grid((5, 12), (48, 50.3), (95, 71))),
        LineString(on_grid((48, 50.3), (20, 95))),
        LineString(on_grid((60, 5), (64, 95))),
        LineString(on_grid((2, 70), (98, 40))),
        box(*on_grid((70, 10))[0], *on_grid((91.2, 22.7))[0]),
    ]
    attributes = {
        "highway": ["secondary", "service", "residential", "cycleway", "pedestrian_zone"],
        "width": ["7,5", None, "24'6\"", None, None],
        "lanes": [None, "2", None, None, None],
        "bridge": [None, None, "yes", None, None],
    }
    road = segment(tile(write(tmp_path / "r.gpkg", lines, **attributes)), Options())
    rows, cols = np.nonzero(road.mask)
    sums = int(rows.sum()), int(cols.sum())
    assert (VERSION, len(rows), *sums, int(road.bridge.sum())) == GOLDEN


def test_class_in_another_encoding_than_declared_costs_no_road(tmp_path):
    path = write(tmp_path / "a.shp", [LINE], highway=["xxxxxxx"])
    in_cp1252(path, "xxxxxxx", "Straße ")
    declared = write(tmp_path / "b.shp", [LINE], highway=["Straße"])
    road, expected = (segment(tile(file), Options()) for file in (path, declared))
    assert np.array_equal(road.mask, expected.mask)
    assert road.mask.any()
    assert "was read as cp1252" in road.notes[0]
    assert not any("cp1252" in note for note in expected.notes)
