import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.tools.prepare.points.ground_filter import Options, ground, ground_cells
from tests.tools.prepare.points import ground_oracle as oracle

EXACT = Options(slope=0.3, noise_m=0, low_m=None)

# Eighths of a metre are exact in binary, so that distances and drops can equal the limits exactly.
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


def check_equals_oracle(cloud, options):
    np.testing.assert_array_equal(ground(*cloud, options), oracle.ground(*cloud, options))


@given(clouds, rules)
@settings(max_examples=150)
def test_ground_equals_comparison_of_all_pairs(points, options):
    check_equals_oracle(points.T, options)


def lattice(n=60):
    """Cell centres of 1 m."""
    y, x = np.indices((n, n)).reshape(2, -1).astype(float)
    return x, y


def rough(seed, n=600, side=40.0):
    """Hilly ground at map coordinates with boxes, noise and some points far below."""
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
def test_ground_at_map_coordinates_equals_comparison_of_all_pairs(seed, options):
    cloud = rough(seed)
    check_equals_oracle(cloud, options)
    assert 0 < ground(*cloud, options).sum() < cloud.shape[1]


@pytest.mark.parametrize("n", [40, 3000])
def test_ground_of_few_points_asked_for_is_that_of_all(n):
    """With 3000 points buckets are full, and sorted in another way."""
    rng = np.random.default_rng(n)
    points = rng.uniform(0, 12, n), rng.uniform(0, 12, n), np.round(rng.uniform(0, 6, n), 1)
    expected, asked = oracle.ground(*points, Options(radius_m=4)), points[0] > 7
    np.testing.assert_array_equal(ground(*points, Options(radius_m=4)), expected)
    np.testing.assert_array_equal(ground(*points, Options(radius_m=4), asked), expected & asked)
    assert 0 < expected[asked].sum() < asked.sum()


def test_ground_excludes_low_outliers_without_companions():
    x, y = lattice()
    z = np.zeros_like(x)
    single, pair, pit = (x == 5) & (y == 7), (x // 2 == 20) & (y == 9), (abs(x - 30) < 2) & (abs(y - 45) < 2)
    z[single | pair | pit] = -4
    is_ground = ground(x, y, z, EXACT.model_copy(update={"low_m": 0.5, "low_companions": 1}))
    assert not is_ground[single | pair].any()
    assert is_ground[pit].all()
    # Around the pit, points within depth / slope are not ground.
    far = np.hypot(x - 30, y - 45) > 4 / EXACT.slope + 3
    assert is_ground[far & ~single & ~pair].all()
    assert ground(x, y, z, EXACT)[single | pair | pit].all()


def test_ground_sparse_ground_points_are_not_outliers():
    x = np.arange(20) * 3.0
    z = np.where(np.arange(20) % 5 == 0, 0.0, 8.0)
    np.testing.assert_array_equal(ground(x, np.zeros(20), z, Options()), z == 0)


@pytest.mark.parametrize("options", [EXACT, Options(low_companions=1)])
def test_ground_does_not_depend_on_rotation_shift_or_order(options):
    x, y, z = rough(1)
    x, y, z = np.round([x * 8, y * 8, z * 1024]) / [[8], [8], [1024]]
    expected = ground(x, y, z, options)
    np.testing.assert_array_equal(ground(-y, x, z, options), expected)
    np.testing.assert_array_equal(ground(x - 356_128, y + 64, z - 64, options), expected)
    order = np.random.default_rng(0).permutation(z.size)
    np.testing.assert_array_equal(ground(x[order], y[order], z[order], options), expected[order])


@pytest.mark.parametrize(("fall", "kept"), [(0.0, True), (0.25, True), (0.2501, False)])
def test_ground_plane_is_ground_up_to_slope_limit(fall, kept):
    x, y = lattice()
    is_ground = ground(x, y, fall * x, EXACT.model_copy(update={"slope": 0.25}))
    assert is_ground[x > 0].all() if kept else not is_ground[x > 0].any()
    assert is_ground[x == 0].all()


@pytest.mark.parametrize(("half", "stays"), [(10, False), (16, True)])
def test_ground_roof_is_removed_up_to_radius_from_its_edge(half, stays):
    x, y = lattice()
    inside = np.maximum(abs(x - 30), abs(y - 30)) < half
    is_ground = ground(x, y, np.where(inside, 8.0, 0.0), Options(radius_m=12))
    assert is_ground[~inside].all()
    assert is_ground[inside].any() == stays
    near = inside & (np.maximum(abs(x - 30), abs(y - 30)) >= half - 12)
    assert not is_ground[near].any()


def test_ground_low_wide_roof_is_removed_up_to_height_over_slope():
    """Beyond height / slope from its edge a roof counts as ground, whatever the radius."""
    x, y = lattice()
    inside = (x >= 20) & (x < 50)
    is_ground = ground(x, y, np.where(inside, 3.0, 0.0), EXACT)
    np.testing.assert_array_equal(is_ground[inside], np.minimum(x - 19, 50 - x)[inside] >= 10)


def test_ground_bridge_is_removed_and_ramps_are_ground():
    x, y = lattice()
    deck, valley = abs(y - 30) <= 4, abs(x - 30) < 15
    ends = 5.0
    bare = np.where(valley, np.maximum(ends - 0.6 * (15 - abs(x - 30)), 0), ends)
    z = np.where(deck, ends, bare)
    is_ground = ground(x, y, z, Options(slope=0.7, radius_m=20))
    assert is_ground[~deck].all()
    assert is_ground[deck & ~valley].all()
    assert not is_ground[deck & (abs(x - 30) < 8)].any()


def test_ground_cells_equals_ground_of_cell_centres():
    rng = np.random.default_rng(2)
    surface = np.add.outer(np.linspace(0, 2, 25), np.linspace(0, 3, 33)) + 3 * (rng.random((25, 33)) < 0.1)
    surface[rng.random(surface.shape) < 0.1] = np.nan
    options = Options(radius_m=4, slope=0.4)
    is_ground = ground_cells(surface, 0.5, options)
    row, col = np.indices(surface.shape)
    east, north = 5.25 + 0.5 * col.ravel(), 99.75 - 0.5 * row.ravel()
    np.testing.assert_array_equal(is_ground.ravel(), oracle.ground(east, north, surface.ravel(), options))
    assert 0 < is_ground.sum() < np.isfinite(surface).sum()
    assert not is_ground[np.isnan(surface)].any()


def test_ground_points_far_apart_need_few_buckets():
    x = np.array([0.0, 1.0, 3e8, 3e8 + 1])
    assert ground(x, x, np.array([0.0, 5.0, 0.0, 0.0]), EXACT).tolist() == [True, False, True, True]
