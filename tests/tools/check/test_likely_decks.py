import numpy as np
import pytest
import shapely
from scipy.ndimage import binary_dilation, label

from flexroad.catalog import Grid
from flexroad.tools.check.catalog import AREA_M2, RISE_M, likely_decks
from flexroad.tools.synthetic import Kind, gerod, make_scene
from flexroad.tools.synthetic.crossings import CrossingOptions, Crossings, make_crossings

GRID = Grid("EPSG:25832", 500_000, 5_600_060, 1.0, 100, 60)
ROW, COL = np.mgrid[:60, :100]
ROAD = np.abs(ROW - 29.5) < 4
GROUND = 100 + 0.02 * COL
"""A street of 8 m along the columns."""
SPAN = (COL >= 40) & (COL < 60)


def decks(dsm=GROUND, dtm=GROUND, road=ROAD, grid=GRID):
    return likely_decks(dsm, dtm, road, grid)


def test_deck_over_a_valley_has_its_outline_rise_and_two_ends():
    (deck,) = decks(dtm=np.where(SPAN, GROUND - 6, GROUND))
    assert deck.area.equals(shapely.box(500_040, 5_600_026, 500_060, 5_600_034))
    assert deck.rise_m == pytest.approx(6.0)
    assert deck.ends == 2
    assert deck.is_sure


@pytest.mark.parametrize(("road", "ends"), [(ROAD & (COL < 60), 1), (ROAD & SPAN, 0)])
def test_deck_whose_road_does_not_go_on_may_be_a_roof(road, ends):
    (deck,) = decks(dtm=np.where(SPAN, GROUND - 6, GROUND), road=road)
    assert deck.ends == ends
    assert not deck.is_sure


@pytest.mark.parametrize("step", [0.3, 1.3])
def test_end_has_the_height_of_the_deck(step):
    """A step of 0.3 m is that of an abutment; with 1.3 m it is another road."""
    lower = np.where(COL >= 60, GROUND - step, GROUND)
    (deck,) = decks(dsm=lower, dtm=np.where(SPAN, GROUND - 6, lower))
    assert deck.ends == (2 if step < 0.5 else 1)


ROUGH = GROUND + np.random.default_rng(0).normal(0, 1, GROUND.shape)
HOLE = np.where(SPAN, np.nan, GROUND)
VALLEY = np.where(SPAN, GROUND - 6, GROUND)
SMALL = np.where((COL >= 50) & (COL < 50 + AREA_M2 // 8), GROUND - 6, GROUND)


@pytest.mark.parametrize(
    ("dsm", "dtm", "road"),
    [
        (GROUND, GROUND, ROAD),
        (GROUND + RISE_M - 0.1, GROUND, ROAD),
        (GROUND, SMALL, ROAD),
        (GROUND, VALLEY, ROAD & (COL < 0)),
        (np.where(SPAN, ROUGH, GROUND), VALLEY, ROAD),
        (HOLE, VALLEY, ROAD),
        (GROUND, HOLE, ROAD),
    ],
    ids=["level", "embankment", "small", "no road", "rough", "no DSM", "no DTM"],
)
def test_other_places_are_no_deck(dsm, dtm, road):
    assert decks(dsm, dtm, road) == []


def test_decks_at_the_edges_of_the_grid_are_found():
    """Both ends of the street are cut off."""
    left, right = decks(dtm=np.where((COL < 20) | (COL >= 80), GROUND - 6, GROUND))
    assert left.area.equals(shapely.box(500_000, 5_600_026, 500_020, 5_600_034))
    assert right.area.equals(shapely.box(500_080, 5_600_026, 500_100, 5_600_034))
    assert (left.ends, right.ends) == (1, 1)


def test_cells_of_half_a_metre():
    grid = Grid("EPSG:25832", 500_000, 5_600_030, 0.5, 100, 60)
    (deck,) = decks(dtm=np.where(SPAN, GROUND - 6, GROUND), grid=grid)
    assert deck.area.area == pytest.approx(40, rel=0.1)
    assert deck.ends == 2


@pytest.mark.parametrize("seed", range(6))
def test_decks_of_crossings_are_found_and_tunnels_are_not(seed):
    grid = Grid("EPSG:25832", 499_980, 5_600_100, 1.0, 120, 120)
    options = CrossingOptions(tunnels=0)
    scene = make_crossings(grid, seed, options)
    (deck,) = likely_decks(scene.dsm, scene.dtm, scene.road_mask, grid)
    areas = Crossings(seed, options).areas(1, grid.bounds)
    true = min(areas, key=deck.area.centroid.distance)
    # A DTM is smooth at walls; parapets are not flat.
    assert shapely.intersection(true, deck.area).area > 0.75 * deck.area.area
    assert deck.area.area > 0.4 * true.area
    assert deck.is_sure
    tunnel = make_crossings(grid, seed, CrossingOptions(tunnels=1))
    assert likely_decks(tunnel.dsm, tunnel.dtm, tunnel.road_mask, grid) == []


@pytest.mark.slow
def test_decks_of_the_benchmark_are_found_and_no_other_place_has_two_ends():
    number = found = 0
    for _, grid, stratum, options in gerod.survey(48, 3):
        scene = make_scene(grid, 3, stratum, options)
        true = (scene.kind == Kind.DECK) & (scene.dsm - scene.dtm > RISE_M)
        cells = np.meshgrid(grid.eastings, grid.northings)
        sure = [deck for deck in decks(scene.dsm, scene.dtm, scene.road_mask, grid) if deck.is_sure]
        places = [shapely.contains_xy(deck.area, *cells) for deck in sure]
        assert all(true[place].mean() > 0.5 for place in places)
        parts, parts_number = label(binary_dilation(true, iterations=2))
        for deck in (true & (parts == k) for k in range(1, parts_number + 1)):
            if deck.sum() >= 30:
                number += 1
                found += any((place & deck).sum() > 0.3 * deck.sum() for place in places)
    assert number == 18
    assert found >= 14
