from dataclasses import replace

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tools.prepare.points import ground_filter as slope_filter
from flexroad.tools.prepare.points.binning import Points
from flexroad.tools.prepare.points.to_rasters import Options, tags
from tests.make_clouds import Rasters, rasterise, reach_m

NO_CLASS, GROUND, TREE, HOUSE, DECK = 0, 2, 5, 6, 17
SMALL = Options(fill_m=2, void_m=6, dop_fill_m=1, despike_m=2)
FILTER = slope_filter.Options(radius_m=11, low_radius_m=3)
CASES = {
    "classes": SMALL,
    "no despiking": SMALL.model_copy(update={"despike_m": None}),
    "mean": SMALL.model_copy(update={"dtm": "mean"}),
    "filter": SMALL.model_copy(update={"ground": "filter", "filter": FILTER, "void_m": 0}),
    "large fill_m": SMALL.model_copy(update={"void_m": 0, "fill_m": 4}),
}


def square(size_m: float, cell: float) -> Grid:
    n = round(size_m / cell)
    return Grid("EPSG:25832", 295500.0, 5629500.0, cell, n, n)


def ground_height(easting, northing):
    x, y = easting - 295500, northing - 5629500
    return 150 + 0.05 * x + 0.4 * np.sin(x / 9) * np.cos(y / 7)


def cloud_of(where: Grid, per_m2: float, layout: str = "scattered", rim_m: float = 0.0) -> Points:
    """Points of ground with houses, trees, a bridge deck, a lake, and a bird every 20 m."""
    rng = np.random.default_rng(4)
    west, south, east, north = where.bounds
    west, south, east, north = west - rim_m, south - rim_m, east + rim_m, north + rim_m
    if layout != "lattice":
        n = round(per_m2 * (east - west) * (north - south))
        easting, northing = np.round([rng.uniform(west, east, n), rng.uniform(south, north, n)], 2)
    else:
        # A lattice, as from stereo: cocircular points, many on the borders of cells.
        step = per_m2**-0.5
        easting, northing = (
            axis.ravel() for axis in np.meshgrid(np.arange(west, east, step), np.arange(south, north, step))
        )
    height = ground_height(easting, northing) + rng.normal(0, 0.03, easting.size)
    kind = np.full(easting.size, GROUND, np.uint8)
    x, y = easting - where.west, where.north - northing
    for class_, above, mask in (
        (HOUSE, 6.0, (x % 35 < 20) & (y % 35 < 20)),
        (TREE, rng.uniform(1, 9, x.size), rng.random(x.size) < 0.1),
        (DECK, 5.0, np.abs(x - y - 3) < 3),
    ):
        kind[mask], height[mask] = class_, (ground_height(easting, northing) + above)[mask]
    _, birds = np.unique(x // 20 + 1000 * (y // 20), return_index=True)
    kind[birds], height[birds] = NO_CLASS, 200
    colour = rng.integers(0, 256, (x.size, 3), dtype=np.uint8)
    return Points(easting, northing, height, kind, colour)[np.hypot(x - 30, y - 12) > 7]


def within(points: Points, where: Grid, rim_m: float) -> Points:
    west, south, east, north = where.bounds
    return points[
        (points.easting >= west - rim_m)
        & (points.easting < east + rim_m)
        & (points.northing > south - rim_m)
        & (points.northing <= north + rim_m)
    ]


def check_equal(result: Rasters, expected: Rasters, cut=np.s_[:, :], pixels=np.s_[:, :]) -> None:
    np.testing.assert_allclose(result.dsm, expected.dsm[cut], rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.dtm, expected.dtm[cut], rtol=0, atol=1e-8)
    for name in ("height", "count", "spread"):
        values, of_whole = getattr(result.top, name), getattr(expected.top, name)[cut]
        np.testing.assert_allclose(values, of_whole, rtol=0, atol=1e-7)
    decks = expected.bridges[cut]
    assert (result.bridges is None) == np.isnan(decks).all()
    if result.bridges is not None:
        np.testing.assert_allclose(result.bridges, decks, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(result.photo.known, expected.photo.known[pixels])
    np.testing.assert_array_equal(result.photo.colour, expected.photo.colour[:, *pixels])


@pytest.mark.parametrize("layout", ["scattered", "sparse", "lattice"])
@pytest.mark.parametrize("cell", [1.0, 0.4])
@pytest.mark.parametrize("case", CASES)
def test_rasterise_block_equals_part_of_whole(case, cell, layout):
    options, dop_cell = CASES[case], cell / 2
    whole = square(60, cell)
    points = cloud_of(whole, (0.5 if layout == "sparse" else 3) / cell, layout)
    expected = rasterise(points, whole, options, dop_cell)
    assert 0 < np.isnan(expected.dtm).mean() < 0.9
    assert 0 < np.isnan(expected.dsm).mean() < 0.5
    rim = reach_m(options, cell)
    for metres in ((0, 0, 20, 24), (20, 14, 30, 10), (26, 22, 34, 38), (44, 44, 4, 4)):
        row, col, rows, cols = (round(side / cell) for side in metres)
        west, north = whole.west + col * cell, whole.north - row * cell
        block = Grid(whole.crs, west, north, cell, cols, rows)
        result = rasterise(within(points, block, rim), block, options, dop_cell)
        cut = slice(row, row + rows), slice(col, col + cols)
        pixels = tuple(slice(2 * part.start, 2 * part.stop) for part in cut)
        check_equal(result, expected, cut, pixels)


@pytest.mark.parametrize("case", CASES)
def test_rasterise_does_not_depend_on_order_of_points(case):
    where = square(40, 1.0)
    points = cloud_of(where, 3)
    # Many points have equal heights but different colours.
    points = replace(points, height=np.round(points.height * 2) / 2)
    shuffled = points[np.random.default_rng(5).permutation(len(points))]
    check_equal(rasterise(shuffled, where, CASES[case], 0.5), rasterise(points, where, CASES[case], 0.5))


def test_rasterise_gives_true_heights():
    where = square(100, 1.0)
    points = cloud_of(where, 12, rim_m=reach_m(SMALL, 1.0))
    rasters = rasterise(points, where, SMALL, 0.5)
    truth = ground_height(where.eastings, where.northings[:, None])
    x, y = where.eastings - where.west, (where.north - where.northings)[:, None]
    deck = np.abs(x - y - 3) < 1.5
    lake = np.hypot(x - 30, y - 12) < 5
    assert np.isnan(rasters.dtm[lake]).all()
    assert np.isnan(rasters.dsm[lake]).all()
    assert np.array_equal(np.isnan(rasters.top.height), np.isnan(rasters.dsm))
    filled = (rasters.top.count == 0) & np.isfinite(rasters.dsm)
    assert filled.any()
    assert np.isnan(rasters.top.spread[filled]).all()
    plain = np.abs(rasters.dsm - truth) < 0.2
    assert np.mean((rasters.dsm - truth)[plain]) > 0.04
    assert abs(np.mean((rasters.top.height - truth)[plain])) < 0.005
    assert np.nanmax(np.abs(rasters.dtm - truth)) < 0.15
    assert np.nanmax(np.abs((rasters.bridges - truth)[deck])) < 5.1
    np.testing.assert_allclose((rasters.bridges - truth)[deck & ~lake], 5, atol=0.1)
    assert np.isnan(rasters.bridges[np.abs(x - y - 3) > 5]).all()
    # Birds are removed, houses and trees are not.
    assert 8 < np.nanmax(rasters.dsm - truth) < 10
    with_birds = rasterise(points, where, SMALL.model_copy(update={"despike_m": None}), None)
    assert np.nanmax(with_birds.dsm - truth) > 30
    assert with_birds.photo is None


def test_rasterise_filtered_ground_is_not_biased():
    """All ground points are used; the lowest alone would be too low by twice the noise at this density."""
    where, noise = square(60, 1.0), 0.05
    rng = np.random.default_rng(6)
    options = Options(ground="filter", void_m=30)
    rim = reach_m(options, 1.0)
    n = round(12 * (60 + 2 * rim) ** 2)
    easting = rng.uniform(where.west - rim, where.east + rim, n)
    northing = rng.uniform(where.south - rim, where.north + rim, n)
    height = 150 + 0.1 * (easting - where.west) + rng.normal(0, noise, n)
    house = ((easting - where.west) % 30 < 10) & ((where.north - northing) % 30 < 12)
    height[house] += 6
    tree = rng.random(n) < 0.1
    height[tree] += rng.uniform(1, 8, tree.sum())
    kind = np.zeros(n, np.uint8)
    error = rasterise(Points(easting, northing, height, kind), where, options, None).dtm
    error -= 150 + 0.1 * (where.eastings - where.west)
    assert np.isfinite(error).all()
    assert abs(error.mean()) < 0.1 * noise
    assert error.std() < 0.5 * noise


def test_rasterise_without_points_is_nan():
    empty = np.empty(0)
    points = Points(empty, empty, empty, empty.astype(np.uint8), np.empty((0, 3), np.uint8))
    for options in CASES.values():
        rasters = rasterise(points, square(20, 1.0), options, 0.5)
        assert np.isnan(rasters.dsm).all()
        assert np.isnan(rasters.dtm).all()
        assert rasters.bridges is None
        assert not rasters.photo.known.any()


@pytest.mark.parametrize("kind", [NO_CLASS, TREE, GROUND, DECK])
def test_rasterise_one_class_gives_only_its_layers(kind):
    where = square(30, 1.0)
    points = cloud_of(where, 6)
    points = replace(points, kind=np.full(len(points), kind, np.uint8), colour=None)
    rasters = rasterise(points, where, SMALL, 0.5)
    assert np.isfinite(rasters.dsm).any()
    assert np.isfinite(rasters.dtm).any() == (kind == GROUND)
    assert (rasters.bridges is not None) == (kind == DECK)
    assert rasters.photo is None


def test_tags_describe_processing():
    described = tags(Options(despike_m=5, ground_classes=(2, 8), fill_m=3))
    assert described["DSM"] == (
        "highest point per cell; single points 5 m above all around dropped; voids up to 3 m filled linearly"
    )
    assert "points of classes 2, 8" in described["DTM"]
    assert described["ROAD_HEIGHT"].startswith(
        "mean, number and standard deviation of the points within 0.25 m"
    )
    filtered = tags(Options(ground="filter", dtm="mean", filter={"radius_m": 20, "slope": 0.3}))
    assert "mean per cell of slope-filtered points (Vosselman 2000: radius 20 m, " in filtered["DTM"]
    assert "dropped" not in filtered["DSM"]
