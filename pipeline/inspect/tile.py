"""One tile of a run as an xarray Dataset.

>>> from flexroad.pipeline.inspect.tile import open_tile
>>> tile = open_tile("RUN", "295500_5629250")                    # doctest: +SKIP
>>> (tile.surface - tile.reference).where(tile.road).plot()      # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flexroad.catalog.storage.paths import Location
from flexroad.pipeline.run.finished import FinishedTile, open_variant
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses

if TYPE_CHECKING:
    import xarray as xr

HEIGHTS = {"units": "m"}


def open_tile(
    run: Location | str, tile_id: str, variant: str | None = None, allow: Sequence[str | Path] = ()
) -> xr.Dataset:
    """Return the input rasters, masks and fitted surface of a tile, on the tile's core.

    Parameters
    ----------
    run : Location or str
        The run's folder.
    tile_id : str
        Id of a tile of the run's catalog.
    variant : str, optional
        The variant of filter and surface; by default the first one exported.
    allow : sequence of str or Path
        Further folders that the sources of the run may lie below (`Run.open`).

    Returns
    -------
    xarray.Dataset
        ``dsm``, ``dtm``, ``surface`` and, where the catalog has one, ``reference`` (m); ``road`` and
        ``road_filtered``, the masks before and after the filter, and ``reference_road``. Coordinates ``x``
        and ``y`` are eastings and northings (m) of the cell centres; the CRS is rioxarray's
        ``spatial_ref``. Stored results are read; others are computed and not stored.

    Raises
    ------
    ConfigError
        If the folder is no run, the variant is unknown or a stage fails on the tile.
    CatalogError
        If the catalog has no such tile, or names a file outside the allowed folders.
    """
    opened, variant = open_variant(run, variant, allow)
    return tile_dataset(opened, tile_id, variant)


def tile_dataset(run: Run, tile_id: str, variant: str) -> xr.Dataset:
    """Return what `open_tile` returns, of an opened run."""
    import rioxarray  # noqa: F401 (gives datasets their .rio)
    import xarray as xr

    (tile,) = run.catalog.select([tile_id]).tiles
    (status,) = peek_statuses(run, [tile])
    results = FinishedTile.of(run, status, variant)
    data, road, clusters, surface = results.data, results.road, results.clusters, results.surface
    core, window = data.core, data.grid.window(data.core)
    rasters = {name: getattr(data, name) for name in ("dsm", "dtm", "reference", "reference_road")}
    rasters |= {"road": road.mask, "road_filtered": clusters.mask}
    cut = {name: raster[window] for name, raster in rasters.items() if raster is not None}
    cut["surface"] = surface.lattice(core.eastings, core.northings)
    dataset = xr.Dataset(
        {name: (("y", "x"), raster, {} if raster.dtype == bool else HEIGHTS) for name, raster in cut.items()},
        coords={"x": core.eastings, "y": core.northings},
        attrs={"tile": tile.id, "variant": variant, "stratum": tile.stratum},
    )
    placed: xr.Dataset = dataset.rio.write_crs(core.crs)
    return placed
