"""Links in a run's folder that lead out of it: nothing behind them is read, written or deleted."""

import json
import shutil
from pathlib import Path

import pytest

from flexroad.catalog import Catalog
from tests import command_line
from tests.builders import finish_run

SERIAL = ("--executor", "serial")


@pytest.fixture(scope="module")
def made(made_survey, tmp_path_factory) -> Path:
    """The folder of a finished run of one tile, with a viewer and a report, for copying."""
    folder = finish_run(tmp_path_factory.mktemp("made") / "run", made_survey, tiles=1).path
    for command in ("view", "report"):
        command_line.call(command, folder).expected(0)
    return folder


@pytest.fixture
def run(made, tmp_path) -> Path:
    return shutil.copytree(made, tmp_path / "run")


@pytest.fixture
def outside(tmp_path) -> Path:
    """A folder that is not of the run."""
    folder = tmp_path / "outside"
    folder.mkdir()
    return folder


def lead_out(path: Path, outside: Path) -> Path:
    """Move a file or folder of a run out of it, and leave a link in its place."""
    target = outside / path.name
    shutil.move(path, target)
    path.symlink_to(target)
    return target


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def tile_of(run: Path) -> Path:
    (folder,) = (run / "tiles").iterdir()
    return folder


FOLDERS = ("store", "tiles", "viewer")
FILES = ("run.json", "config.yaml", "catalog.parquet", "database.txt", "log.jsonl")


@pytest.mark.parametrize("name", [*FOLDERS, *FILES])
def test_link_at_the_top_of_a_run_ends_every_command(name, run, outside, flexroad, made_survey, light_config):
    target, before = lead_out(run / name, outside), contents(outside)
    again = ("--catalog", made_survey / "catalog.parquet", "--config", light_config, *SERIAL)
    for words in (
        ("rerun", run, *SERIAL, "--from", "load"),
        ("run", "--out", run, *again),
        ("clean", run),
        ("status", run),
        ("report", run),
        ("view", run),
    ):
        (line,) = flexroad(*words).expected(2).errors
        assert f"{run / name} is a link that leads out of {run}, to {target}; " in line, words
    assert contents(outside) == before
    assert not (run / "lock.json").exists()


def test_lock_that_leads_out_is_not_taken_over(run, outside, flexroad):
    (outside / "mine").write_text("mine")
    (run / "lock.json").symlink_to(outside / "mine")
    for command in ("rerun", "clean"):
        assert "lock.json is a link that leads out" in flexroad(command, run).expected(2).err
    assert (outside / "mine").read_text() == "mine"


@pytest.mark.parametrize("part", ["folder", "item.json", "failed.json", "product"])
def test_link_in_a_tile_is_not_written_through(part, run, outside, flexroad):
    folder = tile_of(run)
    (folder / "failed.json").write_text("mine")
    product = next(folder.glob("*.glb"))
    place = {"folder": folder, "product": product}.get(part, folder / part)
    lead_out(place, outside)
    before = contents(outside)
    said = flexroad("rerun", run, *SERIAL, "--from", "export").expected(1)
    (line,) = (line for line in said.errors if line.startswith("failed"))
    assert f"export: OSError: [Errno 18] a link leads to {outside}" in line
    assert "replace it by the file or folder itself" in line
    flexroad("clean", run)
    assert contents(outside) == before
    # Without the link the tile is written again.
    place.unlink()
    flexroad("rerun", run, *SERIAL).expected(0)
    assert contents(outside) == before


def test_clean_deletes_nothing_behind_links(run, outside, flexroad):
    """Files that would be garbage in the run itself."""
    tile, gone = tile_of(run), run / "tiles" / "gone"
    shutil.copytree(tile, gone)
    for file in list(gone.iterdir()):
        file.rename(gone / file.name.replace(tile.name, "gone"))
    lead_out(gone, outside)
    artefact = next((run / "store" / "fit").rglob("*.npz"))
    for number, stage in enumerate(("fit", "sample", "evaluate")):
        place = run / "store" / stage / f"{number}{number}"
        shutil.copytree(artefact.parent, place)
        next(place.glob("*.npz")).rename(place / f"{number}{number}{'0' * 30}.npz")
    lead_out(run / "store" / "fit" / "00", outside)
    lead_out(run / "store" / "sample", outside)
    before = contents(outside)
    assert len(before) > 5
    said = flexroad("clean", run).expected(0)
    assert "artefacts that no run needs: 1 file" in said.out
    assert contents(outside) == before


@pytest.mark.parametrize("part", ["stage", "folder", "file"])
def test_link_in_the_store_is_neither_read_nor_written_through(part, run, outside, flexroad):
    nodes = json.loads((tile_of(run) / "item.json").read_text())["properties"]["flexroad:nodes"]
    file = next((run / "store" / "fit").rglob(f"{nodes['flexroad']['fit']}.npz"))
    lead_out({"stage": file.parent.parent, "folder": file.parent, "file": file}[part], outside)
    before = contents(outside)
    said = flexroad("rerun", run, *SERIAL, "--from", "sample").expected(1)
    assert "store: OSError: [Errno 18] a link leads to" in said.err
    flexroad("rerun", run, *SERIAL, "--from", "fit").expected(1)
    assert contents(outside) == before


@pytest.mark.parametrize("name", ["tiles", "index.html", "viewer.js"])
def test_link_in_the_viewer_is_not_written_through(name, run, outside, flexroad):
    lead_out(run / "viewer" / name, outside)
    before = contents(outside)
    said = flexroad("view", run).expected(2)
    assert f"{run / 'viewer' / name} is a link that leads out of {run / 'viewer'}" in said.err
    assert contents(outside) == before


def test_run_and_store_that_are_given_by_links_work(made_survey, light_config, tmp_path, flexroad):
    disk = tmp_path / "disk"
    for name in ("run", "store"):
        (disk / name).mkdir(parents=True)
        (tmp_path / name).symlink_to(disk / name)
    (tmp_path / "mounted").symlink_to(disk)
    catalog = made_survey / "catalog.parquet"
    one = Catalog.read(catalog).tiles[0].id
    words = ("--catalog", catalog, "--config", light_config, "--tile", one, *SERIAL)
    flexroad("run", "--out", tmp_path / "run", "--store", tmp_path / "store", *words).expected(0)
    assert list((disk / "store").rglob("*.npz"))
    for run in (tmp_path / "run", tmp_path / "mounted" / "run", disk / "run"):
        for command in ("status", "view", "report", "clean"):
            flexroad(command, run).expected(0)
        flexroad("rerun", run, *SERIAL, "--from", "export").expected(0)
    assert "1 cached" in flexroad("run", "--out", tmp_path / "run", *words).expected(0).out


def test_link_within_a_run_is_followed(run, flexroad):
    shutil.move(run / "log.jsonl", run / "log of the run.jsonl")
    (run / "log.jsonl").symlink_to("log of the run.jsonl")
    flexroad("rerun", run, *SERIAL, "--from", "export").expected(0)
    assert (run / "log.jsonl").is_symlink()
