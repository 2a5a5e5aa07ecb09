"""A file behaves alike on disk and in a bucket."""

import sys
from pathlib import Path

import pytest

from flexroad.catalog.storage import paths
from flexroad.catalog.storage.paths import StatCache, parse_location
from tests.s3_server import Fault


@pytest.fixture(params=["disk", pytest.param("bucket", marks=pytest.mark.slow)])
def folder(request, tmp_path):
    return tmp_path if request.param == "disk" else request.getfixturevalue("bucket")


def test_what_is_written_is_seen_listed_and_read(folder):
    assert paths.listing(folder) == {}
    for name in ("a.bin", "b/c.bin", "b/d/e.bin"):
        paths.write(folder / name, name.encode())
    found = paths.listing(folder)
    assert {name: seen.size for name, seen in found.items()} == {"a.bin": 5, "b/c.bin": 7, "b/d/e.bin": 9}
    look = StatCache()
    for name, seen in found.items():
        assert paths.read(folder / name) == name.encode()
        assert paths.stat(folder / name) == look(folder / name) == seen
    assert paths.listing(folder / "b").keys() == {"c.bin", "d/e.bin"}
    for name in ("no.bin", "b/no.bin", "no/no.bin"):
        assert look(folder / name) is paths.stat(folder / name) is None
        assert not paths.exists(folder / name)
    assert paths.exists(folder / "a.bin")


def test_other_bytes_are_another_version(folder):
    paths.write(folder / "a", b"one")
    before = paths.stat(folder / "a")
    paths.write(folder / "a", b"two")
    after = paths.stat(folder / "a")
    assert before.size == after.size
    assert before.version != after.version


def test_what_is_missing_is_named(folder):
    with pytest.raises(FileNotFoundError) as caught:
        paths.read(folder / "no")
    assert caught.value.filename in (str(folder / "no"), folder / "no")
    paths.write(folder / "there", b"")
    paths.remove(folder / "there")
    paths.remove(folder / "there")
    assert paths.listing(folder) == {}


@pytest.mark.slow
def test_a_place_says_what_it_was_called(tmp_path, bucket):
    assert parse_location(str(tmp_path)) == tmp_path
    assert type(parse_location(str(tmp_path))) is type(tmp_path)
    assert not paths.is_remote(parse_location("a/s3:/b"))
    address = f"{bucket}/a/b.tif"
    # A path has lost a slash on its way through a command line.
    for told in (address, Path(address), bucket / "a" / "b.tif"):
        assert str(parse_location(told)) == address
        assert paths.is_remote(parse_location(told))
    assert paths.gdal_name(parse_location(address)) == address.replace("s3://", "/vsis3/")


def test_without_s3fs_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)
    with pytest.raises(OSError, match=r"install it with pip install 'flexroad\[s3\]'.*s3://bucket/name"):
        parse_location("s3://bucket/name")


def test_a_name_is_made_plain_without_a_look_at_links(tmp_path):
    (tmp_path / "link").symlink_to("/")
    assert paths.normalise(f"{tmp_path}/link/../b/./c") == f"{tmp_path}/b/c"
    assert paths.normalise("s3://one/a/../b/c") == "s3://one/b/c"
    # Out of the bucket is another bucket, and no longer below the folder.
    assert paths.normalise("s3://one/a/../../../two/c") == "s3://two/c"


@pytest.mark.slow
def test_a_folder_of_a_bucket_is_listed_once(bucket, storage):
    for i in range(20):
        paths.write(bucket / "data" / f"{i}.tif", b"x")
    storage.requests()
    look = StatCache()
    assert all(look(bucket / "data" / f"{i}.tif") for i in range(20))
    assert len(storage.requests()) == 1


@pytest.mark.slow
def test_a_write_is_one_request(bucket, storage):
    storage.requests()
    paths.write(bucket / "a", b"x" * 1_000_000)
    assert [method for method, _ in storage.requests()] == ["PUT"]
    paths.read(bucket / "a")
    assert [method for method, _ in storage.requests()] == ["GET"]


@pytest.mark.slow
@pytest.mark.parametrize("answer", ["slow", "error", "cut"])
def test_storage_that_stumbles_is_asked_again(bucket, storage, answer):
    storage.fail(Fault(answer, first=2))
    paths.write(bucket / "a" / "b", b"whole")
    assert paths.read(bucket / "a" / "b") == b"whole"
    assert paths.stat(bucket / "a" / "b").size == 5
    assert list(paths.listing(bucket)) == ["a/b"]


@pytest.mark.slow
def test_an_answer_that_breaks_off_is_asked_for_again(bucket, storage):
    data = bytes(range(256)) * 1000
    paths.write(bucket / "a", data)
    storage.fail(Fault("half", method="GET", first=1))
    assert paths.read(bucket / "a") == data


@pytest.mark.slow
@pytest.mark.parametrize("answer", ["slow", "denied"])
def test_storage_that_never_answers_is_named(bucket, storage, answer):
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
