"""Options of GDAL and PROJ that others set do not change a result."""

import os
import subprocess
import sys

import numpy as np
import pyogrio
import pytest
import rasterio
from shapely import LineString

from flexroad.catalog import gdal_options
from flexroad.catalog.gdal_options import DEFAULTS, FILE, FOLDERS, NETWORK, WITHOUT_DEFAULT, use_own_values
from flexroad.catalog.guard.open_vector import vector_name
from flexroad.catalog.sources.rasters import index
from flexroad.tasks.errors import TaskError
from flexroad.tasks.load import Options, load
from tests.command_line import PROCESS, call
from tests.make_rasters import damage, write
from tests.make_roads import write as write_roads


def printed(code, **variables):
    """Return what a program says that has variables of its environment."""
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, check=True)


LINE = "ignored {}: set for the GDAL and PROJ of another program; unset it to avoid this line"


def test_variables_of_other_programs_are_dropped_and_named(tmp_path):
    home = {"HOME": str(tmp_path)}
    variables = home | {"GTIFF_POINT_GEO_IGNORE": "YES", "PROJ_LIB": "/usr/share/qgis/proj", NETWORK: "ON"}
    assert use_own_values(variables) == LINE.format(
        "GTIFF_POINT_GEO_IGNORE=YES, PROJ_LIB=/usr/share/qgis/proj"
    )
    assert variables == home | {FILE: ""}
    assert use_own_values(variables) == ""


def test_configuration_files_of_gdal_are_turned_off_and_named(tmp_path):
    file = tmp_path / ".gdal" / "gdalrc"
    file.parent.mkdir()
    file.write_text("[configoptions]\nGTIFF_IGNORE_READ_ERRORS=YES\n")
    for variables, named in (
        ({}, f"{file} (avoid this with {FILE}=)"),
        ({FILE: "/etc/gdal"}, f"{FILE}=/etc/gdal"),
    ):
        variables["HOME"] = str(tmp_path)
        assert use_own_values(variables) == LINE.format(named)
        assert variables[FILE] == ""


@pytest.mark.parametrize("has_own_data", [True, False])
def test_folders_of_the_own_environment_stay_where_rasterio_has_no_data(has_own_data, monkeypatch):
    monkeypatch.setattr(gdal_options, "_has_own_data", lambda: has_own_data)
    variables = {name: f"{sys.prefix}/share/{name}" for name in FOLDERS} | {"GDAL_DATA": "/elsewhere"}
    use_own_values(variables)
    kept = set() if has_own_data else {*FOLDERS} - {"GDAL_DATA"}
    assert set(variables) == kept | {FILE}


def survey(folder):
    heights = np.add.outer(np.arange(60.0), np.arange(60.0))
    for layer in ("dsm", "dtm"):
        with rasterio.open(write(folder / f"{layer}.tif", heights), "r+") as raster:
            raster.update_tags(AREA_OR_POINT="Point")
    return heights


def test_library_reads_a_raster_where_it_lies_with_an_option_of_another_program(tmp_path):
    heights = survey(tmp_path)
    (tile,) = index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm.tif"}, tile_size_m=60).tiles
    with rasterio.Env(GTIFF_POINT_GEO_IGNORE="YES"):
        assert index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm.tif"}, tile_size_m=60).tiles == (tile,)
        np.testing.assert_array_equal(load(tile, Options()).dsm, heights)


def damaged(folder):
    """Write a survey whose DSM has a block that cannot be decoded."""
    heights = np.random.default_rng(1).random((60, 60), np.float32)
    write(folder / "dtm.tif", heights)
    damage(write(folder / "dsm.tif", heights, compress="deflate", blockysize=8), 30, 0)


def test_damaged_block_fails_though_gdal_is_told_to_ignore_errors(tmp_path):
    damaged(tmp_path)
    (tile,) = index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm.tif"}, tile_size_m=60).tiles
    with (
        rasterio.Env(GTIFF_IGNORE_READ_ERRORS="YES"),
        pytest.raises(TaskError, match=r"dsm.tif cannot be read: .*failed.; fetch it again"),
    ):
        load(tile, Options(min_valid=0.0))


def test_command_fails_a_damaged_block_whatever_environment_and_file_say(tmp_path):
    """The configuration file also tells GDAL not to look at the environment."""
    damaged(tmp_path)
    file, catalog = tmp_path / "gdalrc", tmp_path / "a.json"
    file.write_text("[directives]\nignore-env-vars=yes\n[configoptions]\nGTIFF_IGNORE_READ_ERRORS=YES\n")
    words = ("--dsm", "dsm.tif", "--dtm", "dtm.tif", "--tile-size", 60, "-o", catalog)
    call("catalog", "rasters", tmp_path, *words).expected(0)
    expected = call("catalog", "check", catalog).expected(1).out
    for more in ({"GTIFF_IGNORE_READ_ERRORS": "YES"}, {FILE: str(file)}):
        check = [*PROCESS, "catalog", "check", str(catalog)]
        ended = subprocess.run(check, env=os.environ | more, capture_output=True, text=True)
        assert (ended.returncode, ended.stdout) == (1, expected)


def test_ascii_grid_keeps_decimals_though_a_variable_wants_whole_numbers(tmp_path):
    grid = "ncols 3\nnrows 3\nxllcorner 0\nyllcorner 0\ncellsize 1\n" + "1.75 1.5 1.25\n" * 3
    (tmp_path / "a.asc").write_text(grid)
    code = (
        "import flexroad.pipeline\nfrom pathlib import Path\n"
        "from flexroad.catalog.scan.rasters import quiet\n"
        "from flexroad.catalog.guard.open_raster import open_raster\n"
        f"with quiet(), open_raster(Path({str(tmp_path / 'a.asc')!r})) as raster: print(raster.read(1)[0])"
    )
    assert printed(code, AAIGRID_DATATYPE="Int32").stdout.strip() == "[1.75 1.5  1.25]"


def test_vector_file_is_read_with_own_values_of_options(tmp_path):
    path = write_roads(tmp_path / "roads.geojson", [LineString([(7, 51), (7.1, 51)])], "EPSG:4326", w=[4.0])
    pyogrio.set_gdal_config_options({"ATTRIBUTES_SKIP": "YES"})
    try:
        assert list(pyogrio.read_dataframe(vector_name(path)).w) == [4.0]
    finally:
        pyogrio.set_gdal_config_options({"ATTRIBUTES_SKIP": None})


def test_library_warns_of_a_variable_that_it_ignores(tmp_path):
    code = "import flexroad; flexroad.run; flexroad.fit; import os; print('SHAPE_ENCODING' in os.environ)"
    ended = printed(code, SHAPE_ENCODING="latin1")
    assert ended.stdout == "False\n"
    assert ended.stderr.count("UserWarning: ignored SHAPE_ENCODING=latin1") == 1


def test_catalog_is_the_same_with_variables_of_other_programs(tmp_path):
    """The folder has a damaged proj.db, as of another version, and a damaged driver."""
    survey(tmp_path)
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "proj.db").write_bytes(b"of another version")
    (foreign / "gdal_Broken.so").write_bytes(b"no library")
    opposite = {"YES": "NO", "TRUE": "FALSE", "NO": "YES", "FALSE": "TRUE"}
    values = {name: opposite.get(value, "1") for name, value in DEFAULTS.items()}
    values |= dict.fromkeys(WITHOUT_DEFAULT, "YES") | dict.fromkeys(FOLDERS, str(foreign))
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
    listed = ", ".join(f"{name}={values[name]}" for name in (*DEFAULTS, *WITHOUT_DEFAULT, *FOLDERS))
    assert ended.stderr.splitlines() == ["warning: " + LINE.format(listed)]
    assert made[0] == made[1]
