"""Catalogs and runs from anyone: nothing outside their folder is read, no control character is printed."""

import io
import json
import shutil
from pathlib import Path

import pytest
from rich.console import Console

import flexroad as library
from flexroad.catalog import Catalog, CatalogError
from flexroad.pipeline.cli.stdio import echo, echo_document
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.progress import ProgressDisplay

CLI = Path(__file__).parents[3] / "pipeline" / "cli"


@pytest.fixture
def tampered(survey):
    """Write the survey's catalog again with another name for each DSM file; return the catalog."""

    def write(name):
        path = survey.with_name("untrusted.json")
        Catalog.read(survey).write(path, movable=False)
        content = json.loads(path.read_text())
        for feature in content["features"]:
            feature["assets"]["dsm"]["flexroad:files"] = [name]
            feature["assets"]["dsm"]["flexroad:extents"] = None
        path.write_text(json.dumps(content))
        return path

    return write


@pytest.mark.parametrize("name", ["/vsicurl/{url}/a.tif", "{url}/a.tif", "/vsicurl?url={url}/a.tif"])
def test_catalog_with_address_is_refused_by_all_commands(flexroad, tampered, web, tmp_path, name):
    catalog = tampered(name.format(url=web.url))
    options = ("--labels", "mask", "-o", tmp_path / "model")
    for words in (
        ("catalog", "check", catalog),
        ("train", catalog, *options),
        ("run", "--config", "paper", "--catalog", catalog, "--out", tmp_path / "run"),
    ):
        said = flexroad("--allow", "/", *words).expected(2)
        assert said.err.count("fetch it first") == len(said.err.splitlines()) == 1
    assert web.requests == []


def test_catalog_with_file_outside_needs_allow_for_all_commands(flexroad, tampered, survey, tmp_path):
    outside = tmp_path / "elsewhere" / "dsm.tif"
    outside.parent.mkdir()
    shutil.copy(next((survey.parent / "dsm").glob("*.tif")), outside)
    catalog, option = tampered(str(outside)), ("--allow", str(outside.parent))
    options = ("--labels", "mask", "-o", tmp_path / "model")
    for words in (("catalog", "check", catalog), ("train", catalog, *options)):
        said = flexroad(*words).expected(2)
        assert f"dsm names {outside}, outside" in said.err
        assert " ".join(option) in said.err
    assert "missing" not in flexroad(*option, "catalog", "check", catalog).out


@pytest.mark.slow
def test_run_from_another_user_needs_allow(flexroad, survey, quick_config, tmp_path, monkeypatch):
    run, points = tmp_path / "run", tmp_path / "points.csv"
    flexroad(
        "run", "--config", quick_config, "--catalog", survey, "--out", run, "--executor", "serial"
    ).expected(0)
    tile = Catalog.read(survey).tiles[0]
    points.write_text(f"easting,northing\n{tile.grid.west + 9},{tile.grid.south + 9}\n")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another"))
    option = ("--allow", str(survey.parent))
    for words in (
        ("rerun", run, "--executor", "serial"),
        ("report", run, "--format", "html"),
        ("query", run, "--points", points),
        ("status", run),
    ):
        assert "--allow" in flexroad(*words).expected(2).err, words
        flexroad(*option, *words).expected(0)
    view = library.open_run(run)
    with pytest.raises(CatalogError, match="--allow"):
        view.tile(tile.id)
    with pytest.raises(CatalogError, match="--allow"):
        view.height(tile.grid.west + 9, tile.grid.south + 9)
    allowed = library.open_run(run, allow=[survey.parent])
    assert allowed.tile(tile.id).dsm.notnull().any()
    assert allowed.height(tile.grid.west + 9, tile.grid.south + 9) > 0


def test_echo_escapes_control_characters(capsys):
    echo("failed \x1b[2Ja\r\n\u202eb", err=True)
    echo_document("one\x1b\ntwo\n")
    said = capsys.readouterr()
    assert said.err == "failed \\x1b[2Ja\\r\\n\\u202eb\n"
    assert said.out == "one\\x1b\ntwo\n"


def test_commands_print_with_echo_only():
    """The streams' module is the one place where characters are escaped."""
    others = [path for path in CLI.glob("*.py") if path.name != "stdio.py"]
    assert not [path for path in others if any(word in path.read_text() for word in ("typer.echo", "print("))]


def test_error_line_is_escaped(flexroad, monkeypatch):
    def fail():
        raise ConfigError("a\x1b[2Jb\nc")

    monkeypatch.setattr("flexroad.pipeline.cli.main.app", fail)
    assert flexroad("run").expected(2).err == "error: a\\x1b[2Jb\nerror: c\n"


def test_progress_lines_are_escaped():
    out = io.StringIO()
    ProgressDisplay(1, Console(file=out)).say("failed a\x1b[2J\n[bold]b")
    assert out.getvalue() == "failed a\\x1b[2J\\n[bold]b\n"
