"""Roads of Autzen Stadium's surroundings: centre lines by their width against the roads drawn as polygons."""

import numpy as np
import pytest

from flexroad.catalog import Grid
from flexroad.tasks.roads.rasterise import Options, rasterise_roads
from flexroad.tasks.segment import vector
from flexroad.tasks.types import Source, TileData

pytestmark = pytest.mark.real

NORTH = Grid.covering("EPSG:2993", (193_500, 259_500, 195_000, 260_250), 1.0)
"""All of the north, cells of 1 m."""
SURE = "class = 'road' AND certainty <> 'low'"


@pytest.fixture
def north(real_data) -> TileData:
    path = real_data / "autzen" / "roads" / "autzen_north_roads.gpkg"
    flat = np.zeros(NORTH.shape)
    return TileData("north", NORTH, NORTH, flat, flat, roads=Source("roads", (path,)))


def iou(data: TileData, **options) -> float:
    """Of centre lines against polygons; what is uncertain counts in neither."""
    areas = f"{SURE} AND visible_in <> 'rgb'"
    truth = rasterise_roads(data, Options(layer="road_polygons", where=areas))
    unsure = rasterise_roads(
        data, Options(layer="road_polygons", where="class = 'road' AND certainty = 'low'")
    )
    found = vector.segment(data, vector.Options(layer="road_centerlines", where=SURE, **options)).mask
    return float((found & truth)[~unsure].sum() / (found | truth)[~unsure].sum())


def test_centre_lines_with_their_width_are_the_roads(north):
    assert iou(north) >= 0.85


def test_one_width_for_all_is_worse(north):
    """7.5 m, the lines' median; and 12 m, about their mean by length."""
    for width, most in ((7.5, 0.62), (12.0, 0.72)):
        assert iou(north, width_columns=(), class_columns=(), default_width_m=width) < most
