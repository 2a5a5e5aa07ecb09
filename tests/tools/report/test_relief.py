"""The background of the map shows relief, roads and the limit of the survey."""

import io

import numpy as np
from PIL import Image

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import RoadMask
from flexroad.tools.report.pictures import _square, webp

CORE = Grid("EPSG:25832", 588_000.0, 5_519_250.0, 1.0, 250, 250)
WIDE = Grid("EPSG:25832", 587_950.0, 5_519_300.0, 1.0, 350, 350)
ROW, COL = np.indices(WIDE.shape)


class Slope:
    """A plane that rises to one side."""

    bounds = WIDE.bounds

    def __init__(self, east, north):
        self.east, self.north = east, north

    def lattice(self, eastings, northings):
        return self.east * eastings[None, :] + self.north * northings[:, None]


def square(surface, mask=ROW < 0, outside=ROW < 0, side=50):
    return _square(surface, RoadMask(WIDE, CORE, mask, outside), side).astype(int)


def test_roads_are_darker_where_they_lie():
    # The core begins 50 cells into the grid.
    grey = square(Slope(0, 0), mask=(COL >= 50) & (COL < 100))[..., 0]
    assert grey[:, :10].max() < grey[:, 10:].min() - 50
    assert grey.shape == (50, 50)


def test_slopes_that_face_north_west_are_lighter():
    assert square(Slope(0.1, -0.1))[..., 0].mean() > square(Slope(-0.1, 0.1))[..., 0].mean() + 20


def test_cells_beyond_the_survey_are_transparent():
    opacity = square(Slope(0, 0), outside=ROW >= 175)[..., 1]
    assert (opacity[:25] == 255).all()
    assert (opacity[25:] == 0).all()


def test_webp_is_smaller_and_has_the_width_asked_for():
    buffer = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (300, 400, 3)).astype(np.uint8)
    Image.fromarray(noise).save(buffer, "png")
    small = webp(buffer.getvalue(), 200)
    assert Image.open(io.BytesIO(small)).size == (200, 150)
    assert len(small) < len(buffer.getvalue())
    assert Image.open(io.BytesIO(webp(buffer.getvalue(), 500))).size == (400, 300)
