"""Tiles that are processed alone, each in its own process and store, have one surface and one mesh."""

import concurrent.futures
import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh

import flexroad
from flexroad.catalog import Catalog
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks.products import npz
from flexroad.tools.report.content import LARGEST_STEPS, STEPS, gather
from flexroad.tools.synthetic.scenes import write_scenes
from tests.mesh_union import Union
from tests.read_exports import true_heights

SIZE_M = 100
KERNELS: tuple[dict[str, str], ...] = ({}, {"OPENBLAS_CORETYPE": "Prescott"})
"""Instruction sets of OpenBLAS, which round differently, for tiles with even and odd numbers."""
BOTH = """
import sys
from flexroad.pipeline.cli.main import app
tile, out, *catalogs = sys.argv[1:]
for catalog in catalogs:
    words = ["run", "--config", "production", "--catalog", catalog, "--tile", tile]
    app([*words, "--out", f"{out}/{catalog.rpartition('/')[2]}/{tile}"], standalone_mode=False)
"""
"""Code of a process that computes one tile of several catalogs."""


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    folder = tmp_path_factory.mktemp("survey")
    write_scenes(folder, 9, seed=5, size_m=SIZE_M)
    return folder


@pytest.fixture(scope="module")
def processed(survey, tmp_path_factory):
    """The survey as prepared tiles and as rasters; for each tile a process that makes it alone."""
    folder = tmp_path_factory.mktemp("alone")
    patterns = {name: f"{name}/*.tif" for name in ("dsm", "dtm", "road_mask")}
    tiles = rasters.index(survey, patterns, tile_size_m=SIZE_M).tiles
    Catalog(tiles).write(survey / "rasters.json")
    catalogs = survey / "catalog.parquet", survey / "rasters.json"

    def run(number):
        command = [sys.executable, "-c", BOTH, tiles[number].id, folder, *catalogs]
        environment = {**os.environ, **KERNELS[number % 2]}
        subprocess.run([*map(str, command)], env=environment, check=True, capture_output=True, text=True)

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        list(pool.map(run, range(len(tiles))))
    return folder, catalogs


@pytest.fixture(params=[0, 1], ids=["prepared", "rasters"])
def alone(request, processed):
    """A catalog, and the folder with one run for each of its tiles."""
    folder, catalogs = processed
    return catalogs[request.param], folder / catalogs[request.param].name


def product(folder, tile, end):
    return folder / tile / "tiles" / tile / f"{tile}_flexroad{end}"


@pytest.mark.slow
def test_tiles_processed_alone_have_equal_control_points_and_meet(alone):
    path, folder = alone
    tiles = {(tile.grid.west, tile.grid.south): tile.id for tile in Catalog.read(path).tiles}
    surfaces = {place: npz.decode(product(folder, tile, "_surface.npz")) for place, tile in tiles.items()}
    along, pairs = np.random.default_rng(0).uniform(0, SIZE_M, 300), 0
    for (west, south), here in surfaces.items():
        for east, north in ((SIZE_M, 0), (0, SIZE_M)):
            there = surfaces.get((west + east, south + north))
            if there is None:
                continue
            pairs += 1
            ours, theirs = (here.A[:, -3:], there.A[:, :3]) if east else (here.A[-3:], there.A[:3])
            np.testing.assert_array_equal(ours, theirs)
            x, y = west + (east or along), south + (north or along)
            np.testing.assert_array_equal(here.height(x, y), there.height(x, y))
            np.testing.assert_array_equal(here.normal(x, y), there.normal(x, y))
    assert pairs >= 12


def glb_part(path):
    """Return vertices (easting, northing, height, relative to the run) and faces of a GLB."""
    scene = trimesh.load(path, process=False)
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        part = scene.geometry[name]
        x, y, z = (part.vertices.astype(np.float32).astype(np.float64) + matrix[:3, 3]).T
        # Every run has its own origin, which is a whole number of metres.
        origin = scene.metadata["run_origin"]
        yield np.stack([x + origin[0], -z + origin[1], y + origin[2]], axis=1), part.faces


def ply_part(path):
    mesh = trimesh.load(path, process=False)
    yield np.asarray(mesh.vertices), np.asarray(mesh.faces)


@pytest.mark.slow
@pytest.mark.parametrize(("end", "read"), [(".glb", glb_part), (".ply", ply_part)])
def test_exported_meshes_of_tiles_join_without_open_edges(alone, end, read):
    path, folder = alone
    tiles = Catalog.read(path).tiles
    whole = Union.of(part for tile in tiles for part in read(product(folder, tile.id, end)))
    assert whole.uses.max() == 2
    at_rim = ~whole.inside
    assert (whole.uses[~at_rim] == 2).all()
    assert whole.area == len(tiles) * SIZE_M**2


@pytest.mark.slow
def test_meshes_have_equal_normals_where_tiles_meet(alone):
    """So that no line is seen between them."""
    path, folder = alone
    seen: dict[tuple[float, ...], dict[str, tuple[float, ...]]] = {}
    for tile in Catalog.read(path).tiles:
        scene = trimesh.load(product(folder, tile.id, ".glb"), process=False)
        west, south, east, north = tile.grid.bounds
        for node in scene.graph.nodes_geometry:
            matrix, name = scene.graph[node]
            part = scene.geometry[name]
            origin = scene.metadata["run_origin"]
            x, y, z = (part.vertices + matrix[:3, 3]).T
            for place, normal in zip(
                zip(x + origin[0], origin[1] - z, y.astype(np.float32), strict=True),
                part.vertex_normals.astype(np.float32),
                strict=True,
            ):
                if place[0] in (west, east) or place[1] in (south, north):
                    seen.setdefault(place, {})[tile.id] = tuple(normal)
    met = [normals for normals in seen.values() if len(normals) > 1]
    assert len(met) > 200
    assert all(len(set(normals.values())) == 1 for normals in met)


@pytest.mark.slow
def test_tiles_processed_together_have_the_same_bytes(alone, tmp_path):
    """Whether its neighbours are in the run, fail or come first changes no byte of a tile's surface."""
    path, folder = alone
    catalog = Catalog.read(path)
    run = Run.create(tmp_path / "run", load_config("production"), catalog)
    middle = catalog.tiles[4]
    run_tiles(run, SerialExecutor(), only=lambda tile: tile != middle)
    # Tiles with odd numbers were made with other rounding errors.
    for tile in catalog.tiles[::2]:
        if tile == middle:
            continue
        for end in ("_surface.npz", ".ply", "_height.tif"):
            together = run.folder(tile.id).path / f"{tile.id}_flexroad{end}"
            assert together.read_bytes() == product(folder, tile.id, end).read_bytes(), (tile.id, end)
    before = {file: file.read_bytes() for file in (tmp_path / "run" / "tiles").glob("*/*")}
    summary = run_tiles(run, SerialExecutor())
    assert (summary.done, summary.cached) == (9, 8)
    assert all(file.read_bytes() == data for file, data in before.items())
    tables = gather(run).tables
    assert not len(tables[LARGEST_STEPS][0])
    check, _ = tables[STEPS]
    assert list(check.result) == ["one surface: all differences are exactly 0"]
    assert check.edges.sum() == 12
    view = flexroad.open_run(tmp_path / "run")
    west, south, east, north = np.array([tile.grid.bounds for tile in catalog.tiles]).T
    x, y = np.random.default_rng(0).uniform((west.min(), south.min()), (east.max(), north.max()), (500, 2)).T
    surface = view.surface()
    heights = true_heights(tmp_path / "run", np.column_stack([x, y]))
    np.testing.assert_allclose(surface.height(x, y), heights, rtol=0, atol=1e-9)
    np.testing.assert_allclose(surface.normal(x, y), view.normal(x, y), rtol=0, atol=1e-9)


def test_surface_of_part_of_unfinished_run(survey, tmp_path):
    catalog = Catalog.read(survey / "catalog.parquet").select(
        [tile.id for tile in Catalog.read(survey / "catalog.parquet").tiles[:2]]
    )
    run = Run.create(tmp_path / "run", load_config("production"), catalog)
    run_tiles(run, SerialExecutor(), only=lambda tile: tile == catalog.tiles[0])
    view = flexroad.open_run(tmp_path / "run")
    grid = catalog.tiles[0].grid
    inside = grid.west + 10, grid.south + 10, grid.west + 30, grid.south + 40
    surface = view.surface(inside)
    assert surface.bounds == inside
    assert np.isnan(surface.height(grid.west + 50, grid.south + 20))
    assert surface.height(grid.west + 20, grid.south + 20) == pytest.approx(
        float(view.height(grid.west + 20, grid.south + 20)), abs=1e-9
    )
    with pytest.raises(flexroad.ConfigError, match="has no finished tile in"):
        view.surface(catalog.tiles[1].grid.bounds)


def test_surface_of_independent_tiles_raises(finished_paper_run):
    with pytest.raises(flexroad.ConfigError, match=r"fit\.method smoothing_spline makes one"):
        flexroad.open_run(finished_paper_run).surface()


@pytest.fixture
def finished_paper_run(survey, tmp_path):
    catalog = Catalog.read(survey / "catalog.parquet")
    Run.create(tmp_path / "paper", load_config("paper"), catalog)
    return tmp_path / "paper"
