"""Abutments of decks and tunnels, from vectors and heights, and roads of one level that cross."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from shapely.affinity import translate

from flexroad.tasks.levels.abutments import GAP_M, crossing_notes, levels_of
from flexroad.tasks.roads.rasterise import Options, roads
from flexroad.tasks.types import Source, TileData
from tests.builders import make_grid
from tests.make_roads import GRID as FILE_GRID
from tests.make_roads import on_grid, write

GRID = make_grid(100, 100, west=500_000.0, north=5_600_100.0)
FLAT = np.zeros(GRID.shape)


def strip(start, end, width=8.0, y=50.0):
    """Return a road along x, by metres from the south-west corner of the grid."""
    return shapely.box(
        GRID.west + start, GRID.south + y - width / 2, GRID.west + end, GRID.south + y + width / 2
    )


def across(x, width=7.0, low=0.0, high=100.0):
    return shapely.box(
        GRID.west + x - width / 2, GRID.south + low, GRID.west + x + width / 2, GRID.south + high
    )


def found(*given, dsm=FLAT, dtm=FLAT, grid=GRID):
    """Return the levels of roads, given as (level, area), and notes."""
    numbers, areas = zip(*given, strict=True)
    data = TileData("a", grid, grid, dsm, dtm)
    areas = np.array(areas, object)
    return levels_of(areas, areas, np.array(numbers), data)


def abutment_ends(level):
    """Return west and east ends of abutments along x, m from the west."""
    lines = shapely.get_parts(level.abutments)
    return sorted(round(float(line.bounds[0] - GRID.west), 2) for line in lines)


DECK = 1, strip(40, 60)
WAYS = (0, strip(0, 40)), (0, strip(60, 100))
BELOW = 0, across(50)


def test_deck_between_two_roads_has_abutments_at_both_ends():
    (level,), notes = found(DECK, *WAYS, BELOW)
    assert (level.number, abutment_ends(level), notes) == (1, [40, 60], ())
    assert level.abutments.length == pytest.approx(16)
    assert level.approach.bounds == pytest.approx(
        (GRID.west + 24, GRID.south + 46, GRID.west + 76, GRID.south + 54)
    )
    assert level.approach.area == pytest.approx(2 * 16 * 8, rel=0.02)


@pytest.mark.parametrize("gap", [-1.0, 0.0, 0.5, 1.0, 1.4])
def test_abutment_bridges_gaps_and_overlaps(gap):
    (level,), _ = found(DECK, (0, strip(0, 40 - gap)), WAYS[1], BELOW)
    assert abutment_ends(level) == [40, 60]
    # The gap belongs to the approach.
    assert level.weight(GRID.west + 39.5, GRID.south + 50) == 1


def test_gap_that_is_too_wide_gives_no_abutment():
    (level,), notes = found(DECK, (0, strip(0, 40 - GAP_M - 0.3)), BELOW)
    assert level.abutments.is_empty
    assert "1 deck of level 1 without an abutment" in notes[0]
    assert "gaps above 1.5 m" in notes[0]


@pytest.mark.parametrize(("west", "east", "noted"), [(-60, 160, False), (-60, 99, False), (1, 99, True)])
def test_deck_without_abutment_is_noted_if_its_ends_are_known(west, east, noted):
    """The middle tile of a long deck sees none of its abutments."""
    levels, notes = found((1, strip(west, east)), BELOW)
    assert (len(levels), len(notes)) == (1, noted)


def test_street_below_is_no_abutment_also_beside_an_abutment():
    # The street passes below the end of the deck.
    (level,), _ = found(DECK, *WAYS, (0, across(44.5)))
    assert abutment_ends(level) == [40, 60]
    assert level.abutments.length == pytest.approx(16)


def test_pavements_of_a_wider_deck_belong_to_the_abutment():
    (level,), _ = found((1, strip(40, 60, width=11)), *WAYS)
    assert level.abutments.length == pytest.approx(22)


def test_ramp_at_the_side_of_a_long_deck_has_a_abutment_of_its_width():
    (level,), _ = found((1, strip(0, 100)), (0, across(50, low=54)))
    assert level.abutments.length == pytest.approx(7, abs=0.6)


@pytest.mark.parametrize(("rise", "abutments"), [(0.5, [40, 60]), (4.0, [60])])
def test_abutment_is_refused_where_visible_roads_differ_in_height(rise, abutments):
    x = np.arange(100) + 0.5
    dsm = np.where((x < 40), 8.0 - rise, 8.0) + FLAT
    (level,), _ = found(DECK, *WAYS, BELOW, dsm=dsm, dtm=FLAT)
    assert abutment_ends(level) == abutments


def test_hidden_roads_do_not_refuse_a_abutment():
    crowns = np.where(np.arange(100) < 40, 5 + np.random.default_rng(1).random(GRID.shape), 8.0)
    (level,), _ = found(DECK, *WAYS, BELOW, dsm=crowns, dtm=np.full(GRID.shape, np.nan))
    assert abutment_ends(level) == [40, 60]


def test_road_on_level_ground_alone_or_far_from_a_deck_has_no_levels():
    assert found(*WAYS, BELOW) == ((), ())
    assert found(DECK, *WAYS, grid=replace(GRID, west=GRID.west - 90)) == ((), ())


@pytest.mark.parametrize(("high", "kept"), [(70, True), (95, False)])
def test_long_tunnel_is_left_out_with_a_note(high, kept):
    levels, notes = found((-1, strip(40, high)), (0, strip(0, 40)), (0, strip(high, 100)))
    assert bool(levels) == kept
    if not kept:
        assert notes == (
            "segment: the tunnel at E 500068 N 5600050 (level -1) is longer than 50 m, so it is left out",
        )


def test_tunnel_without_second_portal_is_left_out_with_a_note():
    levels, notes = found((-1, strip(40, 70)), (0, strip(0, 40)))
    assert not levels
    assert "has no two portals" in notes[0]


def test_decks_of_two_levels_have_their_own_abutments():
    levels, _ = found(
        DECK, *WAYS, (2, across(50, low=30, high=70)), (0, across(50, high=30)), (0, across(50, low=70))
    )
    assert [level.number for level in levels] == [1, 2]
    assert [len(level.abutments.geoms) for level in levels] == [2, 2]


@pytest.mark.parametrize("numbers", [(2,), (4,), (1, 3)])
def test_levels_with_nothing_below_them_are_levels(numbers):
    levels, _ = found(
        *((number, strip(40, 60, y=20 * number)) for number in numbers), (0, strip(0, 40, y=40))
    )
    assert tuple(level.number for level in levels) == numbers
    assert abutment_ends(levels[0]) == ([40] if numbers == (2,) else [])


@pytest.mark.parametrize("rise", [8.0, 0.0])
def test_lower_street_beside_a_deck_has_no_abutment_and_no_approach(rise):
    """It lies 1 m beside the deck, and its approaches."""
    row = GRID.south + 50 - GRID.northings[:, None]
    dsm = np.where(np.abs(row) < 4, rise, 0.0) + FLAT
    (level,), _ = found(DECK, *WAYS, BELOW, (0, strip(0, 100, width=6, y=58)), dsm=dsm)
    places = GRID.west + np.array([35, 35, 50]), GRID.south + np.array([50, 58, 58])
    if rise:
        assert abutment_ends(level) == [40, 60]
        np.testing.assert_array_equal(level.weight(*places), [1, 0, 0])
    else:
        # Streets of one height are a place on the deck.
        assert abutment_ends(level) == [40, 40, 60]


def test_hole_in_a_deck_is_an_outline():
    deck = shapely.difference(strip(20, 80, width=40), strip(45, 55, width=10))
    (level,), _ = found((1, deck), (0, strip(0, 20)), (0, strip(45, 55)))
    assert abutment_ends(level) == [20, 45, 45, 45, 55]
    assert not level.covers(GRID.west + 50, GRID.south + 50)


def test_damaged_polygons_are_mended():
    bow = shapely.Polygon(
        [(GRID.west + x, GRID.south + y) for x, y in ((40, 46), (60, 54), (60, 46), (40, 54))]
    )
    levels, _ = found((1, bow), *WAYS, (0, shapely.Polygon()))
    assert levels[0].areas.is_valid


ALONG, ACROSS = ((30, 46), (70, 54)), ((47, 35), (54, 75))


def notes(*roads_of, numbers=None, core=GRID):
    """Roads are polygons, or boxes between two corners, by metres from the south-west corner of the grid."""
    areas = [
        shapely.box(*each[0], *each[1]) if len(each) == 2 else shapely.Polygon(each) for each in roads_of
    ]
    areas = np.array([translate(area, GRID.west, GRID.south) for area in areas], object)
    return crossing_notes(areas, areas, np.array(numbers or [1] * len(areas)), core)


def test_roads_of_one_level_that_cross_are_noted_with_both_and_the_place():
    assert notes(ALONG, ACROSS) == (
        "segment: 1 pair of roads of level 1 cross without a common vertex, such as those around "
        "E 500050 N 5600050 and E 500050 N 5600055, at E 500050 N 5600050; give the upper one level 2, or "
        "both a vertex there if it is a junction",
    )
    (note,) = notes(ALONG, ACROSS, numbers=[-1, -1])
    assert "level -1" in note
    assert "give the lower one level -2" in note


@pytest.mark.parametrize(
    "other",
    [
        ((47, 35), (54, 46)),
        ((47, 35), (54, 50)),
        ((47, 35), (54, 54.1)),
        ((60, 46), (90, 54)),
        ((30, 53), (70, 60)),
        ((32, 44), (68, 56)),
    ],
    ids=["beside", "ends in it", "barely beyond it", "goes on", "parallel", "its deck"],
)
def test_roads_of_one_level_that_do_not_cross_are_not_noted(other):
    assert notes(ALONG, other) == ()


def test_roads_of_two_levels_on_the_ground_or_beside_the_tile_may_cross():
    assert notes(ALONG, ACROSS, numbers=[1, 2]) == ()
    assert notes(ALONG, ACROSS, numbers=[0, 0]) == ()
    # A crossing is noted on its own tile.
    assert notes(ALONG, ACROSS, core=replace(GRID, width=46)) == ()


@pytest.mark.parametrize(("junction", "number"), [(True, 0), (False, 1)])
def test_lines_that_share_a_vertex_are_a_junction(tmp_path, junction, number):
    middle = [(50, 50)] if junction else []
    lines = [
        shapely.LineString([on_grid(at)[0] for at in (start, *middle, end)])
        for start, end in (((20, 50), (80, 50)), ((50, 20), (50, 80)))
    ]
    path = write(tmp_path / "r.gpkg", lines, width=[6, 6], level=[1, 1])
    found = roads(Source("roads", (path,)), FILE_GRID, Options(), levels=True)
    assert len(crossing_notes(found.areas, found.shapes, found.level, FILE_GRID)) == number


@pytest.mark.parametrize(("corner", "number"), [([(47, 46)], 0), ([], 1)])
def test_areas_that_share_a_corner_are_a_junction(corner, number):
    along = [(30, 46), (47, 46), (70, 46), (70, 54), (30, 54)]
    across = [(47, 35), (54, 35), (54, 75), (47, 75), *corner]
    assert len(notes(along, across)) == number
