"""Roads as lines in space: slopes of their segments, and the file."""

from datetime import UTC, datetime

import geopandas
import numpy as np
import pytest
import shapely
from pyproj import CRS

from flexroad.catalog.crs import compound
from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads.routes import CentreLine, Route
from flexroad.tools.export import road_lines
from flexroad.tools.export.reference_line import ReferenceLine, reference_line
from flexroad.tools.export.road_lines import Road, stations

DATE = datetime(2025, 3, 1, tzinfo=UTC)


def road(number: int, segments: int, lanes: int | None = None) -> Road:
    x = np.arange(segments + 1.0)
    points = np.column_stack([500_000 + x, np.full_like(x, 5_600_000 + number), 100 + x / 8])
    error = np.where(np.arange(segments) % 2, 0.05, np.nan)
    height_source = np.arange(segments, dtype=np.uint8) % 4
    columns = {"id": number, "name": f"Road {number}", "lanes": lanes}
    numbers = {"grade_percent": np.full(segments, 12.5), "error_m": error}
    return columns, {"points": points, "height_source": height_source, **numbers}


@pytest.mark.parametrize("batch", [1, 50_000])
def test_write_lines_and_segments_have_heights_and_columns(tmp_path, monkeypatch, batch):
    monkeypatch.setattr(road_lines, "BATCH", batch)
    path = tmp_path / "roads.gpkg"
    road_lines.write(path, (road(k, 3 + k, 2) for k in (1, 2)), compound("EPSG:25832", "EPSG:7837"), DATE)
    roads = geopandas.read_file(path, layer="roads")
    assert roads["id"].tolist() == [1, 2]
    assert roads["name"].tolist() == ["Road 1", "Road 2"]
    assert roads["lanes"].tolist() == [2, 2]
    assert CRS(roads.crs).is_compound
    np.testing.assert_array_equal(
        shapely.get_coordinates(roads.geometry[1], include_z=True), road(2, 5)[1]["points"]
    )
    segments = geopandas.read_file(path, layer="segments")
    assert segments.road_id.tolist() == [1] * 4 + [2] * 5
    assert segments.height_source.fillna("").tolist()[:4] == ["", "measured", "dtm", "inferred"]
    np.testing.assert_array_equal(
        shapely.get_coordinates(segments.geometry[8], include_z=True), road(2, 5)[1]["points"][-2:]
    )


def test_write_unknown_numbers_are_null_and_equal_roads_give_equal_bytes(tmp_path):
    for name in ("roads.gpkg", "again.gpkg"):
        road_lines.write(tmp_path / name, [road(1, 4)], "EPSG:25832", DATE)
    path = tmp_path / "roads.gpkg"
    assert path.read_bytes() == (tmp_path / "again.gpkg").read_bytes()
    segments = geopandas.read_file(path, layer="segments")
    assert segments.error_m.isna().tolist() == [True, False, True, False]
    assert geopandas.read_file(path, layer="roads").lanes.isna().all()
    assert len(geopandas.read_file(path, layer="segments", where="error_m IS NULL")) == 2
    with pytest.raises(TaskError, match=r"roads.gpkg cannot be written: .*; check the disk"):
        road_lines.write(tmp_path / "none" / "roads.gpkg", [road(1, 4)], "EPSG:25832", DATE)


def line(*points: tuple[float, float], width: float = 6.0) -> ReferenceLine:
    found = reference_line(Route((CentreLine(np.array(points), width),)))
    assert found is not None
    return found


def test_stations_of_a_plane_have_its_slopes():
    # North-east: up 3% along it, and 2% down to the left.
    along, left = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    found = stations(
        line((0, 0), (60.3, 80.4)),
        lambda x, y: 100 + 0.03 * (x * along[0] + y * along[1]) - 0.02 * (x * left[0] + y * left[1]),
    )
    np.testing.assert_allclose(np.diff(found.s), 1.0, atol=1e-6)
    assert len(found.height) == 100
    np.testing.assert_allclose(found.height, 100 + 0.03 * (found.s[:-1] + 0.5), atol=1e-6)
    np.testing.assert_allclose(found.grade, 0.03, atol=1e-6)
    for slope, value in ((found.crossfall, -0.02), (found.left, -0.02), (found.right, 0.02)):
        np.testing.assert_allclose(slope, value, atol=1e-6)
    np.testing.assert_allclose(found.curvature, 0, atol=1e-6)
    np.testing.assert_allclose(found.width, 6.0)


def test_stations_of_a_crowned_road_fall_to_both_sides():
    found = stations(line((0, 0), (50, 0)), lambda x, y: 10 - 0.025 * np.abs(y))
    np.testing.assert_allclose(found.crossfall, 0, atol=1e-9)
    np.testing.assert_allclose(found.left, -0.025, atol=1e-9)
    np.testing.assert_allclose(found.right, -0.025, atol=1e-9)


@pytest.mark.parametrize("side", [1, -1])
def test_stations_of_a_bend_have_its_curvature(side):
    turn = np.linspace(0, 1.5, 40)
    points = np.stack([50 * np.sin(turn), side * (50 - 50 * np.cos(turn))], axis=1)
    found = stations(line(*map(tuple, points)), lambda x, y: 0 * x)
    np.testing.assert_allclose(found.curvature[10:-10], side / 50, rtol=0.1)


def test_stations_where_an_edge_has_no_height_have_no_slope_there():
    found = stations(line((0, 0), (50, 0)), lambda x, y: np.where(y > 2, np.nan, 5.0))
    assert np.isfinite(found.height).all()
    assert np.isfinite(found.right).all()
    assert np.isnan(found.left).all()
    assert np.isnan(found.crossfall).all()
