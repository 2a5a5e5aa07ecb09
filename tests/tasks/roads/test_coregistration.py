from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from flexroad.catalog import Grid
from flexroad.tasks.roads.coregistration import note, pair, shift
from flexroad.tasks.types import Orthophoto, TileData
from flexroad.tools.synthetic import block, make_scene
from flexroad.tools.synthetic.orthophoto import SUN_AZIMUTH_DEG, SUN_HEIGHT_DEG, orthophoto

GSD = 0.5


@lru_cache
def scene(seed=3):
    grid = block(1, 160)[0][1]
    layers = make_scene(grid, seed, "urban").layers
    data = TileData("t", grid, grid, layers["dsm"].astype(float), layers["dtm"].astype(float))
    colour = orthophoto(grid, seed, "urban", gsd=GSD)
    fine = Grid.covering(grid.crs, grid.bounds, GSD)
    return data, Orthophoto(fine, colour, np.ones(fine.shape, bool))


def moved(photo: Orthophoto, east_m: float, north_m: float) -> Orthophoto:
    """Return the photo shifted by whole pixels; pixels without content become unknown."""
    grid = photo.grid
    col, row = round(east_m / grid.cell), round(-north_m / grid.cell)
    known = np.roll(photo.known, (row, col), (0, 1))
    known[: max(row, 0)] = known[grid.height + min(row, 0) :] = False
    known[:, : max(col, 0)] = known[:, grid.width + min(col, 0) :] = False
    return Orthophoto(grid, np.roll(photo.colour, (row, col), (1, 2)) * known, known)


@pytest.mark.parametrize(
    ("seed", "by", "to_m"),
    [(3, (0.0, 0.0), 0.2), (3, (2.0, -1.0), 0.2), (4, (2.0, -1.5), 0.5), (4, (-3.5, 4.0), 0.5)],
)
def test_shift_and_sun_are_recovered(seed, by, to_m):
    data, photo = scene(seed)
    result = shift([pair(data, moved(photo, *by))])
    assert (result.east_m, result.north_m) == pytest.approx(by, abs=to_m)
    assert result.sun == pytest.approx((SUN_AZIMUTH_DEG, SUN_HEIGHT_DEG), abs=5)
    assert result.confidence > 0.3


def test_note_only_for_shifted_photo():
    data, photo = scene()
    assert note(data, photo) is None
    assert note(data, moved(photo, 2.0, 0.0)).startswith("dop: seems to lie 2.0 m east")


def test_note_photo_without_content_is_none():
    data, photo = scene()
    blank = replace(photo, colour=np.full_like(photo.colour, 90))
    assert note(data, blank) is None
    assert note(data, replace(photo, known=np.zeros_like(photo.known))) is None
    random = np.random.default_rng(0).integers(0, 255, photo.colour.shape, np.uint8)
    assert note(data, replace(photo, colour=random)) is None


def test_shift_ignores_voids_and_missing_photo():
    data, photo = scene()
    dsm, known = data.dsm.copy(), photo.known.copy()
    dsm[60:90, 20:50] = np.nan
    known[:, :60] = False
    result = shift([pair(replace(data, dsm=dsm), moved(replace(photo, known=known), 2.0, -1.5))])
    assert (result.east_m, result.north_m) == pytest.approx((2.0, -1.5), abs=0.5)


def test_shift_of_two_unshifted_tiles_is_small():
    pairs = [pair(*scene(seed)) for seed in (3, 4)]
    assert shift(pairs).length_m < 0.3
