"""The morphological ground filter against loops over all cells, and on surfaces with known ground."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.tasks.errors import TaskError
from flexroad.tools.prepare.points import ground_filter
from flexroad.tools.prepare.points.morphological import Options, ground

EXACT = Options(tolerance_m=0.01, low_m=None)


def lattice(side=60):
    """Return points 1 m apart, each in the middle of a cell."""
    x, y = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    return x.ravel(), y.ravel()


def literal(x, y, z, options):
    """Compute openings by loops over cells, without a picture library."""
    lowest = {}
    for c, r, h in zip(np.floor(x / options.cell_m), np.floor(y / options.cell_m), z, strict=True):
        lowest[r, c] = min(h, lowest.get((r, c), np.inf))
    rows, cols = ([int(key[axis]) for key in lowest] for axis in (0, 1))
    cells = [(r, c) for r in range(min(rows), max(rows) + 1) for c in range(min(cols), max(cols) + 1)]

    def disk(cell, size):
        return [other for other in cells if (other[0] - cell[0]) ** 2 + (other[1] - cell[1]) ** 2 <= size**2]

    limit = dict(lowest)
    for size in range(1, round(options.radius_m / options.cell_m) + 1):
        least = {cell: min(lowest.get(other, np.inf) for other in disk(cell, size)) for cell in cells}
        for cell in lowest:
            opened = max(least[other] for other in disk(cell, size) if np.isfinite(least[other]))
            limit[cell] = min(limit[cell], opened + options.slope * options.cell_m * size)
    cols, rows = np.floor(x / options.cell_m), np.floor(y / options.cell_m)
    own = np.array([limit[cell] for cell in zip(rows, cols, strict=True)])
    return z <= own + options.slope * options.cell_m + options.tolerance_m


@settings(max_examples=30)
@given(st.integers(0, 999), st.integers(1, 60), st.sampled_from([1.0, 2.0]))
def test_ground_equals_literal_openings(seed, number, cell):
    """Cells without points, inside and along the edge, included."""
    rng = np.random.default_rng(seed)
    x, y, z = rng.uniform(-9, 9, number), rng.uniform(100, 112, number), 4 * rng.random(number) ** 3
    options = EXACT.model_copy(update={"radius_m": 4.0, "cell_m": cell})
    np.testing.assert_array_equal(ground(x, y, z, options), literal(x, y, z, options))


@pytest.mark.parametrize("fall", [0.0, 0.05, 0.1])
def test_ground_plane_up_to_the_slope_is_all_ground(fall):
    x, y = lattice()
    assert ground(x, y, fall * x, EXACT).all()


def test_ground_above_a_wall_is_kept_and_rejected_by_the_slope_filter():
    x, y = lattice()
    z = np.where(x > 30, 4.0, 0.0)
    assert ground(x, y, z, Options()).all()
    assert not ground_filter.ground(x, y, z, ground_filter.Options())[(x > 30) & (x < 35)].any()


@pytest.mark.parametrize(("half", "stays"), [(8, False), (16, True)])
def test_ground_roof_is_removed_up_to_the_radius(half, stays):
    x, y = lattice()
    inside = np.maximum(abs(x - 30), abs(y - 30)) < half
    is_ground = ground(x, y, np.where(inside, 8.0, 0.0), Options(radius_m=12))
    assert is_ground[~inside].all()
    assert is_ground[inside].any() == stays


def test_ground_deck_across_a_cutting_is_removed_but_for_its_ends():
    """A disk that touches the ground at an end covers corners of the deck."""
    x, y = lattice(90)
    deck, cutting = abs(y - 45) <= 4, abs(x - 45) < 12
    is_ground = ground(x, y, np.where(cutting & ~deck, 0.0, 6.0), Options())
    assert not is_ground[deck & (abs(x - 45) < 9)].any()
    assert is_ground[~deck].all()


def test_ground_low_outliers_have_no_effect():
    x, y = lattice()
    z = np.zeros_like(x)
    z[1830] = -5.0
    is_ground = ground(x, y, z, Options())
    assert np.flatnonzero(~is_ground).tolist() == [1830]


def test_ground_depends_on_near_points_alone_in_any_order():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 100, (2, 5000))
    z = 0.1 * x + 5 * (rng.random(5000) < 0.2)
    options = Options(radius_m=6)
    expected = ground(x, y, z, options)
    inner = np.maximum(abs(x - 50), abs(y - 50)) < 20
    near = np.flatnonzero(np.maximum(abs(x - 50), abs(y - 50)) < 20 + options.reach_m)
    near = rng.permutation(near)
    result = np.zeros_like(expected)
    result[near] = ground(x[near], y[near], z[near], options)
    np.testing.assert_array_equal(result[inner], expected[inner])
    assert 0 < expected.sum() < expected.size


@pytest.mark.parametrize(
    ("filter_", "options"), [(ground, Options()), (ground_filter.ground, ground_filter.Options())]
)
def test_ground_of_both_filters_is_empty_without_valid_points_and_needs_equal_lengths(filter_, options):
    assert filter_(*np.zeros((3, 0)), options).shape == (0,)
    assert not filter_(np.zeros(3), np.zeros(3), np.array([np.nan, np.inf, -np.inf]), options).any()
    with pytest.raises(TaskError, match=r"\(3,\), \(3,\) and \(2,\)"):
        filter_(np.zeros(3), np.zeros(3), np.zeros(2), options)
