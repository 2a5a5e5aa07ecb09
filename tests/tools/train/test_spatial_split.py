from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.catalog import Grid, Tile
from flexroad.pipeline.errors import ConfigError
from flexroad.tools.train.driver import Block, inside, split, split_tile


def make_block(col, row, road=10, ground=10, size=100):
    grid = Grid("EPSG:25832", 500000.0 + col * size, 5600000.0 + row * size, 1.0, size, size)
    tile = Tile(f"{col}_{row}", grid, (), "", datetime(2025, 1, 1, tzinfo=UTC))
    return Block(tile, grid.bounds, road, ground)


places = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=2, max_size=25, unique=True)


@given(places, st.floats(0.05, 0.9), st.integers(0, 9))
def test_split_sides_are_separated_by_straight_line(places, share, seed):
    sides = split([make_block(*place) for place in places], share, 0.0, seed)
    assert len(sides.train) + len(sides.validate) == len(places)
    assert len(sides.validate) == min(max(1, round(share * len(places))), len(places) - 1)
    corners = [np.array([block.bounds[0], block.bounds[1]]) for block in (*sides.train, *sides.validate)]
    side = np.array([0] * len(sides.train) + [1] * len(sides.validate))
    angles = 2 * np.pi * np.arange(8) / 8
    along = np.array(corners) @ np.array([np.sin(angles), np.cos(angles)])
    assert any(along[side == 0, i].max() <= along[side == 1, i].min() + 1e-6 for i in range(8))


@given(places, st.sampled_from([0.0, 30.0, 150.0]), st.integers(0, 9))
def test_training_cells_keep_gap_to_validation_side(places, gap, seed):
    sides = split([make_block(*place) for place in places], 0.3, gap, seed)
    validation_bounds = [block.bounds for block in sides.validate]
    for block in sides.train:
        grid = block.tile.grid
        cells = sides.training_cells(grid, block.bounds)
        rows, cols = np.nonzero(cells)
        for west, south, east, north in validation_bounds:
            x, y = grid.eastings[cols], grid.northings[rows]
            distance = np.maximum(np.maximum(west - x, x - east), np.maximum(south - y, y - north))
            assert not cells.any() or distance.min() >= gap


def test_split_both_sides_have_labels_of_both_classes():
    with_road = {(0, 0), (3, 0)}
    blocks = [make_block(col, 0, road=10 if (col, 0) in with_road else 0) for col in range(4)]
    for seed in range(6):
        sides = split(blocks, 0.25, 0.0, seed)
        assert sides.validate[0].tile.id in {"0_0", "3_0"}
    with pytest.raises(ConfigError, match="1 of them with road; label more tiles"):
        split([make_block(col, 0, road=10 * (col == 2)) for col in range(4)], 0.25, 0.0, 0)


def test_split_tile_divides_along_longer_side():
    grid = Grid("EPSG:25832", 0.0, 100.0, 1.0, 50, 100)
    train, validate = split_tile(grid.bounds, 0.3)
    assert (inside(grid, train).sum(), inside(grid, validate).sum()) == (3500, 1500)
    assert not (inside(grid, train) & inside(grid, validate)).any()
