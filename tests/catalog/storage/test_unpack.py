"""A zip archive is unpacked beside itself if it is complete, has its checksum, and is no bomb."""

import hashlib
import os
import shutil
import zipfile
from collections import namedtuple

import pytest

from flexroad.catalog import CatalogError
from flexroad.catalog.storage import unpack as module
from flexroad.catalog.storage.unpack import unpack
from tests.builders import make_special

CONTENT = {"GeRoD/readme.txt": b"heights " * 40, "GeRoD/dsm/a.tif": bytes(range(256)) * 20}


def zipped(path, content=CONTENT, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return path


def sha256(path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def quietly(items, step, total):
    return items


def files(folder) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_archive_is_unpacked_beside_itself_with_estimate_and_progress(tmp_path):
    archive, said, steps = zipped(tmp_path / "GeRoD.zip"), [], []

    def progress(items, step, total):
        steps.append(step)
        return items

    folder = unpack(archive, sha256(archive), progress, said.append)
    assert folder == tmp_path / "GeRoD"
    assert files(folder) == CONTENT
    assert steps == ["checksum of GeRoD.zip (MB)", "unpacking GeRoD.zip (MB)"]
    assert said[0].startswith(f"GeRoD.zip unpacks to 0.00 GB in {folder}; ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["GeRoD", "GeRoD.zip"]
    # The folder is complete: it is not unpacked again, and the archive is not needed.
    archive.write_bytes(b"")
    assert unpack(archive, "", progress, said.append) == folder
    assert said[1].startswith(f"{folder} is there and is read in place of GeRoD.zip")


def flipped(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


OUTSIDE = "has a file outside its folder: {}; download it again"


@pytest.mark.parametrize(
    ("damage", "published", "line"),
    [
        (
            lambda path: os.truncate(path, 2000),
            "0000",
            "is no complete zip file (0.00 GB); finish its download",
        ),
        (lambda path: path.write_bytes(b""), "0000", "is no complete zip file"),
        (
            lambda path: zipped(path, {"a": bytes(10**7)}, zipfile.ZIP_DEFLATED),
            "0000",
            "times its size: it is not the dataset; download it again",
        ),
        (flipped, "0000", "the published file 0000; download it again, or unpack it and name the folder"),
        (flipped, "", "is damaged: Bad CRC-32 for file 'GeRoD/dsm/a.tif'; download it again"),
        (lambda path: zipped(path, {"GeRoD/a": b"a", "../b": b"b"}), "0000", OUTSIDE.format("../b")),
        (lambda path: zipped(path, {"/etc/b": b"b"}), "0000", OUTSIDE.format("/etc/b")),
        (lambda path: path.unlink(), "0000", "cannot be read: No such file or directory"),
        (lambda path: make_special(path, "pipe"), "0000", "is not a regular file; replace it by one"),
    ],
)
def test_wrong_archive_is_one_line_and_leaves_nothing(tmp_path, damage, published, line):
    """Where no checksum is given, the archive is damaged as published."""
    archive = zipped(tmp_path / "GeRoD.zip")
    damage(archive)
    with pytest.raises(CatalogError) as raised:
        unpack(archive, published or sha256(archive), quietly, lambda line: None)
    assert line in str(raised.value)
    assert str(archive) in str(raised.value)
    assert "\n" not in str(raised.value)
    assert [path.name for path in tmp_path.iterdir()] in ([], ["GeRoD.zip"])


def test_archive_too_large_for_the_disk_or_of_many_files_is_refused_first(tmp_path, monkeypatch):
    archive = zipped(tmp_path / "GeRoD.zip")
    usage = namedtuple("usage", "free")(100)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(CatalogError, match=r"needs 0.00 GB, but only 0.00 GB are free in .*; move it to a"):
        unpack(archive, "0000", quietly, lambda line: None)
    monkeypatch.setattr(module, "MAX_FILES", 1)
    with pytest.raises(CatalogError, match="in 2 files"):
        unpack(archive, "0000", quietly, lambda line: None)


def test_part_of_a_killed_command_is_replaced(tmp_path):
    archive = zipped(tmp_path / "GeRoD.zip")
    (tmp_path / ".GeRoD.part").mkdir()
    (tmp_path / ".GeRoD.part" / "old").write_text("old")
    assert files(unpack(archive, sha256(archive), quietly, lambda line: None)) == CONTENT
    assert not (tmp_path / ".GeRoD.part").exists()
