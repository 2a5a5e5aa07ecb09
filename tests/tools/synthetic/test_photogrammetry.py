"""The stand-in for DSC3D: its meshes represent the scene with the configured faults."""

import numpy as np
import pytest
from scipy import ndimage

from flexroad.catalog.grid import Grid
from flexroad.tools.prepare.mesh.sample import orthophoto as mesh_orthophoto
from flexroad.tools.prepare.mesh.sample import project_down
from flexroad.tools.synthetic import Kind, make_scene
from flexroad.tools.synthetic.dsc3d import (
    BUMPS_M,
    FRAGMENTS,
    GSD_M,
    MELT_M,
    SITES,
    SIZE_M,
    photogrammetry,
    survey,
)
from flexroad.tools.synthetic.orthophoto import orthophoto

SEED = 3


@pytest.fixture(scope="module")
def place():
    return survey(len(SITES), SEED)[-1]


@pytest.fixture(scope="module")
def scene(place):
    return photogrammetry(place, SEED)


@pytest.fixture(scope="module")
def height(scene):
    """Height of the mesh at the nodes it was made from; NaN in open holes."""
    return project_down(scene.mesh, scene.surface.grid)[0]


def test_survey_scenes_have_rise_of_site():
    places = survey(seed=1)
    for place in places:
        truth = make_scene(place.grid, 1, place.site.stratum, place.options)
        assert np.ptp(truth.reference) == pytest.approx(place.site.rise_m, rel=0.05)
        assert 0.1 < truth.reference_road.mean() < 0.4
    assert survey(2, 1) == places[:2]


@pytest.mark.slow
def test_mesh_fills_square_with_requested_triangles(scene, place):
    assert scene.mesh.bounds == pytest.approx(place.grid.bounds, abs=1e-6)
    assert place.grid.bounds[2] - place.grid.bounds[0] == SIZE_M
    assert 0.99 * place.site.triangles < len(scene.mesh.faces) <= place.site.triangles


@pytest.mark.slow
def test_mesh_away_from_faults_is_surface_plus_bumps(scene, place, height):
    surface, made = scene.surface.dsm, scene.reconstruction
    far = round(4 * MELT_M / scene.surface.grid.cell)
    free = ndimage.maximum_filter(surface - scene.surface.reference, 2 * far + 1) < 0.05
    intact = free & ~ndimage.binary_dilation(made.open | made.bridged, iterations=far)
    error = (height - surface)[intact & np.isfinite(height)]
    assert error.size > 5_000
    # The best 90%: a few fragments float above.
    kept = np.sort(np.abs(error))[: int(0.9 * error.size)]
    assert 0.3 * BUMPS_M < np.sqrt(np.mean(kept**2)) < 1.2 * BUMPS_M
    assert abs(np.median(error)) < 0.02
    # Bumps are longer than a cell, unlike noise.
    bumps = np.where(intact, made.height - surface, 0.0)
    both = intact[:, 1:] & intact[:, :-1]
    assert np.corrcoef(bumps[:, 1:][both], bumps[:, :-1][both])[0, 1] > 0.6


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Kind.BUILDING, Kind.PARKED_CAR, Kind.CROWN])
def test_mesh_objects_keep_height_and_lose_steep_walls(scene, height, kind):
    truth, cell = scene.surface, scene.surface.grid.cell
    cells = (truth.kind == kind) & np.isfinite(height)
    raised = (height - truth.reference)[cells]
    assert cells.sum() > 200
    assert np.median(raised) > 0.4 * np.median((truth.dsm - truth.reference)[cells])
    # Walls become slopes: the steepest cells are far less steep.
    before = np.hypot(*np.gradient(truth.dsm, cell))
    after = np.hypot(*np.gradient(scene.reconstruction.height, cell))
    around = ndimage.binary_dilation(cells, iterations=2) & ~scene.reconstruction.bridged
    walls = around & (before > np.percentile(before[around], 90))
    assert np.median(after[walls]) < 0.8 * np.median(before[walls])


@pytest.mark.slow
def test_reconstruct_moving_cars_lose_height(scene):
    truth, made = scene.surface, scene.reconstruction.height
    moved = truth.kind == Kind.MOVING_CAR
    assert moved.any()
    assert np.mean((made - truth.reference)[moved]) < 0.5 * np.mean((truth.dsm - truth.reference)[moved])


@pytest.mark.slow
def test_reconstruct_holes_are_open_or_bridged(scene, height):
    made = scene.reconstruction
    assert 0.001 < made.open.mean() < 0.1
    assert 0.005 < made.bridged.mean() < 0.15
    assert not (made.open & made.bridged).any()
    inside = ndimage.binary_erosion(made.open, iterations=2)
    assert np.isnan(height[inside]).mean() > 0.95
    assert np.isfinite(height[made.bridged]).mean() > 0.95
    # The outermost nodes lie on the mesh's edge.
    inner = np.s_[1:-1, 1:-1]
    closed = ~ndimage.binary_dilation(made.open, iterations=2)[inner]
    assert np.isfinite(height[inner][closed]).all()
    # The surface in a hole stays between the heights of its rim.
    neighbours = np.ones((3, 3))
    holes, count = ndimage.label(made.bridged, neighbours)
    for hole in range(1, count + 1):
        rim = ndimage.binary_dilation(holes == hole, neighbours) & ~made.bridged
        z, low, high = made.height[holes == hole], made.height[rim].min(), made.height[rim].max()
        assert low - 0.01 <= z.min() <= z.max() <= high + 0.01


@pytest.mark.slow
def test_mesh_fragments_float_above_surface(scene, place):
    pieces = FRAGMENTS
    count = 8 * pieces
    floating = scene.mesh.vertices[-count:].reshape(pieces, 8, 3)
    cells = scene.surface.grid.cells(floating[:, 0, 0], floating[:, 0, 1])
    assert (floating[:, 0, 2] > scene.reconstruction.height[cells] + 1.9).all()


@pytest.mark.slow
def test_texture_has_right_orientation(scene, place):
    photo = mesh_orthophoto(scene.mesh, Grid.covering(place.grid.crs, place.grid.bounds, GSD_M))
    expected = orthophoto(place.grid, SEED, place.site.stratum, place.options, GSD_M).astype(float)
    correlations = [
        np.corrcoef(photo.colour[:, photo.known].ravel(), turned[:, photo.known].ravel())[0, 1]
        for turned in (expected, expected[:, ::-1], expected[:, :, ::-1], expected.transpose(0, 2, 1))
    ]
    assert correlations[0] > 0.95
    assert max(correlations[1:]) < 0.7


@pytest.mark.slow
def test_photogrammetry_equal_seeds_give_equal_scenes(scene, place):
    again = photogrammetry(place, SEED)
    for name in ("vertices", "faces", "uv"):
        assert np.array_equal(getattr(again.mesh, name), getattr(scene.mesh, name)), name
    assert np.array_equal(again.mesh.textures[0], scene.mesh.textures[0])
    assert np.array_equal(again.truth.reference, scene.truth.reference)
    assert survey(1, SEED + 1)[0].options != survey(1, SEED)[0].options
