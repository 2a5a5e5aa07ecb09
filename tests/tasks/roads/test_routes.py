import numpy as np
import pytest
import shapely

from flexroad.tasks.roads.routes import CentreLine, Route, routes

A, B, C = (0.0, 0.0), (100.0, 0.0), (200.0, 10.0)


def line(*points: tuple[float, float], **known: object) -> CentreLine:
    return CentreLine(np.array(points), 6.0, **known)


def ways(lines: list[CentreLine], max_turn_deg: float = 45.0) -> list[list[list[float]]]:
    return [route.points.tolist() for route in routes(lines, max_turn_deg)]


@pytest.mark.parametrize("second", [(B, C), (C, B)])
def test_routes_lines_that_continue_are_one_route_in_the_direction_of_the_first(second):
    assert ways([line(A, B), line(*second)]) == [[list(A), list(B), list(C)]]
    assert ways([line(B, A), line(*second)]) == [[list(C), list(B), list(A)]]


def test_routes_node_of_three_lines_joins_the_straightest_two():
    side = (150.0, 40.0)
    assert ways([line(A, B), line(B, side), line(B, C)]) == [
        [list(A), list(B), list(C)],
        [list(B), list(side)],
    ]


def test_routes_turn_above_the_limit_ends_a_route():
    turned = (150.0, 49.0)
    assert len(ways([line(A, B), line(B, turned)])) == 1
    assert len(ways([line(A, B), line(B, turned)], max_turn_deg=44.0)) == 2


def test_routes_line_with_a_sharp_turn_is_cut_there():
    assert ways([line(A, B, (100.0, 50.0), (100.0, 90.0))]) == [
        [list(A), list(B)],
        [list(B), [100.0, 50.0], [100.0, 90.0]],
    ]


def test_routes_short_hook_at_an_end_does_not_hide_the_continuation():
    # The last 10 cm of the first line point south.
    hooked = line(A, (99.9, 0.1), B)
    assert len(ways([hooked, line(B, C)], max_turn_deg=46.0)) == 1


@pytest.mark.parametrize(
    ("second", "count"),
    [({"lanes": 2}, 2), ({"lanes": 1}, 1), ({"lanes": 1, "oneway": True}, 2)],
    ids=["other lanes", "same lanes", "one way"],
)
def test_routes_change_of_lanes_or_direction_ends_a_route(second, count):
    assert len(ways([line(A, B, lanes=1), line(B, C, **second)])) == count


def test_routes_oneway_lines_join_head_to_tail_alone():
    assert len(ways([line(A, B, oneway=True), line(B, C, oneway=True)])) == 1
    assert len(ways([line(A, B, oneway=True), line(C, B, oneway=True)])) == 2


def test_routes_chain_that_would_cross_itself_is_cut():
    # A loop of straight continuations that comes back over its first line.
    turn = np.radians(np.linspace(-90, 180, 28))
    loop = np.stack([100 + 30 * np.cos(turn), 30 + 30 * np.sin(turn)], axis=1)
    down = CentreLine(np.array([loop[-1], [70.0, -50.0]]), 6.0)
    found = routes([line(A, tuple(loop[0])), CentreLine(loop, 6.0), down])
    assert [len(route.parts) for route in found] == [2, 1]


def test_routes_line_that_crosses_itself_is_cut_at_the_crossing():
    turns = [(90.0, 20.0), (90.0, 50.0), (60.0, 70.0), (40.0, 50.0)]
    pieces = ways([line((0.0, 0.0), (60.0, 0.0), *turns, (40.0, -40.0))])
    assert len(pieces) > 1
    assert all(shapely.LineString(piece).is_simple for piece in pieces)


def test_routes_ring_of_lines_is_one_closed_route():
    turn = np.radians(np.linspace(0, 360, 73))
    ring = np.stack([50 * np.cos(turn), 50 * np.sin(turn)], axis=1)
    ring[-1] = ring[0]
    found = routes([CentreLine(ring[:37], 6.0), CentreLine(ring[36:], 6.0)])
    assert len(found) == 1
    points = found[0].points
    np.testing.assert_array_equal(points[0], points[-1])
    assert {tuple(point) for point in points} == {tuple(point) for point in ring}


def test_route_points_repeated_points_are_dropped():
    route = Route((line(A, B, B), line((100.0, 0.01), C)))
    assert route.points.tolist() == [list(A), list(B), list(C)]


def test_routes_long_lines_and_chains_are_divided():
    chain = [CentreLine(np.array([[x, 0.0], [x + 90.0, 0.0]]), 6.0) for x in (0.0, 90.0, 180.0, 270.0)]
    whole = CentreLine(np.array([[0.0, 50.0], [500.0, 50.0]]), 6.0, name="long")
    found = routes([*chain, whole], max_length_m=200.0)
    spans = [(float(route.points[0, 0]), float(route.points[-1, 0])) for route in found]
    np.testing.assert_allclose(
        spans, [(0, 180), (180, 360), (0, 500 / 3), (500 / 3, 1000 / 3), (1000 / 3, 500)]
    )
    assert found[-1].parts[0].name == "long"
