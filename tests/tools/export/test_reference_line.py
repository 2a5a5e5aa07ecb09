import numpy as np
import pytest
import shapely

from flexroad.tasks.roads.routes import CentreLine, Route
from flexroad.tools.export import reference_line as lines
from flexroad.tools.export.reference_line import ReferenceLine, usable

KINK = np.array([[0.0, 0.0], [60.0, 0.0], [110.0, 30.0]])
ZIGZAG = np.array([[0.0, 0.0], [30.0, 2.0], [60.0, -2.0], [90.0, 3.0], [130.0, 0.0]])


def arc(radius: float, degrees: float) -> np.ndarray:
    turn = np.radians(np.arange(0.0, degrees + 1, 5.0))
    return radius * np.stack([np.sin(turn), 1 - np.cos(turn)], axis=1)


def smooth(points: np.ndarray, **constants: float) -> ReferenceLine:
    """Return the line of a route with other constants of the module; by default its points are 1 m apart."""
    return of_route(Route((CentreLine(points, 6.0),)), **constants)


def of_route(route: Route, INCREMENT_M: float = 1.0, **constants: float) -> ReferenceLine:
    with pytest.MonkeyPatch.context() as patched:
        for name, value in {"INCREMENT_M": INCREMENT_M, **constants}.items():
            patched.setattr(lines, name, value)
        line = lines.reference_line(route)
    assert line is not None
    return line


@pytest.mark.parametrize("points", [KINK, ZIGZAG, arc(20.0, 180.0)], ids=["kink", "zigzag", "arc"])
@pytest.mark.parametrize("increment_m", [0.5, 1.0])
def test_reference_line_points_are_equally_far_apart_and_near_the_route(points, increment_m):
    line = smooth(points, INCREMENT_M=increment_m)
    distance = np.hypot(np.diff(line.x), np.diff(line.y))
    np.testing.assert_allclose(distance, increment_m, rtol=1e-9)
    away = shapely.distance(shapely.LineString(points), shapely.points(line.x, line.y))
    assert away.max() == pytest.approx(line.offset_m)
    assert line.offset_m <= 0.25
    # It starts where the route starts, and ends within one increment of the route's end.
    np.testing.assert_allclose((line.x[0], line.y[0]), points[0], atol=1e-3)
    assert np.hypot(line.x[-1] - points[-1, 0], line.y[-1] - points[-1, 1]) < increment_m + 1e-3


def test_reference_line_smaller_offset_is_kept():
    assert smooth(KINK, MAX_OFFSET_M=0.05).offset_m <= 0.05 < smooth(KINK).offset_m


def test_reference_line_curve_is_smooth_and_passes_the_points():
    line = smooth(ZIGZAG)
    np.testing.assert_array_equal(line.curve(line.parameter), np.stack([line.x, line.y], axis=1))
    knots = line.curve.x[1:-1]
    for order in range(3):
        before, after = line.curve(knots - 1e-9, order), line.curve(knots + 1e-9, order)
        np.testing.assert_allclose(before, after, atol=1e-6)


def test_reference_line_arc_has_the_length_heading_and_curvature_of_its_circle():
    line = smooth(arc(50.0, 120.0), MAX_OFFSET_M=1.0)
    inner = slice(20, -20)
    assert np.ptp(line.s[inner]) == pytest.approx(50 * np.ptp(line.heading[inner]), rel=0.01)
    np.testing.assert_allclose(line.curvature[inner], 1 / 50, rtol=0.06)
    fine = line.curve(np.linspace(line.parameter[0], line.parameter[-1], 200_001))
    assert line.s[-1] == pytest.approx(np.linalg.norm(np.diff(fine, axis=0), axis=1).sum(), abs=1e-6)


def test_reference_line_route_below_the_shortest_length_has_none():
    route = Route((CentreLine(np.array([[0.0, 0.0], [9.9, 0.0]]), 6.0),))
    assert lines.reference_line(route) is None


def test_reference_line_width_steps_are_spread():
    narrow = CentreLine(np.array([[0.0, 0.0], [50.0, 0.0]]), 6.0)
    wide = CentreLine(np.array([[50.0, 0.0], [100.0, 0.0]]), 8.0)
    line = of_route(Route((narrow, wide)))
    assert (line.width[0], line.width[-1]) == (6.0, 8.0)
    steps = np.diff(line.width)
    assert (steps >= 0).all()
    assert steps.max() < 0.25
    assert line.width[50] == pytest.approx(7.0, abs=0.25)


def test_reference_line_beside_points_are_at_their_distance_from_both_chords():
    line = smooth(arc(20.0, 90.0))
    x, y = line.beside(np.array([-3.0, 0.0, 2.0]))
    np.testing.assert_array_equal(np.stack([x[:, 1], y[:, 1]]), np.stack([line.x, line.y]))
    for v, column in ((-3.0, 0), (2.0, 2)):
        for ahead in (slice(None, -1), slice(1, None)):
            # Signed distances from the chords before and after each point.
            dx, dy = np.diff(line.x), np.diff(line.y)
            to_x, to_y = x[ahead, column] - line.x[:-1], y[ahead, column] - line.y[:-1]
            np.testing.assert_allclose(dx * to_y - dy * to_x, v, atol=1e-9)


def test_reference_line_part_has_the_same_points():
    line = smooth(ZIGZAG)
    part = line.part(10, 50)
    assert len(part.x) == 41
    assert part.s[0] == 0
    assert part.s[-1] == pytest.approx(line.s[50] - line.s[10])
    np.testing.assert_array_equal(part.x, line.x[10:51])


def test_usable_gap_in_the_heights_cuts_the_line():
    line = smooth(ZIGZAG)
    known = np.zeros(len(line.x))
    known[40:45] = np.nan
    known[-5] = np.nan  # what follows is shorter than the shortest road
    parts = usable(line, known)
    assert [len(part.x) for part in parts] == [40, len(line.x) - 50]


def test_usable_bend_narrower_than_the_road_cuts_the_line():
    turned = np.array([[0.0, 0.0], [60.0, 0.0], [100.0, 40.0]])
    line = smooth(turned, MAX_OFFSET_M=0.1)
    assert np.abs(line.curvature).max() > 1 / 3
    parts = usable(line, np.zeros(len(line.x)))
    assert len(parts) == 2
    assert all((np.abs(part.curvature) * part.width / 2 < 1).all() for part in parts)


def test_reach_bend_limits_its_inner_side():
    right, left = smooth(arc(6.0, 120.0), MAX_OFFSET_M=0.5).reach(8.0)
    assert right == 8.0
    assert 3.0 < left < 6.5
