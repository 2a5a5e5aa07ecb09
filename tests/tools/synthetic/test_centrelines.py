import numpy as np
import pytest
import shapely

from flexroad.catalog import Grid
from flexroad.tasks.roads.rasterise import cells
from flexroad.tools.synthetic import SceneOptions, make_scene
from flexroad.tools.synthetic.scene import centre_lines

GRID = Grid("EPSG:25832", 295500, 5629500, 1.0, 200, 200)


@pytest.mark.parametrize(
    ("stratum", "options"),
    [
        (None, SceneOptions()),
        ("urban", SceneOptions(medians=1.0, roundabouts=1.0)),
        ("rural", SceneOptions(sunken_share=1.0, stream_share=0.0)),
    ],
)
def test_centre_lines_buffered_by_width_cover_true_roads(stratum, options):
    lines = centre_lines(GRID, 3, stratum, options)
    half = np.array([line.width_m for line in lines]) / 2
    road = cells(shapely.buffer([shapely.LineString(line.points) for line in lines], half), GRID)
    truth = make_scene(GRID, 3, stratum, options).reference_road
    # The ends of medians and the islands of roundabouts are not represented.
    assert (road & truth).sum() / (road | truth).sum() > 0.93
