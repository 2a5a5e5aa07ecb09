import numpy as np
import pytest

from flexroad.catalog import Catalog, CatalogError
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.sampler import RunSampler
from flexroad.tools.results.run import open_run


def test_tile_of_run_returns_inputs_masks_and_surface(survey, quick_config, tmp_path):
    run = Run.create(tmp_path / "run", load_config(quick_config), Catalog.read(survey))
    run_tiles(run, SerialExecutor(), only=lambda tile: tile == run.catalog.tiles[0])
    tile = run.catalog.tiles[0]
    dataset = open_run(run.path).tile(tile.id)
    assert set(dataset.data_vars) == {
        "dsm", "dtm", "reference", "reference_road", "road", "road_filtered", "surface",
    }  # fmt: skip
    assert dataset.rio.crs.to_epsg() == 25832
    assert tuple(dataset.rio.bounds()) == tile.grid.bounds
    assert not (dataset.road_filtered & ~dataset.road).any()
    east, north = np.meshgrid(dataset.x, dataset.y)
    height = RunSampler.open(run.path).at(east.ravel(), north.ravel()).height
    assert np.allclose(dataset.surface.values.ravel(), height, atol=1e-9)
    assert np.array_equal(open_run(run.path, "rgt").tile(tile.id).surface, dataset.dsm)
    with pytest.raises(ConfigError, match="no variant 'x'"):
        open_run(run.path, "x").tile(tile.id)
    with pytest.raises(CatalogError, match="did you mean"):
        open_run(run.path).tile("1_1")


def test_tile_of_an_opened_run_does_not_open_the_run_again(survey, quick_config, tmp_path, monkeypatch):
    run = Run.create(tmp_path / "run", load_config(quick_config), Catalog.read(survey))
    tile = run.catalog.tiles[0]
    run_tiles(run, SerialExecutor(), only=lambda other: other == tile)
    view, expected = open_run(run.path), open_run(run.path).tile(tile.id)

    def opened(*arguments):
        raise AssertionError("the run is opened again")

    monkeypatch.setattr(Run, "open", opened)
    assert view.tile(tile.id).identical(expected)
