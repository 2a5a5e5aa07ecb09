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


def by_name(data, image=None):
    result = features(data, image)
    return dict(zip(result.names, result.values, strict=True))


def test_mean_uses_valid_cells_only():
    layer = rng.normal(size=GRID.shape).astype(np.float32)
    layer[10:20, 30:45] = np.nan
    known = np.isfinite(layer)
    blur = {"sigma": 3.0, "truncate": CUT, "mode": "constant"}
    expected = gaussian_filter(np.where(known, layer, 0).astype(float), **blur) / gaussian_filter(
        known * 1.0, **blur
    )
    np.testing.assert_allclose(mean(layer, 3.0), expected, atol=1e-5)
    assert np.isnan(mean(np.full((5, 5), np.nan, np.float32), 1.0)).all()


def test_features_plane_has_slope_and_no_roughness():
    east, north = np.meshgrid(GRID.eastings - GRID.west, GRID.northings - GRID.south)
    plane = 150 + 0.3 * east - 0.4 * north
    result = by_name(tile(plane + 2, plane))
    middle = np.s_[22:28, 28:32]
    for name in ("dsm", "dtm"):
        np.testing.assert_allclose(result[f"{name}, slope 3 m"][middle], 0.5, atol=1e-3)
        np.testing.assert_allclose(result[f"{name}, roughness 1 m"][middle], 0, atol=1e-3)
    np.testing.assert_allclose(result["above"], 2, atol=1e-4)
    np.testing.assert_allclose(result["share above 0.4 m, 3 m"], 1, atol=1e-5)
    np.testing.assert_allclose(result["share above 2.5 m, 3 m"], 0, atol=1e-5)


def test_features_noise_roughness_is_its_deviation():
    flat = np.full(GRID.shape, 150.0)
    result = by_name(tile(flat + rng.normal(0, 0.2, GRID.shape), flat))
    assert result["dsm, roughness 3 m"].mean() == pytest.approx(0.2, rel=0.1)
    np.testing.assert_array_equal(result["dtm, roughness 3 m"], 0)


def test_features_colours_are_means_of_four_pixels():
    flat = np.zeros(GRID.shape)
    colour = np.zeros((3, 100, 120), np.uint8)
    colour[0, ::2], colour[1], colour[2] = 100, 200, 100
    known = np.ones((100, 120), bool)
    known[:2, :2] = False
    result = by_name(tile(flat, flat), photo(colour=colour, known=known))
    assert np.isnan(result["red"][0, 0])
    rest = np.s_[1:, 1:]
    np.testing.assert_allclose(result["red"][rest], 50)
    np.testing.assert_allclose(result["greenness"][rest], (400 - 150) / 351, rtol=1e-5)
    np.testing.assert_allclose(result["saturation"][rest], 1 - 50 / 201, rtol=1e-5)
    np.testing.assert_allclose(result["grain"][rest], 50 / 3, rtol=1e-3)
    assert np.isfinite(result["light, mean 3 m"]).all()


def test_features_of_heights_do_not_depend_on_photo():
    dsm, dtm = rng.normal(150, 1, (2, *GRID.shape))
    heights, both = by_name(tile(dsm, dtm)), by_name(tile(dsm, dtm), photo())
    assert set(heights) < set(both)
    for name, layer in heights.items():
        np.testing.assert_array_equal(layer, both[name])


def test_features_with_halo_do_not_depend_on_tile():
    halo = int(np.ceil(REACH_M))
    wide = GRID.buffered(halo + 30)
    ground = gaussian_filter(rng.normal(size=wide.shape), 5) * 20 + 150
    dsm = ground + rng.exponential(0.3, wide.shape)
    dsm[:, 70:74] = np.nan
    image = photo(wide)
    near = GRID.buffered(halo)
    here = wide.window(near)
    fine = image.grid.window(Grid(near.crs, near.west, near.north, 0.5, 2 * near.width, 2 * near.height))
    small = features(tile(dsm[here], ground[here], near), photo(near, image.colour[:, *fine])).values
    large = features(tile(dsm, ground, wide), image).values[:, *here]
    core = near.window(GRID)
    np.testing.assert_allclose(small[:, *core], large[:, *core], rtol=1e-3, atol=1e-3)
    assert not np.allclose(small[:, :5, :5], large[:, :5, :5], rtol=1e-3, atol=1e-3, equal_nan=True)
