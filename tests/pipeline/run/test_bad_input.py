"""Invalid input and arguments: each gives one clear line, and fails no more than its tile."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio
from affine import Affine
from rasterio.warp import transform_bounds

import flexroad as library
from flexroad.catalog import Catalog, Grid, Tile
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tools.synthetic import prepared
from flexroad.tools.synthetic.scenes import write_scenes
from tests import command_line
from tests.make_rasters import write

SERIAL = ("--executor", "serial")


def layer(tile: Tile, name: str) -> Path:
    return Path(tile.root) / name / f"{tile.id}.tif"


def values(tile: Tile, name: str) -> np.ndarray:
    with rasterio.open(layer(tile, name)) as raster:
        return raster.read(1)


def rewrite(tile: Tile, name: str, array, **options) -> None:
    layer(tile, name).unlink()
    options = {"west": tile.grid.west, "north": tile.grid.north, "crs": tile.grid.crs} | options
    write(layer(tile, name), array, options.pop("west"), options.pop("north"), **options)


def truncated(tile):
    path = layer(tile, "dsm")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def a_pipe(tile):
    layer(tile, "dsm").unlink()
    os.mkfifo(layer(tile, "dsm"))


def a_vrt_of_the_web(tile):
    layer(tile, "dtm").write_text(
        '<VRTDataset rasterXSize="60" rasterYSize="60"><VRTRasterBand dataType="Float32" band="1">'
        "<SimpleSource><SourceFilename>/vsicurl/http://127.0.0.1:9/a.tif</SourceFilename></SimpleSource>"
        "</VRTRasterBand></VRTDataset>"
    )


def other_crs(tile):
    west, _, _, north = transform_bounds(tile.grid.crs, "EPSG:25833", *tile.grid.bounds)
    rewrite(tile, "dtm", values(tile, "dtm"), west=west, north=north, crs="EPSG:25833")


def thin(tile):
    heights = values(tile, "dsm")
    heights[6:] = np.nan
    rewrite(tile, "dsm", heights, nodata=np.nan)


def absurd(tile):
    heights = np.full(tile.grid.shape, 1e30, np.float32)
    heights[::2], heights[:, ::3], heights[5] = -1e30, np.inf, -np.inf
    rewrite(tile, "dsm", heights)


def bare_mask(tile):
    rewrite(tile, "road_mask", np.ones((30, 30), np.uint8), crs=None, transform=Affine.identity())


def not_listed(tile):
    return replace(tile, layers=tuple(layer for layer in tile.layers if layer.name != "dtm"))


FAULTS = {
    "absent": (lambda tile: layer(tile, "dsm").unlink(), "dsm", "is missing; restore it"),
    "truncated": (truncated, "dsm", "cannot be read: .*; fetch it again"),
    "a pipe": (a_pipe, "dsm", "is not a regular file"),
    "a VRT of the web": (a_vrt_of_the_web, "dtm", "is a VRT, which only names other files"),
    "another CRS": (other_crs, "dtm", "is in EPSG:25833, the tile in EPSG:25832"),
    "in feet": (
        lambda tile: rewrite(tile, "dtm", values(tile, "dtm") / 0.3048, unit="ft"),
        "dtm",
        "has heights in metre, dtm .* in ft; convert one, or correct its unit",
    ),
    "thin": (thin, "dsm", "has 10.0% valid cells on this tile"),
    "absurd": (absurd, "dsm", "has only nodata on this tile"),
    "bare mask": (bare_mask, "road_mask", "no georeference and has 30 x 30 cells"),
    "not listed": (not_listed, "", "the tile has no dtm"),
}
"""Function that damages a tile, the layer whose file is at fault, and a part of the message.

Other faults of a raster are in `tests/tasks/io/test_mosaic.py`.
"""
COMMON = {"absent", "a pipe", "another CRS", "thin", "not listed"}
"""Faults that `catalog check` counts, in words of its own."""


def one_cell(tile):
    mask = np.zeros(tile.grid.shape, np.uint8)
    mask[30, 30] = 1
    rewrite(tile, "road_mask", mask)


def specks(tile):
    heights = values(tile, "dsm")
    heights[:3, :4] = [1e30, -1e30, np.inf, -np.inf]
    heights[5, 5] = np.nan
    rewrite(tile, "dsm", heights)


SWAPPED = (
    "the DSM is more than 1 m below the DTM in 100% of the cells and above it in 0%: are their files swapped?"
)
UNUSUAL = {
    "flat": (lambda tile: rewrite(tile, "dsm", np.full(tile.grid.shape, 100, np.float32)), SWAPPED),
    "all road": (lambda tile: rewrite(tile, "road_mask", np.ones(tile.grid.shape, np.uint8)), None),
    "one cell": (one_cell, None),
    "small mask": (lambda tile: rewrite(tile, "road_mask", np.ones((30, 20), np.uint8)), None),
    "coarse mask": (
        lambda tile: rewrite(tile, "road_mask", np.ones((6, 6), np.uint8), cell=10),
        "road_mask resampled: its cells are 10 m, the tile's 1 m",
    ),
    "specks": (specks, "dsm: 12 cells outside -500..9000 m taken as nodata"),
}
"""Valid input, and the note of the tile."""
ODD_IDS = ("Köln 1/2", "../../escape", "...", "ü/" * 33)


@pytest.fixture(scope="module")
def damaged(light_config, tmp_path_factory):
    """A run of tiles with one oddity each: the tiles by its name, the folder, and what the run said."""
    folder = tmp_path_factory.mktemp("damaged")
    causes = FAULTS | UNUSUAL
    made = Catalog.read(write_scenes(folder / "survey", len(causes) + len(ODD_IDS), seed=3, size_m=60)).tiles
    tiles = {cause: causes[cause][0](tile) or tile for cause, tile in zip(causes, made, strict=False)}
    tiles |= {odd: replace(tile, id=odd) for odd, tile in zip(ODD_IDS, made[len(causes) :], strict=True)}
    catalog = folder / "survey" / "catalog.parquet"
    Catalog(tuple(tiles.values())).write(catalog)
    before = set(folder.rglob("*"))
    words = ("--catalog", catalog, "--config", light_config, "--out", folder / "run", *SERIAL)
    said = command_line.call("run", *words).expected(1)
    new = [path for path in set(folder.rglob("*")) - before if path != folder / "run"]
    assert all(path.is_relative_to(folder / "run") for path in new)
    return tiles, folder / "run", said


def test_run_of_damaged_files_fails_their_tiles_alone(damaged, flexroad):
    tiles, out, said = damaged
    counts = f"{len(tiles) - len(FAULTS)} done (0 cached, 1 without roads), {len(FAULTS)} failed, 0 pending"
    assert counts in said.out
    rows = read_metrics(out)
    bad = rows.tile_id.isin([tiles[fault].id for fault in FAULTS])
    assert set(rows[bad].status) == {"failed"}
    assert rows[bad].triangles.isna().all()
    assert set(rows[~bad].status) == {"done"}
    failures = pd.read_csv(out / "failures.csv", keep_default_na=False)
    status = json.loads(flexroad("status", out, "--json").out)
    assert [failure["message"] for failure in status["failures"]] == list(failures.message)
    shown = flexroad("status", out).expected(0).out
    assert all(line.removeprefix("failed ") in shown for line in said.errors)


@pytest.fixture(scope="module")
def checked(damaged, light_config):
    """The warnings of `catalog check` for the same tiles, which it names five at a time."""
    warnings, causes = [], [*FAULTS]
    path = damaged[1].parent / "survey" / "part.parquet"
    for start in range(0, len(causes), 5):
        Catalog(tuple(damaged[0][cause] for cause in causes[start : start + 5])).write(path)
        said = command_line.call("catalog", "check", path, "--config", light_config).expected(1)
        # Files of the other tiles are listed, too.
        told = [line for line in said.out.splitlines() if line.startswith("warning: ")]
        warnings += [line for line in told if "(0 tiles)" not in line]
    return warnings


@pytest.mark.parametrize("fault", FAULTS)
def test_file_at_fault_is_named_by_run_and_check(fault, damaged, checked):
    tiles, out, said = damaged
    tile, (_, name, message) = tiles[fault], FAULTS[fault]
    failures = pd.read_csv(out / "failures.csv", keep_default_na=False).set_index("tile_id")
    row = failures.loc[tile.id]
    file = str(layer(tile, name)) if name else ""
    assert (row.stage, row.kind, row.file) == ("load", "TaskError", file)
    assert re.search(message, row.message)
    end = f"  [{file}]" if file else ""
    assert f"failed {tile.id}: load: TaskError: {row.message}{end}" in said.errors
    (warning,) = (line for line in checked if tile.id in line)
    if fault not in COMMON:
        assert warning == f"warning: {tile.id} would fail: {row.message}"


@pytest.mark.parametrize("change", UNUSUAL)
def test_unusual_input_gives_finite_metrics(change, damaged):
    tiles, out, _ = damaged
    tile, (_, note) = tiles[change], UNUSUAL[change]
    rows = read_metrics(out).set_index(["tile_id", "variant"])
    found = rows.loc[tile.id, "flexroad"]
    assert found.l2_terrain_m < 1
    assert found.triangles > 50
    item = json.loads((out / "tiles" / tile.id / "item.json").read_text())
    notes = item["properties"]["flexroad:notes"]
    assert notes == ([note] if note else [])


def test_tile_id_invalid_as_file_name_gets_safe_folder(damaged, flexroad):
    tiles, out, _ = damaged
    folders = list((out / "tiles").iterdir())
    assert len(folders) == len(tiles)
    for folder in folders:
        assert all(path.is_file() for path in folder.iterdir())
    for odd in ODD_IDS:
        assert "nothing had changed" in flexroad("rerun", out, "--tile", odd, *SERIAL).out


def plane(easting, northing):
    return 100 + 0.05 * (easting - 500_000) - 0.02 * (northing - 5_600_000)


def tilted_ground(folder: Path, grid: Grid) -> Path:
    """Write a tile of a plane; return its catalog."""
    heights = plane(grid.eastings[None, :], grid.northings[:, None])
    road = np.zeros(grid.shape, bool)
    road[grid.height // 4 : grid.height // 2 + 1] = True
    tile = prepared.write_tile(folder, "a", grid, {"dsm": heights, "dtm": heights, "road_mask": road})
    Catalog((tile,)).write(folder / "catalog.json")
    return folder / "catalog.json"


@pytest.mark.parametrize("cell", [0.5, 2.0])
def test_other_cell_size_gives_correct_heights(cell, flexroad, quick_config, tmp_path):
    grid = Grid("EPSG:25832", 500_000, 5_600_040, cell, int(40 / cell), int(40 / cell))
    words = ("--catalog", tilted_ground(tmp_path / "folder", grid), "--config", quick_config)
    flexroad("run", *words, "--out", tmp_path / "run", *SERIAL).expected(0)
    rows = read_metrics(tmp_path / "run").set_index("variant")
    assert rows.triangles["rgt"] == 2 * np.ceil(40 - cell) ** 2
    assert (rows.l2_road_m < 0.05).all()
    assert (rows.completeness > 0.99).all()
    x, y = np.array([500020.0, 500010.0]), np.array([5600020.0, 5600030.0])
    np.testing.assert_allclose(library.open_run(tmp_path / "run").height(x, y), plane(x, y), atol=0.1)


def test_tile_of_2_by_2_cells_fails_only_nurbs(flexroad, tmp_path):
    catalog = tilted_ground(tmp_path / "tiny", Grid("EPSG:25832", 500_000, 5_600_002, 1.0, 2, 2))
    words = ("run", "--catalog", catalog, *SERIAL, "--out")
    said = flexroad(*words, tmp_path / "run", "--config", "paper").expected(1)
    (line,) = said.errors
    assert line.startswith("failed a: fit: TaskError: 2 x 2 cells are fewer than 35 x 35 control points; ")
    rows = read_metrics(tmp_path / "run").set_index("variant")
    assert dict(rows.status) == {"plane": "done", "rgt": "done", "flexroad": "failed"}
    config = tmp_path / "linear.yaml"
    config.write_text(
        "extends: defaults\nfit: {degree: 1, control_points: [2, 2]}\necsrc: {min_area_m2: 0}\n"
    )
    flexroad(*words, tmp_path / "linear", "--config", config).expected(0)


# --- arguments ----------------------------------------------------------------------------------------


def test_setting_without_a_name_is_shown_in_production(flexroad):
    said = flexroad("config", "show", "--set", "fit.spacing_m=5").expected(0)
    production = flexroad("config", "show", "production").out
    assert said.out == production.replace("spacing_m: 3.6", "spacing_m: 5.0") != production


def test_relative_paths_work_from_other_folder(flexroad, survey, quick_config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("--catalog", "survey/catalog.parquet", "--out", "my runs/1", "--store", "shared", *SERIAL)
    said = flexroad("run", "--config", "quick.yaml", *words).expected(0)
    assert "next: flexroad report 'my runs/1' --format html" in said.out
    (tmp_path / "away").mkdir()
    monkeypatch.chdir(tmp_path / "away")
    again = flexroad("rerun", "../my runs/1", "--from", "sample", *SERIAL)
    assert "4 done (0 cached)" in again.out
    assert not list((tmp_path / "away").iterdir())


RASTERS = "catalog rasters SURVEY --dsm dsm/* --dtm dtm/* -o"


@pytest.fixture(scope="module")
def argument_paths(made_survey, light_run, tmp_path_factory):
    """Paths by their placeholder in the tested commands."""
    folder = tmp_path_factory.mktemp("slips")
    (folder / "p.csv").write_text("a,b\n1,2\n")
    names = {"CSV": "p.csv", "CSV/x.json": "p.csv/x.json", "X": "x", "X.json": "x.json", "X.txt": "x.txt"}
    return {"RUN": light_run.path, "SURVEY": made_survey} | {key: folder / names[key] for key in names}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("stat RUN", "No such command 'stat'"),
        ("status", "Missing argument 'RUN'"),
        ("status nowhere", "nowhere is no run"),
        ("status SURVEY", "is no run"),
        ("query RUN --points RUN", "not readable as a table of points: Is a directory"),
        ("query RUN --points nowhere.csv", "No such file"),
        ("query RUN --points CSV", "no columns of coordinates; it needs easting and northing"),
        ("report RUN --format pdf", "'pdf'"),
        ("rerun RUN --tile x", "no tile 'x' in the catalog; did you mean"),
        ("rerun RUN --from evaluation", "'evaluation'"),
        ("run --config paper --catalog SURVEY --out X", "is a folder; name its file"),
        ("run --config paper --catalog CSV --out X", "is not a FlexRoad catalog"),
        ("catalog rasters SURVEY --dsm dsm/*.tiff --dtm dtm/* -o X.json", "no file matches --dsm"),
        ("catalog rasters SURVEY --dsm /nowhere/* --dtm dtm/* -o X.json", "no file matches --dsm"),
        ("catalog rasters nowhere --dsm dsm/* --dtm dtm/* -o X.json", "does not exist"),
        (f"{RASTERS} X.txt --tile-size 60", "ends in .parquet, .json"),
        (f"{RASTERS} X.json --tile-size 0", ""),
        (f"{RASTERS} X.json --tile-size -5", ""),
        (f"{RASTERS} X.json --tile-size nan", ""),
        (f"{RASTERS} X.json --tile-size inf", ""),
        (f"{RASTERS} X.json --tile-size 33.3", ""),
        (f"{RASTERS} CSV/x.json --tile-size 60", "p.csv"),
        ("catalog synthetic -o CSV", "p.csv"),
    ],
)
def test_invalid_arguments_give_one_error(command, message, argument_paths, flexroad):
    said = flexroad(*[argument_paths.get(word, word) for word in command.split()]).expected(2)
    assert message in said.err
    assert len([line for line in said.err.splitlines() if "rror: " in line]) == 1


# --- pipes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "segment", "code"), [("dsm", "mask", 1), ("roads", "vector", 2)])
def test_pipe_is_not_waited_for_with_checksum(name, segment, code, flexroad, survey, light_config, tmp_path):
    """The file with roads is a file of all tiles: then the run stops before the first one."""
    tile = Catalog.read(survey).tiles[0]
    path = tile.paths(tile.layer(name))[0]
    path.unlink()
    os.mkfifo(path)
    words = ("--catalog", survey, "--config", light_config, "--set", f"segment={segment}", "--checksum")
    said = flexroad("run", *words, "--out", tmp_path / "run", *SERIAL).expected(code)
    assert "is not a regular file; replace it by one" in said.errors[0]


def test_catalog_or_run_that_is_a_pipe_is_refused(flexroad, own_run, light_config, tmp_path):
    pipe = tmp_path / "catalog.json"
    os.mkfifo(pipe)
    said = flexroad("run", "--catalog", pipe, "--config", light_config, "--out", tmp_path / "new")
    assert "not a regular file" in said.expected(2).err
    for name in ("config.yaml", "catalog.parquet", "run.json"):
        file = own_run.path / name
        kept = file.rename(tmp_path / name)
        os.mkfifo(file)
        assert "not a regular file" in flexroad("status", own_run.path).expected(2).err
        kept.replace(file)
