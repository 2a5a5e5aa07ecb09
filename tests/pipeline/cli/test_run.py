"""Nightly operation: repeated runs, exit codes of failures, clean."""

import errno
import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from flexroad.catalog import Catalog, Layer
from flexroad.catalog.storage import paths
from flexroad.pipeline.cli.main import main
from flexroad.pipeline.run import record
from flexroad.pipeline.run.finished import surface_and_road
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.store.records import dump_checked, load_checked
from tests.command_line import same_signals

QUICK = "extends: defaults\nfit: {control_points: [8, 8], iterations: 3}\nvariants:\n  flexroad: {}\n"


@pytest.fixture
def flexroad(monkeypatch, capfd):
    """Run a command line; check its exit code, return standard output and standard error."""

    def call(*words, expect: int = 0) -> str:
        monkeypatch.setattr(sys, "argv", ["flexroad", *map(str, words)])
        code = 0
        try:
            with same_signals():
                main()
        except SystemExit as exit_:
            code = exit_.code or 0
        out, err = capfd.readouterr()
        assert code == expect, out + err
        return out + err

    return call


@pytest.fixture
def nightly(survey, tmp_path) -> list:
    """The words of a run command over the four tiles of `survey`; RUN is tmp_path / "run"."""
    config = tmp_path / "quick.yaml"
    config.write_text(QUICK)
    return ["run", "--config", config, "--catalog", survey, "--out", tmp_path / "run", "--executor", "serial"]


def test_run_repeated_counts_new_changed_and_vanished(flexroad, nightly, survey, tmp_path):
    whole = Catalog.read(survey)
    Catalog(whole.tiles[:3]).write(survey)
    said = flexroad(*nightly)
    assert "3 tiles: 3 done (0 cached), 0 failed, 0 pending; 3 new, 0 changed, 0 vanished; " in said
    Catalog(whole.tiles[1:]).write(survey)
    os.utime(whole.tiles[1].paths(whole.tiles[1].layer("dsm"))[0], (1, 1))
    said = flexroad(*nightly)
    assert "3 tiles: 3 done (1 cached), 0 failed, 0 pending; 1 new, 1 changed, 1 vanished; " in said
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["exit_code"], summary["new"], summary["cached"]) == (0, 1, 1)
    # Same size, but not the checksum in item.json.
    product = next((tmp_path / "run" / "tiles" / whole.tiles[2].id).glob("*.glb"))
    data = bytearray(product.read_bytes())
    data[-1] ^= 1
    product.write_bytes(data)
    assert "3 done (3 cached)" in flexroad(*nightly)
    assert "3 done (2 cached)" in flexroad(*nightly, "--verify")
    states = json.loads((tmp_path / "run" / "tiles.geojson").read_text())["features"]
    assert [state["properties"]["state"] for state in states] == ["cached", "done", "cached"]


def test_run_with_failed_tile_ends_with_1_and_shows_it_on_the_map(flexroad, nightly, survey, tmp_path):
    tiles = Catalog.read(survey).tiles[:2]
    Catalog(tiles).write(survey)
    tiles[1].paths(tiles[1].layer("dtm"))[0].unlink()
    said = flexroad(*nightly, expect=1)
    assert "2 tiles: 1 done (0 cached), 1 failed" in said
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["exit_code"], summary["failed"], summary["interrupted"]) == (1, 1, False)
    assert summary["failures"][0]["tile_id"] == tiles[1].id
    flexroad("status", tmp_path / "run", "--geojson", tmp_path / "map.geojson")
    states = json.loads((tmp_path / "map.geojson").read_text())["features"]
    assert [state["properties"]["state"] for state in states] == ["done", "failed"]


def test_status_with_pipe_as_output_is_refused(flexroad, nightly, survey, tmp_path):
    Catalog(Catalog.read(survey).tiles[:1]).write(survey)
    flexroad(*nightly)
    pipe = tmp_path / "map.geojson"
    os.mkfifo(pipe)
    said = flexroad("status", tmp_path / "run", "--geojson", pipe, expect=2)
    assert f"is a device, pipe or socket and is not replaced: '{pipe}'" in said
    assert pipe.is_fifo()


def test_run_that_cannot_start_ends_with_2_and_one_line(flexroad, nightly, survey, tmp_path):
    said = flexroad(*nightly, "--store", survey, expect=2)
    assert said.startswith("error: cannot write the run")
    assert "choose another --out or --store" in said
    assert said.count("\n") == 1
    # There is no summary of this run.
    assert not (tmp_path / "run").exists()
    (tmp_path / "run").mkdir()
    with run_lock(tmp_path / "run"):
        assert f"is in use by pid {os.getpid()}" in flexroad(*nightly, expect=2)
    assert "No such option" in flexroad(*nightly, "--wrokers", 2, expect=2)
    assert "is no run" in flexroad("rerun", tmp_path / "nowhere", expect=2)


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
def test_refused_run_leaves_folders_as_they_were(flexroad, nightly, survey, tmp_path, words, message):
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


def test_run_into_folder_with_other_files_changes_nothing(flexroad, nightly, survey):
    before = paths.listing(survey.parent)
    message = (
        f"{survey.parent} has files that are not of a run, such as catalog.parquet; choose an empty or new"
    )
    for words in (["--dry-run"], []):
        assert message in flexroad(*nightly, "--out", survey.parent, *words, expect=2)
    assert paths.listing(survey.parent) == before


@pytest.mark.parametrize("name", ["config.yaml", "catalog.parquet"])
def test_run_whose_creation_failed_goes_on(flexroad, nightly, tmp_path, monkeypatch, name):
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


def test_run_into_empty_disk_is_accepted(flexroad, nightly, tmp_path):
    (tmp_path / "run" / "lost+found").mkdir(parents=True)
    (tmp_path / "run" / ".DS_Store").write_bytes(b"x")
    assert "4 done" in flexroad(*nightly)


def test_run_interrupted_ends_with_130_and_one_line(flexroad, nightly, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("flexroad.pipeline.run.api.run_tiles", interrupted)
    said = flexroad(*nightly, expect=130)
    assert said.endswith("interrupted; the same command goes on from here\n")


def test_run_source_outside_catalog_folder_needs_allow(flexroad, nightly, survey, tmp_path):
    tile = Catalog.read(survey).tiles[0]
    (tmp_path / "dtm").mkdir()
    shutil.move(tile.paths(tile.layer("dtm"))[0], tmp_path / "dtm" / "a.tif")
    moved = Layer("dtm", (str(tmp_path / "dtm" / "a.tif"),))
    layers = tuple(moved if layer.name == "dtm" else layer for layer in tile.layers)
    Catalog((replace(tile, layers=layers),)).write(survey)
    said = flexroad(*nightly, expect=2)
    option = f"--allow {tmp_path / 'dtm'}"
    assert option in said
    flexroad(*option.split(), *nightly)
    flexroad("rerun", tmp_path / "run", "--executor", "serial")
    path = tmp_path / "run" / "run.json"
    record = load_checked(path.read_bytes())
    record["allowed"] = [str(tmp_path / "other")]
    path.write_bytes(dump_checked(record))
    assert f"--allow {tmp_path}\n" in flexroad("rerun", tmp_path / "run", "--executor", "serial", expect=2)


def test_allow_after_the_command_names_its_place(flexroad, tmp_path):
    said = flexroad("catalog", "check", tmp_path / "c.json", "--allow", tmp_path, expect=2)
    assert "--allow stands before the command: flexroad --allow FOLDER COMMAND" in said


def test_clean_dry_run_lists_files_that_clean_deletes(flexroad, nightly, survey, tmp_path):
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


def test_status_of_locked_run_shows_owner(flexroad, nightly, survey, tmp_path):
    Catalog(Catalog.read(survey).tiles[:1]).write(survey)
    flexroad(*nightly)
    assert json.loads(flexroad("status", tmp_path / "run", "--json"))["at_work"] is None
    with run_lock(tmp_path / "run"):
        assert json.loads(flexroad("status", tmp_path / "run", "--json"))["at_work"]["pid"] == os.getpid()
        assert f"pid {os.getpid()} on" in flexroad("status", tmp_path / "run")


def test_run_with_setting_records_it_for_rerun(flexroad, nightly, tmp_path):
    assert "fit.iteration: unknown key; did you mean iterations?" in flexroad(
        *nightly, "--set", "fit.iteration=4", "--dry-run", expect=2
    )
    flexroad(*nightly, "--set", "fit.iterations=4", "--tile", "499980_5599980")
    assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["fit"]["iterations"] == 4
    said = flexroad("rerun", tmp_path / "run", "--executor", "serial")
    assert "1 tile: 1 done (1 cached)" in said
    assert "--set fit.iterations=4" in flexroad("report", tmp_path / "run")


def test_query_after_edit_of_configuration_answers_from_the_last_finished_state(flexroad, nightly, tmp_path):
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


def test_rerun_from_export_only_writes_the_products_again(flexroad, nightly, tmp_path):
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
