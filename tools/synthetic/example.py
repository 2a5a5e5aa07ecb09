"""A small synthetic scene as a Dataset, for examples."""

from __future__ import annotations

import rioxarray  # noqa: F401 (adds .rio to datasets)
import xarray as xr

from flexroad.catalog import Grid
from flexroad.pipeline.errors import ConfigError
from flexroad.tools.synthetic import make_scene

LAYERS = ("dsm", "dtm", "road_mask", "reference")
CRS = "EPSG:25832"
WEST_M, SOUTH_M = 500_200, 5_600_000
"""South-west corner of every scene."""


def example(seed: int = 0, size_m: int = 120) -> xr.Dataset:
    """Return the rasters of a synthetic area with streets, houses, trees, cars and known truth.

    Parameters
    ----------
    seed : int
        Seed of the scene, 0 or more.
    size_m : int
        Side of the area (m), 60 to 1000; cells are 1 m.

    Returns
    -------
    xarray.Dataset, (y, x)
        ``dsm`` and ``dtm`` (m) and ``road_mask``, with the noise and errors of a survey; ``reference``, the
        true height of road and terrain (m). ``.rio.crs`` is EPSG:25832.

    Raises
    ------
    ConfigError
        If the seed or the size is out of range.

    Examples
    --------
    >>> import flexroad
    >>> scene = flexroad.example(seed=0, size_m=60)
    >>> list(scene.data_vars), dict(scene.sizes)
    (['dsm', 'dtm', 'road_mask', 'reference'], {'y': 60, 'x': 60})
    """
    if seed < 0 or not 60 <= size_m <= 1000:
        raise ConfigError(f"seed {seed}, size_m {size_m}: give a seed from 0 and a size from 60 to 1000 m")
    grid = Grid(CRS, WEST_M, SOUTH_M + size_m, 1.0, size_m, size_m)
    layers = make_scene(grid, seed).layers
    scene = xr.Dataset(
        {name: (("y", "x"), layers[name], {} if name == "road_mask" else {"units": "m"}) for name in LAYERS},
        coords={"x": grid.eastings, "y": grid.northings},
        attrs={"title": f"synthetic scene, seed {seed}"},
    )
    with_crs: xr.Dataset = scene.rio.write_crs(grid.crs)
    return with_crs
