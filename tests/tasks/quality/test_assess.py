"""Surfaces with deliberate faults raise their flags; surfaces without faults raise none."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from flexroad.tasks.fit import nurbs, plane, smoothing_spline
from flexroad.tasks.quality.assess import NO_ROAD, Options, assess
from flexroad.tasks.quality.estimate import DSM_DTM_TOLERANCE_M, FACTOR, LEAST_M, error_estimate
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Quality
from tests.builders import given_heights, make_clusters, make_grid, make_mask, make_tile

GRID = make_grid(120, 100)
ROW, COL = np.indices(GRID.shape)
NOWHERE = np.zeros(GRID.shape, bool)
STREET = np.abs(ROW - 50 - 8 * np.sin(COL / 30)) < 6
TRUTH = 150 + 0.06 * COL + 1.5 * np.sin(COL / 25) * np.cos(ROW / 30)
NOISE = 0.05 * np.random.default_rng(4).standard_normal(GRID.shape)
CROWN = STREET & (np.hypot(ROW - 55, COL - 60) < 9)
DOME = 5 + np.random.default_rng(5).uniform(-2, 2, GRID.shape)
TILE = make_tile(TRUTH + NOISE, TRUTH)
FIT = nurbs.Options(control_points=(18, 16), weights="unit")
OTHERS = ("flags", "flagged", "height_source", "levels", "structures", "bounded_weights")
FLOATS = [field.name for field in fields(Quality) if not field.name.startswith(("holdout", *OTHERS))]


def assessed(data, surface, road=STREET, kept=None, dtm_invalid=None) -> Quality:
    clusters = make_clusters(road if kept is None else kept, dtm_invalid=dtm_invalid)
    if surface is None:
        surface = nurbs.fit(data, clusters, FIT)
    elif isinstance(surface, np.ndarray):
        surface = given_heights(surface, GRID)
    return assess(data, make_mask(road), clusters, surface, Options())


def test_assess_good_surface_raises_no_flag():
    quality = assessed(TILE, None)
    assert quality.flags == ()
    assert quality.error_estimate_m < 0.06
    assert quality.residual_nmad_m == pytest.approx(0.05, abs=0.02)
    assert (quality.measured_road, quality.inferred_road, quality.dropped_road) == (1, 0, 0)


def test_assess_figures_equal_hand_computed_values():
    step = np.where(STREET, 0.1, 0.4)
    quality = assessed(make_tile(TRUTH, TRUTH - 1), TRUTH + step)
    assert quality.residual_median_m == pytest.approx(0.1)
    assert quality.residual_nmad_m == pytest.approx(0, abs=1e-12)
    assert quality.residual_p95_m == pytest.approx(0.1)
    assert quality.edge_step_m == pytest.approx(0.3, abs=0.01)
    assert quality.off_dtm_m == pytest.approx(1.1)
    assert quality.off_dtm_road == 1
    # The street was fitted to the DSM.
    assert quality.error_estimate_m == pytest.approx(LEAST_M + 0.1 * FACTOR)
    assert quality.curvature_per_m == pytest.approx(0, abs=0.01)


def test_assess_pole_raises_spike():
    pole = TRUTH.copy()
    pole[52, 60] += 2
    quality = assessed(TILE, pole)
    assert quality.flags == ("spike",)
    assert quality.curvature_per_m == pytest.approx(4, abs=0.02)


def test_assess_local_hump_raises_patch():
    hump = STREET & (np.hypot(ROW - 55, COL - 60) < 6)
    quality = assessed(TILE, TRUTH + 0.8 * hump)
    assert "patch" in quality.flags
    assert quality.max_unexplained_area_m2 == hump.sum()


def test_assess_curvature_is_independent_of_cell_size():
    bowl = 0.05 * ((COL * 0.5) ** 2 + (ROW * 0.5) ** 2)
    mask, surface = np.ones(GRID.shape, bool), given_heights(bowl, GRID)
    inputs = make_tile(bowl, cell=0.5), make_mask(mask, 0.5), make_clusters(mask, 0.5), surface
    quality = assess(*inputs, Options())
    assert quality.curvature_per_m == pytest.approx(0.1)


def test_assess_kept_crown_raises_flags():
    data = make_tile(TRUTH + NOISE + np.where(CROWN, DOME, 0), TRUTH)
    climbed, clean = assessed(data, None), assessed(data, None, kept=STREET & ~CROWN)
    assert {"error-estimate", "patch", "loose", "off-dtm"} <= set(climbed.flags)
    assert climbed.max_unexplained_area_m2 == pytest.approx(CROWN.sum(), rel=0.5)
    assert clean.flags == ()
    assert clean.dtm_road == pytest.approx(CROWN.sum() / STREET.sum())


def test_assess_bridge_deck_has_small_error_estimate():
    deck = STREET & (COL > 40) & (COL < 90)
    quality = assessed(make_tile(TRUTH + 6 * deck + NOISE, TRUTH), TRUTH + 6 * deck)
    assert "off-dtm" in quality.flags
    # Not 0, because the DSM has scatter at the ends of the deck.
    assert quality.error_estimate_m < 0.3


def test_assess_missing_road_data_is_inferred():
    gap = STREET & (COL > 40) & (COL < 80)
    quality = assessed(make_tile(np.where(gap, np.nan, TRUTH)), None, kept=STREET & ~gap)
    assert {"inferred", "error-estimate"} <= set(quality.flags)
    assert quality.inferred_road == pytest.approx(gap.sum() / STREET.sum())
    np.testing.assert_array_equal(quality.height_source == HeightSource.INFERRED, gap)
    assert assessed(TILE, None, kept=STREET & (COL < 40)).flags == ("dropped",)


def test_assess_error_estimate_grows_with_inferred_cells():
    data = make_tile(np.where(CROWN, TRUTH + DOME, TRUTH + NOISE), TRUTH)
    valid = assessed(data, None, kept=STREET & ~CROWN)
    inferred = assessed(data, None, kept=STREET & ~CROWN, dtm_invalid=CROWN)
    away = distance_transform_edt(CROWN | ~STREET)[CROWN]
    rise = (away**2 / 200).sum() / STREET.sum()
    assert inferred.error_estimate_m == pytest.approx(valid.error_estimate_m + rise, abs=0.01)


def test_assess_weights_at_bound_are_counted():
    surface = nurbs.fit(TILE, make_clusters(STREET), FIT)
    assert assessed(TILE, surface).bounded_weights == 0
    weights = np.ones_like(surface.W)
    weights[:8], weights[0, 0] = 10, 0.1
    bounded: NurbsSurface = replace(surface, A=surface.A * weights, W=weights)
    assert assessed(TILE, bounded).bounded_weights == pytest.approx(0.5)
    assert "weights" in assessed(TILE, bounded).flags


def test_assess_plane_has_all_figures_but_weights():
    flat = plane.fit(TILE, make_clusters(STREET), plane.Options())
    quality = assessed(TILE, flat)
    assert np.isnan(quality.bounded_weights)
    assert "error-estimate" in quality.flags
    assert np.isfinite([getattr(quality, name) for name in FLOATS]).all()


def test_assess_without_road_or_data():
    no_road = assessed(TILE, TRUTH, road=NOWHERE)
    assert no_road.flags == (NO_ROAD,)
    assert np.isnan([getattr(no_road, name) for name in FLOATS]).all()
    no_heights = np.full(GRID.shape, np.nan)
    no_data = assessed(make_tile(no_heights), TRUTH, kept=NOWHERE)
    assert {NO_ROAD, "inferred", "error-estimate", "dropped"} <= set(no_data.flags)
    assert assessed(TILE, no_heights).error_estimate_m != 0
    dropped = assessed(TILE, None, kept=NOWHERE)
    assert dropped.flags == (NO_ROAD, "dropped")
    assert (dropped.dropped_road, dropped.max_unexplained_area_m2) == (1, 0)


def test_assess_steps_beside_road_are_supported_and_no_steps_of_surface():
    verge = distance_transform_edt(~STREET) <= 4
    wall = np.where(STREET, 0, 2.0)
    beside = verge & ~STREET
    data = make_tile(TRUTH + wall + NOISE, TRUTH + wall)
    clusters = make_clusters(STREET, dtm_invalid=beside, beside=beside)
    surfaces = [
        smoothing_spline.fit(data, clusters, smoothing_spline.Options(steps=steps)) for steps in (False, True)
    ]
    road = make_mask(STREET)
    smooth, stepped = (assess(data, road, clusters, surface, Options()) for surface in surfaces)
    assert (smooth.height_source[beside] == HeightSource.INFERRED).all()
    assert (stepped.height_source[beside] != HeightSource.INFERRED).all()
    assert stepped.edge_step_m == smooth.edge_step_m
    np.testing.assert_array_equal(stepped.height_source[STREET], smooth.height_source[STREET])


def test_assess_ignores_reference():
    quality = assessed(TILE, None)
    with_reference = assessed(replace(TILE, reference=TRUTH + 9, reference_road=~STREET), None)
    assert [getattr(quality, n) for n in FLOATS if n != "bounded_weights"] == [
        getattr(with_reference, n) for n in FLOATS if n != "bounded_weights"
    ]


SHAPE = (60, 60)
EVERYWHERE = np.ones(SHAPE, bool)
NOTHING = np.zeros(SHAPE)


def estimate(residual, road=EVERYWHERE, cell=1.0):
    return error_estimate(residual, NOTHING, NOTHING, road & np.isfinite(residual), road, cell)


@pytest.mark.parametrize("offset", [0.0, 0.05, -0.2])
def test_constant_residual_is_misfit(offset):
    np.testing.assert_allclose(estimate(np.full(SHAPE, offset)), LEAST_M + FACTOR * abs(offset), atol=1e-12)


def test_noise_of_cells_averages_out():
    noise = 0.05 * np.random.default_rng(0).standard_normal(SHAPE)
    assert estimate(noise).mean() < LEAST_M + 0.3 * FACTOR * 0.05


def test_single_cells_far_off_count_as_heights_of_the_same_ground_at_most():
    far = np.random.default_rng(1).random(SHAPE) < 0.1
    found = estimate(np.where(far, 4.0, 0.0)).mean()
    assert found == pytest.approx(LEAST_M + 0.1 * FACTOR * DSM_DTM_TOLERANCE_M, rel=0.1)
    assert found == pytest.approx(estimate(np.where(far, 40.0, 0.0)).mean())


def test_patch_far_off_is_estimated_larger_than_single_cells():
    patch = np.zeros(SHAPE)
    patch[20:40, 20:40] = 4.0
    assert estimate(patch)[28:32, 28:32].min() == pytest.approx(LEAST_M + FACTOR * DSM_DTM_TOLERANCE_M)


def test_cells_without_height_rise_with_distance_to_the_nearest():
    residual = np.zeros(SHAPE)
    residual[:, 30:] = np.nan
    found = estimate(residual)
    assert found[:, :30] == pytest.approx(LEAST_M)
    assert (np.diff(found[30, 30:]) > 0).all()


def test_tile_without_heights_has_the_difference_of_heights_of_the_same_ground():
    assert (estimate(np.full(SHAPE, np.nan)) == DSM_DTM_TOLERANCE_M).all()
