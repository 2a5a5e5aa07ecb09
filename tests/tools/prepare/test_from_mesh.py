"""A textured mesh is converted to rasters that `run` can read; invalid input leaves no files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image

from flexroad.catalog import Catalog, Grid
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.tasks.errors import TaskError
from flexroad.tools.prepare.from_mesh import POINTS, MeshOptions, prepare_mesh
from flexroad.tools.prepare.mesh.read import read_mesh
from flexroad.tools.prepare.mesh.sample import project_down
from flexroad.tools.prepare.options import PrepareOptions

CRS = "EPSG:32617"
ZERO = (552_208.0, 4_114_742.0, 0.0)
SIDE, BOX = 60, (20, 30, 26, 34)
PLACED = MeshOptions(offset=ZERO)
OPTIONS = PrepareOptions(crs=CRS, dop_cell_m=0.5)


def ground(x, y):
    return 600 + 0.05 * x + 0.02 * y


def prepare(path, out, options=OPTIONS, mesh_options=PLACED, executor=None, points=POINTS):
    return prepare_mesh(
        path, out, options, mesh_options, points, executor or SerialExecutor(), lambda _: None
    )


def read(path):
    with rasterio.open(path) as raster:
        return raster.read().squeeze().astype(float)


def write(folder, quads, name="m.obj"):
    """Write quads of four corners each, with `texture` as their texture."""
    vertices = [corner for quad in quads for corner in quad]
    lines = ["mtllib m.mtl", *(f"v {x} {y} {z}" for x, y, z in vertices)]
    lines += [f"vt {x / SIDE} {y / SIDE}" for x, y, _ in vertices] + ["usemtl m"]
    for n in range(1, len(vertices) + 1, 4):
        lines += [f"f {n}/{n} {n + 1}/{n + 1} {n + 2}/{n + 2}", f"f {n}/{n} {n + 2}/{n + 2} {n + 3}/{n + 3}"]
    (folder / name).write_text("\n".join(lines) + "\n")
    (folder / "m.mtl").write_text("newmtl m\nmap_Kd m.png\n")
    Image.fromarray(texture()).save(folder / "m.png")
    return folder / name


def texture():
    """Red, with green in the north and blue in the east."""
    image = np.full((SIDE, SIDE, 3), (200, 0, 0), np.uint8)
    image[:20, :, 1] = 150
    image[:, 40:, 2] = 250
    return image


@pytest.fixture
def box(tmp_path):
    """A box, 3 m high, on a slope."""
    west, south, east, north = BOX
    rim = [(0, 0), (SIDE, 0), (SIDE, SIDE), (0, SIDE)]
    edge = [(west, south), (east, south), (east, north), (west, north)]
    quads = [[(x, y, ground(x, y)) for x, y in rim], [(x, y, 606.0) for x, y in edge]]
    for (ax, ay), (bx, by) in zip(edge, edge[1:] + edge[:1], strict=True):
        quads.append([(ax, ay, ground(ax, ay)), (bx, by, ground(bx, by)), (bx, by, 606), (ax, ay, 606)])
    return write(tmp_path, quads)


@pytest.fixture
def roads(tmp_path):
    """A road from west to east, as a mesh in the same local frame."""
    (tmp_path / "roads.obj").write_text("v 0 10 0\nv 60 10 0\nv 60 18 0\nv 0 18 0\nf 1 2 3 4\n")
    (tmp_path / "coords.txt").write_text(f"WGS84 UTM 17N\n{ZERO[0]} {ZERO[1]}\n")
    return tmp_path / "roads.obj"


def test_prepare_mesh_gives_its_heights_and_colours(box, tmp_path, executor):
    published = prepare(box, tmp_path / "out", executor=executor)
    (tile,) = Catalog.read(published.catalog).tiles
    assert tile.grid == Grid(CRS, ZERO[0], ZERO[1] + SIDE, 1.0, SIDE, SIDE)
    assert tile.dataset == "m.obj"
    dsm, dtm = read(tmp_path / "out" / "dsm.tif"), read(tmp_path / "out" / "dtm.tif")
    x, y = tile.grid.eastings - ZERO[0], tile.grid.northings[:, None] - ZERO[1]
    on_box = (x > BOX[0]) & (x < BOX[2]) & (y > BOX[1]) & (y < BOX[3])
    assert np.abs(dsm[on_box] - 606).max() < 1e-3
    np.testing.assert_allclose(dtm, np.broadcast_to(ground(x, y), dtm.shape), atol=0.06)
    # The highest of about 25 points is between the cell's centre and its highest corner. Points of a wall
    # are in the cell inside or outside.
    beside = (x > BOX[0] - 1) & (x < BOX[2] + 1) & (y > BOX[1] - 1) & (y < BOX[3] + 1)
    rise = (dsm - ground(x, y))[~beside]
    assert rise.min() > 0
    assert rise.max() < 0.035 + 1e-3
    colour = np.moveaxis(read(tmp_path / "out" / "dop.tif"), 0, -1)[::2, ::2]
    # Next to a change of colour the texture is interpolated between two texels.
    rows, cols = np.delete(np.arange(SIDE), [19, 20]), np.delete(np.arange(SIDE), [39, 40])
    assert np.array_equal(colour[np.ix_(rows, cols)], texture()[np.ix_(rows, cols)])


def test_prepare_mesh_in_many_blocks_gives_the_same_rasters(box, tmp_path, monkeypatch):
    one = prepare(box, tmp_path / "one").catalog.parent
    monkeypatch.setattr("flexroad.tools.prepare.point_buckets.POINTS_PER_BLOCK", 1)
    monkeypatch.setattr("flexroad.tools.prepare.point_buckets.SHORTEST_EDGE_M", 17)
    many = prepare(box, tmp_path / "many").catalog.parent
    for name in ("dsm.tif", "dtm.tif", "dop.tif"):
        np.testing.assert_allclose(read(one / name), read(many / name), atol=1e-4)


def test_prepare_mesh_with_same_seed_gives_same_raster(box, tmp_path):
    outs = [
        prepare(box, tmp_path / str(n), mesh_options=MeshOptions(offset=ZERO, seed=seed)).catalog.parent
        for n, seed in enumerate((3, 3, 4))
    ]
    first, again, other = (read(out / "dsm.tif") for out in outs)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_prepare_mesh_with_roads_writes_circular_reference(box, roads, tmp_path):
    published = prepare(box, tmp_path / "out", PrepareOptions(crs=CRS, roads=roads))
    (tile,) = Catalog.read(published.catalog).tiles
    assert tile.dataset == "m.obj; reference by ECSRC itself (circular)"
    dsm, dtm, reference, road = (
        read(tmp_path / "out" / f"{name}.tif") for name in ("dsm", "dtm", "reference", "reference_road")
    )
    truth = np.zeros((SIDE, SIDE), bool)
    truth[SIDE - 18 : SIDE - 10] = True
    assert np.array_equal(road != 0, truth)
    assert np.array_equal(reference, np.where(truth, dsm, dtm))


def test_prepare_mesh_in_feet_gives_metres(box, tmp_path):
    options = PrepareOptions(crs="EPSG:2264", tile_size_m=250)
    placed = MeshOptions(offset=(1_500_000.0, 600_000.0, 0.0))
    published = prepare(box, tmp_path / "out", options, placed)
    (tile,) = Catalog.read(published.catalog).tiles
    west = 1_500_000 * 1200 / 3937
    assert (tile.grid.west, tile.grid.east) == (np.floor(west), np.ceil(west + SIDE * 1200 / 3937))
    assert np.nanmax(read(tmp_path / "out" / "dsm.tif")) == pytest.approx(606 * 1200 / 3937, abs=1e-3)


def test_prepare_mesh_without_dop_writes_no_orthophoto(box, tmp_path):
    (tmp_path / "m.png").unlink()
    published = prepare(box, tmp_path / "out", mesh_options=MeshOptions(offset=ZERO, dop=False))
    names = {path.name for path in published.catalog.parent.iterdir()}
    assert names == {"catalog.parquet", "dsm.tif", "dtm.tif", "road_height.tif"}


@pytest.mark.parametrize(
    "options",
    [OPTIONS, PrepareOptions(), replace(OPTIONS, roads=Path("gone.gpkg")), replace(OPTIONS, dop_cell_m=0.3)],
    ids=["texture", "crs", "roads", "cells"],
)
def test_prepare_mesh_invalid_input_leaves_no_folder(options, box, tmp_path):
    if options is OPTIONS:
        (tmp_path / "m.png").unlink()
    with pytest.raises((TaskError, ConfigError)):
        prepare(box, tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


@pytest.mark.real
def test_prepare_mesh_deepscenario_matches_mesh_and_map(real_data, tmp_path):
    """The DSM is compared with the mesh rendered from above at 0.1 m, the road mask with the map."""
    folder = real_data / "deepscenario"
    path = folder / "textured_mesh" / "textured_mesh.obj"
    options = PrepareOptions(dop_cell_m=0.25, roads=folder / "map" / "map.obj")
    published = prepare(path, tmp_path, options, MeshOptions())
    (tile,) = Catalog.read(published.catalog).tiles
    assert tile.grid.crs == "EPSG:32617"
    fine = Grid.covering(CRS, tile.grid.bounds, 0.1)
    rendered = project_down(read_mesh(path), fine)[0].reshape(tile.grid.height, 10, tile.grid.width, 10)
    whole = np.isfinite(rendered).all(axis=(1, 3))
    assert whole.sum() > 1000
    difference = (rendered.max(axis=(1, 3)) - read(tmp_path / "dsm.tif"))[whole]
    assert np.median(np.abs(difference)) < 0.02
    assert np.abs(difference).max() < 0.35
    road, dsm, dtm = (read(tmp_path / f"{name}.tif") for name in ("reference_road", "dsm", "dtm"))
    on_road = (road != 0) & np.isfinite(dtm)
    assert on_road.sum() > 250
    assert np.median((dsm - dtm)[on_road]) < 0.1
    with rasterio.open(tmp_path / "dop.tif") as photo:
        colour, valid = photo.read().astype(int), photo.dataset_mask() > 0
    # Asphalt is grey, the vegetation beside it is not: this detects a displaced orthophoto.
    grey = np.ptp(colour, axis=0)
    wide = np.kron(road, np.ones((4, 4))) != 0
    assert np.median(grey[wide & valid]) < np.median(grey[~wide & valid]) / 2
