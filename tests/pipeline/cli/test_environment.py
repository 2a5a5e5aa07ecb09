"""Variables that other programs set for their GDAL and PROJ do not change a result."""

import os
import subprocess
import sys

import numpy as np
import pytest
import rasterio

from flexroad.catalog.sources.rasters import index
from flexroad.pipeline.cli import environment
from flexroad.pipeline.cli.environment import FOLDERS, PLACES, drop_foreign
from flexroad.tasks.load import Options, load
from tests.command_line import PROCESS
from tests.make_rasters import write

LINE = "ignored {}: set for the GDAL and PROJ of another program; unset it to avoid this line"


def test_variables_of_other_programs_are_dropped_and_named():
    variables = {"HOME": "/root", "GTIFF_POINT_GEO_IGNORE": "YES", "PROJ_LIB": "/usr/share/qgis/proj"}
    assert drop_foreign(variables) == LINE.format("GTIFF_POINT_GEO_IGNORE=YES, PROJ_LIB=/usr/share/qgis/proj")
    assert variables == {"HOME": "/root"}
    assert drop_foreign(variables) == ""


@pytest.mark.parametrize("has_own_data", [True, False])
def test_folders_of_the_own_environment_stay_where_rasterio_has_no_data(has_own_data, monkeypatch):
    monkeypatch.setattr(environment, "_has_own_data", lambda: has_own_data)
    variables = {name: f"{sys.prefix}/share/{name}" for name in FOLDERS} | {"GDAL_DATA": "/elsewhere"}
    drop_foreign(variables)
    kept = set() if has_own_data else {*FOLDERS} - {"GDAL_DATA"}
    assert set(variables) == kept


def test_library_reads_a_raster_where_it_lies_with_an_option_of_another_program(tmp_path):
    heights = np.add.outer(np.arange(60.0), np.arange(60.0))
    for layer in ("dsm", "dtm"):
        with rasterio.open(write(tmp_path / f"{layer}.tif", heights), "r+") as raster:
            raster.update_tags(AREA_OR_POINT="Point")
    (tile,) = index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm.tif"}, tile_size_m=60).tiles
    with rasterio.Env(GTIFF_POINT_GEO_IGNORE="YES"):
        assert index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm.tif"}, tile_size_m=60).tiles == (tile,)
        np.testing.assert_array_equal(load(tile, Options()).dsm, heights)


def test_catalog_is_the_same_with_variables_of_other_programs(tmp_path):
    """The folder has a damaged proj.db, as of another version, and a damaged driver."""
    heights = np.add.outer(np.arange(60.0), np.arange(60.0))
    for layer in ("dsm", "dtm"):
        with rasterio.open(write(tmp_path / f"{layer}.tif", heights), "r+") as raster:
            raster.update_tags(AREA_OR_POINT="Point")
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "proj.db").write_bytes(b"of another version")
    (foreign / "gdal_Broken.so").write_bytes(b"no library")
    values = dict.fromkeys(FOLDERS, str(foreign)) | dict.fromkeys(PLACES, "YES")
    values |= {"GDAL_GEOREF_SOURCES": "NONE", "GTIFF_SRS_SOURCE": "GEOKEYS"}
    made = []
    for variables in ({}, values):
        clean = {key: value for key, value in os.environ.items() if key not in values}
        out = tmp_path / f"{len(made)}.json"
        words = ["catalog", "rasters", str(tmp_path), "--dsm", "dsm.tif", "--dtm", "dtm.tif"]
        words += ["--tile-size", "30", "--date", "2025-03-01", "-o", str(out)]
        ended = subprocess.run(
            [*PROCESS, *words], env=clean | variables, capture_output=True, text=True, check=True
        )
        made.append(out.read_bytes())
    listed = ", ".join(f"{name}={values[name]}" for name in (*PLACES, *FOLDERS))
    assert ended.stderr.splitlines() == ["warning: " + LINE.format(listed)]
    assert made[0] == made[1]
