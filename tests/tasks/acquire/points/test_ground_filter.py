import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.tasks import TaskError
from flexroad.tasks.acquire.points.ground_filter import Options, ground, ground_cells
from tests.tasks.acquire.points import ground_oracle as oracle

EXACT = Options(slope=0.3, noise_m=0, low_m=None)

# Eighths of a metre are exact in binary: distances hit the radius, drops the limit, points each other.
eighths = st.integers(0, 160).map(lambda n: n / 8)
anywhere = st.floats(0, 20, allow_nan=False)
heights = st.one_of(st.integers(-16, 80).map(lambda n: n / 8), st.floats(-2, 10), st.just(np.nan))
clouds = st.lists(
    st.tuples(st.one_of(eighths, anywhere), st.one_of(eighths, anywhere), heights), min_size=1, max_size=60
).map(np.array)
rules = st.builds(
    Options,
    radius_m=st.sampled_from([0.125, 1.0, 1.25, 5.0, 30.0]),
    slope=st.sampled_from([0.0, 0.125, 0.3, 1.0]),
    noise_m=st.sampled_from([0.0, 0.05]),
    low_m=st.sampled_from([None, 0.125, 1.0]),
    low_radius_m=st.sampled_from([0.5, 5.0, 10.0]),
    low_companions=st.integers(0, 2),
)


def same(cloud, options):
    np.testing.assert_array_equal(ground(*cloud, options), oracle.ground(*cloud, options))


@given(clouds, rules)
@settings(max_examples=300, deadline=None)
def test_ground_is_that_of_all_pairs(points, options):
    same(points.T, options)


def lattice(n=60):
    """Cell centres of 1 m."""
    y, x = np.indices((n, n)).reshape(2, -1).astype(float)
    return x, y


def rough(seed, n=600, side=40.0):
    """Rolling ground at map coordinates with boxes, noise, and some points far below."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, side, (2, n))
    z = 2 * np.sin(x / 9) + np.cos(y / 7) + rng.normal(0, 0.05, n)
    z += 5 * ((x % 17 < 6) & (y % 13 < 7))
    z[rng.choice(n, 4, replace=False)] -= rng.uniform(2, 9, 4)
    return np.array([x + 356_000.25, y + 5_645_000.5, z + 80])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "options",
    [
        Options(low_companions=1),
        Options(radius_m=3, slope=0.1, low_m=None),
        Options(radius_m=12, slope=0.6, noise_m=0, low_radius_m=6),
    ],
)
def test_ground_is_that_of_all_pairs_at_map_coordinates(seed, options):
    cloud = rough(seed)
    same(cloud, options)
    assert 0 < ground(*cloud, options).sum() < cloud.shape[1]


def test_low_points_are_left_out_unless_they_have_companions():
    x, y = lattice()
    z = np.zeros_like(x)
    single, pair, pit = (x == 5) & (y == 7), (x // 2 == 20) & (y == 9), (abs(x - 30) < 2) & (abs(y - 45) < 2)
    z[single | pair | pit] = -4
    found = ground(x, y, z, EXACT.model_copy(update={"low_m": 0.5, "low_companions": 1}))
    assert not found[single | pair].any()
    assert found[pit].all()
    # The pit's walls make objects of what is near it, as far as ground could have fallen by its depth.
    far = np.hypot(x - 30, y - 45) > 4 / EXACT.slope + 3
    assert found[far & ~single & ~pair].all()
    assert ground(x, y, z, EXACT)[single | pair | pit].all()


def test_few_ground_points_of_a_thin_cloud_are_no_outliers():
    x = np.arange(20) * 3.0
    z = np.where(np.arange(20) % 5 == 0, 0.0, 8.0)
    np.testing.assert_array_equal(ground(x, np.zeros(20), z, Options()), z == 0)


@pytest.mark.parametrize("options", [EXACT, Options(low_companions=1)])
def test_a_cloud_turned_moved_or_shuffled_has_the_same_ground(options):
    x, y, z = rough(1)
    x, y, z = np.round([x * 8, y * 8, z * 1024]) / [[8], [8], [1024]]
    here = ground(x, y, z, options)
    np.testing.assert_array_equal(ground(-y, x, z, options), here)
    np.testing.assert_array_equal(ground(x - 356_128, y + 64, z - 64, options), here)
    order = np.random.default_rng(0).permutation(z.size)
    np.testing.assert_array_equal(ground(x[order], y[order], z[order], options), here[order])


def test_a_level_plane_is_all_ground():
    x, y = lattice()
    assert ground(x, y, np.zeros_like(x), EXACT).all()


@pytest.mark.parametrize(("fall", "kept"), [(0.25, True), (0.2501, False)])
def test_a_slope_is_ground_up_to_the_limit(fall, kept):
    x, y = lattice()
    found = ground(x, y, fall * x, EXACT.model_copy(update={"slope": 0.25}))
    assert found[x > 0].all() if kept else not found[x > 0].any()
    assert found[x == 0].all()


@pytest.mark.parametrize(("half", "stays"), [(10, False), (16, True)])
def test_of_a_roof_only_what_is_farther_than_the_radius_from_its_edge_is_ground(half, stays):
    x, y = lattice()
    inside = np.maximum(abs(x - 30), abs(y - 30)) < half
    found = ground(x, y, np.where(inside, 8.0, 0.0), Options(radius_m=12))
    assert found[~inside].all()
    assert found[inside].any() == stays
    near = inside & (np.maximum(abs(x - 30), abs(y - 30)) >= half - 12)
    assert not found[near].any()


def test_a_low_wide_roof_is_ground_where_a_slope_might_have_led_up():
    """Height over slope is how far from its edge a roof is found out, whatever the radius."""
    x, y = lattice()
    inside = (x >= 20) & (x < 50)
    found = ground(x, y, np.where(inside, 3.0, 0.0), EXACT)
    np.testing.assert_array_equal(found[inside], np.minimum(x - 19, 50 - x)[inside] >= 10)


def test_a_bridge_is_an_object_and_its_ramps_are_ground():
    x, y = lattice()
    deck, valley = abs(y - 30) <= 4, abs(x - 30) < 15
    ends = 5.0
    bare = np.where(valley, np.maximum(ends - 0.6 * (15 - abs(x - 30)), 0), ends)
    z = np.where(deck, ends, bare)
    found = ground(x, y, z, Options(slope=0.7, radius_m=20))
    assert found[~deck].all()
    assert found[deck & ~valley].all()
    assert not found[deck & (abs(x - 30) < 8)].any()


def test_cells_are_points_at_their_centres():
    rng = np.random.default_rng(2)
    surface = np.add.outer(np.linspace(0, 2, 25), np.linspace(0, 3, 33)) + 3 * (rng.random((25, 33)) < 0.1)
    surface[rng.random(surface.shape) < 0.1] = np.nan
    options = Options(radius_m=4, slope=0.4)
    found = ground_cells(surface, 0.5, options)
    row, col = np.indices(surface.shape)
    east, north = 5.25 + 0.5 * col.ravel(), 99.75 - 0.5 * row.ravel()
    np.testing.assert_array_equal(found.ravel(), oracle.ground(east, north, surface.ravel(), options))
    assert 0 < found.sum() < np.isfinite(surface).sum()
    assert not found[np.isnan(surface)].any()


def test_nothing_known_has_no_ground():
    assert ground(*np.zeros((3, 0)), Options()).shape == (0,)
    assert not ground_cells(np.full((3, 4), np.nan), 1.0, Options()).any()


def test_points_that_lie_far_apart_need_no_more_buckets_than_points():
    x = np.array([0.0, 1.0, 3e8, 3e8 + 1])
    assert ground(x, x, np.array([0.0, 5.0, 0.0, 0.0]), EXACT).tolist() == [True, False, True, True]


def test_arrays_of_different_lengths_are_refused():
    with pytest.raises(TaskError, match=r"\(3,\), \(3,\) and \(2,\)"):
        ground(np.zeros(3), np.zeros(3), np.zeros(2), Options())
