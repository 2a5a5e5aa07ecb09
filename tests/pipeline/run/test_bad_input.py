"""Invalid input, disks and arguments: each gives one clear line, and fails no more than its tile."""

import io
import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio
from affine import Affine
from rasterio.warp import transform_bounds

from flexroad.catalog import Catalog, Grid, Tile
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tools.synthetic import prepared
from tests.command_line import PROCESS, Said, error_lines
from tests.conftest import QUICK
from tests.make_rasters import write


@pytest.fixture
def run(flexroad, survey, quick_config, tmp_path):
    """Run the survey, by default with the quick configuration into ``tmp_path/run``."""

    def call(*arguments, config=quick_config, catalog=survey, out=tmp_path / "run") -> Said:
        return flexroad(
            "run", "--config", config, "--catalog", catalog, "--out", out, "--executor", "serial", *arguments
        )

    return call


def layer(tile: Tile, name: str) -> Path:
    """Return the first file of a layer."""
    files = tile.layer(name)
    assert files is not None
    return tile.paths(files)[0]


def values(path: Path) -> np.ndarray:
    with rasterio.open(path) as raster:
        return raster.read(1)


def rewrite(tile: Tile, name: str, array, **options) -> None:
    path = layer(tile, name)
    path.unlink()
    options = {"west": tile.grid.west, "north": tile.grid.north, "crs": tile.grid.crs} | options
    write(path, array, options.pop("west"), options.pop("north"), **options)


# --- one tile's input ---------------------------------------------------------------------------------


def _absent(tile: Tile) -> None:
    layer(tile, "dsm").unlink()


def _zero_bytes(tile: Tile) -> None:
    layer(tile, "dtm").write_bytes(b"")


def _truncated(tile: Tile) -> None:
    path = layer(tile, "dsm")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _a_folder(tile: Tile) -> None:
    layer(tile, "dsm").unlink()
    layer(tile, "dsm").mkdir()


def _a_pipe(tile: Tile) -> None:
    layer(tile, "dsm").unlink()
    os.mkfifo(layer(tile, "dsm"))


def _a_vrt_of_the_web(tile: Tile) -> None:
    layer(tile, "dtm").write_text(
        '<VRTDataset rasterXSize="60" rasterYSize="60"><VRTRasterBand dataType="Float32" band="1">'
        "<SimpleSource><SourceFilename>/vsicurl/http://127.0.0.1:9/a.tif</SourceFilename></SimpleSource>"
        "</VRTRasterBand></VRTDataset>"
    )


def _a_text(tile: Tile) -> None:
    layer(tile, "road_mask").write_text("<html>404 Not Found</html>")


def _elsewhere(tile: Tile) -> None:
    rewrite(tile, "dsm", values(layer(tile, "dsm")), west=tile.grid.west + 10_000)


def _other_crs(tile: Tile) -> None:
    west, _, _, north = transform_bounds(tile.grid.crs, "EPSG:25833", *tile.grid.bounds)
    rewrite(tile, "dtm", values(layer(tile, "dtm")), west=west, north=north, crs="EPSG:25833")


def _in_feet(tile: Tile) -> None:
    rewrite(tile, "dtm", values(layer(tile, "dtm")) / 0.3048, unit="ft")


def _in_fathoms(tile: Tile) -> None:
    rewrite(tile, "dsm", values(layer(tile, "dsm")), unit="fathom")


def _void(tile: Tile) -> None:
    rewrite(tile, "dsm", np.full(tile.grid.shape, np.nan, np.float32), nodata=np.nan)


def _thin(tile: Tile) -> None:
    heights = values(layer(tile, "dsm"))
    heights[6:] = np.nan
    rewrite(tile, "dsm", heights, nodata=np.nan)


def _absurd(tile: Tile) -> None:
    heights = np.full(tile.grid.shape, 1e30, np.float32)
    heights[::2], heights[:, ::3], heights[5] = -1e30, np.inf, -np.inf
    rewrite(tile, "dsm", heights)


def _bare_mask(tile: Tile) -> None:
    rewrite(tile, "road_mask", np.ones((30, 30), np.uint8), crs=None, transform=Affine.identity())


def _rotated(tile: Tile) -> None:
    turned = Affine.translation(tile.grid.west, tile.grid.north) @ Affine.rotation(30) @ Affine.scale(1, -1)
    rewrite(tile, "dsm", values(layer(tile, "dsm")), transform=turned)


@dataclass(frozen=True)
class Fault:
    damage: object
    name: str
    """The layer whose file is at fault."""
    message: str
    stage: str = "load"
    kind: str = "TaskError"


FAULTS = (
    Fault(_absent, "dsm", "is missing; restore it or build the catalog again"),
    Fault(_zero_bytes, "dtm", "cannot be read: .*; fetch it again"),
    Fault(_truncated, "dsm", "cannot be read: .*; fetch it again"),
    Fault(_a_folder, "dsm", "is not a regular file; replace it by one"),
    Fault(_a_pipe, "dsm", "is not a regular file; replace it by one"),
    Fault(_a_vrt_of_the_web, "dtm", "is a VRT, which only names other files"),
    Fault(_a_text, "road_mask", "cannot be read: .*; fetch it again"),
    Fault(_elsewhere, "dsm", "does not reach the tile now: it lies at .*; build the catalog again"),
    Fault(_other_crs, "dtm", "is in EPSG:25833, the tile in EPSG:25832; .*gdalwarp -t_srs EPSG:25832"),
    Fault(_in_feet, "dtm", "has heights in metre, dtm .* in ft; convert one, or correct its unit"),
    Fault(_in_fathoms, "dsm", "has the unit 'fathom', which is not a supported unit of height; convert it"),
    Fault(_void, "dsm", "has only nodata on this tile; leave the tile out"),
    Fault(_thin, "dsm", r"has 10.0% valid cells on this tile, below 25%; lower load.min_valid"),
    Fault(_absurd, "dsm", "has only nodata on this tile; leave the tile out"),
    Fault(_bare_mask, "road_mask", "no georeference and has 30 x 30 cells, the tile 60 x 60; give it"),
    Fault(_rotated, "dsm", "is rotated; turn it north up with gdalwarp"),
)


OTHERWISE = {
    _absent: "missing: FILE (1 tile); restore it or build the catalog again",
    _a_folder: "not a regular file: FILE (1 tile); replace it by one",
    _a_pipe: "not a regular file: FILE (1 tile); replace it by one",
    _other_crs: "1 of 4 tiles would fail: dtm is in EPSG:25833, not EPSG:25832; reproject it, or make the "
    "catalog with --reproject: TILE",
    _thin: "1 of 4 tiles would fail: a DSM height in less than 25% of the cells (load.min_valid): TILE",
}
"""What `catalog check` says where it does not say what the run does."""


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.damage.__name__.lstrip("_"))
def test_load_broken_file_fails_only_its_tile_and_is_named_by_the_check(
    fault, run, flexroad, survey, quick_config, tmp_path
):
    tile = Catalog.read(survey).tiles[1]
    fault.damage(tile)
    file = str(layer(tile, fault.name))
    check = flexroad("catalog", "check", survey, "--config", quick_config).expected(1)
    (line,) = (line for line in check.out.splitlines() if line.startswith("warning: "))
    if expected := OTHERWISE.get(fault.damage):
        assert line == "warning: " + expected.replace("FILE", file).replace("TILE", tile.id)
    else:
        assert re.search(f"^warning: {tile.id} would fail: .*{fault.message}", line)
        assert f"{fault.name}/{tile.id}.tif" in line
    assert_only_tile_failed(run(), tile, fault, flexroad, tmp_path / "run", file)


def assert_only_tile_failed(result: Said, tile: Tile, fault: Fault, flexroad, out: Path, file: str) -> None:
    assert result.code == 1
    (line,) = result.errors
    assert line.startswith(f"failed {tile.id}: {fault.stage}: {fault.kind}: ")
    assert re.search(fault.message, line)
    assert line.endswith(f"  [{file}]" if file else line[-1])
    assert "3 done (0 cached), 1 failed, 0 pending" in result.out

    rows = read_metrics(out)
    bad = rows[rows.tile_id == tile.id]
    assert list(bad.status) == ["failed"] * 3
    assert set(rows[rows.tile_id != tile.id].status) == {"done"}
    assert bad.error.str.contains(fault.message).all()
    assert bad.triangles.isna().all()
    (row,) = pd.read_csv(out / "failures.csv", keep_default_na=False).to_dict("records")
    assert (row["tile_id"], row["stage"], row["kind"], row["file"]) == (
        tile.id, fault.stage, fault.kind, file,
    )  # fmt: skip
    status = json.loads(flexroad("status", out, "--json").out)
    assert (status["done"], status["failed"]) == (3, 1)
    assert [failure["message"] for failure in status["failures"]] == [row["message"]]
    text = flexroad("status", out)
    assert text.code == 0
    assert line.removeprefix("failed ") in text.out


@pytest.mark.parametrize("name", ["dsm", "road_mask"])
def test_truncated_file_fails_only_its_tile_of_several_that_list_it(name, run, flexroad, survey, tmp_path):
    """A catalog of rasters lists the neighbouring files for each tile, for use with a halo."""
    catalog = survey.parent / "cut.json"
    arguments = ["--road-mask", "road_mask/*.tif", "--tile-size", 60, "-o", catalog]
    flexroad("catalog", "rasters", survey.parent, "--dsm", "dsm/*.tif", "--dtm", "dtm/*.tif", *arguments)
    first = Catalog.read(catalog).tiles[0]
    assert len(first.layer(name).files) == 4
    path = survey.parent / name / f"{first.id}.tif"
    path.write_bytes(path.read_bytes()[:300])
    fault = Fault(None, name, f"{name} {name}/{first.id}.tif cannot be read: .*; fetch it again")
    assert_only_tile_failed(run(catalog=catalog), first, fault, flexroad, tmp_path / "run", str(path))
    halo = tmp_path / "halo.yaml"
    halo.write_text("extends: defaults\nload: {halo_m: 20}\nfit: {control_points: [8, 8], iterations: 3}\n")
    result = run(catalog=catalog, config=halo)
    assert [line.split(":")[0] for line in result.errors] == [f"failed {first.id}"]
    other = Catalog.read(catalog).tiles[3].id
    item = json.loads((tmp_path / "run" / "tiles" / other / "item.json").read_text())
    (note,) = item["properties"]["flexroad:notes"]
    line = f"a file that the tile does not need was left out: {name} {name}/{first.id}.tif cannot be read"
    assert note.startswith(line)


@pytest.mark.parametrize(
    ("name", "stage", "message"),
    [
        ("dsm", "load", "the tile has no dsm; give its files to `flexroad catalog` with --dsm"),
        ("dtm", "load", "the tile has no dtm; give its files to `flexroad catalog` with --dtm"),
    ],
)
def test_tile_without_layer_fails_alone(name, stage, message, run, flexroad, survey, tmp_path):
    tiles = list(Catalog.read(survey).tiles)
    tiles[1] = replace(tiles[1], layers=tuple(layer for layer in tiles[1].layers if layer.name != name))
    Catalog(tuple(tiles)).write(survey)
    fault = Fault(None, name, message, stage)
    assert_only_tile_failed(run(), tiles[1], fault, flexroad, tmp_path / "run", "")


# --- unusual but valid input --------------------------------------------------------------------------


def _flat(tile: Tile) -> None:
    rewrite(tile, "dsm", np.full(tile.grid.shape, 100, np.float32))


def _above(tile: Tile) -> None:
    rewrite(tile, "dsm", values(layer(tile, "dtm")) + np.float32(47))


def _all_road(tile: Tile) -> None:
    rewrite(tile, "road_mask", np.ones(tile.grid.shape, np.uint8))


def _one_cell(tile: Tile) -> None:
    mask = np.zeros(tile.grid.shape, np.uint8)
    mask[30, 30] = 1
    rewrite(tile, "road_mask", mask)


def _small_mask(tile: Tile) -> None:
    rewrite(tile, "road_mask", np.ones((30, 20), np.uint8))


def _coarse_mask(tile: Tile) -> None:
    rewrite(tile, "road_mask", np.ones((6, 6), np.uint8), cell=10)


def _specks(tile: Tile) -> None:
    heights = values(layer(tile, "dsm"))
    heights[:3, :4] = [1e30, -1e30, np.inf, -np.inf]
    heights[5, 5] = np.nan
    rewrite(tile, "dsm", heights)


@pytest.mark.parametrize(
    ("damage", "note"),
    [
        (
            _flat,
            "the DSM is more than 1 m below the DTM in 100% of the cells and above it in 0%: are their files "
            "swapped?",
        ),
        (_above, "the DSM lies 47.0 m above the DTM: ellipsoidal heights?"),
        (_all_road, None),
        (_one_cell, None),
        (_small_mask, None),
        (_coarse_mask, "road_mask resampled: its cells are 10 m, the tile's 1 m"),
        (_specks, "dsm: 12 cells outside -500..9000 m taken as nodata"),
    ],
)
def test_unusual_input_gives_finite_metrics(damage, note, run, survey, tmp_path):
    tile = Catalog.read(survey).tiles[1]
    damage(tile)
    result = run("--tile", tile.id)
    # The filter drops a road of one cell.
    said = result.err.removeprefix("starting: 1 tile\n")
    warning = {
        _one_cell: "warning: no tile of this run has a road",
        _above: "warning: the DSM lies 47.0 m above the DTM on 1 of 1 tile: ellipsoidal heights? ",
    }.get(damage, "")
    assert (result.code, said[: len(warning) or None]) == (0, warning)
    rows = read_metrics(tmp_path / "run")
    assert set(rows.status) == {"done"}
    flexroad = rows[rows.variant == "flexroad"].iloc[0]
    assert flexroad.l2_terrain_m < 1
    assert flexroad.triangles > 50
    item = json.loads((tmp_path / "run" / "tiles" / tile.id / "item.json").read_text())
    assert item["properties"]["flexroad:notes"] == ([note] if note else [])


@pytest.mark.parametrize("cell", [0.5, 2.0])
def test_other_cell_size_gives_correct_heights(cell, run, flexroad, tmp_path):
    grid = Grid("EPSG:25832", 500_000, 5_600_040, cell, int(40 / cell), int(40 / cell))
    catalog = tilted_ground(tmp_path / "folder", "a", grid)
    result = run(catalog=catalog)
    assert (result.code, result.errors) == (0, [])
    rows = read_metrics(tmp_path / "run").set_index("variant")
    assert rows.triangles["rgt"] == 2 * np.ceil(40 - cell) ** 2
    assert (rows.l2_road_m < 0.05).all()
    assert (rows.completeness > 0.99).all()
    points = tmp_path / "points.csv"
    points.write_text("easting,northing\n500020,5600020\n500010,5600030\n")
    answer = flexroad("query", tmp_path / "run", "--points", points).out.splitlines()
    for line in answer[1:]:
        easting, northing, height, *_ = map(float, line.split(",")[:3])
        assert height == pytest.approx(plane(easting, northing), abs=0.1)


def plane(easting, northing):
    return 100 + 0.05 * (easting - 500_000) - 0.02 * (northing - 5_600_000)


def tilted_ground(folder: Path, tile_id: str, grid: Grid) -> Path:
    """Write a tile of a plane; return its catalog."""
    heights = plane(grid.eastings[None, :], grid.northings[:, None])
    road = np.zeros(grid.shape, bool)
    road[grid.height // 4 : grid.height // 2 + 1] = True
    tile = prepared.write_tile(folder, tile_id, grid, {"dsm": heights, "dtm": heights, "road_mask": road})
    Catalog((tile,)).write(folder / "catalog.json")
    return folder / "catalog.json"


def test_tile_of_2_by_2_cells_fails_only_nurbs(run, tmp_path):
    catalog = tilted_ground(tmp_path / "tiny", "tiny", Grid("EPSG:25832", 500_000, 5_600_002, 1.0, 2, 2))
    result = run(catalog=catalog, config="paper")
    assert result.code == 1
    (line,) = result.errors
    assert line == (
        "failed tiny: fit: TaskError: 2 x 2 cells are fewer than 35 x 35 control points; "
        "lower fit.control_points or raise fit.spacing_m"
    )
    rows = read_metrics(tmp_path / "run").set_index("variant")
    assert dict(rows.status) == {"plane": "done", "rgt": "done", "flexroad": "failed"}
    config = tmp_path / "linear.yaml"
    config.write_text(
        "extends: defaults\nfit: {degree: 1, control_points: [2, 2]}\necsrc: {min_area_m2: 0}\n"
    )
    assert run(catalog=catalog, config=config, out=tmp_path / "linear").code == 0


@pytest.mark.parametrize("tile_id", ["Köln 1/2", "../../escape", "..."])
def test_tile_id_invalid_as_file_name_gets_safe_folder(tile_id, run, flexroad, survey, tmp_path):
    first, *_ = Catalog.read(survey).tiles
    Catalog((replace(first, id=tile_id),)).write(survey)
    before = {path for path in tmp_path.rglob("*") if "run" not in path.parts}
    result = run()
    assert (result.code, result.errors) == (0, [])
    assert {path for path in tmp_path.rglob("*") if tmp_path / "run" not in (path, *path.parents)} == before
    (folder,) = (tmp_path / "run" / "tiles").iterdir()
    assert len(list(folder.iterdir())) == 7
    assert all(path.is_file() for path in folder.iterdir())
    assert list(read_metrics(tmp_path / "run").tile_id.unique()) == [tile_id]
    again = flexroad("rerun", tmp_path / "run", "--tile", tile_id, "--executor", "serial")
    assert "nothing had changed" in again.out


def test_tile_given_twice_is_processed_once(run, survey, tmp_path):
    tile = Catalog.read(survey).tiles[2].id
    result = run("--tile", tile, tile, "--tile", tile)
    assert result.code == 0
    assert len(read_metrics(tmp_path / "run")) == 3


# --- configurations -----------------------------------------------------------------------------------

DEEP = "{a: " * 2000 + "1" + "}" * 2000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fit: {degre: 3}", "fit.degre: unknown key; did you mean degree?"),
        ("fitt: {degree: 3}", "fitt: unknown key; did you mean fit?"),
        ("variants: {a: {smple: uniform}}", "variants.a.smple: unknown key; did you mean sample?"),
        ("fit: {degree: 35}", "fit.degree: input should be less than or equal"),
        (
            "fit: {method: nurbs, degree: 5, control_points: [5, 9]}",
            "degree 5 needs more control points each way than 5 x 9",
        ),
        (
            "fit: {method: nurbs, learning_rate: .inf}",
            "fit.learning_rate: input should be a finite number, not inf",
        ),
        ("fit: bspline", "fit: there is no method 'bspline'"),
        ("fit:\n\tdegree: 3", "not readable as YAML: .*line 2"),
        ("- a", "expected a mapping of stages to options, but it is a list"),
        ("variants: [a, b]", "variants: expected a mapping, not ['a', 'b']"),
        ("load: 3", "load: expected a mapping of options, not 3"),
        ("variants: {a/b: {}}", "variants.a/b: the name is part of file names; use letters, digits, - and _"),
        ("export: {variants: []}", "export.variants: tuple should have at least 1 item"),
        ("export: {variants: [b]}\nvariants: {a: {}}", "export.variants: no variant 'b', only a"),
        ("extends: bad.yaml", "extends: the file extends itself"),
        ("extends: [a]", "extends: expected a file or a shipped name, not ['a']"),
        ("extends: papr", "did you mean paper?"),
        (DEEP, "not readable as YAML"),
    ],
    ids=lambda value: value[:30],
)
def test_invalid_configuration_creates_no_run(text, message, run, tmp_path):
    config = tmp_path / "bad.yaml"
    config.write_text(text + "\n")
    result = run(config=config)
    assert result.code == 2
    (line,) = result.errors
    assert str(config) in line or "papr" in line
    assert re.search(message if "*" in message else re.escape(message), line)
    assert not (tmp_path / "run").exists()


def test_empty_configuration_is_production(flexroad, tmp_path):
    (tmp_path / "empty.yaml").write_text("")
    result = flexroad("config", "show", tmp_path / "empty.yaml")
    assert (result.code, result.errors) == (0, [])
    assert result.out == flexroad("config", "show", "production").out
    assert "method: smoothing_spline" in result.out


def test_setting_without_a_name_is_shown_in_production(flexroad):
    result = flexroad("config", "show", "--set", "fit.spacing_m=5").expected(0)
    production = flexroad("config", "show", "production").out
    assert result.out == production.replace("spacing_m: 3.6", "spacing_m: 5.0") != production


def test_extends_path_is_relative_to_file(flexroad, tmp_path):
    (tmp_path / "parent.yaml").write_text("fit: {degree: 4}\n")
    (tmp_path / "child.yaml").write_text("extends: parent.yaml\n")
    assert "degree: 4" in flexroad("config", "show", tmp_path / "child.yaml").out


@pytest.mark.parametrize("fit", ["{control_points: [100000, 100000]}", "{spacing_m: 1.0e-9}"])
def test_too_many_control_points_fail_each_tile(fit, run, survey, tmp_path):
    config = tmp_path / "huge.yaml"
    config.write_text(f"extends: defaults\nfit: {fit}\n")
    result = run(config=config)
    assert result.code == 1
    assert [line.split(": ")[0] for line in result.errors] == [
        f"failed {tile.id}" for tile in Catalog.read(survey).tiles
    ]
    assert all("60 x 60 cells are fewer than" in line for line in result.errors)


def test_second_configuration_replaces_rows_of_first(run, flexroad, quick_config, tmp_path):
    other = tmp_path / "other.yaml"
    other.write_text(
        "extends: defaults\nfit: {control_points: [8, 8], iterations: 3}\nvariants: {smooth: {}}\n"
    )
    assert run().code == 0
    assert run(config=other).code == 0
    assert set(read_metrics(tmp_path / "run").variant) == {"smooth"}
    assert "4 done" in flexroad("status", tmp_path / "run").out
    back = run()
    assert "4 tiles: 4 done" in back.out
    assert set(read_metrics(tmp_path / "run").variant) == {"plane", "rgt", "flexroad"}


# --- disks and folders --------------------------------------------------------------------------------


@pytest.fixture
def mount(tmp_path):
    """Function that mounts a temporary file system with given options; unmounted after the test."""
    place = tmp_path / "disk"
    place.mkdir()

    def call(options: str) -> Path:
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", options, "tmpfs", place],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
        return place

    yield call
    subprocess.run(["umount", place], capture_output=True, check=False)


@pytest.mark.parametrize("size", ["100k", "300k"])
def test_full_disk_fails_tiles_until_there_is_space(size, mount, run, flexroad, tmp_path):
    out = mount(f"size={size}") / "run"
    result = run(out=out)
    assert result.code == 1
    assert len({line.split(":")[0] for line in result.errors}) == len(result.errors) > 0
    assert all(f"No space left on device: '{out}/" in line for line in result.errors)
    assert not list(out.rglob("*.tmp"))
    subprocess.run(["mount", "-o", "remount,size=20m", out.parent], check=True)
    again = flexroad("rerun", out, "--executor", "serial")
    assert again.code == 0
    assert "4 tiles: 4 done" in again.out
    assert set(read_metrics(out).status) == {"done"}


def test_read_only_disk_allows_only_reading(mount, run, flexroad, survey, tmp_path):
    disk = mount("size=20m")
    assert run(out=disk / "run").code == 0
    tile = Catalog.read(survey).tiles[0]
    points = tmp_path / "points.csv"
    points.write_text(f"easting,northing\n{tile.grid.west + 9},{tile.grid.south + 9}\n")
    for artefact in (disk / "run" / "store").rglob("*.npz"):
        artefact.unlink()
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    for out in (disk / "run", disk / "other"):
        result = run(out=out)
        assert result.code == 2
        (line,) = result.errors
        assert f"cannot write the run to {out}" in line
        assert "Read-only file system" in line
    assert "4 done" in flexroad("status", disk / "run").out
    assert tile.id in flexroad("query", disk / "run", "--points", points).out
    result = flexroad("report", disk / "run")
    assert result.code == 2
    assert "Read-only file system" in result.errors[0]
    result = flexroad("catalog", "synthetic", "-o", disk / "scenes", "--tiles", 1)
    assert (result.code, len(result.errors)) == (2, 1)


def test_output_path_that_is_a_file_is_refused(run, flexroad, survey, tmp_path):
    (tmp_path / "file").write_text("mine")
    folder = survey.parent
    rasters = ["catalog", "rasters", folder, "--dsm", "dsm/*", "--dtm", "dtm/*", "--tile-size", 60, "-o"]
    for result in (
        run(out=tmp_path / "file"),
        run(out=tmp_path / "file" / "run"),
        run("--store", tmp_path / "file"),
        flexroad("catalog", "synthetic", "-o", tmp_path / "file"),
        flexroad(*rasters, tmp_path / "file" / "c.json"),
    ):
        assert result.code == 2
        (line,) = result.errors
        assert str(tmp_path / "file") in line
    assert (tmp_path / "file").read_text() == "mine"


# --- catalogs -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is a folder; name its file"),
        (b"", "is not a FlexRoad catalog"),
        (b"PAR1 and no more", "is not a FlexRoad catalog"),
    ],
)
def test_unreadable_catalog_is_refused(content, message, run, survey):
    survey.unlink()
    survey.mkdir() if content is None else survey.write_bytes(content)
    result = run()
    assert result.code == 2
    (line,) = result.errors
    assert str(survey) in line
    assert message in line


@pytest.mark.parametrize("size", ["0", "-5", "nan", "inf", "33.3"])
def test_invalid_tile_size_is_refused(size, flexroad, survey, tmp_path):
    arguments = ["--dsm", "dsm/*", "--dtm", "dtm/*", "--tile-size", size, "-o", tmp_path / "c.json"]
    result = flexroad("catalog", "rasters", survey.parent, *arguments)
    assert result.code == 2
    assert len(result.errors) == 1


def test_catalog_with_moved_files_is_refused(run, flexroad, survey, tmp_path):
    (survey.parent / "dsm").rename(tmp_path / "elsewhere")
    result = run()
    assert result.code == 2
    assert re.search(
        r"each of the 4 tiles lacks a file, for example tile \d+_\d+: .*dsm/\d+_\d+.tif;", result.err
    )
    (tmp_path / "elsewhere").rename(survey.parent / "dsm")
    repaired = flexroad("rerun", tmp_path / "run", "--executor", "serial")
    assert repaired.code == 0
    assert "4 tiles: 4 done" in repaired.out


def test_missing_file_that_all_tiles_list_fails_only_its_tile(run, survey, tmp_path):
    """With a halo each of the four tiles lists the file, but it lies on one of them."""
    first, *others = Catalog.read(survey).tiles
    layer(first, "dsm").unlink()
    halo = tmp_path / "halo.yaml"
    halo.write_text("extends: defaults\nload: {halo_m: 20}\nfit: {control_points: [8, 8], iterations: 3}\n")
    result = run(config=halo)
    assert [line.split(":")[0] for line in result.errors] == [f"failed {first.id}"]
    item = json.loads((tmp_path / "run" / "tiles" / others[0].id / "item.json").read_text())
    assert any("a file that the tile does not need" in note for note in item["properties"]["flexroad:notes"])


# --- changed and damaged runs -------------------------------------------------------------------------


@pytest.mark.slow
def test_missing_sources_keep_finished_results(run, flexroad, survey, tmp_path):
    tile = Catalog.read(survey).tiles[0]
    points = tmp_path / "points.csv"
    points.write_text(f"easting,northing\n{tile.grid.west + 9},{tile.grid.south + 9}\n")
    out = tmp_path / "run"
    run()
    whole = [flexroad("query", out, "--points", points).out, flexroad("report", out).out]
    survey.rename(tmp_path / "kept.parquet")
    shutil.rmtree(survey.parent)
    assert [flexroad("query", out, "--points", points).out, flexroad("report", out).out] == whole
    assert "4 tiles: 4 done" in flexroad("status", out).out
    assert flexroad("report", out, "--format", "html").code == 0
    lost = flexroad("query", out, "--points", points, "--variant", "rgt")
    assert lost.code == 2
    assert f"tile {tile.id}: load: TaskError: dsm dsm/{tile.id}.tif is missing" in lost.errors[0]
    out.rename(tmp_path / "a moved run")
    assert flexroad("query", tmp_path / "a moved run", "--points", points).out == whole[0]


def test_deleted_store_keeps_finished_results(run, flexroad, survey, tmp_path):
    tile = Catalog.read(survey).tiles[0]
    points = tmp_path / "points.csv"
    points.write_text(f"easting,northing\n{tile.grid.west + 9},{tile.grid.south + 9}\n")
    out = tmp_path / "run"
    run()
    whole = flexroad("query", out, "--points", points).out
    shutil.rmtree(out / "store")
    assert flexroad("query", out, "--points", points).out == whole
    assert flexroad("report", out).code == 0
    assert not (out / "store").exists()
    assert "nothing had changed" in flexroad("rerun", out, "--executor", "serial").out
    assert flexroad("rerun", out, "--from", "fit", "--executor", "serial").code == 0
    assert flexroad("query", out, "--points", points).out == whole


def test_relative_paths_work_from_other_folder(flexroad, survey, quick_config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = ["--catalog", "survey/catalog.parquet", "--out", "my runs/1", "--store", "shared", "--executor"]
    result = flexroad("run", "--config", "quick.yaml", *run, "serial")
    assert result.code == 0
    assert "next: flexroad report 'my runs/1' --format html" in result.out
    (tmp_path / "away").mkdir()
    monkeypatch.chdir(tmp_path / "away")
    again = flexroad("rerun", "../my runs/1", "--from", "sample", "--executor", "serial")
    assert "4 done (0 cached)" in again.out
    assert not list((tmp_path / "away").iterdir())


@pytest.mark.parametrize(
    ("name", "content", "status", "message"),
    [
        ("run.json", "{}", 2, "is no run: run.json is missing or damaged"),
        ("run.json", "[]", 2, "is no run: run.json is missing or damaged"),
        ("config.yaml", "fit: {degre: 3}", 2, "fit.degre: unknown key"),
        ("config.yaml", None, 2, "no configuration"),
        ("catalog.parquet", "", 2, "is not a FlexRoad catalog"),
        ("log.jsonl", 'null\n{"event": 3}\n{"ev', 0, "4 done"),
        ("metrics.parquet", "", 0, "4 done"),
        ("tiles/*/item.json", "{}", 0, "4 pending"),
        ("tiles/*/item.json", "[", 0, "4 pending"),
        ("tiles/*/*.glb", "", 0, "4 pending"),
    ],
)
def test_damaged_run_is_reported_and_repaired(
    name, content, status, message, run, flexroad, finished, made_survey, tmp_path
):
    out = shutil.copytree(finished, tmp_path / "run")
    for path in list(out.glob(name)):
        path.unlink() if content is None else path.write_text(content)
    result = flexroad("status", out)
    assert result.code == status
    assert message in result.out + result.err
    report = flexroad("report", out)
    assert report.code == (2 if name == "metrics.parquet" else status)
    repaired = run(catalog=made_survey / "catalog.parquet")
    assert repaired.code == 0
    assert "4 tiles: 4 done" in repaired.out
    assert flexroad("report", out).code == 0


@pytest.mark.slow
def test_simultaneous_runs_share_a_store(survey, quick_config, tmp_path):
    arguments = ["--executor", "serial", "--config", quick_config, "--catalog", survey]
    arguments += ["--store", tmp_path / "store"]
    call = [*PROCESS, "run", *map(str, arguments), "--out"]
    both = [
        subprocess.Popen(
            [*call, tmp_path / name], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
        )
        for name in "ab"
    ]
    stderr = [process.communicate()[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], stderr
    # The standard error of a slow run also has progress lines.
    assert [error_lines(text) for text in stderr] == [[], []]
    tables = [read_metrics(tmp_path / name).drop(columns="seconds") for name in "ab"]
    pd.testing.assert_frame_equal(*tables, check_exact=True)
    assert not list(tmp_path.rglob("*.tmp"))


# --- invalid arguments --------------------------------------------------------------------------------


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
        ("catalog rasters SURVEY --dsm dsm/* --dtm dtm/* -o X.txt --tile-size 60", "ends in .parquet, .json"),
    ],
)
def test_invalid_arguments_give_one_error(command, message, argument_paths, flexroad):
    result = flexroad(*[argument_paths.get(word, word) for word in command.split()])
    assert result.code == 2
    assert message in result.err
    assert len([line for line in result.err.splitlines() if "rror: " in line]) == 1


def test_query_points_outside_run_gives_note(run, flexroad, survey, tmp_path):
    grid = Catalog.read(survey).tiles[0].grid
    points = tmp_path / "points.csv"
    points.write_text(f"easting,northing\n{grid.west + 9},{grid.south + 9}\n7.1,50.2\n,\ninf,0\n")
    run()
    result = flexroad("query", tmp_path / "run", "--points", points)
    assert result.code == 0
    assert result.err == "note: 3 points lie on no finished tile; their columns are empty\n"
    table = pd.read_csv(io.StringIO(result.out))
    assert list(table.height_m.isna()) == [False, True, True, True]


@pytest.fixture(scope="module")
def finished(made_survey, tmp_path_factory) -> Path:
    """The folder of a finished run, which tests must not change."""
    out = tmp_path_factory.mktemp("finished") / "run"
    made = Run.create(out, compose(QUICK, "quick"), Catalog.read(made_survey / "catalog.parquet"))
    run_tiles(made, SerialExecutor())
    return out


@pytest.fixture(scope="module")
def argument_paths(made_survey, finished, tmp_path_factory):
    """Paths by their placeholder in the tested commands."""
    folder = tmp_path_factory.mktemp("slips")
    (folder / "p.csv").write_text("a,b\n1,2\n")
    return {
        "RUN": finished,
        "CSV": folder / "p.csv",
        "SURVEY": made_survey,
        "X": folder / "x",
        "X.json": folder / "x.json",
        "X.txt": folder / "x.txt",
    }


@pytest.mark.parametrize("name", ["dsm", "roads"])
def test_pipes_hang_neither_client_nor_worker_with_checksum(run, survey, tmp_path, name):
    tile = Catalog.read(survey).tiles[0]
    layer(tile, name).unlink()
    os.mkfifo(layer(tile, name))
    config = compose({**QUICK, "segment": "vector"} if name == "roads" else QUICK, "x")
    path = tmp_path / "x.yaml"
    path.write_text(json.dumps(config.raw))
    # The file with roads is that of all tiles: then the run stops before the first one.
    said = run("--checksum", config=path).expected(2 if name == "roads" else 1)
    assert "is not a regular file; replace it by one" in said.errors[0]


def test_catalog_or_run_that_is_a_pipe_is_refused(run, flexroad, survey, tmp_path):
    pipe = tmp_path / "catalog.json"
    os.mkfifo(pipe)
    assert "not a regular file" in run(catalog=pipe).expected(2).err
    run().expected(0)
    for name in ("config.yaml", "catalog.parquet", "run.json"):
        file = tmp_path / "run" / name
        kept = file.rename(tmp_path / name)
        os.mkfifo(file)
        assert "not a regular file" in flexroad("status", tmp_path / "run").expected(2).err
        kept.replace(file)
