"""The batched fit in torch against the fit of one tile after the other, within 1 mm."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.spline import batch
from flexroad.tasks.spline.batch import Engine
from flexroad.tasks.spline.frame import Corner, Edge, Frame
from flexroad.tasks.spline.surface import basis_matrix
from flexroad.tasks.spline.torch_normal import bases_of, multiply, refinement
from flexroad.tasks.synthetic import make_scene
from flexroad.tasks.types import RoadClusters, TileData

torch = pytest.importorskip("torch")

TILE = Grid("EPSG:25832", 500000, 5600500, 1.0, 100, 130)
OPTIONS = smoothing_spline.Options()
MOST_MM = 1.0
ROUNDING_MM = 0.01
"""Some processors sum a matrix product in another order for another batch, or for another tile of the batch.
Control points that few cells hold turn that into 0.04 mm, the heights of cells into less than 0.001 mm."""
LOST = np.hypot(*(np.indices(TILE.shape) - np.array([60, 50])[:, None, None])) < 30


@cache
def made(stratum="urban", seed=3, void=None, road=True):
    """Return the arguments of a fit, without a frame."""
    scene = make_scene(TILE, seed, stratum)
    lost = {"hole": LOST, "south": np.indices(TILE.shape)[0] > 80}.get(void, np.zeros(TILE.shape, bool))
    dsm, dtm = (np.where(lost, np.nan, heights) for heights in (scene.dsm, scene.dtm))
    mask = scene.road_mask if road else np.zeros(TILE.shape, bool)
    return TileData("made", TILE, TILE, dsm, dtm), RoadClusters(TILE, mask.astype(np.int32)), None


def framed(tile, p=3):
    """Return the tile with a frame whose control points are 0.1 m above those of its own fit."""
    data, clusters, _ = tile
    control, ends, nothing = smoothing_spline.fit(data, clusters, OPTIONS).A + 0.1, np.zeros((2, 2), bool), []

    def corner(rows, cols):
        return Corner(control[rows, cols], ends)

    def edge(rows, cols):
        return Edge(control[rows, cols], nothing, nothing, np.zeros((2, 0), bool), nothing)

    first, middle, last = slice(None, p), slice(p, -p), slice(-p, None)
    corners = [corner(rows, cols) for rows in (first, last) for cols in (first, last)]
    edges = [edge(first, middle), edge(last, middle), edge(middle, first), edge(middle, last)]
    return data, clusters, Frame(*corners, *edges)


def without_corner(tile):
    """Return the tile with a frame that has no ground at one corner."""
    data, clusters, frame = tile
    nothing = replace(frame.north_east, control=np.full((3, 3), np.nan))
    return data, clusters, replace(frame, north_east=nothing)


def off_mm(tiles, options=OPTIONS, engine=None):
    """Return the largest difference of the batch's surfaces from those of `fit`, at all cells (mm)."""
    east, north = TILE.eastings, TILE.northings
    surfaces = smoothing_spline.fit_batch(tiles, options, engine or Engine())
    return 1e3 * max(
        np.abs(
            surface.lattice(east, north)
            - smoothing_spline.fit(data, clusters, options, frame).lattice(east, north)
        ).max()
        for surface, (data, clusters, frame) in zip(surfaces, tiles, strict=True)
    )


def apart_mm(one, other):
    """Return the largest difference of two surfaces at all cells (mm)."""
    at = TILE.eastings, TILE.northings
    return 1e3 * np.abs(one.lattice(*at) - other.lattice(*at)).max()


def mixed():
    return [
        made(),
        framed(made("rural", 4)),
        made("suburban", 5, void="hole"),
        framed(made("urban", 6, void="south")),
        made("rural", 7, road=False),
        without_corner(framed(made("suburban", 8))),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_batch_of_mixed_tiles_equals_fit(precision):
    assert off_mm(mixed(), engine=Engine(precision=precision)) < MOST_MM


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"bending_m3": 1500.0},
        {"bending_terrain": 50.0},
        {"lambda_terrain": 0.01},
        {"degree": 2},
        {"spacing_m": 11.0},
        {"huber_m": 0.02},
    ],
    ids=str,
)
def test_batch_with_other_options_equals_fit(changes):
    assert off_mm([made(), made("rural", 4)], OPTIONS.model_copy(update=changes)) < MOST_MM


@pytest.mark.slow
def test_batch_of_whole_tile_equals_fit():
    """Of 250 m, with a part beside the road that the fit hardly holds."""
    grid = Grid(TILE.crs, TILE.west, TILE.north, 1.0, 250, 250)
    scene = make_scene(grid, 4, "suburban")
    data = TileData("made", grid, grid, scene.dsm, scene.dtm)
    clusters = RoadClusters(grid, scene.road_mask.astype(np.int32))
    (surface,) = smoothing_spline.fit_batch([(data, clusters, None)], OPTIONS, Engine())
    at = grid.eastings, grid.northings
    expected = smoothing_spline.fit(data, clusters, OPTIONS).lattice(*at)
    assert 1e3 * np.abs(surface.lattice(*at) - expected).max() < MOST_MM


@pytest.mark.slow
def test_fit_with_engine_torch_is_a_batch_of_one():
    data, clusters, frame = framed(made("rural", 4))
    torch_options = OPTIONS.model_copy(update={"engine": "torch"})
    (expected,) = smoothing_spline.fit_batch([(data, clusters, frame)], OPTIONS, Engine())
    assert np.array_equal(smoothing_spline.fit(data, clusters, torch_options, frame).A, expected.A)


def test_engine_torch_with_high_degree_is_an_error():
    with pytest.raises(ValueError, match="engine torch needs degree 3 or less, not 5; choose engine numba"):
        smoothing_spline.Options(engine="torch", degree=5)


@pytest.mark.slow
def test_l1_has_the_loss_of_fit():
    """L1 has no unique minimum, so surfaces can differ where the loss does not."""
    options = OPTIONS.model_copy(update={"huber_m": 0.0})
    data, clusters, _ = made()
    at = data.core.eastings, data.core.northings
    ground = np.where(clusters.mask, data.dsm, data.dtm)
    losses = [
        np.abs(surface.lattice(*at) - ground).mean()
        for surface in (
            smoothing_spline.fit(data, clusters, options),
            smoothing_spline.fit_batch([made()], options, Engine())[0],
        )
    ]
    assert losses[1] == pytest.approx(losses[0], rel=0.01)


def test_held_points_keep_their_heights_to_the_bit():
    data, clusters, frame = framed(made("rural", 4))
    surface = smoothing_spline.fit_batch([(data, clusters, frame)], OPTIONS, Engine())[0]
    held = frame.control(surface.A.shape)
    assert np.array_equal(surface.A[np.isfinite(held)], held[np.isfinite(held)])


@pytest.mark.slow
def test_tile_does_not_depend_on_its_company():
    """Hard tiles take more steps than easy ones; those have left the batch by then."""
    tiles = [made(), made("rural", 7, road=False), made("suburban", 5, void="hole")]
    together = smoothing_spline.fit_batch(tiles, OPTIONS, Engine())
    for tile, surface in zip(tiles, together, strict=True):
        (alone,) = smoothing_spline.fit_batch([tile], OPTIONS, Engine())
        assert apart_mm(alone, surface) < ROUNDING_MM


def test_tile_without_heights_does_not_fail_the_others():
    data, clusters, _ = made()
    empty = replace(data, dsm=np.full(TILE.shape, np.nan), dtm=np.full(TILE.shape, np.nan)), clusters, None
    failed, fitted = smoothing_spline.fit_batch([empty, made()], OPTIONS, Engine())
    assert isinstance(failed, TaskError)
    assert "0 cells with a height are fewer than" in str(failed)
    assert np.isfinite(fitted.A).all()


@pytest.mark.slow
def test_tiles_of_two_shapes_are_fitted_in_two_batches():
    small = Grid(TILE.crs, TILE.west, TILE.north, 1.0, 60, 60)
    data, clusters, _ = made()
    window = data.grid.window(small)
    other = (
        TileData("small", small, small, data.dsm[window], data.dtm[window]),
        RoadClusters(small, clusters.labels[window]),
        None,
    )
    surfaces = smoothing_spline.fit_batch([made(), other, made()], OPTIONS, Engine())
    assert [surface.A.shape for surface in surfaces] == [(40, 31), (20, 20), (40, 31)]
    assert apart_mm(surfaces[0], surfaces[2]) < ROUNDING_MM


def problem_of(tile=None):
    return smoothing_spline._tile_problem(*(tile or made())[:2], OPTIONS, None)[0]


@pytest.mark.parametrize(("fit_in", "sizes"), [(2, [2, 2, 1]), (0.5, [1] * 5), (100, [5])])
def test_memory_sets_the_size_of_batches(fit_in, sizes):
    problem = problem_of()
    memory = int(fit_in * batch.bytes_per_tile(problem))
    numbers = list(batch.batches([problem] * 5, Engine(memory_bytes=memory)))
    assert [len(some) for some in numbers] == sizes
    assert [i for some in numbers for i in some] == [0, 1, 2, 3, 4]


def test_float32_needs_less_memory():
    assert batch.bytes_per_tile(problem_of(), "float32") < batch.bytes_per_tile(problem_of())


def test_high_degree_is_an_error():
    with pytest.raises(TaskError, match=r"batches need fit\.degree 3 or less, not 5"):
        smoothing_spline.fit_batch([made()], OPTIONS.model_copy(update={"degree": 5}), Engine())


def test_missing_cuda_is_an_error_with_the_remedy():
    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    with pytest.raises(TaskError, match="no device 'cuda' on this machine; set the device to cpu or auto"):
        smoothing_spline.fit_batch([made()], OPTIONS, Engine("cuda"))
    assert Engine("auto").chosen_device() == "cpu"


def test_stencil_product_equals_dense_product():
    """The matrix of the data term, from dense basis functions of all control points."""
    problem, rng = problem_of(), np.random.default_rng(0)
    space, bases = problem.space, bases_of(problem.space, "cpu", "float64")
    weight = torch.tensor(rng.random((2, *problem.heights.shape)))
    z = torch.tensor(rng.normal(size=(2, *problem.first.shape)))
    product = bases.unpadded(multiply(bases.gram(weight), bases.padded(z))).numpy()
    along_u, along_v = (
        basis_matrix(knots, 3, at)[0] for knots, at in ((space.knots_u, space.u), (space.knots_v, space.v))
    )
    for i in range(2):
        expected = along_v.T @ (weight[i].numpy() * (along_v @ z[i].numpy() @ along_u.T)) @ along_u
        assert np.allclose(product[i], expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("degree", [2, 3, 4])
@pytest.mark.parametrize("intervals", [6, 7, 20])
def test_refinement_represents_coarse_functions(degree, intervals):
    """Every fine polynomial is a coarse spline too: here the constant and the linear one."""
    matrix = refinement(intervals + degree, degree)
    rows = np.arange(intervals + degree) - (degree - 1) / 2.0
    lowest = -((degree + 1) // 2)
    coarse = 2.0 * (np.arange(matrix.shape[1]) + lowest) + (degree + 1) - degree
    assert np.allclose(matrix @ np.ones(matrix.shape[1]), 1)
    assert np.allclose(np.diff(matrix @ coarse), np.diff(rows))
