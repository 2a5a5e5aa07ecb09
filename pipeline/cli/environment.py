"""Environment variables that other programs (QGIS, PostGIS) set for their own GDAL and PROJ."""

from __future__ import annotations

import os
import sys
from collections.abc import MutableMapping
from importlib.util import find_spec
from pathlib import Path

FOLDERS = (
    "PROJ_LIB",
    "PROJ_DATA",
    "GDAL_DATA",
    "GDAL_DRIVER_PATH",
    "OGR_DRIVER_PATH",
    "GDAL_PYTHON_DRIVER_PATH",
)
"""Folders of data and drivers, which only fit the GDAL and PROJ that they were installed with."""
PLACES = (
    "GTIFF_POINT_GEO_IGNORE",
    "GTIFF_SRS_SOURCE",
    "GTIFF_HONOUR_NEGATIVE_SCALEY",
    "GDAL_GEOREF_SOURCES",
)
"""Options of GDAL that move rasters, some by half a cell."""


def drop_foreign(variables: MutableMapping[str, str] = os.environ) -> str:
    """Remove the variables of other programs; return a line on them, empty if there are none.

    Folders of the environment that Python runs in stay if rasterio has no data of its own: conda sets them.
    """
    own = None if _has_own_data() else Path(sys.prefix).resolve()
    foreign = {name: variables[name] for name in PLACES if name in variables}
    for name in (name for name in FOLDERS if name in variables):
        if own is None or not Path(variables[name]).resolve().is_relative_to(own):
            foreign[name] = variables[name]
    for name in foreign:
        del variables[name]
    if not foreign:
        return ""
    listed = ", ".join(f"{name}={value}" for name, value in foreign.items())
    return f"ignored {listed}: set for the GDAL and PROJ of another program; unset it to avoid this line"


def _has_own_data() -> bool:
    """Return whether rasterio was installed with the data of its GDAL and PROJ, as wheels have them."""
    rasterio = find_spec("rasterio")
    return bool(rasterio and rasterio.origin and Path(rasterio.origin).with_name("gdal_data").is_dir())
