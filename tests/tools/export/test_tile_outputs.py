"""Formats with one file: workers write parts, the client joins them, and a second export does nothing."""

from pathlib import Path

import pytest

from flexroad.pipeline.execute import SerialExecutor
from flexroad.tools.export import cityjson, landxml, tile_outputs
from flexroad.tools.export.driver import BEGUN, export
from flexroad.tools.export.source import Options, select

from .conftest import contents

JOINED = ["landxml", "cityjson"]
each = pytest.mark.parametrize("name", JOINED)


@pytest.fixture
def encoded(monkeypatch):
    """The ids of the tiles that workers have encoded."""
    ids, write = [], tile_outputs._write

    def noted(job):
        ids.append(job.tile.id)
        return write(job)

    monkeypatch.setattr(tile_outputs, "_write", noted)
    return ids


def write(city, out, name, ids=(), **options):
    return export(select(city.path, ids), out, [name], Options(**options), SerialExecutor())


def test_files_are_those_of_the_meshes(made_city, tmp_path):
    chosen = select(made_city.path)
    export(chosen, tmp_path, JOINED, Options(), SerialExecutor())
    meshes = [(tile.id, tile.mesh) for tile in chosen.finished()]
    with (tmp_path / "expected").open("wb") as file:
        about = chosen.place.origin, chosen.vertical
        file.write(cityjson.header(chosen.crs, *about))
        file.writelines(cityjson.features(name, mesh, *about) for name, mesh in meshes)
    assert (tmp_path / "cityjson" / "city.city.jsonl").read_bytes() == (tmp_path / "expected").read_bytes()
    written = max(tile.datetime for tile in chosen.tiles)
    project = landxml.Project("city", written, chosen.vertical, joined=False)
    with (tmp_path / "expected").open("wb") as file:
        landxml.join(file, (landxml.part(mesh, joined=False) for _, mesh in meshes), project)
    assert (tmp_path / "landxml" / "city.xml").read_bytes() == (tmp_path / "expected").read_bytes()


@each
def test_second_export_encodes_nothing_and_only_the_file_is_left(made_city, tmp_path, name, encoded):
    first = write(made_city, tmp_path, name)
    (file,) = (tmp_path / name).iterdir()
    before = file.stat().st_mtime_ns
    assert {path.name for path in tmp_path.iterdir()} == {name, f".{name}.json", "export.json", BEGUN}
    encoded.clear()
    assert write(made_city, tmp_path, name) == first
    assert not encoded
    assert file.stat().st_mtime_ns == before


def test_whole_file_is_written_once_and_replaces_one_of_another_name(tmp_path):
    filled = []

    def fill(local):
        filled.append(local)
        local.write_text("roads")

    for name in ("first.xodr", "first.xodr", "second.xodr"):
        (tmp_path / "xodr").mkdir(exist_ok=True)
        tile_outputs.write_whole(tmp_path / "xodr" / name, "key", {}, fill)
    assert len(filled) == 2
    assert [path.name for path in (tmp_path / "xodr").iterdir()] == ["second.xodr"]


@pytest.mark.parametrize("damage", [Path.unlink, lambda file: file.write_bytes(file.read_bytes()[:-1])])
@each
def test_damaged_file_is_written_again(made_city, tmp_path, name, encoded, damage):
    write(made_city, tmp_path, name)
    before = contents(tmp_path)
    encoded.clear()
    damage(next((tmp_path / name).iterdir()))
    write(made_city, tmp_path, name)
    assert encoded == list(made_city.done)
    assert contents(tmp_path) == before


@each
def test_parts_of_an_interrupted_export_are_used(made_city, tmp_path, name, encoded, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(tile_outputs, "atomic_file", interrupted)
        with pytest.raises(KeyboardInterrupt):
            write(made_city, tmp_path, name)
    assert encoded == list(made_city.done)
    assert len(list((tmp_path / name / ".parts").iterdir())) == 2
    first = tmp_path / name / ".parts" / made_city.done[0]
    first.write_bytes(first.read_bytes()[:-10])
    write(made_city, tmp_path, name)
    assert encoded == [*made_city.done, made_city.done[0]]


@each
def test_other_tiles_give_another_file(made_city, tmp_path, name):
    write(made_city, tmp_path / "both", name)
    write(made_city, tmp_path / "one", name, made_city.done[:1])
    write(made_city, tmp_path / "both", name, made_city.done[:1])
    assert contents(tmp_path / "both") == contents(tmp_path / "one")


def test_file_of_another_name_replaces_the_former_one_unless_it_was_changed(made_city, tmp_path):
    write(made_city, tmp_path, "landxml")
    write(made_city, tmp_path, "landxml", compress=True)
    assert [path.name for path in (tmp_path / "landxml").iterdir()] == ["city.xml.gz"]
    (tmp_path / "landxml" / "city.xml.gz").write_bytes(b"of the user")
    write(made_city, tmp_path, "landxml")
    assert sorted(path.name for path in (tmp_path / "landxml").iterdir()) == ["city.xml", "city.xml.gz"]
