from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import ndimage

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads.mask_cleanup import clean, close, drop, fill
from flexroad.tasks.types import Source, TileData

masks = arrays.arrays(bool, st.tuples(st.integers(1, 24), st.integers(1, 24)))
cells = st.sampled_from([1.0, 0.5, 0.2])
widths = st.sampled_from([0.0, 0.2, 1.0, 1.5, 2.0, 3.0])
areas = st.sampled_from([0.0, 0.04, 1.0, 2.5, 6.0, 40.0])


def tile(shape, cell=1.0, void=None, **layers) -> TileData:
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, cell, shape[1], shape[0])
    heights = np.zeros(shape)
    if void is not None:
        heights[void] = np.nan
    return TileData("t", grid, grid, heights, heights, **layers)


def parse_mask(text):
    return np.array([[letter == "#" for letter in line] for line in text.split()])


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


@given(masks, cells, widths, areas)
def test_steps_are_monotonic_and_idempotent(mask, cell, width, area):
    for step, size in ((close, width), (fill, area)):
        result = step(mask, cell, size)
        assert (result | mask == result).all()
        np.testing.assert_array_equal(step(result, cell, size), result)
    result = drop(mask, cell, area)
    assert (result & mask == result).all()
    np.testing.assert_array_equal(drop(result, cell, area), result)


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


@pytest.mark.parametrize("cell", [1.0, 0.5, 0.2])
def test_sizes_do_not_depend_on_cell_size(cell):
    def metres(n):
        return round(n / cell)

    road = np.ones((metres(40), metres(40)), bool)
    road[:, metres(10) : metres(12)] = False  # a gap of 2 m
    road[:, metres(25) : metres(28)] = False  # one of 3 m
    closed = close(road, cell, 2.0)
    # A gap that leaves the grid is not closed at the grid's edge.
    inner = slice(metres(3), metres(-3))
    assert closed[inner, metres(10) : metres(12)].all()
    assert not closed[:, metres(25) : metres(28)].any()

    speck = np.zeros((metres(20), metres(20)), bool)
    speck[metres(5) : metres(8), metres(5) : metres(9)] = True  # 12 m2
    np.testing.assert_array_equal(drop(speck, cell, 12.0), speck)
    assert not drop(speck, cell, 12.5).any()
    assert fill(~speck, cell, 12.0).all()
    np.testing.assert_array_equal(fill(~speck, cell, 11.5), ~speck)


def test_pieces_at_grid_edge_are_kept():
    mask = parse_mask("#...## ....#. ..#..#")
    np.testing.assert_array_equal(drop(mask, 1.0, 100), mask)
    np.testing.assert_array_equal(fill(~mask, 1.0, 100), ~mask)


def test_clean_closes_gaps_before_dropping_pieces():
    mask = np.zeros((40, 60), bool)
    mask[18:22, 5:55] = True
    mask[:, 10::6] = False  # abutments of one metre
    data = tile(mask.shape)
    assert not drop(mask, 1.0, 25).any()
    whole = clean(mask, data, "pieces")
    assert whole[18:22, 6:54].all()


def test_clean_adds_no_cells_beyond_survey():
    mask = np.ones((20, 20), bool)
    mask[:, 9:11] = False
    void = np.zeros_like(mask)
    void[:, 9] = True
    result = clean(mask, tile(mask.shape, void=void), "pieces")
    np.testing.assert_array_equal(result[5:-5], ~void[5:-5])


@given(masks)
def test_clean_without_steps_changes_nothing(mask):
    np.testing.assert_array_equal(clean(mask, tile(mask.shape), "none"), mask)


def test_clean_corridor_without_roads_fails():
    mask = np.ones((4, 4), bool)
    with pytest.raises(TaskError, match=r"corridor needs roads.*--roads"):
        clean(mask, tile(mask.shape), "corridor")


def test_clean_corridor_is_5_m_around_roads_of_catalog(tmp_path):
    import geopandas
    from shapely.geometry import box

    mask = np.ones((20, 30), bool)
    data = tile(mask.shape)
    west, south, east, _ = data.grid.bounds
    path = tmp_path / "roads.gpkg"
    geopandas.GeoDataFrame(geometry=[box(west, south, east, south + 4)], crs=data.grid.crs).to_file(path)
    result = clean(mask, replace(data, roads=Source("roads", (path,))), "corridor")
    np.testing.assert_array_equal(result[:, 0], [*[False] * 11, *[True] * 9])
    assert (result == result[:, :1]).all()
