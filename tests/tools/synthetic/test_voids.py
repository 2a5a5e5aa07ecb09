"""Voids of the DSM lie beside crowns, away from the middle of an image, and on water."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, label

from flexroad.catalog import Grid
from flexroad.tools.synthetic import Kind, Scene, SceneOptions, block, make_scene
from flexroad.tools.synthetic.network import Plan
from flexroad.tools.synthetic.objects import Crown, from_middle
from flexroad.tools.synthetic.orthophoto import orthophoto
from flexroad.tools.synthetic.spoilers import Canvas
from flexroad.tools.synthetic.survey_errors import hidden

GRID = block(1)[0][1]
WET = {"stream_share": 1.0, "density": 0.0}
WOODED = {"stream_share": 0.0, "trees": 3.0, "built": 0.0}


def made(options: dict[str, float], voids: float = 0.4, grid: Grid = GRID) -> Scene:
    return make_scene(grid, 2, "rural", SceneOptions(**options, voids=voids))


@pytest.mark.parametrize("options", [WET, WOODED])
def test_voids_change_no_height_and_no_other_layer(options):
    without, scene = made(options, 0.0), made(options)
    void = np.isnan(scene.dsm)
    assert 0.01 < void.mean() < 0.3
    assert np.array_equal(scene.dsm[~void], without.dsm[~void])
    for name in ("dtm", "road_mask", "reference", "extended_dtm", "reference_road", "kind"):
        assert np.array_equal(getattr(scene, name), getattr(without, name)), name
    assert np.array_equal(made(options).dsm, scene.dsm, equal_nan=True)


def test_streams_have_no_heights_but_bridges_over_them_do():
    scene = made(WET)
    void = np.isnan(scene.dsm)
    assert not void[scene.kind == Kind.DECK].any()
    assert (scene.kind == Kind.DECK).any()
    # Deep in its bed the stream has its full depth below the land: all of the lowest ground is water.
    depth = scene.reference - np.median(scene.reference)
    assert depth[void].mean() < depth[~void].mean() - 2


def test_hidden_ground_touches_crowns_and_is_longer_with_a_larger_angle():
    short, long = (np.isnan(made(WOODED, voids).dsm) for voids in (0.2, 0.4))
    crowns = binary_dilation(made(WOODED, 0.0).kind == Kind.CROWN, iterations=3)
    patches, number = label(long, np.ones((3, 3)))
    # A few crowns stand beyond the tile, so that only their hidden ground is on it.
    touching = {*np.unique(patches[crowns]).tolist()} - {0}
    assert len(touching) > 0.9 * number
    assert (long | ~short).all()
    assert long.mean() > 1.3 * short.mean()


def test_crown_hides_the_ground_away_from_the_middle_of_the_image():
    canvas = Canvas.of(GRID, Plan(2, 100.0, 0.0, "rural", 0.0))
    x, y = (float(axis[125, 125]) for axis in (canvas.x, canvas.y))
    crown = Crown(x, y, 3.0, 110.0, 10.0, hides=False)
    ground = np.full(GRID.shape, 100.0)
    void = hidden(canvas, ground, [crown], 2, 0.4)
    away = from_middle(2, np.array([x]), np.array([y]))[:, 0]
    offset = np.array([(canvas.x[void] - x).mean(), (canvas.y[void] - y).mean()])
    assert offset @ away > 0.95 * np.hypot(*offset) * np.hypot(*away)
    assert np.hypot(canvas.x[void] - x, canvas.y[void] - y).min() > crown.radius
    # A roof behind the crown that is as high as the crown is seen.
    assert not hidden(canvas, ground + 9, [crown], 2, 0.4).any()


def test_neighbouring_tiles_have_the_same_voids():
    both = made(WOODED, grid=Grid(GRID.crs, GRID.west, GRID.north, 1.0, 500, 250))
    parts = [made(WOODED, grid=tile) for _, tile in block(2)[:2]]
    joined = np.isnan(np.hstack([part.dsm for part in parts]))
    assert np.mean(joined != np.isnan(both.dsm)) < 0.002


def test_photo_has_no_voids():
    grid = Grid(GRID.crs, GRID.west, GRID.north, 1.0, 60, 60)
    photos = [orthophoto(grid, 2, "rural", SceneOptions(**WOODED, voids=voids)) for voids in (0.0, 0.4)]
    assert np.array_equal(*photos)
