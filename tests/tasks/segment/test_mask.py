import numpy as np

from flexroad.tasks.segment.mask import Options, segment
from flexroad.tasks.types import TileData
from tests.builders import make_grid

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
