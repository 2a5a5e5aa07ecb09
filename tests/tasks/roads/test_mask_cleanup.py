from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy import ndimage

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads.mask_cleanup import NOTHING, Cleanup, clean, close, drop, fill, within
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


def drawn(text):
    return np.array([[letter == "#" for letter in line] for line in text.split()])


@given(arrays.arrays(bool, st.tuples(st.integers(1, 10), st.integers(1, 10))), cells, widths)
@settings(deadline=None, max_examples=60)
def test_ground_stays_ground_where_a_disc_wider_than_the_gap_lies_in_it(mask, cell, width):
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
@settings(deadline=None)
def test_every_step_adds_or_takes_and_does_so_once(mask, cell, width, area):
    for step, size in ((close, width), (fill, area)):
        found = step(mask, cell, size)
        assert (found | mask == found).all()
        np.testing.assert_array_equal(step(found, cell, size), found)
    found = drop(mask, cell, area)
    assert (found & mask == found).all()
    np.testing.assert_array_equal(drop(found, cell, area), found)


@given(masks, cells, areas)
@settings(deadline=None)
def test_pieces_and_holes_are_weighed_as_scipy_labels_them(mask, cell, area):
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
def test_sizes_are_metres_at_every_cell(cell):
    def metres(n):
        return round(n / cell)

    road = np.ones((metres(40), metres(40)), bool)
    road[:, metres(10) : metres(12)] = False  # a gap of 2 m
    road[:, metres(25) : metres(28)] = False  # one of 3 m
    closed = close(road, cell, 2.0)
    # Where a gap leaves the grid, nothing says that it ends.
    inner = slice(metres(3), metres(-3))
    assert closed[inner, metres(10) : metres(12)].all()
    assert not closed[:, metres(25) : metres(28)].any()

    speck = np.zeros((metres(20), metres(20)), bool)
    speck[metres(5) : metres(8), metres(5) : metres(9)] = True  # 12 m2
    np.testing.assert_array_equal(drop(speck, cell, 12.0), speck)
    assert not drop(speck, cell, 12.5).any()
    assert fill(~speck, cell, 12.0).all()
    np.testing.assert_array_equal(fill(~speck, cell, 11.5), ~speck)


def test_what_the_edge_cuts_stays():
    mask = drawn("#...## ....#. ..#..#")
    np.testing.assert_array_equal(drop(mask, 1.0, 100), mask)
    np.testing.assert_array_equal(fill(~mask, 1.0, 100), ~mask)


def test_a_road_in_fragments_counts_as_one():
    mask = np.zeros((40, 60), bool)
    mask[18:22, 5:55] = True
    mask[:, 10::6] = False  # joints of one metre
    data = tile(mask.shape)
    assert not clean(mask, data, Cleanup(close_m=0, drop_m2=25)).any()
    whole = clean(mask, data, Cleanup(close_m=2, drop_m2=25))
    assert whole[18:22, 6:54].all()


def test_nothing_is_added_beyond_the_survey():
    mask = np.ones((20, 20), bool)
    mask[:, 9:11] = False
    void = np.zeros_like(mask)
    void[:, 9] = True
    found = clean(mask, tile(mask.shape, void=void), Cleanup(close_m=3))
    np.testing.assert_array_equal(found[5:-5], ~void[5:-5])


@given(masks)
@settings(deadline=None)
def test_nothing_asked_is_nothing_done(mask):
    np.testing.assert_array_equal(clean(mask, tile(mask.shape), NOTHING), mask)


def test_fusion_with_a_second_source():
    mask, second = np.zeros((30, 30), bool), np.zeros((30, 30), bool)
    mask[10:20], second[:, 14] = True, True
    data = tile(mask.shape, cell=0.5, road_mask=second)

    def fused(how, **more):
        options = NOTHING.model_copy(update={"fuse": how, "fuse_with": "road_mask", **more})
        return clean(mask, data, options)

    np.testing.assert_array_equal(fused("union"), mask | second)
    np.testing.assert_array_equal(fused("intersection"), mask & second)
    corridor = mask.copy()
    corridor[:, :11] = corridor[:, 18:] = False
    np.testing.assert_array_equal(fused("corridor", corridor_m=1.5), corridor)


@given(masks, cells, st.sampled_from([0.0, 0.7, 1.0, 2.5]))
@settings(deadline=None)
def test_a_corridor_is_measured_between_cell_centres(mask, cell, reach):
    if mask.any():
        distance = ndimage.distance_transform_edt(~mask) * cell
        np.testing.assert_array_equal(within(mask, cell, reach), distance <= reach + 1e-6)
    else:
        assert not within(mask, cell, reach).any()


def test_a_second_source_that_is_missing_is_named():
    mask = np.ones((4, 4), bool)
    with pytest.raises(TaskError, match=r"union needs roads.*--roads"):
        clean(mask, tile(mask.shape), Cleanup(fuse="union"))


def test_roads_of_the_catalog_are_such_a_source(tmp_path):
    import geopandas
    from shapely.geometry import box

    mask = np.zeros((20, 30), bool)
    data = tile(mask.shape)
    west, south, east, _ = data.grid.bounds
    path = tmp_path / "roads.gpkg"
    geopandas.GeoDataFrame(geometry=[box(west, south + 5, east, south + 9)], crs=data.grid.crs).to_file(path)
    found = clean(mask, replace(data, roads=Source("roads", (path,))), Cleanup(fuse="union"))
    np.testing.assert_array_equal(found[:, 0], [*[False] * 11, *[True] * 4, *[False] * 5])
    assert (found == found[:, :1]).all()
