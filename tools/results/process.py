"""Make a catalog and run it from Python, as `flexroad catalog` and `flexroad run` do."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flexroad.catalog.sources import rasters
from flexroad.catalog.storage.paths import parse_location
from flexroad.catalog.tiling import Conversion
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.run.api import Selection, Workers, created, process
from flexroad.pipeline.run.events import Observer
from flexroad.tools.results.run import RunView, open_run


def catalog_from(
    root: str | Path,
    output: str | Path,
    *,
    tile_size_m: float = 250,
    road_values: Sequence[int] = (),
    crs: str | None = None,
    reproject: bool = False,
    **patterns: str,
) -> Path:
    """Cut a folder of rasters into tiles and write their catalog.

    Parameters
    ----------
    root : str or Path
        The folder.
    output : str or Path
        The catalog to write: ``.parquet``, ``.json`` or ``.geojson``.
    tile_size_m : float
        Edge of a tile (m).
    road_values : sequence of int
        Values of the road mask that mean road; empty: all except 0 and nodata.
    crs : str, optional
        CRS of files without one.
    reproject : bool
        Whether rasters in another CRS, or in feet, are warped when they are read.
    **patterns : str
        Files of each layer as patterns relative to the folder: ``dsm="dsm/*.tif"``. Layers are ``dsm``, which
        is required, ``dtm``, ``road_mask``, ``roads`` (vectors), ``road_height``, ``dop``, ``reference`` and
        ``reference_road``.

    Returns
    -------
    Path
        The catalog.

    Warns
    -----
    UserWarning
        For each file that cannot be used: the tiles lack its cells.

    Raises
    ------
    CatalogError
        If there is no usable file, or the CRS is missing or not in metres.

    Examples
    --------
    >>> import flexroad
    >>> layers = {"dsm": "dsm/*.tif", "dtm": "dtm/*.tif", "road_mask": "road_mask/*.tif"}
    >>> flexroad.catalog_from("survey", "survey/rasters.parquet", tile_size_m=60, **layers).name
    'rasters.parquet'
    """
    result = rasters.index(
        Path(root),
        patterns,
        road_values=tuple(road_values),
        tile_size_m=tile_size_m,
        crs=crs,
        conversion=Conversion(reproject),
    )
    for line in result.left_out:
        warnings.warn(line, stacklevel=2)
    result.catalog.write(Path(output))
    return Path(output)


def run(
    catalog: str | Path,
    config: str | Path = "production",
    *,
    out: str | Path,
    tiles: Sequence[str] = (),
    workers: int | None = None,
    settings: Sequence[str] | Mapping[str, Any] = (),
    store: str | Path | None = None,
    allow: Sequence[str | Path] = (),
    observer: Observer | None = None,
) -> RunView:
    """Bring the tiles of a catalog up to date, as ``flexroad run`` does. A failed tile does not stop the run.

    Results that are up to date are not computed again. So the same call resumes a run.

    Parameters
    ----------
    catalog : str or Path
        The catalog's file, or its address in object storage.
    config : str or Path
        Name of a shipped configuration, or a YAML file.
    out : str or Path
        The run's folder: new, empty, or with an earlier run.
    tiles : sequence of str
        Ids of the tiles to process; empty: all.
    workers : int, optional
        Most worker processes; 1: this process alone; None: as many as save time. A script with workers needs
        ``if __name__ == "__main__":`` around the call.
    settings : sequence of str, or mapping
        Options of the configuration: ``["fit.spacing_m=5"]`` or ``{"fit": {"spacing_m": 5}}``.
    store : str or Path, optional
        Folder of stage results that several runs share.
    allow : sequence of str or Path
        Folders besides the catalog's that its files may lie below.
    observer : Observer, optional
        Takes the events of the run.

    Returns
    -------
    RunView
        The run; ``failures`` has the tiles that failed, with the reasons.

    Raises
    ------
    ConfigError
        If the configuration is invalid, the folder has other files, or another process works on it.
    CatalogError
        If the catalog cannot be read, or has no such tile.
    ClusterLost
        If all workers are lost; finished tiles are kept.
    OSError
        If a file of the run cannot be written.

    Examples
    --------
    >>> import flexroad
    >>> town = flexroad.run("survey/catalog.parquet", out="runs/town", tiles=["499980_5599980"], workers=1)
    >>> town.tiles["state"].tolist()
    ['done']
    """
    with created(
        parse_location(out),
        parse_location(catalog),
        load_config(str(config), settings),
        Selection(tuple(tiles)),
        store=parse_location(store) if store else None,
        allow=allow,
        workers=Workers("serial" if workers == 1 else "auto", workers),
        observer=observer,
    ) as prepared:
        process(prepared)
    return open_run(out, allow=allow)
