"""Fit of a surface to rasters in memory: the stages of a run, without files."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from threadpoolctl import threadpool_limits

from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.borders import BorderStages, has_borders
from flexroad.pipeline.graph.stages import stage_function
from flexroad.pipeline.inspect.surface import Surface
from flexroad.tasks.load_arrays import load_arrays
from flexroad.tasks.segment import mask
from flexroad.tasks.spline.frame import Frame

if TYPE_CHECKING:
    import xarray as xr


def fit(
    dsm: xr.DataArray,
    dtm: xr.DataArray,
    road_mask: xr.DataArray,
    config: str | Path = "production",
    variant: str | None = None,
) -> Surface:
    """Fit a smooth surface to the road and the terrain of one area.

    The stages and the result are those of a run over the same rasters. The area is fitted as one tile, which
    suits 60 m x 60 m to about 500 m x 500 m. For larger areas make a catalog and a run.

    Parameters
    ----------
    dsm : xarray.DataArray, (H, W)
        Digital surface model, heights in m. Its grid is that of the surface: square pixels, a projected CRS
        in metres (``dsm.rio.crs``), coordinates of the cell centres that ascend or descend. NaN and
        ``dsm.rio.nodata`` are nodata. Dask arrays are computed.
    dtm : xarray.DataArray, (H, W)
        Digital terrain model, heights in m, in the same CRS. If its cells do not coincide with those of the
        DSM, it is resampled bilinearly, with a warning.
    road_mask : xarray.DataArray, (H, W)
        Road where True or not 0, in the same CRS. If its cells do not coincide with those of the DSM, the
        nearest cell is taken, with a warning. It replaces the configuration's ``segment``. Without any road
        cell, also after the filter, the surface is that of the terrain, as in a run, and has the flag
        ``no-road`` (`Surface.flags`); a mask without road cells also gives a warning.
    config : str or Path
        A shipped configuration (``production``, ``paper``) or a YAML file.
    variant : str, optional
        A variant of the configuration; by default the first one exported.

    Returns
    -------
    Surface
        The fitted surface.

    Raises
    ------
    TaskError
        If an array has no CRS, is in degrees or feet, is rotated, or its pixels are not square; if the CRS of
        two arrays differ; if the DSM has too few heights; if a stage fails.
    ConfigError
        If there is no such configuration or variant.

    Examples
    --------
    >>> import flexroad
    >>> scene = flexroad.example(size_m=60)
    >>> surface = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask)
    >>> surface
    <flexroad.Surface: stepped of 20 x 20 control points, config production>
    EPSG:25832, 60 x 60 m, bounds 500200 5600000 500260 5600060
    road: 1576 cells given, 1445 kept by the filter
    """
    chosen = load_config(config)
    variant = variant or chosen.export.variants[0]
    if variant not in chosen.chains:
        raise ConfigError(f"{config} has no variant {variant!r}; it has {', '.join(chosen.chains)}")
    chain = chosen.chains[variant]
    data = load_arrays(dsm, dtm, road_mask, chain["load"])
    for note in data.notes:
        warnings.warn(note, stacklevel=2)
    # At these sizes several BLAS threads are much slower than one.
    with threadpool_limits(1):
        road = mask.segment(data, mask.Options())
        clusters = stage_function("ecsrc", chain["ecsrc"])(data, road, chain["ecsrc"])
        framed: dict[str, Frame] = {}
        # As in a run, the control points on the border are fitted first.
        if has_borders(chain["fit"]):
            stages = replace(BorderStages.of(chain), segment=mask.Options())
            wide = chain["load"].model_copy(update={"halo_m": stages.reach_m})
            framed["frame"] = stages.frame(load_arrays(dsm, dtm, road_mask, wide), data.core)
        fitted = stage_function("fit", chain["fit"])(data, clusters, chain["fit"], **framed)
    return Surface(fitted, data.core.crs, data.core.bounds, road, clusters, chain["sample"], str(config))
