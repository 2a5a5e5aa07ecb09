"""Cubic pieces against the profile that they stand for."""

import numpy as np
import pytest

from flexroad.tools.export.profiles import cubic_pieces, value_at


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
