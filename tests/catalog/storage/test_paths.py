"""Files behave the same on disk and in a bucket; links that lead out, and folders that are made."""

import itertools
import os
import sys
from pathlib import Path

import pytest
from fsspec.registry import _registry

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.storage import paths
from flexroad.catalog.storage.buckets import StatCache
from flexroad.catalog.storage.outputs import made_folder
from flexroad.catalog.storage.paths import contained, parse_location
from tests.builders import make_special
from tests.s3_server import Fault


@pytest.fixture(params=["disk", pytest.param("bucket", marks=pytest.mark.slow)])
def folder(request, tmp_path):
    return tmp_path if request.param == "disk" else request.getfixturevalue("bucket")


def test_written_files_can_be_listed_and_read(folder):
    assert paths.listing(folder) == {}
    for name in ("a.bin", "b/c.bin", "b/d/e.bin"):
        paths.write(folder / name, name.encode())
    files = paths.listing(folder)
    assert {name: stat.size for name, stat in files.items()} == {"a.bin": 5, "b/c.bin": 7, "b/d/e.bin": 9}
    for name, stat in files.items():
        assert paths.read(folder / name) == name.encode()
        assert paths.stat(folder / name) == stat
    assert paths.listing(folder / "b").keys() == {"c.bin", "d/e.bin"}
    for name in ("no.bin", "b/no.bin", "no/no.bin"):
        assert paths.stat(folder / name) is None
        assert not paths.exists(folder / name)
    assert paths.exists(folder / "a.bin")
    before = paths.stat(folder / "a.bin")
    paths.write(folder / "a.bin", b"other")
    after = paths.stat(folder / "a.bin")
    assert before.size == after.size
    assert before.version != after.version


def test_visible_entry_leaves_out_hidden_and_given_names(folder):
    assert paths.visible_entry(folder / "no") is None
    for name in (".DS_Store", ".cache/a.bin", "lost+found/b.bin", "lock.json"):
        paths.write(folder / name, b"x")
    assert paths.visible_entry(folder) == "lock.json"
    assert paths.visible_entry(folder, {"lock.json"}) is None
    assert paths.visible_entry(folder / "lock.json") is None
    paths.write(folder / "z" / "c.bin", b"x")
    assert paths.visible_entry(folder, {"lock.json"}) == "z"


def test_missing_file_is_named_and_remove_ignores_it(folder):
    with pytest.raises(FileNotFoundError) as caught:
        paths.read(folder / "no")
    assert caught.value.filename in (str(folder / "no"), folder / "no")
    paths.write(folder / "there", b"")
    paths.remove(folder / "there")
    paths.remove(folder / "there")
    assert paths.listing(folder) == {}


@pytest.mark.slow
def test_location_text_round_trip(tmp_path, bucket):
    assert parse_location(str(tmp_path)) == tmp_path
    assert type(parse_location(str(tmp_path))) is type(tmp_path)
    assert not paths.is_remote(parse_location("a/s3:/b"))
    address = f"{bucket}/a/b.tif"
    # Path() drops a slash of the address.
    for text in (address, Path(address), bucket / "a" / "b.tif", address.replace("s3:", "S3:")):
        assert str(parse_location(text)) == address
        assert paths.is_remote(parse_location(text))
    assert paths.gdal_name(parse_location(address)) == address.replace("s3://", "/vsis3/")


def test_parse_location_without_s3fs_names_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(_registry, "s3", raising=False)
    with pytest.raises(OSError, match=r"install it with pip install 'flexroad\[s3\]'.*s3://bucket/name"):
        parse_location("s3://bucket/name")


@pytest.mark.parametrize("text", ["https://x/a", "HTTPS://x/a", "File:///a", "file:/a", "gs://b/a"])
def test_parse_location_of_other_address_is_refused(text):
    for where in (text, Path(text)):
        with pytest.raises(CatalogError, match="neither a path on disk nor s3://BUCKET/NAME"):
            parse_location(where)


def test_normalise_does_not_follow_links(tmp_path):
    (tmp_path / "link").symlink_to("/")
    assert paths.normalise(f"{tmp_path}/link/../b/./c") == f"{tmp_path}/b/c"
    assert paths.normalise("s3://one/a/../b/c") == "s3://one/b/c"
    assert paths.normalise("S3://one/a/../b/c") == "s3://one/b/c"
    assert paths.join("/a", "S3://one/b") == "S3://one/b"
    # ".." above the bucket leads to another bucket.
    assert paths.normalise("s3://one/a/../../../two/c") == "s3://two/c"


@pytest.mark.slow
def test_write_and_read_are_one_request_each(bucket, storage):
    storage.requests()
    paths.write(bucket / "a", b"x" * 1_000_000)
    assert [method for method, _ in storage.requests()] == ["PUT"]
    paths.read(bucket / "a")
    assert [method for method, _ in storage.requests()] == ["GET"]


@pytest.mark.slow
@pytest.mark.parametrize("answer", ["slow", "error", "cut", "half"])
def test_storage_fails_twice_request_is_retried(bucket, storage, answer):
    data = bytes(range(256)) * 1000
    half = {"method": "GET", "first": 1} if answer == "half" else {"first": 2}
    storage.fail(Fault(answer, **half))
    paths.write(bucket / "a" / "b", data)
    assert paths.read(bucket / "a" / "b") == data
    assert paths.stat(bucket / "a" / "b").size == len(data)
    assert list(paths.listing(bucket)) == ["a/b"]


@pytest.mark.slow
@pytest.mark.parametrize("answer", ["slow", "denied"])
def test_storage_always_fails_error_names_bucket(bucket, storage, answer):
    storage.fail(Fault(answer))
    for attempt in (
        lambda: paths.write(bucket / "a", b""),
        lambda: paths.read(bucket / "a"),
        lambda: paths.stat(bucket / "a"),
        lambda: paths.listing(bucket),
        lambda: StatCache()(bucket / "a"),
    ):
        with pytest.raises(OSError, match=str(bucket)) as caught:
            attempt()
        assert isinstance(caught.value, PermissionError) == (answer == "denied")


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("pipe", "is a device, pipe or socket and is not replaced"),
        ("socket", "is a device, pipe or socket and is not replaced"),
        ("folder", "Is a directory"),
        ("link to itself", "Too many levels of symbolic links"),
    ],
)
def test_write_does_not_replace_special_file(kind, reason, tmp_path):
    make_special(name := tmp_path / "there", kind)
    before = name.lstat()
    with pytest.raises(OSError, match=reason) as caught:
        paths.write(name, b"new")
    assert caught.value.filename == str(name)
    after = name.lstat()
    assert (after.st_mode, after.st_ino) == (before.st_mode, before.st_ino)
    assert list(tmp_path.iterdir()) == [name]


def test_write_failed_keeps_existing_file(tmp_path):
    path = tmp_path / "a" / "b.json"
    paths.write(path, b"old")
    with pytest.raises(TypeError):
        paths.write(path, "not bytes")
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


def test_write_through_link_keeps_link(tmp_path):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "old.txt").write_bytes(b"old")
    for target in ("old.txt", "new.txt"):
        link = tmp_path / f"to_{target}"
        link.symlink_to(folder / target)
        paths.write(link, b"written")
        assert link.is_symlink()
        assert (folder / target).read_bytes() == b"written"
    pipe = folder / "pipe"
    os.mkfifo(pipe)
    (tmp_path / "to_pipe").symlink_to(pipe)
    with pytest.raises(OSError, match="pipe or socket"):
        paths.write(tmp_path / "to_pipe", b"new")
    assert pipe.is_fifo()


def test_pipe_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for name in ("pipe", "link"):
        assert paths.stat(tmp_path / name) is None
        with pytest.raises(OSError, match="not a regular file"):
            paths.read(tmp_path / name)
    assert paths.stat(tmp_path) is None
    with pytest.raises(IsADirectoryError):
        paths.read(tmp_path)


PARTS = ("a", "b", "..", "file", "up", "inside", "outside", "lost", "round", "missing")


def test_contained_takes_what_is_below_the_folder_with_all_links_resolved(tmp_path):
    """The folder has links in it, and is behind a link; beside the literal definition."""
    real, home = tmp_path / "real", tmp_path / "home"
    (real / "a" / "b").mkdir(parents=True)
    (real / "a" / "file").touch()
    (tmp_path / "other").mkdir()
    for link, target in {
        real / "inside": real / "a",
        real / "outside": tmp_path / "other",
        real / "a" / "up": "..",
        real / "a" / "lost": tmp_path / "missing",
        real / "round": real / "round",
        home: real,
    }.items():
        link.symlink_to(target)
    tried = [Path(home, *parts) for count in range(4) for parts in itertools.product(PARTS, repeat=count)]
    tried += [real / "a", tmp_path / "homes", tmp_path]
    taken = 0
    for path in tried:
        below = os.path.relpath(os.path.realpath(path), os.path.realpath(home))
        if below.split("/")[0] == "..":
            with pytest.raises(OSError, match="a link leads to"):
                contained(path, home)
        else:
            assert contained(path, home) == path
            taken += 1
    assert len(tried) / 4 < taken < len(tried)
    for path in (home / "a" / "b\0", home / ".." / "\0"):
        with pytest.raises(ValueError, match="null byte"):
            contained(path, home)


def test_made_folder_stays_with_its_parents(tmp_path):
    for _ in range(2):
        with made_folder(tmp_path / "new" / "city"):
            assert (tmp_path / "new" / "city").is_dir()
    assert (tmp_path / "new" / "city").is_dir()


def fails_after(*files):
    for file in files:
        file.write_text("mine")
    raise KeyboardInterrupt


def test_made_folder_of_failed_block_is_removed_if_new_and_empty(tmp_path):
    with pytest.raises(KeyboardInterrupt), made_folder(tmp_path / "new" / "city"):
        fails_after()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(KeyboardInterrupt), made_folder(tmp_path / "new" / "city"):
        fails_after(tmp_path / "new" / "notes.txt")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["new", "notes.txt"]
    with pytest.raises(FileExistsError, match="notes"), made_folder(tmp_path / "new" / "notes.txt"):
        pass
    (tmp_path / "new" / "notes.txt").unlink()
    with pytest.raises(KeyboardInterrupt), made_folder(tmp_path / "new"):
        fails_after()
    assert (tmp_path / "new").is_dir()
