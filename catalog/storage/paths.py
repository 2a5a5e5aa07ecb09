"""File access on disk and in object storage; the only module that distinguishes the two.

A location on disk is a `pathlib.Path`. A location in a bucket, ``s3://bucket/name``, is a `upath.UPath` and
needs the extra ``s3``. Both join with ``/`` and have ``parent`` and ``name``; reading, writing and listing
files is done by the functions below.

This module does not retry requests. botocore (used by s3fs) and GDAL do, with growing pauses, when storage
throttles, answers 5xx or drops the connection.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from stat import S_ISREG
from typing import TYPE_CHECKING, TypeAlias
from uuid import uuid4

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.outputs import atomic_path, flush_path
from flexroad.catalog.storage.settings import s3_options
from flexroad.catalog.text import printable, without_credentials

if TYPE_CHECKING:
    from upath import UPath

aiohttp = lazy("aiohttp")
botocore = lazy("botocore.exceptions")
upath = lazy("upath")

Location: TypeAlias = "Path | UPath"

PROBE = ".probe-"
"""Start of the names of files that test whether a folder is writable; 32 hexadecimal digits follow."""
ROUNDS = 3
"""Attempts of s3fs when an answer breaks off in the middle; botocore does not retry these."""
# Path("s3://bucket") drops a slash.
_BUCKET = re.compile(r"(?i:s3):/{1,2}(?=[^/])")
_SCHEME = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*:/")
# s3fs raises some of these without an errno.
_NUMBERS = (
    (FileNotFoundError, errno.ENOENT),
    (PermissionError, errno.EACCES),
    (FileExistsError, errno.EEXIST),
)


@dataclass(frozen=True)
class FileStat:
    """Size and version of a file."""

    size: int
    """Bytes."""
    version: int | str
    """Changes when the content changes: modification time (ns) on disk, ETag in a bucket; a text on disk
    if a source has several files (`source_stat`)."""


def parse_location(where: str | Location) -> Location:
    """Return the location given as text: a path, or s3://BUCKET/NAME."""
    if not isinstance(where, str | Path):
        return where
    text = str(where)
    bucket = _BUCKET.match(text)
    if bucket is None:
        if _SCHEME.match(text):
            reason = "is neither a path on disk nor s3://BUCKET/NAME"
            address = printable(without_credentials(text))
            raise CatalogError(f"{address} {reason}; fetch it first, or give its path")
        return Path(where)
    name = normalise(text)
    try:
        remote: UPath = upath.UPath("s3://" + text[bucket.end() :], **s3_options())
        remote.fs.retries = ROUNDS
    except ImportError as error:
        raise OSError(
            errno.ENOTSUP,
            "object storage needs s3fs; install it with pip install 'flexroad[s3]'",
            name,
        ) from error
    return remote


def is_remote(where: Location) -> bool:
    """Return whether a location is in object storage."""
    return not isinstance(where, Path)


def absolute(where: Location) -> Location:
    """Return the location as an absolute path with links resolved; a location in a bucket is unchanged."""
    return where.resolve() if isinstance(where, Path) else where


def join(folder: str, name: str) -> str:
    """Return the full name of a file: relative names are joined to the folder, others are unchanged."""
    return name if _BUCKET.match(name) else os.path.join(folder, name)  # noqa: PTH118 (UPath is slow)


def normalise(name: str) -> str:
    """Return an absolute path or address without ``..``; links are not followed."""
    bucket = _BUCKET.match(name)
    if bucket is None:
        return os.path.normpath(name if name.startswith("/") else Path(name).absolute())
    if (hidden := without_credentials(name)) != name:
        raise CatalogError(
            f"{printable(hidden)} has credentials; give s3://BUCKET/NAME, and set AWS_ACCESS_KEY_ID and "
            "AWS_SECRET_ACCESS_KEY"
        )
    return "s3:/" + os.path.normpath("/" + name[bucket.end() :])


def resolved(name: str) -> str:
    """Return an absolute path with links resolved, or an address without ``..``.

    The links of a folder are read once, the links of a file each time.
    """
    if _BUCKET.match(name) or "\0" in name:
        return normalise(name)
    folder, file = os.path.split(name if name.startswith("/") else f"{Path.cwd()}/{name}")
    if file in ("", ".", "..") or os.path.islink(name):  # noqa: PTH114 (Path is slow)
        return os.path.realpath(name)
    return _resolved_folder(folder).rstrip("/") + "/" + file


@lru_cache(maxsize=4096)
def _resolved_folder(folder: str) -> str:
    return os.path.realpath(folder)


def gdal_name(where: Location) -> str:
    """Return GDAL's name of a file."""
    return str(where) if isinstance(where, Path) else f"/vsis3/{where.path}"


def stat(where: Location) -> FileStat | None:
    """Return a file's size and version, or None if there is no such file.

    Links are followed. Folders, pipes, sockets and devices are not files: reading them may never end.
    """
    if isinstance(where, Path):
        return file_stat(where)
    try:
        with named(where):
            entry = where.fs.info(where.path)
        is_file = entry["type"] == "file"
        return FileStat(int(entry["size"]), str(entry["ETag"]).strip('"')) if is_file else None
    except FileNotFoundError:
        return None


def file_stat(path: str | Path) -> FileStat | None:
    """Return `stat` of a path on disk, which may be a text."""
    try:
        stats = os.stat(path)  # noqa: PTH116 (Path is slow)
    except (OSError, ValueError):
        return None
    if not S_ISREG(stats.st_mode):
        return None
    return FileStat(stats.st_size, stats.st_mtime_ns)


def listing(folder: Location) -> dict[str, FileStat]:
    """Return all files below a folder by their relative names; empty if the folder does not exist.

    In a bucket this is one (paged) list request. For a large folder, `entries` yields files one by one.
    """
    return dict(entries(folder))


def entries(folder: Location) -> Iterator[tuple[str, FileStat]]:
    """Yield relative name and stat of all files below a folder; nothing if it does not exist.

    Links to folders inside it are not followed. In a bucket, files come in the order of their names, in pages
    of a thousand: memory does not grow with their number.
    """
    return _scan(folder, "") if isinstance(folder, Path) else _pages(folder, {})


def entries_of(folder: UPath) -> Iterator[tuple[str, FileStat]]:
    """Yield the files of a folder of a bucket as `entries` does, without those in subfolders."""
    return _pages(folder, {"Delimiter": "/"})


def _pages(folder: UPath, options: dict[str, str], start: str = "") -> Iterator[tuple[str, FileStat]]:
    bucket, _, key = folder.path.partition("/")
    prefix = f"{key.rstrip('/')}/" if key.strip("/") else ""
    request = {"Bucket": bucket, "Prefix": prefix + start, **options}
    while True:
        try:
            with named(folder):
                page = folder.fs.call_s3("list_objects_v2", **request)
        except FileNotFoundError:
            return
        for entry in page.get("Contents", ()):
            name = entry["Key"][len(prefix) :]
            # Some programs make empty objects with the names of folders.
            if name and not name.endswith("/"):
                yield name, FileStat(int(entry["Size"]), str(entry["ETag"]).strip('"'))
        if not page.get("IsTruncated"):
            return
        request["ContinuationToken"] = page["NextContinuationToken"]


def visible_entry(folder: Location, without: Collection[str] = ()) -> str | None:
    """Return the name of any file or folder in a folder; None if it is empty or does not exist.

    Hidden files (``.DS_Store``), ``lost+found`` of a new disk, and the names in ``without`` are ignored. Of a
    large folder in a bucket only the first page of names is requested.
    """
    if isinstance(folder, Path):
        try:
            names = iter(sorted(os.listdir(folder)))  # noqa: PTH208 (iterdir gives no names)
        except (FileNotFoundError, NotADirectoryError):
            return None
    else:
        names = (name.partition("/")[0] for name, _ in entries(folder))
    left_out = {"lost+found", *without}
    return next((name for name in names if not name.startswith(".") and name not in left_out), None)


def hidden_files(folder: Location) -> dict[str, int]:
    """Return the sizes of a folder's hidden files (bytes) by name, without those in subfolders."""
    if isinstance(folder, Path):
        return {path.name: path.stat().st_size for path in folder.glob(".*") if path.is_file()}
    return {name: file.size for name, file in entries_of(folder) if name.startswith(".")}


def sidecars(where: UPath) -> set[str]:
    """Return the names of a file in a bucket and of the files with the same stem, by one list request.

    Calling this before GDAL opens a file saves a dozen requests for side-car files, which are rare.
    """
    with named(where):
        return {name for name, _ in _pages(where.parent, {"Delimiter": "/"}, f"{where.stem}.")}


def exists(where: Location) -> bool:
    """Return whether the file exists, or in a bucket any file below its name."""
    if isinstance(where, Path):
        return where.exists()
    with named(where):
        return bool(where.fs.exists(where.path))


def read(where: Location) -> bytes:
    """Return a file's bytes; in a bucket, by one request."""
    if isinstance(where, Path):
        if not where.is_file() and not where.is_dir() and where.exists():
            # Opening a pipe would wait for a writer.
            raise OSError(errno.EINVAL, "not a regular file", str(where))
        return where.read_bytes()
    with named(where):
        data: bytes = where.fs.cat_file(where.path, max_concurrency=1)
        return data


def fetch(where: UPath, folder: Path) -> Path:
    """Copy a file of a bucket and its side-car files into a folder; return the path of the copy."""
    for name in {where.name, *sidecars(where)}:
        source = where.parent / name
        with named(source):
            source.fs.get_file(source.path, str(folder / name))
    return folder / where.name


def write(where: Location, data: bytes, flushed: bool = False) -> None:
    """Write a file atomically: to a temporary file that is then renamed, or in a bucket by one request.

    With ``flushed`` the content is on the disk before the file has its name.
    """
    if not isinstance(where, Path):
        # A file appears in a bucket only when it is complete.
        with named(where):
            where.fs.pipe_file(where.path, data)
        return
    with atomic_path(where, flushed) as temporary:
        where.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)


def flush(where: Location) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk; nothing in a bucket."""
    if isinstance(where, Path):
        flush_path(where)


def flush_names(*folders: Location) -> None:
    """Wait until the names in folders are on the disk, if the storage can do that: some shares cannot."""
    for folder in folders:
        with contextlib.suppress(OSError):
            flush(folder)


def refresh(*folders: Location) -> None:
    """Look up the names in folders again: a share may remember for a minute that a file was missing."""
    for folder in folders:
        if isinstance(folder, Path):
            # Opening a folder sends a request to the server.
            with contextlib.suppress(OSError), os.scandir(folder):
                pass


def remove(where: Location) -> None:
    """Remove a file; do nothing if it does not exist."""
    if isinstance(where, Path):
        where.unlink(missing_ok=True)
        return
    with named(where), contextlib.suppress(FileNotFoundError):
        where.fs.rm_file(where.path)


def check_writable(folder: Location) -> None:
    """Check that files can be written in ``folder``."""
    probe = folder / f"{PROBE}{uuid4().hex}"
    write(probe, b"")
    remove(probe)


def _scan(folder: Path, prefix: str) -> Iterator[tuple[str, FileStat]]:
    """Yield name and stat of all files below a folder; names start with ``prefix``."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
        for entry in entries:
            name = prefix + entry.name
            if entry.is_dir(follow_symlinks=False):
                yield from _scan(folder / entry.name, name + "/")
            elif not entry.is_dir():
                with contextlib.suppress(FileNotFoundError):
                    stats = entry.stat()
                    yield name, FileStat(stats.st_size, stats.st_mtime_ns)


@contextlib.contextmanager
def named(where: UPath) -> Iterator[None]:
    """Turn errors of object storage into an OSError that names the file."""
    try:
        yield
    except OSError as error:
        number = error.errno or next((n for kind, n in _NUMBERS if isinstance(error, kind)), errno.EIO)
        raise OSError(number, error.strerror or str(error), str(where)) from error
    except (botocore.BotoCoreError, aiohttp.ClientError, ValueError) as error:
        # botocore raises ValueError for settings that it cannot use.
        raise OSError(errno.EIO, str(error), str(where)) from error


def contained(where: Location, home: Location) -> Location:
    """Return a location in an untrusted folder; OSError if a link leads out of the folder.

    The folder itself may be a link, or lie behind one. In a bucket there are no links.
    """
    if isinstance(where, Path) and not _is_direct(str(where), str(home)):
        target = os.path.realpath(where)
        if not _is_below(target, os.path.realpath(str(home))):
            reason = f"a link leads to {target}, out of {home}; replace it by the file or folder itself"
            raise OSError(errno.EXDEV, reason, str(where))
    return where


def links_out(folder: Location, below: bool = False) -> Iterator[Path]:
    """Yield the links in a folder, with ``below`` also in folders inside it, that lead out of it."""
    if isinstance(folder, Path):
        yield from _links_out(folder, os.path.realpath(folder), below)


def _links_out(folder: Path, home: str, below: bool) -> Iterator[Path]:
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except (FileNotFoundError, NotADirectoryError):
        return
    for entry in entries:
        if entry.is_symlink():
            if not _is_below(os.path.realpath(entry.path), home):
                yield folder / entry.name
        elif below and entry.is_dir():
            yield from _links_out(folder / entry.name, home, below)


def _is_direct(where: str, home: str) -> bool:
    """Return whether a path leads from a folder to a place below it without ``..`` and links.

    A tile has dozens of such paths, and resolving both sides would take four times as long.
    """
    start = home.rstrip("/") + "/"
    parts = where.removeprefix(start).split("/")
    folders = itertools.accumulate(parts, lambda folder, part: f"{folder}/{part}")
    return (
        where.startswith(start)
        and ".." not in parts
        # `os.path.islink` returns False for it.
        and "\0" not in where
        and not any(os.path.islink(start + folder) for folder in folders)  # noqa: PTH114 (Path is slow)
    )


def _is_below(target: str, home: str) -> bool:
    return target == home or target.startswith(home.rstrip("/") + "/")
