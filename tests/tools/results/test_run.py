"""The surface over the tiles of a run is that of queries, with the steps beside roads."""

from dataclasses import replace

import numpy as np
import pytest

import flexroad
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.sampler import RunSampler
from flexroad.tasks.spline.stepped import SteppedSurface, without_steps
from flexroad.tools.results.run import _joined


def places(bounds):
    """Return places within bounds, and places on the borders and corners of two by two tiles."""
    west, south, east, north = bounds
    rng = np.random.default_rng(0)
    x, y = rng.uniform(west, east, 4000), rng.uniform(south, north, 4000)
    x[:1200], y[800:2000] = rng.choice([west, (west + east) / 2, east], 1200), (south + north) / 2
    return x, y


def test_surface_over_tiles_has_the_heights_of_queries_within_tiles_and_on_their_borders(town):
    view = flexroad.open_run(town.path)
    surface = view.surface()
    x, y = places(surface.bounds)
    expected = view.height(x, y)
    known = np.isfinite(surface.height(x, y)) & np.isfinite(expected)
    np.testing.assert_allclose(surface.height(x, y)[known], expected[known], rtol=0, atol=1e-9)
    # The tile that is not computed has no heights, nor have its borders; queries end with the survey's cells.
    assert 0.6 < known.mean() < np.isfinite(expected).mean()
    smooth = without_steps(surface.fitted).height(x, y)
    steps = np.abs(expected - smooth)[known]
    inside = ~np.isin(x[known], x[:1200]) & (y[known] != y[800])
    assert (steps[inside] > 0.01).mean() > 0.02
    assert (steps[~inside] > 0.01).any()
    np.testing.assert_allclose(surface.normal(x, y)[known], view.normal(x, y)[known], rtol=0, atol=1e-9)


def test_surface_over_tiles_gives_the_raster_of_the_run_and_is_the_same_from_its_file(town, tmp_path):
    view = flexroad.open_run(town.path)
    surface = view.surface()
    surface.save(tmp_path / "town.npz")
    again = flexroad.open_surface(tmp_path / "town.npz")
    x, y = places(surface.bounds)
    assert again.height(x, y).tobytes() == surface.height(x, y).tobytes()
    raster, run = again.to_xarray(1.0), view.to_xarray()
    np.testing.assert_allclose(raster.height, run.height, rtol=0, atol=1e-4)
    assert float(raster.height.isnull().mean()) == 0.25


def test_surface_over_tiles_of_other_cells_raises(town):
    view = flexroad.open_run(town.path)
    tiles = view.run.catalog.tiles[:2]
    grids = [tiles[0].grid, replace(tiles[1].grid, cell=0.5)]
    with pytest.raises(flexroad.ConfigError, match="no common lattice; give bounds with tiles of one"):
        _joined(grids, iter(()))


def test_tile_of_an_opened_run_has_inputs_masks_and_surface(light_run, monkeypatch):
    tile = light_run.catalog.tiles[0]
    flexroad_run, raster_run = (flexroad.open_run(light_run.path, name) for name in ("flexroad", "rgt"))
    sampler = RunSampler.open(light_run.path)
    # Nothing opens the run again.
    monkeypatch.delattr(Run, "open")
    dataset = flexroad_run.tile(tile.id)
    assert set(dataset.data_vars) == {
        "dsm", "dtm", "reference", "reference_road", "road", "road_filtered", "surface",
    }  # fmt: skip
    assert dataset.rio.crs.to_epsg() == 25832
    assert tuple(dataset.rio.bounds()) == tile.grid.bounds
    assert not (dataset.road_filtered & ~dataset.road).any()
    east, north = np.meshgrid(dataset.x, dataset.y)
    height = sampler.at(east.ravel(), north.ravel()).height
    assert np.allclose(dataset.surface.values.ravel(), height, atol=1e-9)
    assert np.array_equal(raster_run.tile(tile.id).surface, dataset.dsm)
    with pytest.raises(flexroad.CatalogError, match="did you mean"):
        flexroad_run.tile("1_1")


def test_run_of_an_unknown_variant_raises(light_run):
    with pytest.raises(flexroad.ConfigError, match="no variant 'x'"):
        flexroad.open_run(light_run.path, "x")


def test_surface_over_one_tile_has_the_borders_of_the_tile(town):
    view = flexroad.open_run(town.path)
    tile = view.run.catalog.tiles[0]
    west, south, east, north = tile.grid.bounds
    surface = view.surface((west + 1, south + 1, east - 1, north - 1))
    alone = flexroad.open_surface(town.path / "tiles" / tile.id / f"{tile.id}_flexroad_surface.npz")
    assert isinstance(surface.fitted, SteppedSurface)
    for name in ("steps", "south_north", "west_east"):
        assert getattr(surface.fitted, name).tobytes() == getattr(alone.fitted, name).tobytes()
