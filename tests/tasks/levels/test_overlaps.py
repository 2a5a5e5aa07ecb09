"""Roads of one level that cross: a mistake of the vectors, unless they have a common vertex."""

import numpy as np
import pytest
import shapely
import shapely.affinity

from flexroad.catalog.grid import Grid
from flexroad.tasks.levels.abutments import crossing_notes
from flexroad.tasks.roads.rasterise import Options, roads
from flexroad.tasks.types import Source
from tests.make_roads import GRID as FILE_GRID
from tests.make_roads import on_grid, write

GRID = Grid("EPSG:25832", 500_000.0, 5_600_100.0, 1.0, 100, 100)
ALONG, ACROSS = ((30, 46), (70, 54)), ((47, 35), (54, 75))


def area(corners):
    """Return a polygon, or a box between two corners, by metres from the south-west corner of the grid."""
    own = shapely.box(*corners[0], *corners[1]) if len(corners) == 2 else shapely.Polygon(corners)
    return shapely.affinity.translate(own, GRID.west, GRID.south)


def notes(*roads_of, numbers=None, core=GRID):
    areas = np.array([area(corners) for corners in roads_of], object)
    return crossing_notes(areas, areas, np.array(numbers or [1] * len(areas)), core)


def test_roads_of_one_level_that_cross_are_noted_with_both_and_the_place():
    assert notes(ALONG, ACROSS) == (
        "segment: 1 pair of roads of level 1 cross without a common vertex, such as those around "
        "E 500050 N 5600050 and E 500050 N 5600055, at E 500050 N 5600050; give the upper one level 2, or "
        "both a vertex there if it is a junction",
    )
    (note,) = notes(ALONG, ACROSS, numbers=[-1, -1])
    assert "level -1" in note
    assert "give the lower one level -2" in note


@pytest.mark.parametrize(
    "other",
    [
        ((47, 35), (54, 46)),
        ((47, 35), (54, 50)),
        ((47, 35), (54, 54.1)),
        ((60, 46), (90, 54)),
        ((30, 53), (70, 60)),
        ((32, 44), (68, 56)),
    ],
    ids=["beside", "ends in it", "barely beyond it", "goes on", "parallel", "its deck"],
)
def test_roads_of_one_level_that_do_not_cross_are_not_noted(other):
    assert notes(ALONG, other) == ()


def test_roads_of_two_levels_or_on_the_ground_may_cross():
    assert notes(ALONG, ACROSS, numbers=[1, 2]) == ()
    assert notes(ALONG, ACROSS, numbers=[0, 0]) == ()


def test_crossing_is_noted_on_its_own_tile():
    west = Grid(GRID.crs, GRID.west, GRID.north, 1.0, 46, 100)
    assert notes(ALONG, ACROSS, core=west) == ()


@pytest.mark.parametrize(("junction", "number"), [(True, 0), (False, 1)])
def test_lines_that_share_a_vertex_are_a_junction(tmp_path, junction, number):
    middle = [(50, 50)] if junction else []
    lines = [
        shapely.LineString([on_grid(at)[0] for at in (start, *middle, end)])
        for start, end in (((20, 50), (80, 50)), ((50, 20), (50, 80)))
    ]
    path = write(tmp_path / "r.gpkg", lines, width=[6, 6], level=[1, 1])
    found = roads(Source("roads", (path,)), FILE_GRID, Options(), levels=True)
    assert len(crossing_notes(found.areas, found.shapes, found.level, FILE_GRID)) == number


@pytest.mark.parametrize(("corner", "number"), [([(47, 46)], 0), ([], 1)])
def test_areas_that_share_a_corner_are_a_junction(corner, number):
    along = [(30, 46), (47, 46), (70, 46), (70, 54), (30, 54)]
    across = [(47, 35), (54, 35), (54, 75), (47, 75), *corner]
    assert len(notes(along, across)) == number
