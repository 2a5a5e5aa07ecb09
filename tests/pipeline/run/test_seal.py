"""The folders that a run may read hold only with the seal of the user's key."""

import pytest

from flexroad.catalog import Catalog, CatalogError
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.seal import seal, sealed
from flexroad.pipeline.store import checked_json
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
    record = checked_json.loads((run / "run.json").read_bytes())
    assert str(survey.parent) in record["allowed"]
    record["allowed"] = allowed
    (run / "run.json").write_bytes(checked_json.dumps(record))
    tile = Run.open(run).catalog.tiles[0]
    with pytest.raises(CatalogError, match=f"--allow {survey.parent}"):
        tile.paths(tile.layers[0])
    for command in ("rerun", "status", "clean"):
        said = flexroad(command, run)
        assert said.code == 2, command
        assert f"--allow {survey.parent}" in said.err
    assert flexroad("status", run, "--allow", survey.parent).code == 0
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
