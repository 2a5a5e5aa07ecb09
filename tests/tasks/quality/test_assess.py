"""A surface with made faults tells of them; one without tells of none."""

from dataclasses import fields, replace

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.fit import nurbs, plane
from flexroad.tasks.quality.assess import NO_ROAD, Options, assess
from flexroad.tasks.quality.support import Support
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
FLOATS = [field.name for field in fields(Quality) if field.name not in ("flags", "support")]


class Shape:
    """A surface that is what it is told."""

    bounds = GRID.hull

    def __init__(self, height):
        self.heights = height

    def lattice(self, eastings, northings):
        return self.heights


def tile(dsm=None, dtm=None) -> TileData:
    return TileData("made", GRID, GRID, TRUTH + NOISE if dsm is None else dsm, TRUTH if dtm is None else dtm)


def told(data, surface, road=STREET, kept=None, dtm_invalid=None) -> Quality:
    clusters = RoadClusters(GRID, (road if kept is None else kept).astype(np.int32), dtm_invalid)
    if surface is None:
        surface = nurbs.fit(data, clusters, FIT)
    return assess(data, RoadMask(GRID, GRID, road, NOWHERE), clusters, surface, Options())


def test_a_good_surface_raises_no_flag():
    found = told(tile(), None)
    assert found.flags == ()
    assert found.error_estimate_m < 0.06
    assert found.residual_nmad_m == pytest.approx(0.05, abs=0.02)
    assert (found.measured_road, found.inferred_road, found.dropped_road) == (1, 0, 0)


def test_figures_are_those_of_a_surface_known_by_hand():
    step = np.where(STREET, 0.1, 0.4)
    found = told(tile(dsm=TRUTH, dtm=TRUTH - 1), Shape(TRUTH + step))
    assert found.residual_median_m == pytest.approx(0.1)
    assert found.residual_nmad_m == pytest.approx(0, abs=1e-12)
    assert found.residual_p95_m == pytest.approx(0.1)
    assert found.edge_step_m == pytest.approx(0.3, abs=0.01)
    assert found.off_dtm_m == pytest.approx(1.1)
    assert found.off_dtm_road == 1
    # The scan is the nearer witness, and even.
    assert found.error_estimate_m == pytest.approx(0.1)
    assert found.curvature_per_m == pytest.approx(0, abs=0.01)


def test_a_pole_is_a_spike():
    pole = TRUTH.copy()
    pole[52, 60] += 2
    found = told(tile(), Shape(pole))
    assert found.flags == ("spike",)
    assert found.curvature_per_m == pytest.approx(4, abs=0.02)


def test_a_hump_in_one_place_is_a_patch():
    hump = STREET & (np.hypot(ROW - 55, COL - 60) < 6)
    found = told(tile(), Shape(TRUTH + 0.8 * hump))
    assert "patch" in found.flags
    assert found.suspect_m2 == hump.sum()


def test_curvature_does_not_depend_on_the_size_of_cells():
    fine = Grid(GRID.crs, GRID.west, GRID.north, 0.5, 120, 100)
    bowl = 0.05 * ((COL * 0.5) ** 2 + (ROW * 0.5) ** 2)
    mask = np.ones(GRID.shape, bool)
    found = assess(
        TileData("made", fine, fine, bowl, bowl), RoadMask(fine, fine, mask, NOWHERE),
        RoadClusters(fine, mask.astype(np.int32)), Shape(bowl), Options(),
    )  # fmt: skip
    assert found.curvature_per_m == pytest.approx(0.1)


def test_a_filter_that_climbs_a_crown_is_doubted():
    data = tile(dsm=TRUTH + NOISE + np.where(CROWN, DOME, 0))
    climbed, clean = told(data, None), told(data, None, kept=STREET & ~CROWN)
    assert {"error-estimate", "patch", "loose", "off-dtm"} <= set(climbed.flags)
    assert climbed.suspect_m2 == pytest.approx(CROWN.sum(), rel=0.5)
    assert clean.flags == ()
    assert clean.dtm_road == pytest.approx(CROWN.sum() / STREET.sum())


def test_a_bridge_deck_is_not_doubted():
    deck = STREET & (COL > 40) & (COL < 90)
    found = told(tile(dsm=TRUTH + 6 * deck + NOISE), Shape(TRUTH + 6 * deck))
    assert "off-dtm" in found.flags
    # But for its ends, where the scan is not even.
    assert found.error_estimate_m < 0.3


def test_missing_road_data_is_inferred():
    gap = STREET & (COL > 40) & (COL < 80)
    found = told(
        tile(dsm=np.where(gap, np.nan, TRUTH), dtm=np.where(gap, np.nan, TRUTH)), None, kept=STREET & ~gap
    )
    assert {"inferred", "error-estimate"} <= set(found.flags)
    assert found.inferred_road == pytest.approx(gap.sum() / STREET.sum())
    np.testing.assert_array_equal(found.support == Support.INFERRED, gap)
    assert told(tile(), None, kept=STREET & (COL < 40)).flags == ("dropped",)


def test_doubt_grows_with_what_is_inferred():
    data = tile(dsm=np.where(CROWN, TRUTH + DOME, TRUTH + NOISE))
    believed = told(data, None, kept=STREET & ~CROWN)
    inferred = told(data, None, kept=STREET & ~CROWN, dtm_invalid=CROWN)
    assert inferred.error_estimate_m > believed.error_estimate_m + 0.3 * CROWN.sum() / STREET.sum() - 0.01


def test_weights_at_a_bound_are_counted():
    surface = nurbs.fit(tile(), RoadClusters(GRID, STREET.astype(np.int32)), FIT)
    assert told(tile(), surface).bounded_weights == 0
    weights = np.ones_like(surface.W)
    weights[:8], weights[0, 0] = 10, 0.1
    found: NurbsSurface = replace(surface, A=surface.A * weights, W=weights)
    assert told(tile(), found).bounded_weights == pytest.approx(0.5)
    assert "weights" in told(tile(), found).flags


def test_other_surfaces_tell_what_they_can():
    flat = plane.fit(tile(), RoadClusters(GRID, STREET.astype(np.int32)), plane.Options())
    found = told(tile(), flat)
    assert np.isnan(found.bounded_weights)
    assert "error-estimate" in found.flags
    assert np.isfinite([getattr(found, name) for name in FLOATS if name != "bounded_weights"]).all()


def test_nothing_to_tell_of_is_no_fault():
    empty = told(tile(), Shape(TRUTH), road=NOWHERE)
    assert empty.flags == (NO_ROAD,)
    assert np.isnan([getattr(empty, name) for name in FLOATS if name != "suspect_m2"]).all()
    unknown = np.full(GRID.shape, np.nan)
    blind = told(tile(unknown, unknown), Shape(TRUTH), kept=NOWHERE)
    assert {"inferred", "error-estimate", "dropped"} <= set(blind.flags)
    assert told(tile(), Shape(unknown)).error_estimate_m != 0


def test_neither_truth_nor_the_land_around_matters():
    data = tile()
    found = told(data, None)
    again = told(replace(data, reference=TRUTH + 9, reference_road=~STREET), None)
    assert [getattr(found, n) for n in FLOATS if n != "bounded_weights"] == [
        getattr(again, n) for n in FLOATS if n != "bounded_weights"
    ]
