"""Heights of roads on several levels."""

from dataclasses import replace

import numpy as np
import pytest

from flexroad.pipeline.run.sampler import on_levels
from flexroad.tasks.levels.along_route import PlaceLevels
from tests.tasks.spline.test_levelled import GRID, SOUTH, WEST, made_surface

STEP_M = 0.5


@pytest.fixture
def surface():
    """A deck 7 m above the ground, from 25 to 45 m, with an approach from 9 m; and steps everywhere."""
    surface = made_surface(own=100.0, deck=107.0)
    steps = np.full(GRID.shape, STEP_M, np.float32)
    return replace(surface, steps=steps)


@pytest.mark.parametrize(
    ("x", "y", "number", "own", "height", "step"),
    [
        (35, 24, 1, True, 107, 0),
        (35, 29, 1, True, 107, 0),  # beside the deck
        (35, 24, 0, True, 100, STEP_M),  # below it
        (20, 24, 0, True, 107, STEP_M),  # on the approach, level 0 has the deck's surface
        (20, 31, 1, False, 107, 0),  # beside the approach
        (20, 34, 1, False, 100, STEP_M),  # farther away the deck's surface does not count
        (46, 24, 1, False, 100, STEP_M),  # where no road goes on from the deck
        (44, 24, 1, False, 107, 0),  # the deck is longer than its centre line
        (35, 24, -1, True, np.nan, 0),  # a tunnel that was left out
        (50, 24, -1, False, 100, STEP_M),
        (50, 24, 2, True, 100, STEP_M),  # no deck of this level is known
    ],
)
def test_height_is_that_of_the_level(surface, x, y, number, own, height, step):
    at = np.array([WEST + x, WEST + 55.0]), np.array([SOUTH + y, SOUTH + 24.0])
    levels = PlaceLevels(np.array([number, 0], np.int8), np.array([own, True]))
    np.testing.assert_allclose(on_levels(surface, *at, levels), [height, 100], atol=1e-9)
    np.testing.assert_allclose(on_levels(surface, *at, levels, steps=True), [step, STEP_M], atol=1e-9)
