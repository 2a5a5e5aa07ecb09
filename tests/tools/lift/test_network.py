"""Levels of lines, and heights beyond the surface."""

import numpy as np
import pytest

from flexroad.pipeline.run.sampler import Heights
from flexroad.tools.lift.network import ANY, Network, along, filled, level_of, tagged_level

S = np.arange(60.0)
GROUND = 100 + 0.01 * S
NAN = np.nan


def heights(deck=NAN, ground=GROUND):
    return Heights((0, 1), np.stack([ground, np.broadcast_to(deck, ground.shape)]))


def any_level(n=60):
    return np.full(n, ANY)


def test_a_street_that_passes_below_a_deck_stays_below():
    deck = np.where((S > 20) & (S < 32), 106.0, NAN)
    z, numbers = along(heights(deck), any_level())
    np.testing.assert_array_equal(z, GROUND)
    assert not numbers.any()


def test_a_road_that_goes_over_a_deck_is_on_it():
    on_deck = (S > 20) & (S < 32)
    road = 106 + 0.01 * S
    ground = np.where((S > 22) & (S < 30), 100.0, road)
    z, numbers = along(heights(np.where(on_deck, road, NAN), ground), any_level())
    np.testing.assert_array_equal(z, road)
    np.testing.assert_array_equal(numbers, on_deck)


@pytest.mark.parametrize("ends", ["first", "last"])
def test_a_road_that_ends_on_a_deck_is_on_it(ends):
    road = 106 + 0.01 * S
    ground = np.where(S > 25, 100.0, road)
    deck = np.where(S > 22, road, NAN)
    order = slice(None) if ends == "last" else slice(None, None, -1)
    z, _ = along(heights(deck[order], ground[order]), any_level())
    np.testing.assert_array_equal(z, road[order])


@pytest.mark.parametrize(("number", "above"), [(1, 106.0), (-1, 94.0)])
def test_a_line_with_two_levels_from_end_to_end_is_on_the_higher_one(number, above):
    order = slice(None, None, number)
    own = Heights((0, number)[order], np.stack([GROUND, np.full(60, above)])[order])
    z, numbers = along(own, any_level())
    np.testing.assert_array_equal(z, np.maximum(GROUND, above))
    assert (numbers == max(number, 0)).all()


def test_attributes_decide_where_there_are_any():
    deck = np.where((S > 20) & (S < 32), 106.0, NAN)
    z, numbers = along(heights(deck), np.ones(60, np.int8))
    np.testing.assert_array_equal(numbers, np.isfinite(deck))
    assert (z[numbers == 1] == 106).all()
    assert not along(heights(deck), np.zeros(60, np.int8))[1].any()


def test_points_beyond_the_surface_have_no_height():
    ground = np.where(S < 10, NAN, GROUND)
    z, _ = along(heights(ground=ground), any_level())
    np.testing.assert_array_equal(z, ground)


@pytest.mark.parametrize(("number", "level"), [(1, 2), (3, 2), (-1, -1), (-2, -1)])
def test_a_bridge_has_the_level_of_its_kind_whose_number_is_nearest(number, level):
    row = np.where(S > 30, 1.0, NAN)
    found = Heights((-1, 0, 2, 4), np.stack([row, GROUND, row, row]))
    assert level_of(found, number) == level
    assert level_of(found[S < 20], number) is None


@pytest.mark.parametrize(
    ("tags", "level"),
    [
        ({}, 0),
        ({"layer": "1"}, 0),
        ({"bridge": "yes"}, 1),
        ({"bridge": "viaduct", "layer": "2", "name": "A"}, 2),
        ({"tunnel": "yes", "bridge": "no"}, -1),
    ],
)
def test_tags_name_levels_of_bridges_and_tunnels_alone(tags, level):
    assert tagged_level(tags) == level


def test_a_line_goes_on_from_the_heights_of_its_nodes():
    """At the first node, deck and ground have one height; the other node is on the deck."""
    ground = 100 - 6 * np.sin(S / 60)
    for ends in ((100.0, NAN), (100.1, 106.0), (NAN, 106.0)):
        _, numbers = along(heights(100 + 0.1 * S, ground), any_level(), ends)
        assert numbers.all()
    _, numbers = along(heights(100 + 0.1 * S, ground), any_level(), (NAN, ground[-1] + 0.1))
    assert not numbers.any()


@pytest.mark.parametrize("order", [1, -1])
def test_what_one_line_has_passes_on_to_all_that_follow(order):
    """Lanes b and c of an edge lie on two levels; lane a comes from the ground, and d follows on."""
    covered, begins = heights(106.0), heights(np.where(S > 30, 106.0, NAN))
    lines = [("ab", "12", begins), ("cd", "23", covered), ("cd", "45", covered), ("e", "56", covered)]
    network = Network()
    for name, nodes, own in lines[::order]:
        network.note(name, tuple(nodes), own, any_level())
    network.note("alone", ("7", "8"), covered, any_level())
    network.decide()
    assert network.levels == {"cd": 0, "e": 0, "alone": 1}
    assert network.guessed == {"alone"}
    assert network.ends(("4", "6")) == (GROUND[0], GROUND[-1])


def test_lines_beyond_the_surface_have_the_heights_of_those_on_it_whatever_their_order():
    network = Network()
    network.note_open(("b", "c"), S, np.full(60, NAN))
    network.note_open(("a", "b"), S, np.where(S < 10, GROUND, NAN))
    network.note_open(("c", "d"), S, np.where(S > 50, GROUND, NAN))
    network.note_open(("e", "f"), S, np.full(60, NAN))
    network.decide()
    assert network.ends("bc", beyond=True) == pytest.approx((GROUND[9], GROUND[51]))
    assert np.isnan(network.ends("ef", beyond=True)).all()


def test_heights_are_straight_from_known_to_known_and_level_beyond():
    s, z = np.array([0.0, 1, 2, 10, 20, 21]), np.array([NAN, 5.0, NAN, NAN, 24.0, NAN])
    np.testing.assert_allclose(filled(s, z), [5, 5, 6, 14, 24, 24])
    np.testing.assert_allclose(filled(s, z, (4.0, NAN)), [4, 5, 6, 14, 24, 24])
    assert np.isnan(filled(s, z * NAN)).all()
