import numpy as np
from hypothesis import given
from hypothesis.extra.numpy import arrays

from flexroad.tasks.segment.mask import Options, segment
from flexroad.tasks.types import TileData
from tests.builders import make_grid, make_tile

CORE = make_grid(8, 6)


def data(mask=None, halo=0) -> TileData:
    grid = CORE.buffered(halo)
    flat = np.zeros(grid.shape)
    return TileData("a", grid, CORE, flat, flat, road_mask=mask)


def test_segment_returns_mask_unchanged():
    mask = np.eye(6, 8, dtype=bool)
    road = segment(data(mask), Options())
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
    road = segment(data(mask, halo=2), Options())
    np.testing.assert_array_equal(road.mask, mask)
    (note,) = road.notes
    assert "no road cell on this tile; " in note
    assert "--road-value" in note
    mask[5, 5] = True
    road = segment(data(mask, halo=2), Options())
    assert (road.mask.sum(), road.notes) == (13, ())


def tile(void, dtm_void=None):
    models = (np.where(cells, np.nan, 5.0) for cells in (void, void if dtm_void is None else dtm_void))
    return make_tile(*models)


def test_beyond_extent_cell_with_one_height_is_inside():
    row = np.indices((6, 8))[0]
    assert not tile(row < 3, row >= 3).beyond_extent().any()
    np.testing.assert_array_equal(tile(row < 3, row >= 2).beyond_extent(), row == 2)


@given(arrays(bool, (6, 8)))
def test_beyond_extent_equals_flood_fill_from_edge(void):
    """Compared with a flood fill that spreads cell by cell, not diagonally."""
    filled = np.zeros_like(void)
    rim = np.ones_like(void)
    rim[1:-1, 1:-1] = False
    filled |= void & rim
    for _ in range(void.size):
        spread = np.pad(filled, 1)
        filled |= void & (spread[:-2, 1:-1] | spread[2:, 1:-1] | spread[1:-1, :-2] | spread[1:-1, 2:])
    np.testing.assert_array_equal(tile(void).beyond_extent(), filled)
