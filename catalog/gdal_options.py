"""Options of GDAL and PROJ on which results depend: neither environment nor configuration files change them.

GDAL's list has about 1,100 options (``port/cpl_known_config_options.h``). This file has the options of the
core and of our formats that change cells, places, features or text. The user may set options for limits,
speed, messages and access to the web. GDAL takes an option from the program, else from the environment, else
from ``GDAL_CONFIG_FILE`` or ``~/.gdal/gdalrc``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import MutableMapping
from importlib.util import find_spec
from pathlib import Path

from flexroad.catalog.lazy import lazy

pyogrio = lazy("pyogrio")

CHOSEN = {
    # Do not list the folder for every file (it may have 10,000); side-car files are still opened.
    "GDAL_DISABLE_READDIR_ON_OPEN": "TRUE",
    # Otherwise GDAL does not report the vertical CRS of GeoTIFF 1.0 files.
    "GTIFF_REPORT_COMPD_CS": "YES",
    # Do not write a file with the unpacked size beside a .gz file.
    "CPL_VSIL_GZIP_WRITE_PROPERTIES": "NO",
}
"""Values that differ from GDAL's own."""
DEFAULTS = {
    # Damaged blocks of a GeoTIFF would be 0 without an error.
    "GTIFF_IGNORE_READ_ERRORS": "NO",
    # Cut-off answers of a server would be read without an error, too.
    "CPL_CURL_IGNORE_ERROR": "NO",
    # These move rasters, some by half a cell, or turn them upside down.
    "GTIFF_POINT_GEO_IGNORE": "FALSE",
    "GTIFF_HONOUR_NEGATIVE_SCALEY": "NO",
    "GDAL_GEOREF_SOURCES": "PAM,INTERNAL,TABFILE,WORLDFILE",
    "GDAL_USE_GEOJP2": "TRUE",
    "GDAL_USE_GMLJP2": "TRUE",
    "GDAL_IGNORE_AXIS_ORIENTATION": "FALSE",
    "GDAL_JP2K_ALT_OFFSETVECTOR_ORDER": "FALSE",
    # These make a georeference from control points that do not fit a georeference.
    "GDAL_GCPS_TO_GEOTRANSFORM_APPROX_OK": "NO",
    "TAB_APPROX_GEOTRANSFORM": "NO",
    # These change the CRS that a file has, or its parameters.
    "GTIFF_IMPORT_FROM_EPSG": "YES",
    "GTIFF_LINEAR_UNITS": "DEFAULT",
    "GTIFF_READ_ANGULAR_PARAMS_IN_DEGREE": "NO",
    "OSR_STRIP_TOWGS84": "YES",
    "OSR_ADD_TOWGS84_ON_IMPORT_FROM_EPSG": "NO",
    "OSR_USE_NON_DEPRECATED": "YES",
    "OSR_USE_APPROX_TMERC": "NO",
    "USE_OSR_FIND_MATCHES": "YES",
    # These choose another transformation between two CRSs, or swap the axes.
    "OSR_DEFAULT_AXIS_MAPPING_STRATEGY": "AUTHORITY_COMPLIANT",
    "OSR_CT_USE_DEFAULT_EPSG_TOWGS84": "NO",
    "OGR_CT_FORCE_TRADITIONAL_GIS_ORDER": "NO",
    "OGR_CT_OP_SELECTION": "PROJ",
    "OGR_CT_PREFER_OFFICIAL_SRS_DEF": "YES",
    "OGR_CT_USE_SRS_COORDINATE_EPOCH": "YES",
    "OGR_ENABLE_PARTIAL_REPROJECTION": "NO",
    "CHECK_WITH_INVERT_PROJ": "NO",
    # These hide side-car files, or their values.
    "GDAL_PAM_ENABLED": "YES",
    "USE_RRD": "NO",
    # These change values, colours and masks of cells.
    "GTIFF_FORCE_RGBA": "NO",
    "CONVERT_YCBCR_TO_RGB": "YES",
    "GDAL_TIFF_INTERNAL_MASK_TO_8BIT": "YES",
    "GDAL_JPEG_TO_RGB": "YES",
    "JPEG_READ_MASK": "YES",
    "JPEG_MASK_BIT_ORDER": "AUTO",
    "JP2OPENJPEG_PROMOTE_1BIT_ALPHA_AS_8BIT": "YES",
    # These choose the cells or overviews that a coarser cell is made of.
    "GDAL_RASTERIO_RESAMPLING": "NEAR",
    "GDAL_NO_COSTLY_OVERVIEW": "NO",
    "GTIFF_IMPLICIT_JPEG_OVR": "YES",
    "GDAL_OVR_PROPAGATE_NODATA": "NO",
    "GDAL_WARP_USE_AFFINE_OPTIMIZATION": "YES",
    "GDAL_WARP_USE_TRANSLATION_OPTIM": "YES",
    # A locale would change what a comma in a number means.
    "GDAL_DISABLE_CPLLOCALEC": "NO",
    # Damaged XML of a side-car file would be read as far as it goes.
    "CPL_MINIXML_RELAXED": "NO",
    # These change the rasters that are written.
    "GDAL_TIFF_ENDIANNESS": "NATIVE",
    "GTIFF_WRITE_ANGULAR_PARAMS_IN_DEGREE": "NO",
    "GTIFF_WRITE_IMAGE_STRUCTURE_METADATA": "YES",
    "ESRI_XML_PAM": "NO",
    "TIFF_USE_OVR": "NO",
    # These change geometries: arcs as lines, open rings, rounding, infinite coordinates.
    "OGR_ARC_STEPSIZE": "4",
    "OGR_ARC_MAX_GAP": "0",
    "OGR_STROKE_CURVE": "FALSE",
    "OGR_GEOMETRY_ACCEPT_UNCLOSED_RING": "YES",
    "OGR_APPLY_GEOM_SET_PRECISION": "NO",
    "OGR_SHAPE_ALLOW_NON_FINITE_COORDINATES": "NO",
    "GEOMETRY_AS_COLLECTION": "NO",
    # These drop or change attributes.
    "ATTRIBUTES_SKIP": "NO",
    "GEOJSON_FLATTEN_GEOCOUCH": "NO",
    "OGR_GEOJSON_ARRAY_AS_STRING": "NO",
    "OGR_GEOJSON_DATE_AS_STRING": "NO",
    "OGR_PROMOTE_TO_INTEGER64": "NO",
    "OGR_FORCE_ASCII": "NO",
    # This changes what ``segment.where`` selects.
    "OGR_SQL_LIKE_AS_ILIKE": "FALSE",
    "OGR_SQLITE_USE_CUSTOM_LIKE": "YES",
    # These leave out layers or features.
    "OGR_TABLE_LIMIT": "10000",
    "OGR_INTERLEAVED_READING": "NO",
    "OSM_INDEX_POINTS": "YES",
    "OSM_USE_POINTS_INDEX": "YES",
    "OSM_INDEX_WAYS": "YES",
    "OSM_USE_WAYS_INDEX": "YES",
    "SQLITE_LIST_ALL_TABLES": "NO",
    "OGR_SQLITE_LIST_VIRTUAL_OGR": "NO",
    # A source is never written, as an index would be.
    "SHAPE_RESTORE_SHX": "NO",
    # These let the views of a file read other files.
    "ALLOW_OGR_SQL_FUNCTIONS_FROM_TRIGGER_AND_VIEW": "NO",
    "ALLOW_VIRTUAL_OGR_FROM_TRIGGER_AND_VIEW": "NO",
    "OGR_SQLITE_ALLOW_EXTERNAL_ACCESS": "NO",
}
"""GDAL's own values."""
WITHOUT_DEFAULT = (
    # Type of the heights of ASCII grids.
    "AAIGRID_DATATYPE",
    # Place, CRS and its axes.
    "GTIFF_SRS_SOURCE",
    "GMLJP2OVERRIDE",
    "CENTER_LONG",
    "OSR_USE_ETMERC",
    # Overviews, side-car files of another folder, and rules of numbers.
    "GDAL_OVERVIEW_OVERSAMPLING_THRESHOLD",
    "GDAL_PAM_PROXY_DIR",
    "GDAL_LOCALE",
    # Drivers, and code that they load.
    "GDAL_SKIP",
    "OGR_SKIP",
    "OGR_SQLITE_LOAD_EXTENSIONS",
    "OGR_SQLITE_PRAGMA",
    "SPATIALITESO",
    # Geometries, attributes and text of vectors.
    "OGR_ORGANIZE_POLYGONS",
    "OSM_CONFIG_FILE",
    "OSM_EXISTING_TMPFILE",
    "SHAPE_ENCODING",
    # PROJ's database and choice of grids.
    "PROJ_AUX_DB",
    "PROJ_ONLY_BEST_DEFAULT",
)
"""Options that have no neutral value: they are removed from the environment."""
NETWORK = "PROJ_NETWORK"
"""PROJ asks a server for grids, so that places depend on its answer; conda sets it in every shell."""
FOLDERS = "PROJ_LIB PROJ_DATA GDAL_DATA GDAL_DRIVER_PATH OGR_DRIVER_PATH GDAL_PYTHON_DRIVER_PATH".split()
"""Folders of data and drivers, which fit only the GDAL and PROJ with which they were installed."""
FILE = "GDAL_CONFIG_FILE"


def use_own_values(variables: MutableMapping[str, str] = os.environ) -> str:
    """Remove variables that change results from the environment, and turn off GDAL's configuration files.

    Call it before GDAL and PROJ are loaded. Folders of the environment that Python runs in stay if rasterio
    has no data of its own: conda sets them.

    - result: a line that lists the ignored settings; empty if no setting is ignored.
    """
    own = None if _has_own_data() else Path(sys.prefix).resolve()
    foreign = {name: variables[name] for name in (*DEFAULTS, *WITHOUT_DEFAULT) if name in variables}
    for name in (name for name in FOLDERS if name in variables):
        if own is None or not Path(variables[name]).resolve().is_relative_to(own):
            foreign[name] = variables[name]
    for name in foreign:
        del variables[name]
    variables.pop(NETWORK, None)
    ignored = [f"{name}={value}" for name, value in foreign.items()]
    # GDAL looks for files of its own if the variable is not set, and reads none if it is empty.
    file = variables.get(FILE)
    if file is None:
        usual = Path(variables.get("HOME", "/"), ".gdal", "gdalrc")
        ignored += [f"{usual} (avoid this with {FILE}=)"] if usual.is_file() else []
    elif file:
        ignored.append(f"{FILE}={file}")
    variables[FILE] = ""
    if not ignored:
        return ""
    listed = ", ".join(ignored)
    return f"ignored {listed}: set for the GDAL and PROJ of another program; unset it to avoid this line"


def _has_own_data() -> bool:
    """Return whether rasterio was installed with the data of its GDAL and PROJ, as wheels have them."""
    rasterio = find_spec("rasterio")
    return bool(rasterio and rasterio.origin and Path(rasterio.origin).with_name("gdal_data").is_dir())


def settle_vectors() -> None:
    """Set the options in pyogrio, which has a GDAL of its own, for this process."""
    pyogrio.set_gdal_config_options(CHOSEN | DEFAULTS)
