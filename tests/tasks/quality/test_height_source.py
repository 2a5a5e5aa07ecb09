"""Height source of the surface and validity of the DTM under a road, on synthetic data with known result."""

from dataclasses import replace

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.quality.height_source import HeightSource, height_source, of_faces
from flexroad.tasks.roads.dtm_validity import (
    NEAR_M,
    REACH_M,
    extrapolated_plane,
    invalid_dtm,
    valid_dtm,
)
from flexroad.tasks.types import Mesh, Quality, RoadMask
from tests.builders import make_clusters, make_grid, make_mask, make_tile
from tests.crossing import SOUTH, WEST, Crossing

FIGURES = [name for name, kind in Quality.__annotations__.items() if kind == "float"]
GRID = make_grid(60, 50)
ROW, COL = np.indices(GRID.shape)
NOWHERE = np.zeros(GRID.shape, bool)
STREET = np.abs(ROW - 25) < 5
RAMP = 100 + 0.08 * COL - 0.03 * ROW


def test_height_source_equals_source_used_by_fit():
    crown = STREET & (COL > 20) & (COL < 30)
    house, hole, sea = ROW < 8, (ROW > 40) & (COL < 10), COL > 55
    data = make_tile(RAMP)
    data.dsm[crown | house] += 6
    data.dtm[hole] = np.nan
    data.dsm[:, 12], data.dtm[:, 13] = np.nan, np.nan
    result = height_source(data, make_mask(STREET, outside=sea), make_clusters(STREET & ~crown))
    truth = np.full(GRID.shape, HeightSource.MEASURED)
    truth[crown | house] = HeightSource.DTM
    truth[hole] = HeightSource.INFERRED
    # A kept cell without DSM has no height in the fit; any other cell without DSM has the DTM's.
    truth[:, 12] = np.where(STREET[:, 12], HeightSource.INFERRED, truth[:, 12])
    truth[~STREET & ~hole & (COL == 12)] = HeightSource.DTM
    truth[:, 13] = np.where(STREET[:, 13], HeightSource.MEASURED, HeightSource.INFERRED)
    truth[sea] = HeightSource.NONE
    np.testing.assert_array_equal(result, truth)


def test_height_source_invalid_dtm_is_inferred():
    crown = STREET & (COL > 20) & (COL < 30)
    data, clusters = make_tile(RAMP + 6 * crown, RAMP), make_clusters(STREET & ~crown, dtm_invalid=crown)
    assert (height_source(data, make_mask(STREET), clusters)[crown] == HeightSource.INFERRED).all()
    np.testing.assert_array_equal(np.isnan(valid_dtm(data, clusters)), crown)
    assert valid_dtm(data, make_clusters(STREET)).base is data.dtm


def test_of_faces_uses_cell_under_centroid():
    classes = np.where(COL < 30, HeightSource.MEASURED, HeightSource.DTM).astype(np.uint8)
    west, east = [(28.5, 10, 0), (29.5, 10, 0), (28.5, 12, 0)], [(30.5, 10, 0), (33, 10, 0), (30.5, 12, 0)]
    vertices = np.array(west + east, float)
    faces = np.arange(6, dtype=np.int32).reshape(2, 3)
    mesh = Mesh(GRID.crs, (*GRID.origin, 0.0), vertices, faces, np.ones(2, bool))
    found = of_faces(classes, make_mask(STREET), mesh, ())
    assert found.tolist() == [HeightSource.MEASURED, HeightSource.DTM]
    beyond = np.where(COL < 30, HeightSource.MEASURED, HeightSource.NONE).astype(np.uint8)
    found = of_faces(beyond, make_mask(STREET), mesh, ())
    assert found.tolist() == [HeightSource.MEASURED, HeightSource.INFERRED]


def plane_field(heights, ground):
    """Return height, scatter and distance of the extrapolated plane at all cells of 1 m."""
    fields = extrapolated_plane(heights, ground, np.ones(GRID.shape, bool), 1.0)
    return [field.reshape(GRID.shape) for field in fields]


def test_extrapolated_plane_cells_on_line_is_nan():
    extrapolated, _, _ = plane_field(RAMP, ROW == 25)
    assert np.isnan(extrapolated).all()
    extrapolated, _, _ = plane_field(RAMP, (ROW == 25) | (ROW == 26))
    np.testing.assert_allclose(extrapolated[30], RAMP[30], atol=1e-6)


def test_extrapolated_plane_far_from_given_cells_is_nan():
    extrapolated, scatter, away = plane_field(RAMP, (ROW > 45) & (COL < 5))
    nowhere = (ROW < 46 - REACH_M) | (COL > 4 + REACH_M)
    assert np.isnan(extrapolated[nowhere]).all()
    assert np.isnan(scatter[nowhere]).all()
    np.testing.assert_array_equal(np.isinf(away), nowhere)


@pytest.mark.parametrize("cell", [0.7, 1.0, 2.0])
def test_extrapolated_plane_equals_weighted_fit(cell):
    rng = np.random.default_rng(1)
    heights, ground = rng.normal(300, 1, GRID.shape), rng.random(GRID.shape) < 0.3
    wanted = rng.random(GRID.shape) < 0.05
    fits = [weighted_fit(heights, ground, r, c, cell) for r, c in np.argwhere(wanted)]
    np.testing.assert_allclose(
        np.transpose(extrapolated_plane(heights, ground, wanted, cell)), fits, rtol=0, atol=1e-9
    )


def weighted_fit(heights, ground, r, c, cell):
    """Return height, scatter and distance to the nearest cell of the plane at a cell, by least squares."""
    south, east = (ROW - r) * cell, (COL - c) * cell
    near = ground & (np.abs(south) <= REACH_M) & (np.abs(east) <= REACH_M)
    design = np.column_stack([np.ones(near.sum()), south[near], east[near]])
    weight = np.exp(-0.5 * (south[near] ** 2 + east[near] ** 2) / NEAR_M**2)
    root = np.sqrt(weight)
    plane = np.linalg.lstsq(design * root[:, None], heights[near] * root, rcond=None)[0]
    scatter = np.sqrt(np.average((heights[near] - design @ plane) ** 2, weights=weight))
    return plane[0], scatter, np.hypot(south, east)[near].min()


@pytest.mark.parametrize(("offset", "valid"), [(0.0, True), (0.2, True), (1.5, False), (-1.5, False)])
def test_invalid_dtm_gap_is_compared_with_road_beside(offset, valid):
    gap = STREET & (COL > 25) & (COL < 35)
    rng = np.random.default_rng(0)
    data = make_tile(RAMP + 0.05 * rng.standard_normal(GRID.shape), RAMP + offset * gap)
    invalid = invalid_dtm(data, make_mask(STREET), STREET & ~gap)
    assert not invalid[~gap].any()
    assert invalid[gap].mean() == (0 if valid else 1)


def test_invalid_dtm_far_from_visible_road_is_valid():
    visible = STREET & (COL < 10)
    invalid = invalid_dtm(make_tile(RAMP, RAMP + 9.0), make_mask(STREET), visible)
    assert invalid[STREET & (COL > 10) & (COL < 20)].all()
    assert not invalid[COL >= 9 + REACH_M + 1].any()
    assert not invalid_dtm(make_tile(RAMP, RAMP + 9.0), make_mask(STREET), NOWHERE).any()


def test_invalid_dtm_under_crown_on_bridge():
    deck, crown = STREET & (COL > 10) & (COL < 50), STREET & (COL > 27) & (COL < 34)
    invalid = invalid_dtm(make_tile(RAMP + 5 * deck, RAMP), make_mask(deck), deck & ~crown)
    np.testing.assert_array_equal(invalid, crown)


def test_of_faces_of_a_deck_uses_its_own_classes():
    mesh, _ = Crossing((40.0, 30.0)).mesh()
    grid = Grid(GRID.crs, WEST, SOUTH + 60, 1.0, 60, 60)
    road = RoadMask(grid, grid, np.zeros(grid.shape, bool), np.zeros(grid.shape, bool))
    ground, deck = (
        np.full(grid.shape, kind, np.uint8) for kind in (HeightSource.INFERRED, HeightSource.MEASURED)
    )
    quality = Quality(
        **dict.fromkeys(FIGURES, 0.0), flags=(), height_source=deck, flagged=np.zeros_like(deck, np.uint16)
    )
    kinds = of_faces(ground, road, mesh, ((1, quality),))
    np.testing.assert_array_equal(kinds == HeightSource.MEASURED, mesh.level == 1)
    assert quality.at(1) is quality
    assert replace(quality, levels=((2, quality),)).at(2) is quality
