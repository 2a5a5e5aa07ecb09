"""Zip archives unpacked beside themselves, after their content, size and checksum were checked."""

from __future__ import annotations

import hashlib
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.text import Notify, one_line, printable, write_reason

CHUNK_BYTES = 1 << 20
MAX_RATIO = 20
"""Largest size of the files of an archive, relative to its own; archives of height rasters have 1 to 5."""
MAX_FILES = 100_000
GB = 1e9

Progress = Callable[[Iterable[int], str, int], Iterable[int]]
"""Shows progress: steps of `CHUNK_BYTES`, the work's name, and the number of steps."""


def unpack(archive: Path, sha256: str, progress: Progress, notify: Notify) -> Path:
    """Return the folder with an archive's files: beside it, with its name; unpack the archive if needed.

    An existing folder is complete, because it gets its name when all files are in it.

    - `notify`: takes a line with the size and the folder, or that the folder exists.
    """
    target = archive.with_suffix("")
    if target.is_dir():
        notify(f"{target} is there and is read in place of {archive.name}; remove it to unpack anew")
        return target
    entries = _entries(archive)
    size, free = sum(entry.file_size for entry in entries), shutil.disk_usage(target.parent).free
    notify(f"{archive.name} unpacks to {size / GB:.2f} GB in {target}; {free / GB:.2f} GB are free")
    if size > free:
        raise CatalogError(
            f"{archive} needs {size / GB:.2f} GB, but only {free / GB:.2f} GB are free in {target.parent}; "
            "move it to a larger disk"
        )
    _check_sum(archive, sha256, progress)
    part = target.with_name(f".{target.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        _extract(archive, entries, part, progress, size)
        part.replace(target)
    except OSError as error:
        raise CatalogError(
            f"{archive} cannot be unpacked to {target}: {write_reason(error)}; copy it where you may write"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return target


def _entries(archive: Path) -> list[zipfile.ZipInfo]:
    if archive.exists() and not archive.is_file():
        # Opening a pipe would wait for a writer.
        raise CatalogError(f"{archive} is not a regular file; replace it by one")
    try:
        size = archive.stat().st_size
        with zipfile.ZipFile(archive) as opened:
            entries = [entry for entry in opened.infolist() if not entry.is_dir()]
    except OSError as error:
        raise CatalogError(f"{archive} cannot be read: {error.strerror or error}") from error
    except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
        raise CatalogError(
            f"{archive} is no complete zip file ({size / GB:.2f} GB); finish its download"
        ) from error
    total = sum(entry.file_size for entry in entries)
    if total > MAX_RATIO * size or len(entries) > MAX_FILES:
        raise CatalogError(
            f"{archive} would unpack to {total / GB:.2f} GB in {len(entries)} files, "
            f"{total / size:.0f} times its size: it is not the dataset; download it again"
        )
    for entry in entries:
        path = PurePosixPath(entry.filename)
        # A link in an archive is written as a regular file with the link's target as content.
        if path.is_absolute() or ".." in path.parts:
            raise CatalogError(
                f"{archive} has a file outside its folder: {printable(entry.filename)}; download it again"
            )
    return entries


def _check_sum(archive: Path, sha256: str, progress: Progress) -> None:
    digest = hashlib.sha256()
    try:
        with archive.open("rb") as file:
            number = -(-archive.stat().st_size // CHUNK_BYTES)
            for _ in progress(range(number), f"checksum of {archive.name} (MB)", number):
                digest.update(file.read(CHUNK_BYTES))
    except OSError as error:
        raise CatalogError(f"{archive} cannot be read: {error.strerror or error}") from error
    if digest.hexdigest() != sha256:
        raise CatalogError(
            f"{archive} has the SHA-256 {digest.hexdigest()}, the published file {sha256}; "
            "download it again, or unpack it and name the folder"
        )


def _extract(
    archive: Path, entries: list[zipfile.ZipInfo], part: Path, progress: Progress, size: int
) -> None:
    def written() -> Iterator[int]:
        """Yield a number for each complete `CHUNK_BYTES`."""
        done = 0
        for entry in entries:
            target = part / entry.filename
            target.parent.mkdir(parents=True, exist_ok=True)
            with opened.open(entry) as source, target.open("xb") as file:
                while chunk := source.read(CHUNK_BYTES):
                    file.write(chunk)
                    before, done = done, done + len(chunk)
                    yield from range(before // CHUNK_BYTES, done // CHUNK_BYTES)

    try:
        with zipfile.ZipFile(archive) as opened:
            for _ in progress(written(), f"unpacking {archive.name} (MB)", size // CHUNK_BYTES):
                pass
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, ValueError) as error:
        raise CatalogError(f"{archive} is damaged: {one_line(error)}; download it again") from error
