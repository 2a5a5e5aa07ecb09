"""The folders that a run may read hold only with the seal of the user's key."""

import json
import shlex

import pytest
import yaml

from flexroad.catalog import Catalog, CatalogError
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.seal import seal, sealed
from flexroad.pipeline.store.records import dump_checked, load_checked
from tests.faulty_files import intercepted
from tests.power_loss import Recording, states


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    folder = tmp_path / "state"
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))
    return folder


def test_seal_holds_for_its_list_and_its_user(home, monkeypatch):
    allowed = ["/data", "s3://bucket/a"]
    assert not sealed(allowed, "")
    text = seal(allowed)
    assert sealed(allowed, text)
    assert (home / "flexroad" / "key").stat().st_mode & 0o777 == 0o600
    for other in ([], ["/"], ["/data"], allowed[::-1]):
        assert not sealed(other, text)
    for wrong in ("", "é", text[:-1], None, 5):
        assert not sealed(allowed, wrong)
    for wrong in (None, 5, "/data", {"/data": 1}):
        assert not sealed(wrong, text)
    monkeypatch.setenv("XDG_STATE_HOME", str(home / "of another user"))
    assert not sealed(allowed, text)
    assert seal(allowed) != text


def test_seal_of_named_values_holds_for_them_alone():
    values = {"prologue": ["module load gdal"], "queue": "long"}
    text = seal(values)
    assert sealed(dict(reversed(values.items())), text)
    for other in ({}, {"prologue": ["module load gdal"]}, values | {"queue": "short"}, list(values)):
        assert not sealed(other, text)
    assert not sealed(["prologue"], seal({"prologue": []}))


PROGRAMS = {
    "prologue": ["touch {mark}"],
    "job_extra": ["--comment x\ntouch {mark}"],
    "queue": "x\ntouch {mark}",
    "security": "none",
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_of_a_changed_configuration_need_to_be_given_again(
    name, flexroad, survey, quick_config, tmp_path
):
    run = tmp_path / "run"
    Run.create(run, *_settings(survey, quick_config))
    value = json.loads(json.dumps(PROGRAMS[name]).replace("{mark}", str(tmp_path / "mark")))
    config = yaml.safe_load((run / "config.yaml").read_text()) | {"cluster": {name: value}}
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    said = flexroad("rerun", run, "--executor", "serial").expected(2)
    (line,) = said.errors
    assert f"{run}/config.yaml: cluster.{name} can start programs, and this user has not given it" in line
    assert not list(run.glob("tiles/*"))
    assert flexroad("status", run).code == 0
    # The words of the message, as a shell reads them.
    again = shlex.split(line.partition("add ")[2])
    assert flexroad("rerun", run, "--executor", "serial", *again).expected(0)
    assert not (tmp_path / "mark").exists()


def test_programs_given_to_run_hold_for_its_user(flexroad, survey, quick_config, tmp_path, monkeypatch):
    run, one = tmp_path / "run", Catalog.read(survey).tiles[0].id
    words = ("--executor", "serial", "--tile", one)
    given = ("--set", "cluster.prologue=[module load gdal]")
    flexroad("run", "--catalog", survey, "--config", quick_config, "--out", run, *given, *words).expected(0)
    flexroad("rerun", run, *words).expected(0)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another"))
    option = ("--allow", survey.parent)
    assert "cluster.prologue can start programs" in flexroad(*option, "rerun", run, *words).expected(2).err
    flexroad(*option, "rerun", run, *words, *given).expected(0)


@pytest.mark.parametrize(
    "setting", ["fit.spacing_m=5", "clusters.workers=3", "cluster.no=3", "cluster.workers=0"]
)
def test_rerun_takes_options_of_workers_only(setting, flexroad, survey, quick_config, tmp_path):
    Run.create(tmp_path / "run", *_settings(survey, quick_config))
    said = flexroad("rerun", tmp_path / "run", "--set", setting).expected(2)
    assert len(said.errors) == 1


def test_store_outside_of_a_foreign_run_needs_allow(flexroad, survey, quick_config, tmp_path, monkeypatch):
    run, store = tmp_path / "run", tmp_path / "store"
    config, catalog = _settings(survey, quick_config)
    Run.create(run, config, catalog, store)
    assert Run.open(run).store == store
    record = load_checked((run / "run.json").read_bytes())
    other = tmp_path / "other"
    (run / "run.json").write_bytes(dump_checked(record | {"store": str(other)}))
    line = f"{run} has its store in {other}, which this user has not .* begin with flexroad --allow {other}$"
    with pytest.raises(ConfigError, match=line):
        Run.open(run)
    with pytest.raises(ConfigError, match=f"add --store {other}$"):
        Run.create(run, config, catalog)
    for command in ("rerun", "status", "clean"):
        assert f"--allow {other}" in flexroad(command, run).expected(2).err
    assert not other.exists()
    assert Run.open(run, [other]).store == other
    assert Run.create(run, config, catalog, store).store == Run.open(run).store


def test_key_after_power_failure_is_whole_or_missing(home, tmp_path):
    recording = Recording(tmp_path)
    with intercepted(tmp_path, recording):
        assert seal(["/data"])
    path = home / "flexroad" / "key"
    whole = path.read_bytes()
    assert {state.get(path, (None,))[0] for state in states(recording, 200)} == {whole, None}


def test_user_without_writable_home_seals_nothing(home):
    home.write_text("a file where the folder should be")
    assert seal(["/data"]) == ""
    assert not sealed(["/data"], "")


@pytest.mark.parametrize("allowed", [[], ["/"], None])
def test_changed_list_of_a_run_allows_nothing(flexroad, survey, quick_config, tmp_path, allowed):
    run = tmp_path / "run"
    Run.create(run, *_settings(survey, quick_config))
    tile = Run.open(run).catalog.tiles[0]
    assert all(path.exists() for path in tile.paths(tile.layers[0]))
    record = load_checked((run / "run.json").read_bytes())
    assert str(survey.parent) in record["allowed"]
    record["allowed"] = allowed
    (run / "run.json").write_bytes(dump_checked(record))
    tile = Run.open(run).catalog.tiles[0]
    with pytest.raises(CatalogError, match=f"--allow {survey.parent}"):
        tile.paths(tile.layers[0])
    for command in ("rerun", "status", "clean"):
        said = flexroad(command, run)
        assert said.code == 2, command
        assert f"--allow {survey.parent}" in said.err
    assert flexroad("--allow", survey.parent, "status", run).code == 0
    tile = Run.open(run, [str(survey.parent)]).catalog.tiles[0]
    assert tile.paths(tile.layers[0])


def test_run_of_a_catalog_just_made_may_read_its_files(survey, quick_config, tmp_path):
    config, catalog = _settings(survey, quick_config)
    made = Catalog(tuple(_unread(tile) for tile in catalog.tiles))
    Run.create(tmp_path / "run", config, made)
    for tile in Run.open(tmp_path / "run").catalog.tiles:
        assert all(path.is_file() for layer in tile.layers for path in tile.paths(layer))


def _settings(survey, quick_config):
    from flexroad.pipeline.config.loading import load_config

    return load_config(quick_config), Catalog.read(survey)


def _unread(tile):
    from dataclasses import replace

    return replace(tile, allowed=None)
