"""A textured mesh becomes rasters that `run` takes; what cannot be used leaves nothing behind."""

import numpy as np
import pytest
import rasterio
from PIL import Image

from flexroad.catalog import Catalog, Grid
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.prepare.asked import Asked
from flexroad.pipeline.prepare.mesh import POINTS, MeshAsked, prepare_mesh
from flexroad.tasks.acquire.mesh.read import read_mesh
from flexroad.tasks.acquire.mesh.sample import tops
from flexroad.tasks.errors import TaskError

CRS = "EPSG:32617"
ZERO = (552_208.0, 4_114_742.0, 0.0)
SIDE, BOX = 60, (20, 30, 26, 34)
PLACED = MeshAsked(offset=ZERO)
ASKED = Asked(crs=CRS, dop_cell_m=0.5)


def ground(x, y):
    return 600 + 0.05 * x + 0.02 * y


def prepare(path, out, asked=ASKED, mesh_asked=PLACED, executor=None, options=POINTS):
    return prepare_mesh(path, out, asked, mesh_asked, options, executor or SerialExecutor(), lambda _: None)


def read(path):
    with rasterio.open(path) as raster:
        return raster.read().squeeze().astype(float)


def write(folder, quads, name="m.obj"):
    """Quads of four corners each, over a texture of red, green in the north and blue in the east."""
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
    image = np.full((SIDE, SIDE, 3), (200, 0, 0), np.uint8)
    image[:20, :, 1] = 150
    image[:, 40:, 2] = 250
    return image


@pytest.fixture
def box(tmp_path):
    """A box of 3 m on a slope."""
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


def test_rasters_are_those_of_the_mesh(box, tmp_path, executor):
    published = prepare(box, tmp_path / "out", executor=executor)
    (tile,) = Catalog.read(published.catalog).tiles
    assert tile.grid == Grid(CRS, ZERO[0], ZERO[1] + SIDE, 1.0, SIDE, SIDE)
    assert tile.dataset == "m.obj"
    dsm, dtm = read(tmp_path / "out" / "dsm.tif"), read(tmp_path / "out" / "dtm.tif")
    x, y = tile.grid.eastings - ZERO[0], tile.grid.northings[:, None] - ZERO[1]
    on_box = (x > BOX[0]) & (x < BOX[2]) & (y > BOX[1]) & (y < BOX[3])
    assert np.abs(dsm[on_box] - 606).max() < 1e-3
    np.testing.assert_allclose(dtm, np.broadcast_to(ground(x, y), dtm.shape), atol=0.06)
    # The highest of about 25 points lies between the cell's centre and its highest corner; points of a wall
    # are of the cell inside or outside.
    beside = (x > BOX[0] - 1) & (x < BOX[2] + 1) & (y > BOX[1] - 1) & (y < BOX[3] + 1)
    rise = (dsm - ground(x, y))[~beside]
    assert rise.min() > 0
    assert rise.max() < 0.035 + 1e-3
    colour = np.moveaxis(read(tmp_path / "out" / "dop.tif"), 0, -1)[::2, ::2]
    # Next to a change of colour the texture is read between two texels.
    rows, cols = np.delete(np.arange(SIDE), [19, 20]), np.delete(np.arange(SIDE), [39, 40])
    assert np.array_equal(colour[np.ix_(rows, cols)], texture()[np.ix_(rows, cols)])


def test_blocks_change_nothing(box, tmp_path, monkeypatch):
    one = prepare(box, tmp_path / "one").catalog.parent
    monkeypatch.setattr("flexroad.pipeline.prepare.spool.POINTS_PER_BLOCK", 1)
    monkeypatch.setattr("flexroad.pipeline.prepare.spool.SHORTEST_EDGE_M", 17)
    many = prepare(box, tmp_path / "many").catalog.parent
    for name in ("dsm.tif", "dtm.tif", "dop.tif"):
        np.testing.assert_allclose(read(one / name), read(many / name), atol=1e-4)


def test_the_same_seed_is_the_same_raster(box, tmp_path):
    outs = [
        prepare(box, tmp_path / str(n), mesh_asked=MeshAsked(offset=ZERO, seed=seed)).catalog.parent
        for n, seed in enumerate((3, 3, 4))
    ]
    first, again, other = (read(out / "dsm.tif") for out in outs)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_with_roads_there_is_the_papers_reference_and_it_says_that_it_is_circular(box, roads, tmp_path):
    published = prepare(box, tmp_path / "out", Asked(crs=CRS, roads=roads))
    (tile,) = Catalog.read(published.catalog).tiles
    assert tile.dataset == "m.obj; reference by ECSRC itself (circular)"
    dsm, dtm, reference, road = (
        read(tmp_path / "out" / f"{name}.tif") for name in ("dsm", "dtm", "reference", "reference_road")
    )
    truth = np.zeros((SIDE, SIDE), bool)
    truth[SIDE - 18 : SIDE - 10] = True
    assert np.array_equal(road != 0, truth)
    assert np.array_equal(reference, np.where(truth, dsm, dtm))


def test_feet_become_metres(box, tmp_path):
    asked = Asked(crs="EPSG:2264", tile_size_m=250)
    placed = MeshAsked(offset=(1_500_000.0, 600_000.0, 0.0))
    published = prepare(box, tmp_path / "out", asked, placed)
    (tile,) = Catalog.read(published.catalog).tiles
    west = 1_500_000 * 1200 / 3937
    assert (tile.grid.west, tile.grid.east) == (np.floor(west), np.ceil(west + SIDE * 1200 / 3937))
    assert np.nanmax(read(tmp_path / "out" / "dsm.tif")) == pytest.approx(606 * 1200 / 3937, abs=1e-3)


def test_no_orthophoto_on_request(box, tmp_path):
    (tmp_path / "m.png").unlink()
    published = prepare(box, tmp_path / "out", mesh_asked=MeshAsked(offset=ZERO, dop=False))
    assert sorted(path.name for path in published.catalog.parent.iterdir()) == [
        "catalog.parquet",
        "dsm.tif",
        "dtm.tif",
    ]


@pytest.mark.parametrize("spoil", ["texture", "crs", "roads", "cells"])
def test_what_cannot_be_used_leaves_nothing(spoil, box, tmp_path):
    asked = ASKED
    if spoil == "texture":
        (tmp_path / "m.png").unlink()
    elif spoil == "crs":
        asked = Asked()
    elif spoil == "roads":
        asked = Asked(crs=CRS, roads=tmp_path / "gone.gpkg")
    else:
        asked = Asked(crs=CRS, dop_cell_m=0.3)
    with pytest.raises((TaskError, ConfigError)):
        prepare(box, tmp_path / "out", asked)
    assert not (tmp_path / "out").exists()


@pytest.mark.real
def test_the_divided_road_of_deepscenario(real_data, tmp_path):
    """The surface against the highest of a fine look from above; the road against the map's."""
    folder = real_data / "deepscenario"
    path = folder / "textured_mesh" / "textured_mesh.obj"
    asked = Asked(dop_cell_m=0.25, roads=folder / "map" / "map.obj")
    published = prepare(path, tmp_path, asked, MeshAsked())
    (tile,) = Catalog.read(published.catalog).tiles
    assert tile.grid.crs == "EPSG:32617"
    fine = Grid.covering(CRS, tile.grid.bounds, 0.1)
    seen = tops(read_mesh(path), fine).reshape(tile.grid.height, 10, tile.grid.width, 10)
    whole = np.isfinite(seen).all(axis=(1, 3))
    assert whole.sum() > 1000
    off = (seen.max(axis=(1, 3)) - read(tmp_path / "dsm.tif"))[whole]
    assert np.median(np.abs(off)) < 0.02
    assert np.abs(off).max() < 0.35
    road, dsm, dtm = (read(tmp_path / f"{name}.tif") for name in ("reference_road", "dsm", "dtm"))
    on_road = (road != 0) & np.isfinite(dtm)
    assert on_road.sum() > 250
    assert np.median((dsm - dtm)[on_road]) < 0.1
    with rasterio.open(tmp_path / "dop.tif") as photo:
        colour, known = photo.read().astype(int), photo.dataset_mask() > 0
    # Asphalt is grey, the brush beside it is not: a photo in a wrong place would not know.
    grey = np.ptp(colour, axis=0)
    wide = np.kron(road, np.ones((4, 4))) != 0
    assert np.median(grey[wide & known]) < np.median(grey[~wide & known]) / 2
