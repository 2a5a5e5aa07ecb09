import numpy as np
from hypothesis import given
from hypothesis.extra.numpy import arrays

from flexroad.catalog import Grid
from flexroad.tasks.segment.mask import Options, segment
from flexroad.tasks.types import TileData

CORE = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 8, 6)


def data(void=None, mask=None, halo=0, dtm_void=None) -> TileData:
    grid = CORE.buffered(halo)
    dsm, dtm = np.full(grid.shape, 5.0), np.full(grid.shape, 4.0)
    if void is not None:
        dsm[void] = np.nan
        dtm[void if dtm_void is None else dtm_void] = np.nan
    return TileData("a", grid, CORE, dsm, dtm, road_mask=mask)


def test_segment_returns_mask_unchanged():
    mask = np.eye(6, 8, dtype=bool)
    road = segment(data(mask=mask), Options())
    np.testing.assert_array_equal(road.mask, mask)
    assert (road.grid, road.core, road.probability) == (CORE, CORE, None)
    assert not road.outside.any()


def test_segment_tile_beyond_mask_has_no_road_and_a_note():
    road = segment(data(), Options())
    assert road.mask.shape == CORE.shape
    assert not road.mask.any()
    assert road.notes == ("segment: no road mask reaches this tile, so it counts as a tile without roads",)


def test_segment_road_only_in_halo_is_kept_with_a_note():
    mask = np.zeros((10, 12), bool)
    mask[0] = True
    road = segment(data(mask=mask, halo=2), Options())
    np.testing.assert_array_equal(road.mask, mask)
    (note,) = road.notes
    assert "no road cell on this tile; " in note
    assert "--road-value" in note
    mask[5, 5] = True
    road = segment(data(mask=mask, halo=2), Options())
    assert (road.mask.sum(), road.notes) == (13, ())


def test_beyond_extent_is_void_connected_to_edge():
    void = np.array(
        [
            [1, 0, 0, 0, 0, 0, 1, 1],
            [0, 1, 0, 0, 0, 0, 0, 1],
            [0, 0, 0, 1, 1, 0, 0, 0],
            [0, 0, 0, 1, 1, 0, 0, 0],
            [0, 0, 0, 0, 0, 0, 0, 0],
            [0, 0, 1, 0, 0, 0, 0, 0],
        ],
        bool,
    )
    expected = void.copy()
    expected[1, 1] = False  # connected to the void in the corner only diagonally
    expected[2:4, 3:5] = False
    np.testing.assert_array_equal(data(void).beyond_extent(), expected)


def test_beyond_extent_cell_with_one_height_is_inside():
    void, dtm_void = np.zeros((6, 8), bool), np.zeros((6, 8), bool)
    void[:3] = True
    dtm_void[3:] = True
    assert not data(void, dtm_void=dtm_void).beyond_extent().any()
    dtm_void[2] = True
    np.testing.assert_array_equal(
        np.flatnonzero(data(void, dtm_void=dtm_void).beyond_extent().all(axis=1)), [2]
    )


@given(arrays(bool, (6, 8)))
def test_beyond_extent_equals_flood_fill_from_edge(void):
    """Compared with a flood fill that spreads cell by cell."""
    filled = np.zeros_like(void)
    rim = np.ones_like(void)
    rim[1:-1, 1:-1] = False
    filled |= void & rim
    for _ in range(void.size):
        spread = np.pad(filled, 1)
        filled |= void & (spread[:-2, 1:-1] | spread[2:, 1:-1] | spread[1:-1, :-2] | spread[1:-1, 2:])
    np.testing.assert_array_equal(data(void).beyond_extent(), filled)
