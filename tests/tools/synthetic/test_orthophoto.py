from functools import lru_cache

import numpy as np
import pytest
import rasterio
from scipy import ndimage

from flexroad.catalog import Catalog, Grid
from flexroad.tasks import TaskError
from flexroad.tools.synthetic import Kind, SceneOptions, block, make_scene
from flexroad.tools.synthetic.orthophoto import (
    MARGIN_M,
    SUN_AZIMUTH_DEG,
    SUN_HEIGHT_DEG,
    UNIFORM,
    _shadow,
    orthophoto,
)
from flexroad.tools.synthetic.scenes import write_scenes

SIZE_M = 120
GSD = 0.5
USUAL = SceneOptions()
OPEN = SceneOptions(density=0, stream_share=0)
"""Streets without objects on them or shadows."""


def tile(size_m: int = SIZE_M) -> Grid:
    return block(1, size_m)[0][1]


@lru_cache
def photo(seed: int = 3, stratum: str = "urban", options: SceneOptions = USUAL) -> np.ndarray:
    return orthophoto(tile(), seed, stratum, options, GSD).astype(float)


@lru_cache
def fine_scene(seed: int = 3, stratum: str = "urban", options: SceneOptions = USUAL):
    grid = tile()
    return make_scene(Grid.covering(grid.crs, grid.bounds, GSD), seed, stratum, options)


def test_orthophoto_has_size_of_gsd_and_is_repeatable():
    grid = tile(60)
    image = orthophoto(grid, 3, "urban")
    assert (image.shape, image.dtype) == ((3, 120, 120), np.uint8)
    assert np.array_equal(image, orthophoto(grid, 3, "urban"))
    assert not np.array_equal(image, orthophoto(grid, 4, "urban"))
    assert orthophoto(grid, 3, "urban", gsd=0.2).shape == (3, 300, 300)


@pytest.mark.parametrize("stratum", ["urban", "suburban", "rural"])
def test_orthophoto_colours_match_classes_of_scene(stratum):
    """Roads are grey and plants green, in light and shadow."""
    red, green, blue = photo(3, stratum, OPEN)
    scene = fine_scene(3, stratum, OPEN)
    distance = ndimage.distance_transform_edt(~scene.reference_road) * GSD
    road, land = ndimage.binary_erosion(scene.reference_road, iterations=2), distance > 6
    assert road.mean() > 0.03
    grey = np.ptp(np.stack([red, green, blue]), axis=0) < 16
    assert grey[road].mean() > 0.95
    assert grey[land].mean() < 0.4
    assert 85 < np.median(green[road]) < 125
    crowns = ndimage.binary_erosion(fine_scene(3, stratum).kind == Kind.CROWN, iterations=2)
    red, green, blue = photo(3, stratum)
    assert crowns.any()
    assert ((green > red) & (green > blue))[crowns].mean() > 0.95


def test_orthophoto_houses_and_cars_differ_in_colour():
    scene, image = fine_scene(), photo()
    for kind in (Kind.BUILDING, Kind.PARKED_CAR):
        objects, count = ndimage.label(ndimage.binary_erosion(scene.kind == kind))
        numbers = range(1, count + 1)
        reds = ndimage.mean(image[0] / image.sum(axis=0), objects, numbers)
        assert count > 5
        assert np.ptp(reds) > 0.1


def test_every_kind_has_a_colour():
    own_colours = {Kind.BUILDING, Kind.PARKED_CAR, Kind.MOVING_CAR, Kind.CROWN}
    never_shown = {Kind.GROUND, Kind.MIXED}
    assert set(UNIFORM) | own_colours | never_shown == set(Kind)


def test_orthophoto_lines_run_along_middle_of_roads():
    scene, image = fine_scene(options=OPEN), photo(options=OPEN)
    painted = image.min(axis=0) > 130
    inside = ndimage.distance_transform_edt(scene.reference_road) * GSD
    widest = ndimage.maximum_filter(inside, size=round(2 * 8 / GSD) + 1)
    middle = (inside > 0.93 * widest) & (inside > 2.5)
    beside = (inside > 1) & (inside < 0.5 * widest)
    # Dashes are as long as gaps; crossings have no lines.
    assert 0.15 < painted[middle].mean() < 0.5
    assert beside.sum() > 1000
    assert painted[beside].mean() < 0.005


def test_orthophoto_of_neighbouring_tiles_joins():
    """An image of both tiles equals the images of each, except for sensor noise."""
    west = tile(60)
    east = Grid(west.crs, west.east, west.north, 1.0, 60, 60)
    both = orthophoto(Grid(west.crs, west.west, west.north, 1.0, 120, 60), 3, "urban", OPEN).astype(float)
    halves = np.concatenate([orthophoto(grid, 3, "urban", OPEN) for grid in (west, east)], axis=2)
    differs = np.abs(both - halves).max(axis=0) > 25
    assert differs.mean() < 0.002
    assert differs[:, 118:122].mean() < 0.02


def test_shadow_of_tower_matches_sun_height_and_azimuth():
    cell, height = 0.5, 10.0
    dsm = np.zeros((240, 240))
    dsm[118:122, 118:122] = height
    row, col = np.nonzero(_shadow(dsm, cell))
    reach = np.hypot(row - 119.5, col - 119.5).max() * cell
    assert reach == pytest.approx(height / np.tan(np.radians(SUN_HEIGHT_DEG)), abs=2.5)
    assert reach < MARGIN_M
    # The sun is in the south-east, so shadows fall to the north-west.
    direction = np.degrees(np.arctan2(119.5 - row.mean(), 119.5 - col.mean()))
    assert direction == pytest.approx(SUN_AZIMUTH_DEG - 90, abs=3)


@pytest.mark.parametrize("gsd", [0.7, 0.0, -1.0, float("nan")])
def test_orthophoto_gsd_not_dividing_tile_raises(gsd):
    with pytest.raises(
        TaskError, match=r"a GSD of .* m does not divide the tile .*use one that does, like 0.5"
    ):
        orthophoto(tile(60), 0, gsd=gsd)


def test_write_scenes_dop_writes_orthophotos(tmp_path):
    path = write_scenes(tmp_path / "survey", 2, seed=3, size_m=60, dop=True)
    tiles = Catalog.read(path).tiles
    for written in tiles:
        with rasterio.open(written.paths(written.layer("dop"))[0]) as src:
            assert (src.shape, src.count, src.res, tuple(src.bounds)) == (
                (120, 120), 3, (0.5, 0.5), written.grid.bounds,
            )  # fmt: skip
            assert np.array_equal(src.read(), orthophoto(written.grid, 3))
    plain = Catalog.read(write_scenes(tmp_path / "plain", 1, seed=3, size_m=60)).tiles
    assert plain[0].layer("dop") is None
