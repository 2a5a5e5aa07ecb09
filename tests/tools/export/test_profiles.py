import numpy as np
import pytest

from flexroad.tasks.roads.routes import CentreLine, Route
from flexroad.tools.export import profiles as heights_along
from flexroad.tools.export import reference_line as lines
from flexroad.tools.export.profiles import (
    HeightGrid,
    Profiles,
    cubic_pieces,
    grid_error,
    height_grid,
    profile_error,
    profiles,
    value_at,
)
from flexroad.tools.export.reference_line import ReferenceLine


def straight(length: float = 120.0) -> ReferenceLine:
    """Return a straight road to the east, 6 m wide: s is x, and v is y."""
    return road(np.array([[0.0, 0.0], [length, 0.0]]))


def grid(heights_at, length: float = 120.0) -> HeightGrid:
    return height_grid(straight(length), heights_at)


def hill(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a slope of cubics with a crossfall that changes along the road."""
    return 80 + 0.05 * x - 2e-4 * x**2 + 1e-6 * x**3 + y * np.tan(0.02 + 2e-4 * x)


def fitted(heights: HeightGrid) -> tuple[Profiles, float]:
    result = profiles(heights)
    return result, profile_error(heights, result)[1]


@pytest.mark.parametrize("length", [10.0, 11.0, 25.0, 120.0])
def test_profiles_cubic_road_is_found(length):
    result, worst = fitted(grid(hill, length))
    s = np.linspace(0, length, 37)
    np.testing.assert_allclose(value_at(result.elevation, s), hill(s, 0 * s), atol=1e-6)
    np.testing.assert_allclose(value_at(result.superelevation, s), 0.02 + 2e-4 * s, atol=1e-6)
    assert worst < 1e-6


def test_profiles_verge_does_not_count():
    # A kerb of 0.3 m from 3 m on, where the carriageway ends; the grid reaches 4 m.
    result, worst = fitted(grid(lambda x, y: hill(x, y) + 0.3 * (np.abs(y) > 3.01)))
    assert worst < 1e-6
    assert value_at(result.elevation, 60.0) == pytest.approx(hill(60.0, 0.0), abs=1e-6)


def test_profile_error_of_a_crown_is_what_a_straight_section_misses():
    crowned = grid(lambda x, y: hill(x, y) - 0.01 * y**2)
    result, worst = fitted(crowned)
    # The best line is level at the mean of the squares; the edges miss it most.
    v = np.arange(-3, 3.1, 0.25)
    truth = np.abs(0.01 * (v**2 - (v**2).mean()))
    assert worst == pytest.approx(truth.max(), abs=1e-6)
    assert profile_error(crowned, result)[0] == pytest.approx(truth.mean(), abs=1e-6)


def test_profiles_unknown_cross_sections_are_bridged():
    whole = grid(hill)
    holed = whole.heights.copy()
    holed[50:53] = np.nan
    result, worst = fitted(HeightGrid(whole.line, whole.v, holed))
    assert worst < 0.001
    assert value_at(result.elevation, 51.0) == pytest.approx(hill(51.0, 0.0), abs=0.005)


@pytest.mark.parametrize("step", [0.5, -2.0])
def test_profiles_of_a_crowned_road_do_not_bend_where_its_surface_ends(step):
    """A tile ends askew: the first and last cross-sections are cut."""

    def crowned(x, y):
        return 100 + 0.04 * x + 0.01 * y - 0.025 * np.abs(y)

    def ending(x, y):
        return np.where(np.abs(x - 30 - step * y) < 30.01, crowned(x, y), np.nan)

    s = np.linspace(0, 60, 25)
    complete, cut = (profiles(grid(heights, 60.0)) for heights in (crowned, ending))
    np.testing.assert_allclose(value_at(cut.elevation, s), value_at(complete.elevation, s), rtol=0, atol=1e-9)
    np.testing.assert_allclose(value_at(cut.superelevation, s), np.arctan(0.01), rtol=0, atol=1e-9)


def test_profiles_go_on_from_piece_to_piece():
    s = np.arange(120.0)
    height = hill(s, 0) + 0.05 * np.sin(s)
    result, _ = fitted(grid(lambda x, y: hill(x, y) + 0.05 * np.sin(x)))
    np.testing.assert_allclose(value_at(result.elevation, s), height, rtol=0, atol=0.00051)
    for pieces in (result.elevation, result.superelevation):
        at = pieces[1:, 0]
        before, after = value_at(pieces, at - 1e-7), value_at(pieces, at + 1e-7)
        np.testing.assert_allclose(before, pieces[1:, 1], atol=1e-6)
        np.testing.assert_allclose((pieces[1:, 1] - before) / 1e-7, (after - pieces[1:, 1]) / 1e-7, atol=1e-6)


def hills(s):
    return 100 + 3 * np.sin(s / 20) + 0.02 * s, 3 / 20 * np.cos(s / 20) + 0.02


@pytest.mark.parametrize("tolerance", [0.05, 0.005, 0.0005])
def test_pieces_stay_within_the_tolerance_and_go_on_smoothly(tolerance):
    s = np.linspace(0, 300, 601)
    z, slope = hills(s)
    pieces = cubic_pieces(s, z, slope, tolerance)
    assert np.abs(value_at(pieces, s) - z).max() <= tolerance
    begin, a, b, c, d = pieces.T
    length = np.diff(np.append(begin, s[-1]))
    np.testing.assert_allclose((a + b * length + c * length**2 + d * length**3)[:-1], a[1:], atol=1e-9)
    np.testing.assert_allclose((b + 2 * c * length + 3 * d * length**2)[:-1], b[1:], atol=1e-9)
    # The fourth derivative bounds the length of a piece: (384 tolerance / |z''''|) ** (1 / 4).
    shortest = (384 * tolerance / (3 / 20**4)) ** 0.25
    assert len(pieces) <= np.ceil(300 / (shortest - 1)) + 1


def test_a_cubic_is_one_piece():
    s = np.linspace(0, 40, 81)
    pieces = cubic_pieces(s, 1 + 0.1 * s - 2e-3 * s**2 + 1e-5 * s**3, 0.1 - 4e-3 * s + 3e-5 * s**2, 1e-9)
    np.testing.assert_allclose(pieces, [[0, 1, 0.1, -2e-3, 1e-5]], atol=1e-12)


def road(points: np.ndarray, width_m: float = 6.0) -> ReferenceLine:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(lines, "INCREMENT_M", 1.0)
        line = lines.reference_line(Route((CentreLine(points, width_m),)))
    assert line is not None
    return line


def tilted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 100 + 0.02 * x + 0.05 * y


def test_height_grid_narrow_bend_has_no_margin_on_its_inside(monkeypatch):
    monkeypatch.setattr(heights_along, "MARGIN_M", 5.0)
    turn = np.radians(np.arange(0.0, 181.0, 5.0))
    bend = 6 * np.stack([np.sin(turn), 1 - np.cos(turn)], axis=1)
    grid = height_grid(road(bend), tilted)
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


def test_height_grid_has_its_left_at_positive_v_and_no_heights_or_error_beyond_the_surface():
    # Northwards: the left is in the west.
    line = road(np.array([[10.0, 0.0], [10.0, 40.0]]))
    complete = height_grid(line, tilted)
    np.testing.assert_allclose(complete.v, np.arange(-4, 4.1, 0.25))
    np.testing.assert_allclose(complete.heights, tilted(10 - complete.v, np.arange(41.0)[:, None]), atol=1e-9)
    assert grid_error(complete, tilted)[1] < 1e-9
    half = lambda x, y: np.where(x < 9.99, np.nan, tilted(x, y))  # noqa: E731
    cut = height_grid(line, half)
    assert np.isnan(cut.heights[:, cut.v > 1e-6]).all()
    assert grid_error(cut, half)[1] < 1e-9
    nothing = HeightGrid(line, complete.v, complete.heights * np.nan)
    assert np.isnan(profile_error(nothing, profiles(nothing))[1])
    assert np.isnan(grid_error(complete, lambda x, y: x + np.nan)[0])
