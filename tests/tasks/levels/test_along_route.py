"""The level of places along routes: on decks, near their ends, and elsewhere."""

import numpy as np
import pytest

from flexroad.tasks.levels.along_route import Structure, route_levels, structures
from flexroad.tasks.roads.routes import CentreLine, Route


def route(*parts):
    """Return a straight route along x from lengths and levels."""
    ends = np.cumsum([0, *(length for length, _ in parts)])
    lines = zip(ends[:-1], ends[1:], parts, strict=True)
    return Route(tuple(CentreLine(np.array([[a, 0.0], [b, 0.0]]), 6.0, level=k) for a, b, (_, k) in lines))


def test_route_on_the_ground_has_no_levels():
    assert route_levels(route((50, 0), (30, 0))) is None


@pytest.mark.parametrize(
    ("parts", "x", "numbers", "own"),
    [
        ([(50, 0), (30, 1), (50, 0)], [33, 35, 51, 79, 95, 97], [0, 1, 1, 1, 1, 0], [1, 0, 1, 1, 0, 1]),
        # Short pieces: the middle between two decks, a whole end of a road.
        ([(30, 1), (20, 0), (30, -1), (9, 0)], [29, 39, 41, 51, 88], [1, 1, -1, -1, -1], [1, 0, 0, 1, 0]),
        ([(30, 1), (30, 2), (40, 0)], [29, 31, 59, 61, 77], [1, 2, 2, 2, 0], [1, 1, 1, 0, 1]),
        ([(10, 1), (10, 1), (40, 0)], [9, 11, 21, 40], [1, 1, 1, 0], [1, 1, 0, 1]),
    ],
)
@pytest.mark.parametrize("aside", [0.0, -4.0])
def test_decks_go_on_for_16_m(parts, x, numbers, own, aside):
    found = route_levels(route(*parts))(np.array(x, float)[:, None], np.full((1, 2), aside))
    assert found.number[:, 1].tolist() == numbers
    assert found.own[:, 0].tolist() == [bool(each) for each in own]
    assert found.of_line[:, 0].tolist() == [k if mine else 0 for k, mine in zip(numbers, own, strict=True)]


def test_structures_are_the_pieces_off_the_ground():
    levels = np.array([0, 0, 1, 1, 1, 2, 2, 0, -1, 0, -1, -1], np.int8)
    found = structures(levels, np.arange(12) / 2)
    assert found == (Structure(1, 1.0, 2.0), Structure(2, 2.5, 3.0), Structure(-1, 5.0, 5.5))
    assert structures(levels[:2], np.arange(2.0)) == ()
