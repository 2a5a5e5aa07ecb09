import numpy as np
import pytest

from flexroad.tasks.roads.routes import CentreLine, Route
from flexroad.tools.export.reference_line import Options, ReferenceLine, reference_line
from flexroad.tools.export.road_lines import stations


def line(*points: tuple[float, float], width: float = 6.0) -> ReferenceLine:
    found = reference_line(Route((CentreLine(np.array(points), width),)), Options())
    assert found is not None
    return found


def test_stations_of_a_plane_have_its_slopes():
    # North-east: up 3% along it, and 2% down to the left.
    along, left = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    found = stations(
        line((0, 0), (60.3, 80.4)),
        lambda x, y: 100 + 0.03 * (x * along[0] + y * along[1]) - 0.02 * (x * left[0] + y * left[1]),
    )
    np.testing.assert_allclose(np.diff(found.s), 1.0, atol=1e-6)
    assert len(found.height) == 100
    np.testing.assert_allclose(found.height, 100 + 0.03 * (found.s[:-1] + 0.5), atol=1e-6)
    np.testing.assert_allclose(found.grade, 0.03, atol=1e-6)
    for slope, value in ((found.crossfall, -0.02), (found.left, -0.02), (found.right, 0.02)):
        np.testing.assert_allclose(slope, value, atol=1e-6)
    np.testing.assert_allclose(found.curvature, 0, atol=1e-6)
    np.testing.assert_allclose(found.width, 6.0)


def test_stations_of_a_crowned_road_fall_to_both_sides():
    found = stations(line((0, 0), (50, 0)), lambda x, y: 10 - 0.025 * np.abs(y))
    np.testing.assert_allclose(found.crossfall, 0, atol=1e-9)
    np.testing.assert_allclose(found.left, -0.025, atol=1e-9)
    np.testing.assert_allclose(found.right, -0.025, atol=1e-9)


@pytest.mark.parametrize("side", [1, -1])
def test_stations_of_a_bend_have_its_curvature(side):
    turn = np.linspace(0, 1.5, 40)
    points = np.stack([50 * np.sin(turn), side * (50 - 50 * np.cos(turn))], axis=1)
    found = stations(line(*map(tuple, points)), lambda x, y: 0 * x)
    np.testing.assert_allclose(found.curvature[10:-10], side / 50, rtol=0.1)


def test_stations_where_an_edge_has_no_height_have_no_slope_there():
    found = stations(line((0, 0), (50, 0)), lambda x, y: np.where(y > 2, np.nan, 5.0))
    assert np.isfinite(found.height).all()
    assert np.isfinite(found.right).all()
    assert np.isnan(found.left).all()
    assert np.isnan(found.crossfall).all()
