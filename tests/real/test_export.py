"""Barbican, London, in all formats of exports: read back, the heights are those of the fitted surfaces."""

import zipfile

import numpy as np
import pytest
import rhino3dm

from flexroad.catalog import Catalog
from flexroad.catalog.ellipsoidal import Datum
from flexroad.catalog.sources.rasters import index
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.export.driver import export
from flexroad.pipeline.export.formats import FORMATS
from flexroad.pipeline.export.options import Options
from flexroad.pipeline.export.source import select
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from tests.pipeline.export.test_driver import OFFSET_M, heightfields, true_heights, vertices
from tests.validators.opencascade import read_step

pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.fixture(scope="module")
def barbican(real_data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("barbican")
    with zipfile.ZipFile(real_data / "umep" / "London_BNG.zip") as archive:
        archive.extractall(folder)
    layers = {"dsm": "dsm_barb*.tif", "dtm": "dem_barb*.tif", "road_mask": "landcover*.tif"}
    catalog = Catalog(tuple(index(folder / "London_BNG", layers, road_values=(1,)).tiles))
    run = Run.create(folder / "run", load_config("production"), catalog)
    run_tiles(run, SerialExecutor())
    return run.path


@pytest.fixture(scope="module")
def exported(barbican, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    export(select(barbican), out, list(FORMATS), Options(Datum("offset", str(OFFSET_M))), SerialExecutor())
    return out


@pytest.fixture(scope="module")
def tiles(barbican):
    return {tile.id: tile for tile in select(barbican).finished()}


def test_vertices_lie_on_the_surface(barbican, exported):
    for name, points in vertices(exported, "EPSG:27700").items():
        assert len(points) > 100_000
        error = np.abs(points[:, 2] - true_heights(barbican, points[:, :2]))
        # On a slope, the error in plan is also one in height; vertices on borders may be just outside.
        assert np.nanmax(error) <= 2 * FORMATS[name].precision_m, name
        assert np.isfinite(error).mean() > 0.99


def test_nodes_of_height_fields_lie_on_the_surface(tiles, exported):
    for name, tile in tiles.items():
        points, precision = heightfields(exported / "heightfield", name)
        error = np.abs(points[:, 2] - tile.surface.height(*points[:, :2].T))
        assert error.max() <= precision * 1.01
        assert precision < 0.001


def test_step_is_the_surface_of_each_tile(tiles, exported):
    for name, tile in tiles.items():
        valid, points = read_step(exported / "step" / f"{name}.stp", 30)
        assert valid
        west, south, east, north = tile.tile.grid.bounds
        x, y = points[:, 0] + west, points[:, 1] + south
        assert (x.min(), x.max(), y.min(), y.max()) == pytest.approx((west, east, south, north), abs=1e-8)
        # A northing of 181,750 m has a rounding error of 3e-11 m; slopes here are below 10.
        np.testing.assert_allclose(points[:, 2], tile.surface.height(x, y), rtol=0, atol=1e-9)


def test_3dm_has_the_meshes_of_each_tile(tiles, exported):
    for name, tile in tiles.items():
        model = rhino3dm.File3dm.Read(str(exported / "3dm" / f"{name}.3dm"))
        west, south, *_ = tile.mesh.origin
        for part in (item.Geometry for item in model.Objects):
            if isinstance(part, rhino3dm.Mesh):
                points = np.array(
                    [(p.X, p.Y, p.Z) for p in map(part.Vertices.Point3dAt, range(len(part.Vertices)))]
                )
                heights = tile.surface.height(points[:, 0] + west, points[:, 1] + south)
                # The mesh itself has rounded vertices.
                np.testing.assert_allclose(points[:, 2], heights, rtol=0, atol=2 * FORMATS["3dm"].precision_m)
