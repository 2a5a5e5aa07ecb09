"""A DTM of another year than the DSM, and the paper's reference made from it."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, distance_transform_edt, label

from flexroad.catalog import Grid
from flexroad.tools.synthetic import Kind, Scene, SceneOptions, block, make_scene
from flexroad.tools.synthetic.network import Plan
from flexroad.tools.synthetic.objects import Crown, from_middle
from flexroad.tools.synthetic.orthophoto import orthophoto
from flexroad.tools.synthetic.spoilers import Canvas
from flexroad.tools.synthetic.survey_errors import BESIDE_M, RISE_M, TRENCH_M, hidden

GRID = block(1)[0][1]
SMALL = Grid(GRID.crs, GRID.west, GRID.north, 1.0, 60, 60)
INNER = np.s_[8:-8, 8:-8]


@lru_cache
def made(seed: int = 2, grid: Grid = GRID, **options: float) -> Scene:
    plain = {"dsm_noise_m": (0, 0), "dtm_noise_m": 0, "density": 0, "stream_share": 0.3}
    return make_scene(grid, seed, "urban", SceneOptions(**{**plain, **options}))


def test_works_change_dsm_and_truth_and_not_dtm():
    before, after = made(), made(works=2)
    rise = after.reference - before.reference
    assert np.array_equal(after.dtm, before.dtm)
    assert np.array_equal(after.dsm - before.dsm, rise)
    assert 0.01 < np.mean(rise != 0) < 0.3


def test_works_are_surfaces_kerbs_and_excavations_on_streets():
    before, after = made(), made(works=2)
    rise = after.reference - before.reference
    changed = rise != 0
    allowed = np.zeros_like(changed)
    for low, high in RISE_M.values():
        of_kind = (rise > low - 1e-9) & (rise < high + 1e-9)
        assert of_kind.any()
        allowed |= of_kind
    assert allowed[changed].all()
    away = distance_transform_edt(~before.reference_road)[INNER]
    assert away[changed[INNER]].max() < BESIDE_M + TRENCH_M[1] / 2 + 1.5
    assert not changed[before.kind == Kind.DECK].any()


def test_flight_offset_is_slow_and_in_dtm_only():
    one, other = made(), made(flight_offset_m=0.05)
    offset = other.dtm - one.dtm
    assert np.array_equal(one.dsm, other.dsm)
    assert np.array_equal(one.reference, other.reference)
    assert np.abs(np.diff(offset, axis=0)).max() < 0.002
    means = [
        np.mean(made(seed, SMALL, flight_offset_m=0.05).dtm - made(seed, SMALL).dtm) for seed in range(2, 14)
    ]
    assert np.sqrt(np.mean(np.square(means))) == pytest.approx(0.05, rel=0.5)


def test_extended_dtm_is_dtm_with_decks():
    scene = made(stream_share=1, flight_offset_m=0.05)
    deck = scene.kind == Kind.DECK
    assert deck.sum() > 100
    assert np.array_equal(scene.extended_dtm[~deck], scene.dtm[~deck])
    assert np.abs(scene.extended_dtm - scene.reference)[deck].max() < 0.2
    assert np.max((scene.extended_dtm - scene.dtm)[deck]) > 3


WET = {"stream_share": 1.0, "density": 0.0}
WOODED = {"stream_share": 0.0, "trees": 3.0, "built": 0.0}


def with_voids(options: dict[str, float], voids: float = 0.4, grid: Grid = GRID) -> Scene:
    return make_scene(grid, 2, "rural", SceneOptions(**options, voids=voids))


@pytest.mark.parametrize("options", [WET, WOODED])
def test_voids_change_no_height_and_no_other_layer(options):
    without, scene = with_voids(options, 0.0), with_voids(options)
    void = np.isnan(scene.dsm)
    assert 0.01 < void.mean() < 0.3
    assert np.array_equal(scene.dsm[~void], without.dsm[~void])
    for name in ("dtm", "road_mask", "reference", "extended_dtm", "reference_road", "kind"):
        assert np.array_equal(getattr(scene, name), getattr(without, name)), name
    assert np.array_equal(with_voids(options).dsm, scene.dsm, equal_nan=True)


def test_streams_have_no_heights_but_bridges_over_them_do():
    scene = with_voids(WET)
    void = np.isnan(scene.dsm)
    assert not void[scene.kind == Kind.DECK].any()
    assert (scene.kind == Kind.DECK).any()
    # Deep in its bed the stream has its full depth below the land: all of the lowest ground is water.
    depth = scene.reference - np.median(scene.reference)
    assert depth[void].mean() < depth[~void].mean() - 2


def test_hidden_ground_touches_crowns_and_is_longer_with_a_larger_angle():
    short, long = (np.isnan(with_voids(WOODED, voids).dsm) for voids in (0.2, 0.4))
    crowns = binary_dilation(with_voids(WOODED, 0.0).kind == Kind.CROWN, iterations=3)
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
    both = with_voids(WOODED, grid=Grid(GRID.crs, GRID.west, GRID.north, 1.0, 500, 250))
    parts = [with_voids(WOODED, grid=tile) for _, tile in block(2)]
    joined = np.isnan(np.hstack([part.dsm for part in parts]))
    assert np.mean(joined != np.isnan(both.dsm)) < 0.002


def test_photo_has_no_voids():
    photos = [orthophoto(SMALL, 2, "rural", SceneOptions(**WOODED, voids=voids)) for voids in (0.0, 0.4)]
    assert np.array_equal(*photos)
