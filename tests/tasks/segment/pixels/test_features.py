import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from flexroad.catalog import Grid
from flexroad.tasks.segment.pixels.features import CUT, REACH_M, features, mean
from flexroad.tasks.types import Orthophoto, TileData

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 60, 50)
rng = np.random.default_rng(0)


def tile(dsm, dtm, grid=GRID, core=GRID) -> TileData:
    return TileData("a", grid, core, dsm, dtm)


def photo(grid=GRID, colour=None, known=None) -> Orthophoto:
    fine = Grid(grid.crs, grid.west, grid.north, grid.cell / 2, 2 * grid.width, 2 * grid.height)
    colour = rng.integers(0, 256, (3, *fine.shape)).astype(np.uint8) if colour is None else colour
    return Orthophoto(fine, colour, np.ones(fine.shape, bool) if known is None else known)


def named(data, seen=None):
    found = features(data, seen)
    return dict(zip(found.names, found.values, strict=True))


def test_a_mean_weighs_known_cells_alone():
    layer = rng.normal(size=GRID.shape).astype(np.float32)
    layer[10:20, 30:45] = np.nan
    known = np.isfinite(layer)
    blur = {"sigma": 3.0, "truncate": CUT, "mode": "constant"}
    want = gaussian_filter(np.where(known, layer, 0).astype(float), **blur) / gaussian_filter(
        known * 1.0, **blur
    )
    np.testing.assert_allclose(mean(layer, 3.0), want, atol=1e-5)
    assert np.isnan(mean(np.full((5, 5), np.nan, np.float32), 1.0)).all()


def test_a_slope_is_sloped_and_not_rough():
    east, north = np.meshgrid(GRID.eastings - GRID.west, GRID.northings - GRID.south)
    plane = 150 + 0.3 * east - 0.4 * north
    found = named(tile(plane + 2, plane))
    middle = np.s_[22:28, 28:32]
    for name in ("dsm", "dtm"):
        np.testing.assert_allclose(found[f"{name}, slope 3 m"][middle], 0.5, atol=1e-3)
        np.testing.assert_allclose(found[f"{name}, roughness 1 m"][middle], 0, atol=1e-3)
    np.testing.assert_allclose(found["above"], 2, atol=1e-4)
    np.testing.assert_allclose(found["share above 0.4 m, 3 m"], 1, atol=1e-5)
    np.testing.assert_allclose(found["share above 2.5 m, 3 m"], 0, atol=1e-5)


def test_roughness_is_the_spread_of_noise():
    flat = np.full(GRID.shape, 150.0)
    found = named(tile(flat + rng.normal(0, 0.2, GRID.shape), flat))
    assert found["dsm, roughness 3 m"].mean() == pytest.approx(0.2, rel=0.1)
    np.testing.assert_array_equal(found["dtm, roughness 3 m"], 0)


def test_colours_are_those_of_the_four_pixels_of_a_cell():
    flat = np.zeros(GRID.shape)
    colour = np.zeros((3, 100, 120), np.uint8)
    colour[0, ::2], colour[1], colour[2] = 100, 200, 100
    known = np.ones((100, 120), bool)
    known[:2, :2] = False
    found = named(tile(flat, flat), photo(colour=colour, known=known))
    assert np.isnan(found["red"][0, 0])
    rest = np.s_[1:, 1:]
    np.testing.assert_allclose(found["red"][rest], 50)
    np.testing.assert_allclose(found["greenness"][rest], (400 - 150) / 351, rtol=1e-5)
    np.testing.assert_allclose(found["saturation"][rest], 1 - 50 / 201, rtol=1e-5)
    np.testing.assert_allclose(found["grain"][rest], 50 / 3, rtol=1e-3)
    assert np.isfinite(found["light, mean 3 m"]).all()


def test_without_a_photo_the_heights_are_the_same():
    dsm, dtm = rng.normal(150, 1, (2, *GRID.shape))
    alone, both = named(tile(dsm, dtm)), named(tile(dsm, dtm), photo())
    assert set(alone) < set(both)
    for name, layer in alone.items():
        np.testing.assert_array_equal(layer, both[name])


def test_a_halo_makes_features_independent_of_the_tile():
    halo = int(np.ceil(REACH_M))
    wide = GRID.buffered(halo + 30)
    ground = gaussian_filter(rng.normal(size=wide.shape), 5) * 20 + 150
    dsm = ground + rng.exponential(0.3, wide.shape)
    dsm[:, 70:74] = np.nan
    seen = photo(wide)
    near = GRID.buffered(halo)
    here = wide.window(near)
    fine = seen.grid.window(Grid(near.crs, near.west, near.north, 0.5, 2 * near.width, 2 * near.height))
    small = features(tile(dsm[here], ground[here], near), photo(near, seen.colour[:, *fine])).values
    large = features(tile(dsm, ground, wide), seen).values[:, *here]
    core = near.window(GRID)
    np.testing.assert_allclose(small[:, *core], large[:, *core], rtol=1e-3, atol=1e-3)
    assert not np.allclose(small[:, :5, :5], large[:, :5, :5], rtol=1e-3, atol=1e-3, equal_nan=True)
