from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.catalog import Grid, Tile
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.training.spatial_split import Block, inside, split, split_tile


def piece(col, row, road=10, ground=10, size=100):
    grid = Grid("EPSG:25832", 500000.0 + col * size, 5600000.0 + row * size, 1.0, size, size)
    tile = Tile(f"{col}_{row}", grid, (), "", datetime(2025, 1, 1, tzinfo=UTC))
    return Block(tile, grid.bounds, road, ground)


places = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=2, max_size=25, unique=True)


@given(places, st.floats(0.05, 0.9), st.integers(0, 9))
def test_a_straight_line_parts_the_two_sides(places, share, seed):
    found = split([piece(*place) for place in places], share, 0.0, seed)
    assert len(found.train) + len(found.validate) == len(places)
    assert len(found.validate) == min(max(1, round(share * len(places))), len(places) - 1)
    centres = [np.array([piece.bounds[0], piece.bounds[1]]) for piece in (*found.train, *found.validate)]
    sides = np.array([0] * len(found.train) + [1] * len(found.validate))
    angles = 2 * np.pi * np.arange(8) / 8
    along = np.array(centres) @ np.array([np.sin(angles), np.cos(angles)])
    assert any(along[sides == 0, i].max() <= along[sides == 1, i].min() + 1e-6 for i in range(8))


@given(places, st.sampled_from([0.0, 30.0, 150.0]), st.integers(0, 9))
def test_what_is_learnt_keeps_its_distance(places, gap, seed):
    found = split([piece(*place) for place in places], 0.3, gap, seed)
    judged = [one.bounds for one in found.validate]
    for one in found.train:
        grid = one.tile.grid
        cells = found.learnt(grid, one.bounds)
        rows, cols = np.nonzero(cells)
        for west, south, east, north in judged:
            x, y = grid.eastings[cols], grid.northings[rows]
            beside = np.maximum(np.maximum(west - x, x - east), np.maximum(south - y, y - north))
            assert not cells.any() or beside.min() >= gap


def test_both_sides_have_labels_of_both_kinds():
    road = {(0, 0), (3, 0)}
    pieces = [piece(col, 0, road=10 if (col, 0) in road else 0) for col in range(4)]
    for seed in range(6):
        found = split(pieces, 0.25, 0.0, seed)
        assert found.validate[0].tile.id in {"0_0", "3_0"}
    with pytest.raises(ConfigError, match="1 of them with road; label more tiles"):
        split([piece(col, 0, road=10 * (col == 2)) for col in range(4)], 0.25, 0.0, 0)


def test_a_single_tile_is_parted_along_its_longer_side():
    grid = Grid("EPSG:25832", 0.0, 100.0, 1.0, 50, 100)
    learn, judge = split_tile(grid.bounds, 0.3)
    assert (inside(grid, learn).sum(), inside(grid, judge).sum()) == (3500, 1500)
    assert not (inside(grid, learn) & inside(grid, judge)).any()
