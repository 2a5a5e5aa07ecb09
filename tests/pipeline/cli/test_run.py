"""Commands on runs: output and exit codes, repeated runs, refused runs, clean."""

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import rasterio
import yaml

from flexroad.catalog import Catalog
from flexroad.catalog.storage import paths
from flexroad.pipeline.run import record
from flexroad.pipeline.run.finished import surface_and_road
from flexroad.pipeline.run.sampler import RunSampler
from flexroad.pipeline.store.tables import read_metrics
from tests.builders import LIGHT
from tests.command_line import call, process

QUICK = "extends: defaults\nfit: {control_points: [8, 8], iterations: 3}\nvariants:\n  flexroad: {}\n"


def flexroad(*words, expect: int = 0) -> str:
    """Return the output of a command, with its lines on standard error."""
    said = call(*words).expected(expect)
    return said.out + said.err


@pytest.fixture
def nightly(survey, tmp_path) -> list:
    """The words of a run command over the four tiles of `survey`; RUN is tmp_path / "run"."""
    config = tmp_path / "quick.yaml"
    config.write_text(QUICK)
    return ["run", "--config", config, "--catalog", survey, "--out", tmp_path / "run", "--executor", "serial"]


def test_run_with_failed_tile_ends_with_1_and_shows_it_on_the_map(nightly, survey, tmp_path):
    tiles = Catalog.read(survey).tiles[:2]
    Catalog(tiles).write(survey)
    path, *_ = tiles[1].paths(tiles[1].layer("dtm"))
    path.unlink()
    said = flexroad(*nightly, expect=1)
    assert f"failed {tiles[1].id}: load: TaskError: " in said
    assert "2 tiles: 1 done (0 cached), 1 failed" in said
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["exit_code"], summary["failed"], summary["interrupted"]) == (1, 1, False)
    (failure,) = json.loads(flexroad("status", tmp_path / "run", "--json"))["failures"]
    assert [failure[name] for name in ("tile_id", "stage", "file")] == [tiles[1].id, "load", str(path)]
    flexroad("status", tmp_path / "run", "--geojson", tmp_path / "map.geojson")
    states = json.loads((tmp_path / "map.geojson").read_text())["features"]
    assert [state["properties"]["state"] for state in states] == ["done", "failed"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--catalog", "ROADLESS"], "no tile of the catalog has a road mask"),
        (["--config", "nowhere"], "neither a file nor a shipped name"),
        (["--set", "fit.iteration=4"], "unknown key"),
        (
            ["--set", "segment={method: dinov2, model: nowhere.safetensors}"],
            "nowhere.safetensors does not exist",
        ),
        (["--catalog", "nowhere.json"], "nowhere.json does not exist"),
        (["--store", "CATALOG"], "cannot write the run"),
        (["--tile", "x"], "no tile 'x'"),
        (["--wrokers", "2"], "No such option"),
    ],
)
def test_refused_run_leaves_folders_as_they_were(nightly, survey, tmp_path, words, message):
    paths = {"CATALOG": survey, "ROADLESS": survey.with_name("roadless.parquet")}
    roadless = [
        replace(tile, layers=tuple(layer for layer in tile.layers if "road" not in layer.name))
        for tile in Catalog.read(survey).tiles
    ]
    Catalog(tuple(roadless)).write(paths["ROADLESS"])
    words = [paths.get(word, word) for word in words]
    new = tmp_path / "new" / "city" / "run"
    # The last of repeated options counts.
    assert message in flexroad(*nightly, *words, "--out", new, expect=2)
    assert not (tmp_path / "new").exists()
    empty = tmp_path / "empty"
    empty.mkdir()
    flexroad(*nightly, *words, "--out", empty / "run", expect=2)
    assert list(empty.iterdir()) == []
    flexroad(*nightly, *words, "--out", empty, expect=2)
    assert empty.is_dir()
    flexroad("rerun", new, expect=2)
    assert not (tmp_path / "new").exists()


def test_run_into_folder_with_other_files_changes_nothing(nightly, survey):
    before = paths.listing(survey.parent)
    message = (
        f"{survey.parent} has files that are not of a run, such as catalog.parquet; choose an empty or new"
    )
    for words in (["--dry-run"], []):
        assert message in flexroad(*nightly, "--out", survey.parent, *words, expect=2)
    assert paths.listing(survey.parent) == before


@pytest.mark.parametrize("name", ["config.yaml", "catalog.parquet"])
def test_run_whose_creation_failed_goes_on(nightly, tmp_path, monkeypatch, name):
    out, write_file = tmp_path / "run", record.write

    def fails(where, *args, **options):
        if where.name == name:
            raise OSError(errno.ENOSPC, "No space left on device", str(where))
        write_file(where, *args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(record, "write", fails)
        patch.setattr(Catalog, "write", lambda catalog, path, **options: fails(path))
        assert "No space left on device" in flexroad(*nightly, expect=2)
    assert (out / "run.json").exists()
    assert "is no run: run.json is missing or damaged" in flexroad("status", out, expect=2)
    assert "4 done" in flexroad(*nightly)


def test_allow_after_the_command_names_its_place(flexroad, tmp_path):
    said = flexroad("catalog", "check", tmp_path / "c.json", "--allow", tmp_path).expected(2)
    assert "--allow stands before the command: flexroad --allow FOLDER COMMAND" in said.err


def test_clean_dry_run_lists_files_that_clean_deletes(nightly, survey, tmp_path):
    tiles = Catalog.read(survey).tiles
    Catalog(tiles[:2]).write(survey)
    flexroad(*nightly)
    Catalog(tiles[:1]).write(survey)
    flexroad(*nightly)
    said = flexroad("clean", tmp_path / "run", "--dry-run")
    *paths, artefacts, files, total = said.splitlines()
    assert artefacts.startswith("artefacts that no run needs: ")
    assert files.startswith("files of tiles that the catalog no longer has: ")
    assert total.startswith(f"would free {len(paths)} files, ")
    assert all(Path(path).exists() for path in paths)
    assert f"freed {len(paths)} files, " in flexroad("clean", tmp_path / "run")
    assert not any(Path(path).exists() for path in paths)
    assert flexroad("clean", tmp_path / "run") == "freed 0 files, 0.0 MB\n"
    assert "no run of the store" in flexroad("clean", tmp_path / "run", "--forget", "x", expect=2)
    assert "1 done (1 cached)" in flexroad(*nightly)


def test_run_with_setting_records_it_for_rerun(nightly, tmp_path):
    assert "fit.iteration: unknown key; did you mean iterations?" in flexroad(
        *nightly, "--set", "fit.iteration=4", "--dry-run", expect=2
    )
    flexroad(*nightly, "--set", "fit.iterations=4", "--tile", "499980_5599980")
    assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["fit"]["iterations"] == 4
    said = flexroad("rerun", tmp_path / "run", "--executor", "serial")
    assert "1 tile: 1 done (1 cached)" in said
    assert "--set fit.iterations=4" in flexroad("report", tmp_path / "run")


def test_query_after_edit_of_configuration_answers_from_the_last_finished_state(nightly, tmp_path):
    flexroad(*nightly)
    run, points = tmp_path / "run", tmp_path / "points.csv"
    points.write_text("easting,northing\n500010,5600010\n500011,5600070\n")
    before = flexroad("query", run, "--points", points)
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("iterations: 3", "iterations: 4"))
    said = flexroad("rerun", run, "--tile", "499980_5599980", "--executor", "serial", expect=1)
    assert f"3 tiles have no result of the present files and options; next: flexroad rerun {run}\n" in said
    *after, note = flexroad("query", run, "--points", points).splitlines()
    # The first point is on the tile that was computed again, the second one is not.
    assert after[1] != before.splitlines()[1]
    assert after[2] == before.splitlines()[2]
    assert note.startswith(
        "note: sources or options of 1 tile have changed since; the values are of the last"
    )
    shutil.rmtree(run / "store")
    # Each command is a process of its own, which has no surfaces yet.
    surface_and_road.cache_clear()
    assert "1 point lies on no finished tile" in flexroad("query", run, "--points", points)


def test_rerun_from_export_only_writes_the_products_again(nightly, tmp_path):
    one = ["--tile", "499980_5599980"]
    assert "starting: 1 tile\n" in flexroad(*nightly, *one)
    run = tmp_path / "run"
    mesh = run / "tiles" / one[1] / f"{one[1]}_flexroad.ply"
    before = mesh.read_bytes()
    # The size is the same, so only --verify would notice it.
    mesh.write_bytes(b"x" * len(before))
    flexroad("rerun", run, "--from", "export", "--executor", "serial")
    assert mesh.read_bytes() == before
    last = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    stages = [event["stage"] for event in last if event.get("tile") == one[1] and event.get("computed")]
    assert stages.count("export") == 2
    assert stages.count("fit") == 1


@pytest.mark.slow
def test_run_with_worker_processes_equals_serial_run(light_run, made_survey, tmp_path):
    config, out = tmp_path / "light.yaml", tmp_path / "run"
    config.write_text(yaml.safe_dump(LIGHT, sort_keys=False))
    words = ["--config", config, "--catalog", made_survey / "catalog.parquet", "--out", out]
    said = process("run", *words, "--executor", "dask", "--workers", 2).expected(0)
    assert "4 tiles: 4 done (0 cached), 0 failed, 0 pending" in said.out
    tables = [read_metrics(run).drop(columns="seconds") for run in (light_run.path, out)]
    pd.testing.assert_frame_equal(*tables, check_exact=True)


def test_surface_of_rgt_has_the_heights_of_the_dsm(light_run):
    tile = light_run.catalog.tiles[1]
    with rasterio.open(tile.paths(tile.layer("dsm"))[0]) as raster:
        dsm = raster.read(1)
    surface = RunSampler.open(light_run.path, "rgt")
    answer = surface.at(tile.grid.eastings[[5, 40]], tile.grid.northings[[7, 50]])
    assert answer.height == pytest.approx([dsm[7, 5], dsm[50, 40]], abs=1e-5)


@pytest.mark.slow
def test_report_is_written_in_every_format_and_needs_no_network(own_run):
    for form in ("md", "csv", "html"):
        said = call("report", own_run.path, "--format", form).expected(0)
        text = (own_run.path / f"report.{form}").read_text()
        assert "flexroad" in text
        assert form == "html" or said.out.strip() == text.strip()
    assert text.count("data:image/webp;base64,") >= 4 * 6
    assert "http" not in text.split("<body>")[1].split("Configuration")[0]


def test_dry_run_prints_a_line_per_tile_and_writes_nothing(made_survey, tmp_path):
    catalog = Catalog.read(made_survey / "catalog.parquet")
    words = ["run", "--config", "paper", "--catalog", made_survey / "catalog.parquet"]
    words += ["--out", tmp_path / "r", "--dry-run"]
    said = flexroad(*words).splitlines()
    assert not (tmp_path / "r").exists()
    assert said[:5] == [*(f"{tile.id}: new" for tile in catalog.tiles), "4 tiles: 4 new"]
    assert "12 to do" in said[-2]
    assert said[-1] == "expected exit code: 0"
    graph = flexroad(*words, "--verbose")
    assert graph.count("fit ") == 4 * 3 + 1
    assert "(plane, rgt, flexroad)" in graph
    one, two = catalog.tiles[0].id, catalog.tiles[3].id
    west, south, east, north = catalog.tiles[3].grid.bounds
    assert flexroad(*words, "--tile", one, two).splitlines()[:2] == [f"{one}: new", f"{two}: new"]
    inside = flexroad(*words, "--bbox", west + 1, south + 1, east - 1, north - 1)
    assert inside.splitlines()[:2] == [f"{two}: new", "1 tile: 1 new"]


def test_run_of_some_tiles_keeps_the_other_tiles_of_the_run(nightly, survey, tmp_path):
    one, two = (Catalog.read(survey).tiles[number].id for number in (3, 1))
    assert "1 tile: 1 done (0 cached)" in flexroad(*nightly, "--tile", one)
    assert "2 tiles: 2 done (0 cached)" in flexroad(*nightly, "--tile", two)
    assert read_metrics(tmp_path / "run").tile_id.tolist() == [two, one]
    assert "4 tiles: 4 done (2 cached)" in flexroad(*nightly)


def test_catalog_show_lists_layers_and_count(made_survey):
    said = flexroad("catalog", "show", made_survey / "catalog.parquet")
    assert said.splitlines()[-1] == "4 tiles, EPSG:25832"
    assert "dsm(4) dtm(4) road_mask(4) reference(4) reference_road(4)" in said


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (f"rounds={'9' * 5000}", "rounds: not readable as YAML: line 1, column 1: a number of more than"),
        ("rounds=[", "rounds: not readable as YAML"),
        ("rounds", "'rounds': give KEY=VALUE, like --set epochs=100"),
    ],
)
def test_train_setting_that_cannot_be_read_gives_one_line(setting, message):
    words = ["train", "none.json", "--labels", "mask", "-o", "x.safetensors", "--set", setting]
    (line,) = call(*words).expected(2).errors
    assert f"--set {message}" in line
