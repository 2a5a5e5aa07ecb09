"""The lazy raster of a run: which tile a cell is from, and what is read of its file."""

import numpy as np
import pytest
import xarray as xr
from xarray.core import indexing

from flexroad.tools.results import mosaic

RNG = np.random.default_rng(1)
FILES = {"a_h": RNG.random((6, 5)), "b_h": RNG.random((4, 6))}
BOXES = np.array([[-2, 4, 1, 6], [2, 6, 4, 10]])
"""The first tile begins above the raster and overlaps the second, which ends to the right of it."""


@pytest.fixture
def read(monkeypatch):
    """Read parts of `FILES`; the list has the parts read."""
    parts = []

    def part(product, window):
        parts.append((product, window.col_off, window.row_off, window.width, window.height))
        return FILES[product][window.toslices()]

    monkeypatch.setattr(mosaic, "_read", part)
    return parts


def expected():
    whole = np.full((8, 9), np.nan)
    whole[2:6, 4:9] = FILES["b_h"][:, :5]
    whole[0:4, 1:6] = FILES["a_h"][2:]
    return whole


def lazy_layer():
    layer = mosaic.Mosaic((8, 9), ("a", "b"), BOXES, "_h", np.dtype("float64"), np.nan)
    return xr.DataArray(xr.Variable(("y", "x"), indexing.LazilyIndexedArray(layer)))


def test_mosaic_of_overlapping_tiles_has_cells_of_the_first(read):
    raster = lazy_layer().chunk(y=4, x=(1, 3, 5))
    assert not read
    np.testing.assert_array_equal(raster, expected())


@pytest.mark.parametrize(
    "part",
    [np.s_[3, 5], np.s_[1:7:3, ::2], np.s_[::-1, 4:], np.s_[2, :], np.s_[[0, 5, 2], 1:3], np.s_[0:0, :]],
)
def test_part_of_mosaic_equals_part_of_whole(read, part):
    np.testing.assert_array_equal(lazy_layer()[part], expected()[part])
    np.testing.assert_array_equal(lazy_layer().chunk(y=4, x=(1, 3, 5))[part], expected()[part])


def test_mosaic_reads_only_cells_in_the_part(read):
    lazy_layer()[0:2, 0:4].load()
    assert read == [("a_h", 0, 2, 3, 2)]


def test_chunks_of_mosaic_end_at_edges_of_tiles():
    assert mosaic._steps(BOXES[:, :2], 8) == (2, 2, 2, 2)
    assert mosaic._steps(BOXES[:, 2:], 9) == (1, 3, 2, 3)
