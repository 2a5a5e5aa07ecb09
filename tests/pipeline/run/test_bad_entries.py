"""Runs of catalogs with entries that cannot be used: each costs its own tile and one line."""

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

from flexroad.catalog import Catalog
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tools.results.run import open_run
from tests import bad_entries
from tests.bad_entries import CHANGES
from tests.command_line import Said

PLANE = {"extends": "defaults", "fit": "plane", "sample": "corners", "variants": {"plane": {}}}
NEGATIVE = next(change for change in CHANGES if change.name == "shape negative")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """The results of the valid tiles, which all tests share."""
    return tmp_path_factory.mktemp("store")


@pytest.fixture
def run(flexroad, store, tmp_path):
    config = tmp_path / "plane.yaml"
    config.write_text(yaml.safe_dump(PLANE))

    def call(catalog, *arguments) -> Said:
        where = ["--catalog", catalog, "--out", tmp_path / "run", "--store", store]
        return flexroad("run", "--config", config, *where, "--executor", "serial", *arguments)

    return call


@pytest.fixture
def write(made_survey):
    """Write changed entries beside the data of a survey, in a format."""
    valid = made_survey / "valid.json"
    Catalog.read(made_survey / "catalog.parquet").write(valid)
    written: list[Path] = []

    def call(change, kind="json"):
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


def with_negative_shape(entries):
    return [entries[0], NEGATIVE.apply(entries[1]), *entries[2:]]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["json", "parquet"])
def test_many_bad_entries_fail_only_their_tiles(kind, run, write, flexroad, tmp_path):
    """Every command that reads the catalog or the run works with them."""
    changes = [change for change in CHANGES if kind == "json" or change.parquet]

    def changed(entries):
        bad = [change.apply(entries[1] | {"id": f"bad-{n}"}) for n, change in enumerate(changes)]
        return [*bad, *entries]

    catalog, out = write(changed, kind), tmp_path / "run"
    whole = run(catalog).expected(1)
    assert len(whole.errors) == len(changes)
    assert all(line.isprintable() for line in whole.errors)
    assert f"4 done (0 cached), {len(changes)} failed, 0 pending" in whole.out
    assert (read_metrics(out).status == "done").sum() == 4
    again = run(catalog).expected(1)
    assert f"4 done (4 cached), {len(changes)} failed, 0 pending; 0 new, 0 changed, 0 vanished" in again.out
    lines = flexroad("status", out).expected(0).out.splitlines()
    assert [f"failed {line.strip()}" for line in lines if line.startswith("  ")] == whole.errors
    assert json.loads(flexroad("status", out, "--json").expected(0).out)["failed"] == len(changes)
    assert flexroad("rerun", out, "--failed", "--executor", "serial").expected(1).errors == whole.errors
    shapes = [feature["geometry"] for feature in json.loads((out / "tiles.geojson").read_text())["features"]]
    assert sum(shape is None for shape in shapes) == len(changes)
    assert f"{len(changes)} failed" in flexroad("report", out, "--format", "md").expected(0).out
    flexroad("report", out, "--format", "html").expected(0)
    assert_no_controls(out)
    assert f"{4 + len(changes)} tiles" in flexroad("catalog", "show", catalog).expected(0).out
    check = flexroad("catalog", "check", catalog).expected(1)
    assert f"warning: {len(changes) - 5} more entries cannot be used" in check.out
    assert "4 tiles of 60x60 at 1 m" in check.out
    assert list(open_run(out).tiles.geometry.isna()) == [*[True] * len(changes), *[False] * 4]
    assert f"{4 + len(changes)} tiles" in run(catalog, "--dry-run").expected(1).out


def assert_no_controls(folder: Path) -> None:
    for path in [*folder.glob("report*"), *folder.glob("report/*")]:
        if path.suffix in (".md", ".html"):
            assert all(line.isprintable() for line in path.read_text().split("\n"))


def test_bad_entry_is_selected_refused_alone_and_repaired(run, write):
    catalog = write(with_negative_shape)
    bad = Catalog.read(catalog).tiles[1].id
    (line,) = run(catalog, "--tile", bad).expected(2).errors
    assert line.startswith("error: no tile can be used: feature 2 of changed.json: proj:shape")
    run(catalog, "--bbox", 0, 0, 1e7, 1e7).expected(0)
    assert "3 done (0 cached), 1 failed" in run(catalog, "--tile", bad).expected(1).out
    run(catalog).expected(1)
    said = run(write(lambda entries: entries)).expected(0)
    assert "4 done (3 cached), 0 failed, 0 pending; 0 new, 1 changed, 0 vanished" in said.out


def test_survey_not_mounted_is_one_error_with_bad_entries(run, write):
    def away(entries):
        for entry in entries:
            for asset in entry["assets"].values():
                asset["flexroad:files"] = [f"away/{name}" for name in asset["flexroad:files"]]
        return [*entries[:-1], {}]

    (line,) = run(write(away)).expected(2).errors
    assert "each of the 3 tiles lacks a file" in line
