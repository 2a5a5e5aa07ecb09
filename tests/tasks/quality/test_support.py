"""Support of the surface and validity of the DTM under a road, on synthetic data with known result."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.catalog.grid import Grid
from flexroad.tasks.quality.support import Support, of_faces, support
from flexroad.tasks.roads.dtm_validity import REACH_M, extrapolated_plane, invalid_dtm, without_invalid_dtm
from flexroad.tasks.types import Mesh, RoadClusters, RoadMask, TileData

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 60, 50)
ROW, COL = np.indices(GRID.shape)
NOWHERE = np.zeros(GRID.shape, bool)
STREET = np.abs(ROW - 25) < 5
RAMP = 100 + 0.08 * COL - 0.03 * ROW


def tile(dsm=RAMP, dtm=RAMP) -> TileData:
    return TileData("made", GRID, GRID, dsm.copy(), dtm.copy())


def street(mask=STREET, outside=NOWHERE) -> RoadMask:
    return RoadMask(GRID, GRID, mask, outside)


def kept(mask, dtm_invalid=None) -> RoadClusters:
    return RoadClusters(GRID, mask.astype(np.int32), dtm_invalid)


def test_support_equals_source_used_by_fit():
    crown = STREET & (COL > 20) & (COL < 30)
    house, hole, sea = ROW < 8, (ROW > 40) & (COL < 10), COL > 55
    data = tile()
    data.dsm[crown | house] += 6
    data.dtm[hole] = np.nan
    data.dsm[:, 12], data.dtm[:, 13] = np.nan, np.nan
    result = support(data, street(outside=sea), kept(STREET & ~crown))
    truth = np.full(GRID.shape, Support.MEASURED)
    truth[crown | house] = Support.DTM
    truth[hole] = Support.INFERRED
    # A kept cell without DSM has no height in the fit; any other cell without DSM has the DTM's.
    truth[:, 12] = np.where(STREET[:, 12], Support.INFERRED, truth[:, 12])
    truth[~STREET & ~hole & (COL == 12)] = Support.DTM
    truth[:, 13] = np.where(STREET[:, 13], Support.MEASURED, Support.INFERRED)
    truth[sea] = Support.NONE
    np.testing.assert_array_equal(result, truth)


def test_support_invalid_dtm_is_inferred():
    crown = STREET & (COL > 20) & (COL < 30)
    data, clusters = tile(dsm=RAMP + 6 * crown), kept(STREET & ~crown, crown)
    assert (support(data, street(), clusters)[crown] == Support.INFERRED).all()
    np.testing.assert_array_equal(np.isnan(without_invalid_dtm(data, clusters).dtm), crown)
    assert without_invalid_dtm(data, kept(STREET)) is data


def test_of_faces_uses_cell_under_centroid():
    classes = np.where(COL < 30, Support.MEASURED, Support.DTM).astype(np.uint8)
    west, east = [(28.5, 10, 0), (29.5, 10, 0), (28.5, 12, 0)], [(30.5, 10, 0), (33, 10, 0), (30.5, 12, 0)]
    vertices = np.array(west + east, float)
    mesh = Mesh(
        GRID.crs, (*GRID.origin, 0.0), vertices, np.arange(6, dtype=np.int32).reshape(2, 3), np.ones(2, bool)
    )
    np.testing.assert_array_equal(of_faces(classes, street(), mesh), [Support.MEASURED, Support.DTM])


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-500, 5000))
def test_extrapolated_plane_reproduces_plane(by_row, by_col, level):
    plane = level + by_row * ROW + by_col * COL
    ground = STREET & ((COL < 22) | (COL > 30))
    extrapolated, scatter = extrapolated_plane(np.where(ground, plane, 1e4), ground, 1.0)
    determined = np.isfinite(extrapolated)
    np.testing.assert_allclose(extrapolated[determined], plane[determined], atol=1e-5)
    assert scatter[determined].max() < 1e-3


def test_extrapolated_plane_cells_on_line_is_nan():
    extrapolated, _ = extrapolated_plane(RAMP, ROW == 25, 1.0)
    assert np.isnan(extrapolated).all()
    extrapolated, _ = extrapolated_plane(RAMP, (ROW == 25) | (ROW == 26), 1.0)
    np.testing.assert_allclose(extrapolated[30], RAMP[30], atol=1e-6)


def test_extrapolated_plane_equals_weighted_fit():
    rng = np.random.default_rng(1)
    heights, ground = rng.normal(0, 1, GRID.shape), rng.random(GRID.shape) < 0.3
    extrapolated, _ = extrapolated_plane(heights, ground, 1.0)
    r, c = 20, 31
    near = ground & (np.abs(ROW - r) <= 15) & (np.abs(COL - c) <= 15)
    x = np.column_stack([np.ones(near.sum()), ROW[near] - r, COL[near] - c])
    root = np.exp(-0.25 * (x[:, 1] ** 2 + x[:, 2] ** 2) / 25)
    oracle = np.linalg.lstsq(x * root[:, None], heights[near] * root, rcond=None)[0][0]
    assert extrapolated[r, c] == pytest.approx(oracle, abs=1e-9)


@pytest.mark.parametrize(("offset", "valid"), [(0.0, True), (0.2, True), (1.5, False), (-1.5, False)])
def test_invalid_dtm_gap_is_compared_with_road_beside(offset, valid):
    gap = STREET & (COL > 25) & (COL < 35)
    rng = np.random.default_rng(0)
    data = tile(dsm=RAMP + 0.05 * rng.standard_normal(GRID.shape), dtm=RAMP + offset * gap)
    invalid = invalid_dtm(data, street(), STREET & ~gap)
    assert not invalid[~gap].any()
    assert invalid[gap].mean() == (0 if valid else 1)


def test_invalid_dtm_far_from_visible_road_is_valid():
    visible = STREET & (COL < 10)
    invalid = invalid_dtm(tile(dtm=RAMP + 9.0), street(), visible)
    assert invalid[STREET & (COL > 10) & (COL < 20)].all()
    assert not invalid[COL >= 9 + REACH_M + 1].any()
    assert not invalid_dtm(tile(dtm=RAMP + 9.0), street(), NOWHERE).any()


def test_invalid_dtm_under_crown_on_bridge():
    deck, crown = STREET & (COL > 10) & (COL < 50), STREET & (COL > 27) & (COL < 34)
    invalid = invalid_dtm(tile(dsm=RAMP + 5 * deck), street(deck), deck & ~crown)
    np.testing.assert_array_equal(invalid, crown)
