"""Features from others: a coordinate that is no place costs its feature, nothing more."""

import geopandas
import numpy as np
import pytest
import shapely

from flexroad.tasks import TaskError, memory
from flexroad.tasks.io.vectors import Query, has_place, read_near

CRS = "EPSG:25832"
BOUNDS = (399_000.0, 5_699_000.0, 400_080.0, 5_700_100.0)
GOOD = shapely.box(400_010, 5_700_010, 400_030, 5_700_050)


def write(path, number, crs):
    """Write a good road between two with a coordinate that is no place; they cross the borders of squares."""
    corners = [(399_000, 5_699_000), (400_050, number), (405_000, 5_710_000)]
    shapes = geopandas.GeoSeries([shapely.LineString(corners), GOOD, shapely.Polygon(corners)], crs=CRS)
    if crs != CRS:
        degrees = [(7.55, 51.43), (7.56, number), (7.65, 51.6)]
        good = shapes.iloc[[1]].to_crs(crs).iloc[0]
        shapes = geopandas.GeoSeries([shapely.LineString(degrees), good, shapely.Polygon(degrees)], crs=crs)
    geopandas.GeoDataFrame({"id": [1, 2, 3]}, geometry=shapes).to_file(path)
    return Query(path, None, None, ("id",), None, CRS)


@pytest.mark.parametrize("crs", [CRS, "EPSG:4326"])
@pytest.mark.parametrize("suffix", ["gpkg", "fgb", "geojson"])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e300])
def test_coordinate_that_is_no_place_costs_its_feature(tmp_path, number, suffix, crs):
    assert list(read_near(write(tmp_path / f"a.{suffix}", number, crs), BOUNDS)["id"]) == [2]


def test_file_to_be_read_as_a_whole_is_compared_with_memory(tmp_path, monkeypatch):
    query = write(tmp_path / "a.fgb", np.nan, "EPSG:4326")
    monkeypatch.setattr(memory, "limit", lambda: 100)
    with pytest.raises(
        TaskError, match=r"a.fgb, read as a whole, would need .*remove features with infinite"
    ):
        read_near(query, BOUNDS)


def test_has_place_looks_at_every_coordinate():
    lines = [shapely.LineString([(0, 0), (1, y), (2, 2)]) for y in (1, np.nan, np.inf, 1e12)]
    assert list(has_place(np.array([*lines, shapely.Point(), GOOD], object))) == [
        True,
        *[False] * 3,
        True,
        True,
    ]
