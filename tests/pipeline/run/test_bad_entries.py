"""Runs of catalogs with entries that cannot be used: each costs its own tile and one line."""

import json
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml

from flexroad.catalog import Catalog
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tools.results.run import open_run
from tests import bad_entries
from tests.bad_entries import CHANGES, Change, cases
from tests.command_line import Said

PLANE = {"fit": "plane", "sample": "corners"}


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "plane.yaml"
    path.write_text(yaml.safe_dump({"extends": "defaults", **PLANE, "variants": {"plane": {}}}))
    return path


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """The results of the valid tiles, which all tests share."""
    return tmp_path_factory.mktemp("store")


@pytest.fixture
def run(flexroad, config, store, tmp_path):
    def call(catalog, *arguments) -> Said:
        where = ["--catalog", catalog, "--out", tmp_path / "run", "--store", store]
        return flexroad("run", "--config", config, *where, "--executor", "serial", *arguments)

    return call


@pytest.fixture
def write(made_survey):
    """Write entries beside the data of a survey, in a format."""
    valid = made_survey / "valid.json"
    Catalog.read(made_survey / "catalog.parquet").write(valid)
    written: list[Path] = []

    def call(kind, change):
        path = made_survey / f"changed.{kind}"
        written.append(path)
        entries = change(bad_entries.features(valid))
        if kind == "json":
            bad_entries.write_json(path, entries)
        else:
            bad_entries.write_parquet(path, entries, pq.read_schema(made_survey / "catalog.parquet"))
        return path

    yield call
    for path in written:
        path.unlink(missing_ok=True)


def with_change(change: Change):
    """Return a function that changes the second of several entries."""
    return lambda entries: [entries[0], change.apply(entries[1]), *entries[2:]]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "change"), list(cases()), ids=lambda value: getattr(value, "name", value))
def test_bad_entry_fails_only_its_tile(kind, change, run, write, tmp_path):
    said = run(write(kind, with_change(change))).expected(1)
    (line,) = said.errors
    assert line.isprintable()
    assert "3 done (0 cached), 1 failed, 0 pending" in said.out
    (row,) = pd.read_csv(tmp_path / "run" / "failures.csv").to_dict("records")
    assert line == f"failed {row['tile_id']}: load: TaskError: {row['message']}"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["json", "parquet"])
def test_many_bad_entries_fail_only_their_tiles(kind, run, write, flexroad, tmp_path):
    """Every command that reads the catalog or the run works with them."""
    changes = [change for change in CHANGES if kind == "json" or change.parquet]

    def changed(entries):
        made = []
        for number, change in enumerate(changes):
            entry = json.loads(json.dumps(entries[1]))
            entry["id"] = f"bad-{number}"
            made.append(change.apply(entry))
        return [*made, *entries]

    catalog = write(kind, changed)
    whole = run(catalog).expected(1)
    assert len(whole.errors) == len(changes)
    assert f"4 done (0 cached), {len(changes)} failed, 0 pending" in whole.out
    out = tmp_path / "run"
    rows = read_metrics(out)
    assert (rows.status == "done").sum() == 4
    again = run(catalog).expected(1)
    assert f"4 done (4 cached), {len(changes)} failed, 0 pending; 0 new, 0 changed, 0 vanished" in again.out
    lines = flexroad("status", out).expected(0).out.splitlines()
    assert [f"failed {line.strip()}" for line in lines if line.startswith("  ")] == whole.errors
    assert json.loads(flexroad("status", out, "--json").expected(0).out)["failed"] == len(changes)
    assert flexroad("rerun", out, "--failed", "--executor", "serial").expected(1).errors == whole.errors
    shapes = [feature["geometry"] for feature in json.loads((out / "tiles.geojson").read_text())["features"]]
    assert sum(shape is None for shape in shapes) == len(changes)
    page = flexroad("report", out, "--format", "md").expected(0)
    assert f"{len(changes)} failed" in page.out
    flexroad("report", out, "--format", "html").expected(0)
    assert_no_controls(out)
    assert f"{4 + len(changes)} tiles" in flexroad("catalog", "show", catalog).expected(0).out
    check = flexroad("catalog", "check", catalog).expected(1)
    assert f"warning: {len(changes) - 5} more entries cannot be used" in check.out
    assert "4 tiles of 60x60 at 1 m" in check.out
    tiles = open_run(out).tiles
    assert list(tiles.geometry.isna()) == [*[True] * len(changes), *[False] * 4]
    dry = run(catalog, "--dry-run").expected(1)
    assert f"{4 + len(changes)} tiles" in dry.out


def assert_no_controls(folder: Path) -> None:
    for path in [*folder.glob("report*"), *folder.glob("report/*")]:
        if path.suffix in (".md", ".html"):
            assert all(line.isprintable() for line in path.read_text().split("\n"))


def test_repaired_entry_is_done(run, write):
    change = next(change for change in CHANGES if change.name == "shape negative")
    run(write("json", with_change(change))).expected(1)
    said = run(write("json", lambda entries: entries)).expected(0)
    assert "4 done (3 cached), 0 failed, 0 pending; 0 new, 1 changed, 0 vanished" in said.out


def test_selection_with_bad_entries(run, write):
    change = next(change for change in CHANGES if change.name == "shape negative")
    catalog = write("json", with_change(change))
    bad = Catalog.read(catalog).tiles[1].id
    (line,) = run(catalog, "--tile", bad).expected(2).errors
    assert line.startswith("error: no tile can be used: feature 2 of changed.json: proj:shape")
    run(catalog, "--bbox", 0, 0, 1e7, 1e7).expected(0)
    assert "3 done (0 cached), 1 failed" in run(catalog, "--tile", bad).expected(1).out


def test_survey_not_mounted_is_one_error_with_bad_entries(run, write, tmp_path):
    def away(entries):
        for entry in entries:
            for asset in entry["assets"].values():
                asset["flexroad:files"] = [f"away/{name}" for name in asset["flexroad:files"]]
        return [*entries[:-1], {}]

    (line,) = run(write("json", away)).expected(2).errors
    assert "each of the 3 tiles lacks a file" in line


def test_equal_ids_are_refused_with_a_remedy(run, write):
    (line,) = run(write("json", lambda entries: [*entries, entries[0]])).expected(2).errors
    assert "occur more than once; rename those tiles" in line


def test_longest_id_runs_again(run, write):
    def longest(entries):
        entries[0]["id"] = "ü/" * 33
        return entries[:1]

    catalog = write("json", longest)
    run(catalog).expected(0)
    assert "1 done (1 cached)" in run(catalog).expected(0).out


@pytest.mark.slow
def test_control_characters_in_file_names_are_escaped(run, write, flexroad, tmp_path):
    name = "dsm/\x1b[2J\n*evil* <b>_x_</b>.tif"

    def renamed(entries):
        entries[1]["assets"]["dsm"] |= {"flexroad:files": [name], "flexroad:extents": None}
        return entries

    catalog = write("json", renamed)
    said = run(catalog).expected(1)
    (line,) = said.errors
    assert r"dsm/\x1b[2J\n*evil* <b>_x_</b>.tif" in line
    out = tmp_path / "run"
    for command in (["status", out], ["catalog", "check", catalog], ["report", out, "--format", "md"]):
        shown = flexroad(*command)
        assert all(line.isprintable() for line in (shown.out + shown.err).split("\n"))
    page = flexroad("report", out, "--format", "md").out
    assert r"\*evil\* &lt;b>\_x\_&lt;/b>.tif" in page
    assert "<b>" not in page
    flexroad("report", out, "--format", "html").expected(0)
    assert_no_controls(out)
