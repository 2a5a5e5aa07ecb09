"""Settings of buckets, and lists of their files: as for folders, with bounded memory."""

import tracemalloc
from types import SimpleNamespace

import pytest

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.storage import paths
from flexroad.catalog.storage.buckets import ListedFiles, StatCache
from flexroad.catalog.storage.paths import FileStat, parse_location
from flexroad.catalog.storage.settings import gdal_options, s3_options

PAGE, PAGES = 1000, 100


def full_bucket():
    """Return a folder of a made bucket with 100,000 files, whose pages are made when they are asked for."""

    def call_s3(method, Bucket, Prefix, ContinuationToken="0"):
        page = int(ContinuationToken)
        names = (
            f"{Prefix}{number // 5:06}/file_{number % 5}" for number in range(page * PAGE, (page + 1) * PAGE)
        )
        contents = [{"Key": name, "Size": len(name), "ETag": '"abc"'} for name in names]
        return {"Contents": contents, "IsTruncated": page + 1 < PAGES, "NextContinuationToken": str(page + 1)}

    return SimpleNamespace(path="bucket/run/tiles", fs=SimpleNamespace(call_s3=call_s3))


def test_files_of_many_pages_are_kept_outside_memory():
    listed = ListedFiles()
    # The first page loads libraries.
    next(paths.entries(full_bucket()))
    tracemalloc.start()
    try:
        parts = ((name.partition("/"), file) for name, file in paths.entries(full_bucket()))
        listed.add((folder, name, file) for (folder, _, name), file in parts)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # One page; a dict of all of them has 24 MB.
    assert peak < 1e6
    size = len("run/tiles/012345/file_0")
    assert listed.files("012345") == {f"file_{number}": FileStat(size, "abc") for number in range(5)}
    assert listed.get("019999", "file_4") == FileStat(size, "abc")
    assert listed.get("019999", "file_5") is None
    assert listed.files("020000") == ListedFiles().files("a") == {}


@pytest.mark.slow
def test_entries_of_bucket_equal_files_written(bucket):
    names = ["a", "b/c", "b/d/e", "b-f/g"]
    for name in names:
        paths.write(bucket / "run" / name, name.encode())
    paths.write(bucket / "runs", b"beside the folder")
    # An object with the name of a folder, as some programs make it.
    (bucket / "run").fs.call_s3(
        "put_object",
        Bucket=bucket.path.partition("/")[0],
        Key=f"{bucket.path.partition('/')[2]}/run/b/".lstrip("/"),
        Body=b"",
    )
    listed = dict(paths.entries(bucket / "run"))
    assert list(listed) == sorted(names)
    assert {name: stat.size for name, stat in listed.items()} == {name: len(name) for name in names}
    assert all(listed[name] == paths.stat(bucket / "run" / name) for name in names)
    assert [name for name, _ in paths.entries_of(bucket / "run" / "b")] == ["c"]
    assert dict(paths.entries(bucket / "nothing")) == {}


@pytest.mark.slow
def test_stat_cache_of_bucket_equals_stat_and_lists_a_folder_once(bucket, storage):
    for name in ("a/b", "a/c", "d"):
        paths.write(bucket / name, name.encode())
    stat_of = StatCache()
    for name in ("a/b", "a/c", "d", "a/none", "none/a"):
        assert stat_of(bucket / name) == paths.stat(bucket / name)
    storage.requests()
    stat_of = StatCache()
    assert stat_of(bucket / "a" / "b")
    assert stat_of(bucket / "a" / "c")
    assert len(storage.requests()) == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("AWS_ENDPOINT_URL", "localhost:9000"),
        ("AWS_ENDPOINT_URL_S3", "localhost"),
        ("AWS_ENDPOINT_URL", "://x"),
        ("AWS_ENDPOINT_URL", "http://"),
        ("AWS_ENDPOINT_URL", "ftp://a"),
        ("AWS_ENDPOINT_URL", "http://localhost:99999"),
        ("AWS_MAX_ATTEMPTS", "many"),
    ],
)
def test_wrong_setting_gives_one_line_with_remedy_for_buckets_only(name, value, monkeypatch, tmp_path):
    monkeypatch.setenv(name, value)
    with pytest.raises(CatalogError, match=f"{name} is '{value}'; set it to"):
        parse_location("s3://bucket/name")
    assert parse_location(tmp_path) == tmp_path
    # GDAL's options are set for files on disk, too.
    assert "AWS_S3_ENDPOINT" not in gdal_options()


def test_endpoint_in_upper_case_is_used(monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "HTTPS://storage.example.org")
    assert gdal_options()["AWS_HTTPS"] == "YES"
    assert gdal_options()["AWS_S3_ENDPOINT"] == "storage.example.org"
    assert s3_options()["endpoint_url"] == "HTTPS://storage.example.org"
