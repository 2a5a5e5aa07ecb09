"""Roads around Autzen Stadium: centre lines with a width, compared with roads drawn as polygons."""

import numpy as np
import pytest

from flexroad.catalog import Grid
from flexroad.tasks.roads.rasterise import Options, rasterise_roads
from flexroad.tasks.segment import vector
from flexroad.tasks.types import Source, TileData

pytestmark = pytest.mark.real

NORTH = Grid.covering("EPSG:2993", (193_500, 259_500, 195_000, 260_250), 1.0)
"""The whole northern area, with cells of 1 m."""
CERTAIN = "class = 'road' AND certainty <> 'low'"


@pytest.fixture
def north(real_data) -> TileData:
    path = real_data / "autzen" / "roads" / "autzen_north_roads.gpkg"
    flat = np.zeros(NORTH.shape)
    return TileData("north", NORTH, NORTH, flat, flat, roads=Source("roads", (path,)))


def iou(data: TileData, **options) -> float:
    """IoU of centre lines and polygons, without the cells of uncertain polygons."""
    areas = f"{CERTAIN} AND visible_in <> 'rgb'"
    truth = rasterise_roads(data, Options(layer="road_polygons", where=areas))
    uncertain = rasterise_roads(
        data, Options(layer="road_polygons", where="class = 'road' AND certainty = 'low'")
    )
    mask = vector.segment(data, vector.Options(layer="road_centerlines", where=CERTAIN, **options)).mask
    return float((mask & truth)[~uncertain].sum() / (mask | truth)[~uncertain].sum())


def test_segment_centre_lines_with_own_width_match_roads(north):
    assert iou(north) >= 0.85


def test_segment_single_width_matches_worse(north):
    """7.5 m is the median width of the lines, 12 m about their mean weighted by length."""
    for width, most in ((7.5, 0.62), (12.0, 0.72)):
        assert iou(north, width_columns=(), class_columns=(), default_width_m=width) < most
