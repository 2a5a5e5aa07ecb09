from dataclasses import replace

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points import ground_filter as slope_filter
from flexroad.tasks.acquire.points.to_rasters import Options, rasterise, reach_m, tags
from flexroad.tasks.acquire.types import Points, Rasters

NO_CLASS, GROUND, TREE, HOUSE, DECK = 0, 2, 5, 6, 17
SMALL = Options(fill_m=2, void_m=6, dop_fill_m=1, despike_m=2)
FILTER = slope_filter.Options(radius_m=11, low_radius_m=3)
EVERY_WAY = {
    "classes": SMALL,
    "no despiking": SMALL.model_copy(update={"despike_m": None}),
    "mean": SMALL.model_copy(update={"dtm": "mean"}),
    "filter": SMALL.model_copy(update={"ground": "filter", "filter": FILTER, "void_m": 0}),
    "surface reaches farthest": SMALL.model_copy(update={"void_m": 0, "fill_m": 4}),
}


def sheet(size_m: float, cell: float) -> Grid:
    n = round(size_m / cell)
    return Grid("EPSG:25832", 295500.0, 5629500.0, cell, n, n)


def ground_height(easting, northing):
    x, y = easting - 295500, northing - 5629500
    return 150 + 0.05 * x + 0.4 * np.sin(x / 9) * np.cos(y / 7)


def land(where: Grid, per_m2: float, layout: str = "scattered", rim_m: float = 0.0) -> Points:
    """Ground with houses, trees, a deck, a lake, and every 20 m a bird."""
    rng = np.random.default_rng(4)
    west, south, east, north = where.bounds
    west, south, east, north = west - rim_m, south - rim_m, east + rim_m, north + rim_m
    if layout != "lattice":
        n = round(per_m2 * (east - west) * (north - south))
        easting, northing = np.round([rng.uniform(west, east, n), rng.uniform(south, north, n)], 2)
    else:
        # As from stereo: four points on the same circle everywhere, many on the lines between cells.
        step = per_m2**-0.5
        easting, northing = (
            axis.ravel() for axis in np.meshgrid(np.arange(west, east, step), np.arange(south, north, step))
        )
    height = ground_height(easting, northing) + rng.normal(0, 0.03, easting.size)
    kind = np.full(easting.size, GROUND, np.uint8)
    x, y = easting - where.west, where.north - northing
    for k, up, part in (
        (HOUSE, 6.0, (x % 35 < 20) & (y % 35 < 20)),
        (TREE, rng.uniform(1, 9, x.size), rng.random(x.size) < 0.1),
        (DECK, 5.0, np.abs(x - y - 3) < 3),
    ):
        kind[part], height[part] = k, (ground_height(easting, northing) + up)[part]
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


def check_equal(found: Rasters, expected: Rasters, cut=np.s_[:, :], pixels=np.s_[:, :]) -> None:
    np.testing.assert_allclose(found.dsm, expected.dsm[cut], rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.dtm, expected.dtm[cut], rtol=0, atol=1e-8)
    decks = expected.bridges[cut]
    assert (found.bridges is None) == np.isnan(decks).all()
    if found.bridges is not None:
        np.testing.assert_allclose(found.bridges, decks, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found.photo.known, expected.photo.known[pixels])
    np.testing.assert_array_equal(found.photo.colour, expected.photo.colour[:, *pixels])


@pytest.mark.parametrize("layout", ["scattered", "sparse", "lattice"])
@pytest.mark.parametrize("cell", [1.0, 0.4])
@pytest.mark.parametrize("way", EVERY_WAY)
def test_blocks_do_not_show(way, cell, layout):
    options, dop_cell = EVERY_WAY[way], cell / 2
    whole = sheet(60, cell)
    points = land(whole, (0.5 if layout == "sparse" else 3) / cell, layout)
    expected = rasterise(points, whole, options, dop_cell)
    assert 0 < np.isnan(expected.dtm).mean() < 0.9
    assert 0 < np.isnan(expected.dsm).mean() < 0.5
    rim = reach_m(options, cell)
    for metres in ((0, 0, 20, 24), (20, 14, 30, 10), (26, 22, 34, 38), (44, 44, 4, 4)):
        row, col, rows, cols = (round(side / cell) for side in metres)
        west, north = whole.west + col * cell, whole.north - row * cell
        block = Grid(whole.crs, west, north, cell, cols, rows)
        found = rasterise(within(points, block, rim), block, options, dop_cell)
        cut = slice(row, row + rows), slice(col, col + cols)
        pixels = tuple(slice(2 * part.start, 2 * part.stop) for part in cut)
        check_equal(found, expected, cut, pixels)


@pytest.mark.parametrize("way", EVERY_WAY)
def test_the_order_of_points_changes_nothing(way):
    where = sheet(40, 1.0)
    points = land(where, 3)
    # Many at one height, in different colours.
    points = replace(points, height=np.round(points.height * 2) / 2)
    shuffled = points[np.random.default_rng(5).permutation(len(points))]
    check_equal(
        rasterise(shuffled, where, EVERY_WAY[way], 0.5), rasterise(points, where, EVERY_WAY[way], 0.5)
    )


def test_rasters_are_those_of_the_land():
    where = sheet(100, 1.0)
    points = land(where, 12, rim_m=reach_m(SMALL, 1.0))
    made = rasterise(points, where, SMALL, 0.5)
    truth = ground_height(where.eastings, where.northings[:, None])
    x, y = where.eastings - where.west, (where.north - where.northings)[:, None]
    deck = np.abs(x - y - 3) < 1.5
    lake = np.hypot(x - 30, y - 12) < 5
    assert np.isnan(made.dtm[lake]).all()
    assert np.isnan(made.dsm[lake]).all()
    assert np.nanmax(np.abs(made.dtm - truth)) < 0.15
    assert np.nanmax(np.abs((made.bridges - truth)[deck])) < 5.1
    np.testing.assert_allclose((made.bridges - truth)[deck & ~lake], 5, atol=0.1)
    assert np.isnan(made.bridges[np.abs(x - y - 3) > 5]).all()
    # No bird, but houses and trees.
    assert 8 < np.nanmax(made.dsm - truth) < 10
    unspoiled = rasterise(points, where, SMALL.model_copy(update={"despike_m": None}), None)
    assert np.nanmax(unspoiled.dsm - truth) > 30
    assert unspoiled.photo is None


def test_filtered_ground_is_not_biased():
    """All ground points count, not the lowest: those lie lower by twice the noise at this density."""
    where, noise = sheet(60, 1.0), 0.05
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


def test_a_block_of_nothing_is_void():
    nothing = np.empty(0)
    points = Points(nothing, nothing, nothing, nothing.astype(np.uint8), np.empty((0, 3), np.uint8))
    for options in EVERY_WAY.values():
        made = rasterise(points, sheet(20, 1.0), options, 0.5)
        assert np.isnan(made.dsm).all()
        assert np.isnan(made.dtm).all()
        assert made.bridges is None
        assert not made.photo.known.any()


@pytest.mark.parametrize("kind", [NO_CLASS, TREE, GROUND, DECK])
def test_points_of_one_class(kind):
    where = sheet(30, 1.0)
    points = land(where, 6)
    points = replace(points, kind=np.full(len(points), kind, np.uint8), colour=None)
    made = rasterise(points, where, SMALL, 0.5)
    assert np.isfinite(made.dsm).any()
    assert np.isfinite(made.dtm).any() == (kind == GROUND)
    assert (made.bridges is not None) == (kind == DECK)
    assert made.photo is None


def test_the_facts_state_what_was_done():
    stated = tags(Options(despike_m=5, ground_classes=(2, 8), fill_m=3))
    assert stated["DSM"] == (
        "highest point per cell; single points 5 m above all around dropped; voids up to 3 m filled linearly"
    )
    assert "points of classes 2, 8" in stated["DTM"]
    filtered = tags(Options(ground="filter", dtm="mean", filter={"radius_m": 20, "slope": 0.3}))
    assert "mean per cell of slope-filtered points (Vosselman 2000: radius 20 m, " in filtered["DTM"]
    assert "dropped" not in filtered["DSM"]
