"""Surfaces with deliberate faults raise their flags; surfaces without faults raise none."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from flexroad.catalog.grid import Grid
from flexroad.tasks.fit import nurbs, plane, smoothing_spline
from flexroad.tasks.quality.assess import NO_ROAD, Options, assess
from flexroad.tasks.quality.estimate import FACTOR, LEAST_M
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Quality, RoadClusters, RoadMask, TileData

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 120, 100)
ROW, COL = np.indices(GRID.shape)
NOWHERE = np.zeros(GRID.shape, bool)
STREET = np.abs(ROW - 50 - 8 * np.sin(COL / 30)) < 6
TRUTH = 150 + 0.06 * COL + 1.5 * np.sin(COL / 25) * np.cos(ROW / 30)
NOISE = 0.05 * np.random.default_rng(4).standard_normal(GRID.shape)
CROWN = STREET & (np.hypot(ROW - 55, COL - 60) < 9)
DOME = 5 + np.random.default_rng(5).uniform(-2, 2, GRID.shape)
FIT = nurbs.Options(control_points=(18, 16), weights="unit")
OTHERS = ("flags", "flagged", "height_source", "levels", "structures", "bounded_weights")
FLOATS = [field.name for field in fields(Quality) if not field.name.startswith(("holdout", *OTHERS))]


class GivenHeights:
    """A surface with given heights."""

    bounds = GRID.hull

    def __init__(self, height):
        self.heights = height

    def lattice(self, eastings, northings):
        return self.heights


def tile(dsm=None, dtm=None) -> TileData:
    return TileData("made", GRID, GRID, TRUTH + NOISE if dsm is None else dsm, TRUTH if dtm is None else dtm)


def assessed(data, surface, road=STREET, kept=None, dtm_invalid=None) -> Quality:
    clusters = RoadClusters(GRID, (road if kept is None else kept).astype(np.int32), dtm_invalid)
    if surface is None:
        surface = nurbs.fit(data, clusters, FIT)
    return assess(data, RoadMask(GRID, GRID, road, NOWHERE), clusters, surface, Options())


def test_assess_good_surface_raises_no_flag():
    quality = assessed(tile(), None)
    assert quality.flags == ()
    assert quality.error_estimate_m < 0.06
    assert quality.residual_nmad_m == pytest.approx(0.05, abs=0.02)
    assert (quality.measured_road, quality.inferred_road, quality.dropped_road) == (1, 0, 0)


def test_assess_figures_equal_hand_computed_values():
    step = np.where(STREET, 0.1, 0.4)
    quality = assessed(tile(dsm=TRUTH, dtm=TRUTH - 1), GivenHeights(TRUTH + step))
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
    quality = assessed(tile(), GivenHeights(pole))
    assert quality.flags == ("spike",)
    assert quality.curvature_per_m == pytest.approx(4, abs=0.02)


def test_assess_local_hump_raises_patch():
    hump = STREET & (np.hypot(ROW - 55, COL - 60) < 6)
    quality = assessed(tile(), GivenHeights(TRUTH + 0.8 * hump))
    assert "patch" in quality.flags
    assert quality.max_unexplained_area_m2 == hump.sum()


def test_assess_curvature_is_independent_of_cell_size():
    fine = Grid(GRID.crs, GRID.west, GRID.north, 0.5, 120, 100)
    bowl = 0.05 * ((COL * 0.5) ** 2 + (ROW * 0.5) ** 2)
    mask = np.ones(GRID.shape, bool)
    quality = assess(
        TileData("made", fine, fine, bowl, bowl), RoadMask(fine, fine, mask, NOWHERE),
        RoadClusters(fine, mask.astype(np.int32)), GivenHeights(bowl), Options(),
    )  # fmt: skip
    assert quality.curvature_per_m == pytest.approx(0.1)


def test_assess_kept_crown_raises_flags():
    data = tile(dsm=TRUTH + NOISE + np.where(CROWN, DOME, 0))
    climbed, clean = assessed(data, None), assessed(data, None, kept=STREET & ~CROWN)
    assert {"error-estimate", "patch", "loose", "off-dtm"} <= set(climbed.flags)
    assert climbed.max_unexplained_area_m2 == pytest.approx(CROWN.sum(), rel=0.5)
    assert clean.flags == ()
    assert clean.dtm_road == pytest.approx(CROWN.sum() / STREET.sum())


def test_assess_bridge_deck_has_small_error_estimate():
    deck = STREET & (COL > 40) & (COL < 90)
    quality = assessed(tile(dsm=TRUTH + 6 * deck + NOISE), GivenHeights(TRUTH + 6 * deck))
    assert "off-dtm" in quality.flags
    # Not 0, because the DSM has scatter at the ends of the deck.
    assert quality.error_estimate_m < 0.3


def test_assess_missing_road_data_is_inferred():
    gap = STREET & (COL > 40) & (COL < 80)
    quality = assessed(
        tile(dsm=np.where(gap, np.nan, TRUTH), dtm=np.where(gap, np.nan, TRUTH)), None, kept=STREET & ~gap
    )
    assert {"inferred", "error-estimate"} <= set(quality.flags)
    assert quality.inferred_road == pytest.approx(gap.sum() / STREET.sum())
    np.testing.assert_array_equal(quality.height_source == HeightSource.INFERRED, gap)
    assert assessed(tile(), None, kept=STREET & (COL < 40)).flags == ("dropped",)


def test_assess_error_estimate_grows_with_inferred_cells():
    data = tile(dsm=np.where(CROWN, TRUTH + DOME, TRUTH + NOISE))
    valid = assessed(data, None, kept=STREET & ~CROWN)
    inferred = assessed(data, None, kept=STREET & ~CROWN, dtm_invalid=CROWN)
    away = distance_transform_edt(CROWN | ~STREET)[CROWN]
    rise = (away**2 / 200).sum() / STREET.sum()
    assert inferred.error_estimate_m == pytest.approx(valid.error_estimate_m + rise, abs=0.01)


def test_assess_weights_at_bound_are_counted():
    surface = nurbs.fit(tile(), RoadClusters(GRID, STREET.astype(np.int32)), FIT)
    assert assessed(tile(), surface).bounded_weights == 0
    weights = np.ones_like(surface.W)
    weights[:8], weights[0, 0] = 10, 0.1
    bounded: NurbsSurface = replace(surface, A=surface.A * weights, W=weights)
    assert assessed(tile(), bounded).bounded_weights == pytest.approx(0.5)
    assert "weights" in assessed(tile(), bounded).flags


def test_assess_plane_has_all_figures_but_weights():
    flat = plane.fit(tile(), RoadClusters(GRID, STREET.astype(np.int32)), plane.Options())
    quality = assessed(tile(), flat)
    assert np.isnan(quality.bounded_weights)
    assert "error-estimate" in quality.flags
    assert np.isfinite([getattr(quality, name) for name in FLOATS]).all()


def test_assess_without_road_or_data():
    no_road = assessed(tile(), GivenHeights(TRUTH), road=NOWHERE)
    assert no_road.flags == (NO_ROAD,)
    assert np.isnan([getattr(no_road, name) for name in FLOATS]).all()
    no_heights = np.full(GRID.shape, np.nan)
    no_data = assessed(tile(no_heights, no_heights), GivenHeights(TRUTH), kept=NOWHERE)
    assert {NO_ROAD, "inferred", "error-estimate", "dropped"} <= set(no_data.flags)
    assert assessed(tile(), GivenHeights(no_heights)).error_estimate_m != 0


def test_assess_road_dropped_by_filter_has_figures_and_both_flags():
    dropped = assessed(tile(), None, kept=NOWHERE)
    assert dropped.flags == (NO_ROAD, "dropped")
    assert (dropped.dropped_road, dropped.max_unexplained_area_m2) == (1, 0)


def test_assess_steps_beside_road_are_supported_and_no_steps_of_surface():
    verge = distance_transform_edt(~STREET) <= 4
    wall = np.where(STREET, 0, 2.0)
    labels = STREET.astype(np.int32)
    data = tile(dsm=TRUTH + wall + NOISE, dtm=TRUTH + wall)
    clusters = RoadClusters(GRID, labels, verge & ~STREET, verge & ~STREET)
    surfaces = [
        smoothing_spline.fit(data, clusters, smoothing_spline.Options(steps=steps)) for steps in (False, True)
    ]
    road = RoadMask(GRID, GRID, STREET, NOWHERE)
    smooth, stepped = (assess(data, road, clusters, surface, Options()) for surface in surfaces)
    beside = verge & ~STREET
    assert (smooth.height_source[beside] == HeightSource.INFERRED).all()
    assert (stepped.height_source[beside] != HeightSource.INFERRED).all()
    assert stepped.edge_step_m == smooth.edge_step_m
    np.testing.assert_array_equal(stepped.height_source[STREET], smooth.height_source[STREET])


def test_assess_ignores_reference():
    data = tile()
    quality = assessed(data, None)
    with_reference = assessed(replace(data, reference=TRUTH + 9, reference_road=~STREET), None)
    assert [getattr(quality, n) for n in FLOATS if n != "bounded_weights"] == [
        getattr(with_reference, n) for n in FLOATS if n != "bounded_weights"
    ]
