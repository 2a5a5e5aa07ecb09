import numpy as np
import pytest

from flexroad.tasks.roads.routes import CentreLine, Route
from flexroad.tools.export.along_line import grid_error, height_grid
from flexroad.tools.export.reference_line import Options as LineOptions
from flexroad.tools.export.reference_line import ReferenceLine, reference_line


def road(points: np.ndarray, width_m: float = 6.0) -> ReferenceLine:
    line = reference_line(Route((CentreLine(points, width_m),)), LineOptions(increment_m=1.0))
    assert line is not None
    return line


def tilted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 100 + 0.02 * x + 0.05 * y


def test_height_grid_left_of_the_line_has_positive_v():
    # Northwards: the left is in the west.
    grid = height_grid(road(np.array([[10.0, 0.0], [10.0, 40.0]])), tilted)
    np.testing.assert_allclose(grid.v, np.arange(-4, 4.1, 0.25))
    y = np.arange(41.0)[:, None]
    np.testing.assert_allclose(grid.heights, tilted(10 - grid.v, y), atol=1e-9)
    assert grid_error(grid, tilted)[1] < 1e-9


def test_height_grid_narrow_bend_has_no_margin_on_its_inside():
    turn = np.radians(np.arange(0.0, 181.0, 5.0))
    bend = 6 * np.stack([np.sin(turn), 1 - np.cos(turn)], axis=1)
    grid = height_grid(road(bend), tilted, margin_m=5.0)
    assert grid.v[0] == -8
    assert 3 < grid.v[-1] < 6
    # Cross-sections do not meet: all cells have an area.
    x, y = grid.line.beside(grid.v)
    across = np.diff(x, axis=1)[:-1], np.diff(y, axis=1)[:-1]
    along = np.diff(x, axis=0)[:, :-1], np.diff(y, axis=0)[:, :-1]
    assert (along[0] * across[1] - along[1] * across[0] > 0).all()


def test_height_grid_beyond_a_gap_is_nan():
    """Readers of OpenCRG refuse a cross-section with a gap."""
    holed = lambda x, y: np.where((x == 12) & ((np.abs(y - 1.5) < 0.1) | (y < -3.8)), np.nan, x)  # noqa: E731
    grid = height_grid(road(np.array([[0.0, 0.0], [40.0, 0.0]])), holed)
    known = np.isfinite(grid.heights)
    assert (grid.v[known[12]].min(), grid.v[known[12]].max()) == (-3.75, 1.25)
    assert known[12].sum() == 21
    assert known[np.arange(41) != 12].all()


def test_grid_error_is_that_of_the_middle_of_cells():
    line = road(np.array([[0.0, 0.0], [40.0, 0.0]]))
    bowl = lambda x, y: 0.5 * (0.2 * x**2 + 0.4 * y**2)  # noqa: E731
    median_m, max_m = grid_error(height_grid(line, bowl), bowl)
    # h^2 / 8 of the second derivative along each direction.
    assert median_m == pytest.approx(0.2 / 8 + 0.4 * 0.25**2 / 8)
    assert max_m == pytest.approx(median_m)


def test_height_grid_beyond_the_surface_is_nan_and_has_no_error():
    line = road(np.array([[0.0, 0.0], [40.0, 0.0]]))
    half = lambda x, y: np.where(y > 0, np.nan, x)  # noqa: E731
    grid = height_grid(line, half)
    assert np.isnan(grid.heights[:, grid.v > 1e-6]).all()
    assert grid_error(grid, half)[1] < 1e-9
    assert np.isnan(grid_error(grid, lambda x, y: x + np.nan)[0])
