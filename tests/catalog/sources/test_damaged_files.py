"""Surveys with one damaged file: it is left out with a line, and the catalog has all others."""

import contextlib
import os
import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import box

from flexroad.catalog import Catalog, CatalogError
from flexroad.catalog.sources import nrw, templates
from flexroad.catalog.sources.rasters import index
from flexroad.catalog.tiling import Conversion
from tests.command_line import call
from tests.fuzz.damage import damage
from tests.make_clouds import write_cloud
from tests.make_rasters import UTM, write
from tests.make_roads import write as write_roads
from tests.permissions import permissions_enforced

SIDE = 32
"""Cells of a file along an axis, one tile."""
BAD = "4.tif"
PATTERNS = {"dsm": "dsm/*.tif", "dtm": "dtm/*.tif"}
ONES = np.ones((SIDE, SIDE), np.float32)
GEO_KEYS, PIXEL_SCALE, TIE_POINT = 34735, 33550, 33922


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A folder of 9 files of surface and 9 of terrain."""
    root = tmp_path_factory.mktemp("whole")
    heights = np.random.default_rng(0).normal(100, 3, (SIDE, SIDE)).astype(np.float32)
    for number in range(9):
        west, north = 320000 + SIDE * (number % 3), 5600000 - SIDE * (number // 3)
        for layer in ("dsm", "dtm"):
            write(root / layer / f"{number}.tif", heights, west, north)
    return root


@pytest.fixture
def survey(whole, tmp_path) -> Path:
    return shutil.copytree(whole, tmp_path / "survey")


def tag(data: bytes, number: int) -> tuple[int, int]:
    """Position of the values of a tag of a TIFF file in its first directory, and their number."""
    (directory,) = struct.unpack_from("<I", data, 4)
    (entries,) = struct.unpack_from("<H", data, directory)
    for start in range(directory + 2, directory + 2 + 12 * entries, 12):
        kind, _, count, position = struct.unpack_from("<HHII", data, start)
        if kind == number:
            return position, count
    raise KeyError(number)


def overwritten(path: Path, position: int, new: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(position)
        file.write(new)


def with_tag(path: Path, number: int, skipped: int, values: bytes) -> None:
    """Overwrite the values of a tag after the first bytes."""
    overwritten(path, tag(path.read_bytes(), number)[0] + skipped, values)


def replaced(path: Path, target: str) -> None:
    """Put a folder, or a link to a file, in the place of a file."""
    path.unlink()
    path.symlink_to(target) if target else path.mkdir()


DAMAGES = {
    "empty": (lambda path: path.write_bytes(b""), "it cannot be read: it is no GeoTIFF"),
    "truncated": (lambda path: os.truncate(path, 100), "not a raster that GDAL can read"),
    "zeros": (lambda path: overwritten(path, 0, bytes(path.stat().st_size)), "it cannot be read"),
    "header": (lambda path: overwritten(path, 4, b"\xff" * 60), "not a raster that GDAL can read"),
    "keys of zeros": (
        lambda path: with_tag(path, GEO_KEYS, 8, bytes(24)),
        "it has no CRS; give it with --crs",
    ),
    "huge cells": (
        lambda path: with_tag(path, PIXEL_SCALE, 0, struct.pack("<2d", 1e6, 1e6)),
        r"it has cells of 1e\+06 m, while most .* 1 m;",
    ),
    "tiny cells": (
        lambda path: with_tag(path, PIXEL_SCALE, 0, struct.pack("<2d", 1e-9, 1e-9)),
        "it has cells of 1e-09 x -1e-09",
    ),
    "far away": (lambda path: with_tag(path, TIE_POINT, 24, struct.pack("<d", 1e300)), "it reaches from 1e"),
    "folder": (lambda path: replaced(path, ""), "it is not a regular file"),
    "link to nothing": (lambda path: replaced(path, "gone.tif"), "it cannot be read: No such file"),
    "link to itself": (lambda path: replaced(path, BAD), "it cannot be read: Too many levels"),
    "side-car": (lambda path: path.with_name(f"{BAD}.ovr").write_bytes(b"damaged"), "it has the side-car"),
    "other zone": (
        lambda path: write(path, ONES, 1e8, 9e7, crs="EPSG:25833"),
        "in EPSG:25833 it has no position in EPSG:25832, the CRS of the dsm; "
        "correct its CRS with `gdal_edit.py -a_srs`$",
    ),
    "degrees": (
        lambda path: write(path, ONES, 1e7, 9e7, crs="EPSG:4326"),
        "it has the CRS EPSG:4326, but 10000032 is no longitude; "
        "give its CRS with --crs, or declare it with gdal_edit.py -a_srs$",
    ),
}


@pytest.mark.parametrize(("layer", "kind"), [*(("dsm", kind) for kind in DAMAGES), ("dtm", "header")])
def test_damaged_file_costs_its_own_cells(survey, layer, kind):
    make, reason = DAMAGES[kind]
    make(survey / layer / BAD)
    result = index(survey, PATTERNS, tile_size_m=SIDE)
    (line,) = result.left_out
    assert line.startswith(f"skipped {layer}/{BAD} ({layer}): ")
    assert re.search(reason, line), line
    assert files_of(result, layer) == {f"{layer}/{n}.tif" for n in range(9) if n != 4}
    other = {"dsm": "dtm", "dtm": "dsm"}[layer]
    assert files_of(result, other) == {f"{other}/{n}.tif" for n in range(9)}


def files_of(result, layer: str) -> set[str]:
    layers = (found for tile in result.tiles for found in tile.all_layers)
    return {name for found in layers if found.name == layer for name in found.files}


@pytest.mark.parametrize("seed", range(12))
def test_survey_with_a_randomly_damaged_file_has_a_catalog_of_the_others(survey, seed):
    rng = np.random.default_rng(seed)
    path = survey / ("dsm", "dtm")[seed % 2] / BAD
    whole = path.read_bytes()
    damaged = bytearray(damage(whole, rng))
    position, count = tag(whole, GEO_KEYS)
    if seed % 3 == 0 and len(damaged) == len(whole):
        damaged[position + 2 * int(rng.integers(count))] = rng.integers(256)
    path.write_bytes(damaged)
    result = index(survey, PATTERNS, tile_size_m=SIDE, conversion=Conversion(reproject=seed % 5 == 0))
    layer = path.parent.name
    assert {f"{layer}/{n}.tif" for n in range(9) if n != 4} <= files_of(result, layer)
    assert len(result.tiles) < 30


def test_vrt_is_left_out_with_the_remedy_and_a_folder_is_passed_over(survey):
    (survey / "dsm" / "old").mkdir()
    (survey / "dsm" / "more.vrt").write_text("<VRTDataset></VRTDataset>")
    result = index(survey, {**PATTERNS, "dsm": "dsm/*"}, tile_size_m=SIDE)
    (line,) = result.left_out
    assert line.startswith(
        "skipped dsm/more.vrt (dsm): it is a VRT, which only names other files; give those"
    )
    assert len(result.tiles) == 9


@contextlib.contextmanager
def forbidden(folder: Path, mode: int = 0):
    """Take all permissions of a folder away, or leave the permissions ``mode``."""
    folder.chmod(mode)
    with permissions_enforced():
        yield
    folder.chmod(0o755)


@pytest.mark.parametrize("pattern", ["dsm/*.tif", "dsm/**/*.tif", "*sm/*.tif"])
def test_file_and_folder_without_permission_are_left_out(survey, pattern):
    patterns = {**PATTERNS, "dsm": pattern}
    with forbidden(survey / "dsm" / BAD):
        result = index(survey, patterns, tile_size_m=SIDE)
    assert result.left_out == (f"skipped dsm/{BAD} (dsm): it cannot be read: Permission denied",)
    assert len(result.tiles) == 8
    with forbidden(survey / "dsm"), pytest.raises(CatalogError, match="folder dsm .* Permission denied"):
        index(survey, patterns, tile_size_m=SIDE)


@pytest.mark.parametrize(("mode", "what"), [(0o000, "folder more "), (0o600, "more/0.tif, more/1.tif ")])
def test_one_of_two_folders_without_permission_is_left_out(survey, mode, what):
    (survey / "more").mkdir()
    for number in (0, 1):
        (survey / "dsm" / f"{number}.tif").rename(survey / "more" / f"{number}.tif")
    patterns = {**PATTERNS, "dsm": "[dm][so]*/*.tif"}
    assert len(index(survey, patterns, tile_size_m=SIDE).tiles) == 9
    with forbidden(survey / "more", mode):
        result = index(survey, patterns, tile_size_m=SIDE)
    assert len(result.tiles) == 7
    (line,) = result.left_out
    assert line.startswith(f"skipped {what}")
    assert line.endswith("it cannot be read: Permission denied")


def test_damaged_file_of_roads_is_left_out(survey):
    for number in range(3):
        place = box(320000 + 40 * number, 5599900, 320020 + 40 * number, 5599990)
        write_roads(survey / f"r{number}.gpkg", [place], UTM)
    patterns = {**PATTERNS, "roads": "r*.gpkg"}
    assert not index(survey, patterns, tile_size_m=SIDE).left_out
    (survey / "r1.gpkg").write_bytes(b"SQLite format 3\0" + bytes(1000))
    write_roads(survey / "r9.gpkg", [box(0, 0, 1, 1)], UTM)
    result = index(survey, patterns, tile_size_m=SIDE)
    assert files_of(result, "roads") == {"r0.gpkg", "r2.gpkg"}
    damaged, far = result.left_out
    assert damaged.startswith(f"skipped --roads {survey / 'r1.gpkg'} is not a vector file")
    assert far.startswith(f"skipped --roads {survey / 'r9.gpkg'} reaches no tile")


def test_damaged_bridge_raster_beside_the_catalog_is_made_anew(tmp_path):
    heights = np.ones((50, 50), np.float32)
    for product in ("dom1", "dgm1"):
        write(tmp_path / f"{product}_32_356_5699_1_nw_2020.tif", heights, 356000, 5700000)
    write_cloud(tmp_path / "3dm_32_356_5699_1_nw_2020.laz", [(356001, 5699999, 100)], kind=17)
    first = nrw.index(tmp_path, tile_size_m=50, derived=tmp_path / "derived")
    (made,) = (tmp_path / "derived").iterdir()
    data = made.read_bytes()
    made.write_bytes(b"damaged")
    second = nrw.index(tmp_path, tile_size_m=50, derived=tmp_path / "derived")
    assert made.read_bytes() == data
    assert first.tiles == second.tiles


def test_scene_in_degrees_is_left_out_of_scenes_by_templates(tmp_path):
    for number, crs in enumerate((UTM, UTM, "EPSG:4326")):
        for layer in ("dsm", "dtm"):
            write(tmp_path / layer / f"{number}.tif", np.ones((9, 9), np.float32), 7, 51, crs=crs)
    layout = {"layers": {"dsm": "dsm/{tile}.tif", "dtm": "dtm/{tile}.tif"}}
    result = templates.index(tmp_path, layout, templates.GEROD)
    assert [tile.id for tile in result.tiles] == ["0", "1"]
    (line,) = result.left_out
    assert line.startswith("skipped dsm/2.tif is in EPSG:4326, whose unit is degrees")


def test_command_writes_the_catalog_of_the_other_files_with_exit_code_1(survey, tmp_path):
    out = tmp_path / "catalog.json"
    words = ("catalog", "rasters", survey, "--dsm", "dsm/*.tif", "--dtm", "dtm/*.tif", "--tile-size", SIDE)
    call(*words, "-o", out, "--strict").expected(0)
    assert len(Catalog.read(out).tiles) == 9
    before = out.read_bytes()
    overwritten(survey / "dsm" / BAD, 4, b"\xff" * 60)
    said = call(*words, "-o", out, "--strict").expected(2)
    assert said.errors == [f"error: {out} is not written, as files cannot be used and --strict is given"]
    assert out.read_bytes() == before
    said = call(*words, "-o", out).expected(1)
    assert f"warning: skipped dsm/{BAD} (dsm): not a raster that GDAL can read" in said.err
    assert "warning: the catalog lacks what was skipped; repair it, then repeat the command" in said.err
    assert len(Catalog.read(out).tiles) == 8
