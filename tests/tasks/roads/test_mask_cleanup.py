import geopandas
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import ndimage
from shapely.geometry import box

from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads.mask_cleanup import clean, close, drop, fill
from flexroad.tasks.types import Source
from tests.builders import make_tile

masks = arrays.arrays(bool, st.tuples(st.integers(1, 24), st.integers(1, 24)))
cells = st.sampled_from([1.0, 0.5, 0.2])
widths = st.sampled_from([0.0, 0.2, 1.0, 1.5, 2.0, 3.0])
areas = st.sampled_from([0.0, 0.04, 1.0, 2.5, 6.0, 40.0])


@given(arrays.arrays(bool, st.tuples(st.integers(1, 10), st.integers(1, 10))), cells, widths)
@settings(max_examples=60)
def test_close_keeps_ground_that_holds_a_disc(mask, cell, width):
    n = int(width / cell + 1e-9) + 1
    rows, cols = np.indices((n, n)) - (n - 1) / 2
    disc = rows**2 + cols**2 <= (n / 2) ** 2
    plane = np.pad(mask, n)
    ground = np.zeros_like(plane)
    for row, col in np.ndindex(plane.shape[0] - n + 1, plane.shape[1] - n + 1):
        under = slice(row, row + n), slice(col, col + n)
        if not (plane[under] & disc).any():
            ground[under] |= disc
    np.testing.assert_array_equal(close(mask, cell, width), ~ground[n:-n, n:-n])


@given(masks, cells, areas)
def test_drop_and_fill_match_scipy_labels(mask, cell, area):
    def small(cells, joined, limit):
        labels, count = ndimage.label(cells, joined)
        cut = {*labels[0], *labels[-1], *labels[:, 0], *labels[:, -1]}
        sizes = np.bincount(labels.ravel(), minlength=count + 1)
        return np.isin(labels, [i for i in range(1, count + 1) if i not in cut and limit(sizes[i])])

    specks = small(mask, np.ones((3, 3)), lambda n: n * cell**2 < area - 1e-9)
    holes = small(~mask, None, lambda n: n * cell**2 <= area + 1e-9)
    np.testing.assert_array_equal(drop(mask, cell, area), mask & ~specks)
    np.testing.assert_array_equal(fill(mask, cell, area), mask | holes)


def test_clean_closes_gaps_before_dropping_pieces():
    mask = np.zeros((40, 60), bool)
    mask[18:22, 5:55] = True
    mask[:, 10::6] = False  # abutments of one metre
    assert not drop(mask, 1.0, 25).any()
    assert clean(mask, make_tile(np.zeros(mask.shape)), "pieces")[18:22, 6:54].all()


def test_clean_adds_no_cells_beyond_survey():
    mask, heights = np.ones((20, 20), bool), np.zeros((20, 20))
    mask[:, 9:11] = False
    heights[:, 9] = np.nan
    result = clean(mask, make_tile(heights), "pieces")
    np.testing.assert_array_equal(result[5:-5], np.isfinite(heights)[5:-5])


@given(masks)
def test_clean_without_steps_changes_nothing(mask):
    np.testing.assert_array_equal(clean(mask, make_tile(np.zeros(mask.shape)), "none"), mask)


def test_clean_corridor_is_5_m_around_roads_of_catalog(tmp_path):
    mask, path = np.ones((20, 30), bool), tmp_path / "roads.gpkg"
    data = make_tile(np.zeros(mask.shape), roads=Source("roads", (path,)))
    west, south, east, _ = data.grid.bounds
    geopandas.GeoDataFrame(geometry=[box(west, south, east, south + 4)], crs=data.grid.crs).to_file(path)
    result = clean(mask, data, "corridor")
    np.testing.assert_array_equal(result[:, 0], [*[False] * 11, *[True] * 9])
    assert (result == result[:, :1]).all()
    with pytest.raises(TaskError, match=r"corridor needs roads.*--roads"):
        clean(mask, make_tile(np.zeros(mask.shape)), "corridor")
