"""Where files are: on disk, or in object storage; the one file that knows the difference.

A place on disk is a plain `pathlib.Path`. One in a bucket, ``s3://bucket/name``, is a `upath.UPath`, and
wants the extra ``s3``. Both join with ``/`` and have ``parent`` and ``name``; what touches files is here.

Nothing here tries again by itself: botocore (which s3fs stands on) and GDAL do, after pauses that grow, when
storage throttles, answers 5xx or drops the connection. Both read the usual variables ``AWS_...``;
`gdal_options` tells GDAL those that it knows by other names.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from uuid import uuid4

from upath import UPath

Location = Path | UPath

TRIES = 5
"""How often a request is sent before it counts as failed, unless AWS_MAX_ATTEMPTS says otherwise."""
ROUNDS = 3
"""How often s3fs, which alone sees an answer break off in the middle, begins with that anew."""
# Path("s3://bucket") has lost a slash.
_BUCKET = re.compile(r"s3:/{1,2}(?=[^/])")
# s3fs raises some without their number.
_NUMBERS = (
    (FileNotFoundError, errno.ENOENT),
    (PermissionError, errno.EACCES),
    (FileExistsError, errno.EEXIST),
)
_YES = ("YES", "TRUE", "ON", "1")


@dataclass(frozen=True)
class FileStat:
    """How a file looked."""

    size: int
    version: int | str
    """What changes with its bytes: the time (ns) on disk, the ETag in a bucket."""


def parse_location(where: str | Location) -> Location:
    """Return where a file is, by what an operator or a record calls it: a path, or s3://BUCKET/NAME.

    Raises
    ------
    OSError
        If it is in a bucket and s3fs is not installed; the line says how to get it.
    """
    if isinstance(where, UPath):
        return where
    text = str(where)
    bucket = _BUCKET.match(text)
    if bucket is None:
        return Path(where)
    try:
        remote: UPath = UPath("s3://" + text[bucket.end() :], **_s3_options())
        remote.fs.retries = ROUNDS
    except ImportError as error:
        raise OSError(
            errno.ENOTSUP,
            "object storage needs s3fs; install it with pip install 'flexroad[s3]'",
            normalise(text),
        ) from error
    return remote


def is_remote(where: Location) -> bool:
    """Tell whether a file is in object storage."""
    return not isinstance(where, Path)


def absolute(where: Location) -> Location:
    """Return a place that means the same to every process."""
    return where.resolve() if isinstance(where, Path) else where


def join(folder: str, name: str) -> str:
    """Return what a file is called whose name is relative to a folder, a whole path or an address."""
    return name if _BUCKET.match(name) else os.path.join(folder, name)  # noqa: PTH118 (places are slow)


def normalise(name: str) -> str:
    """Return an absolute path or address without ``..``, by the name alone: links are not followed."""
    bucket = _BUCKET.match(name)
    if bucket is None:
        return os.path.normpath(name if name.startswith("/") else Path(name).absolute())
    return "s3:/" + os.path.normpath("/" + name[bucket.end() :])


def gdal_name(where: Location) -> str:
    """Return what GDAL calls a file."""
    return str(where) if isinstance(where, Path) else f"/vsis3/{where.path}"


def gdal_options() -> dict[str, str]:
    """Return GDAL's options for object storage; what the environment sets for GDAL itself stands."""
    options = {
        # A worker lives longer than a file: what was read of one is forgotten as it is closed.
        "CPL_VSIL_CURL_NON_CACHED": "/vsis3/",
        "GDAL_HTTP_MAX_RETRY": str(_tries() - 1),
        "GDAL_HTTP_RETRY_DELAY": "0.5",
        # 0: no answer at all.
        "GDAL_HTTP_RETRY_CODES": "0,429,500,502,503,504",
        "GDAL_HTTP_CONNECTTIMEOUT": "10",
        # Not a limit on large files: less than a byte a second, for a minute.
        "GDAL_HTTP_LOW_SPEED_LIMIT": "1",
        "GDAL_HTTP_LOW_SPEED_TIME": "60",
    }
    if endpoint := _endpoint():
        options |= {
            "AWS_S3_ENDPOINT": urlsplit(endpoint).netloc,
            "AWS_HTTPS": "YES" if endpoint.startswith("https:") else "NO",
            "AWS_VIRTUAL_HOSTING": "FALSE",
        }
    return {name: value for name, value in options.items() if name not in os.environ}


def stat(where: Location) -> FileStat | None:
    """Return how a file looks, or None if it is not there.

    Raises
    ------
    OSError
        If the storage does not answer; on disk, what cannot be looked at is not there.
    """
    if isinstance(where, Path):
        try:
            found = where.stat()
        except OSError:
            return None
        return FileStat(found.st_size, found.st_mtime_ns)
    try:
        with named(where):
            return _seen(where.fs.info(where.path))
    except FileNotFoundError:
        return None


def listing(folder: Location) -> dict[str, FileStat]:
    """Return every file below a folder by its name relative to it: one sweep, or one paged list of a bucket.

    A folder that is not there has none.
    """
    if isinstance(folder, Path):
        return dict(_swept(folder, ""))
    with named(folder):
        return _files(folder, folder.fs.find(folder.path, detail=True))


@dataclass(frozen=True)
class StatCache:
    """How files looked, each looked at once: the files of a bucket by one list of the folder they lie in.

    Make one for each sweep over a catalog, and call it for each source: ``look = Sightings(); look(path)``
    gives the same as ``stat(path)``. What changes while it lives is not noticed.
    """

    _files: dict[Location, FileStat | None] = field(default_factory=dict)
    _folders: dict[str, dict[str, FileStat]] = field(default_factory=dict)

    def __call__(self, where: Location) -> FileStat | None:
        """Return how a file looks, or None if it is not there.

        Raises
        ------
        OSError
            If the storage does not answer.
        """
        if not isinstance(where, Path):
            # Its own ways to parent and name take as long as all the rest.
            folder, _, name = where.path.rpartition("/")
            if folder not in self._folders:
                self._folders[folder] = _listed(where.parent)
            return self._folders[folder].get(name)
        if where not in self._files:
            self._files[where] = stat(where)
        return self._files[where]


def _listed(folder: UPath) -> dict[str, FileStat]:
    """Return the files in a folder of a bucket, but not those in folders within."""
    try:
        with named(folder):
            there = {found["name"]: found for found in folder.fs.ls(folder.path, detail=True)}
    except FileNotFoundError:
        return {}
    return _files(folder, there)


def sidecars(where: UPath) -> set[str]:
    """Return the names of a file in a bucket and of those that differ in what follows its stem: one list.

    Asked before GDAL opens a file, it saves a dozen requests for files beside it that are seldom there.

    Raises
    ------
    OSError
        If the storage does not answer.
    """
    folder = where.parent
    with named(where):
        return set(_files(folder, folder.fs.find(folder.path, prefix=f"{where.stem}.", detail=True)))


def exists(where: Location) -> bool:
    """Tell whether there is such a file, or in a bucket anything below such a name."""
    if isinstance(where, Path):
        return where.exists()
    with named(where):
        return bool(where.fs.exists(where.path))


def read(where: Location) -> bytes:
    """Return a file's bytes, by one request.

    Raises
    ------
    OSError
        FileNotFoundError if it is not there; it names the file.
    """
    if isinstance(where, Path):
        return where.read_bytes()
    with named(where):
        data: bytes = where.fs.cat_file(where.path, max_concurrency=1)
        return data


def fetch(where: UPath, folder: Path) -> Path:
    """Copy a file of a bucket, and those beside it that belong to it, into a folder; return the copy.

    Raises
    ------
    OSError
        If it is not there, or the storage does not answer.
    """
    for name in {where.name, *sidecars(where)}:
        source = where.parent / name
        with named(source):
            source.fs.get_file(source.path, str(folder / name))
    return folder / where.name


def write(where: Location, data: bytes) -> None:
    """Write a file whole or not at all: renamed when it is whole, or by one request.

    Raises
    ------
    OSError
        If the disk is full or the folder cannot be written; it names the file, and nothing is left behind.
    """
    if not isinstance(where, Path):
        # A bucket shows a file when all of it has come, and not before.
        with named(where):
            where.fs.pipe_file(where.path, data)
        return
    with atomic_path(where) as temporary:
        where.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)


@contextlib.contextmanager
def atomic_path(where: Path) -> Iterator[Path]:
    """Give another file to write beside one, whose place it takes when it is whole.

    Raises
    ------
    OSError
        If it cannot be written; it names the place, and nothing is left behind.
    """
    temporary = where.with_name(f".{where.name}.{uuid4().hex}.tmp")
    try:
        yield temporary
        temporary.replace(where)
    except OSError as error:
        # A full disk names no file, a failed renaming the temporary one.
        number = error.errno or errno.EIO
        raise OSError(number, error.strerror or str(error), str(where)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove(where: Location) -> None:
    """Remove a file; one that is not there is no error."""
    if isinstance(where, Path):
        where.unlink(missing_ok=True)
        return
    with named(where), contextlib.suppress(FileNotFoundError):
        where.fs.rm_file(where.path)


def _swept(folder: Path, above: str) -> Iterator[tuple[str, FileStat]]:
    with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
        for entry in entries:
            name = above + entry.name
            if entry.is_dir():
                yield from _swept(folder / entry.name, name + "/")
            else:
                with contextlib.suppress(FileNotFoundError):
                    found = entry.stat()
                    yield name, FileStat(found.st_size, found.st_mtime_ns)


def _files(folder: UPath, found: dict[str, Any]) -> dict[str, FileStat]:
    """Return the files among what a list of a bucket holds, by their names relative to the folder."""
    start = len(folder.path.rstrip("/")) + 1
    named = {name[start:]: _seen(entry) for name, entry in found.items()}
    return {name: seen for name, seen in named.items() if name and seen}


def _seen(entry: dict[str, Any]) -> FileStat | None:
    if entry["type"] != "file":
        return None
    return FileStat(int(entry["size"]), str(entry["ETag"]).strip('"'))


def _endpoint() -> str:
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""


def _tries() -> int:
    return int(os.environ.get("AWS_MAX_ATTEMPTS") or TRIES)


def _s3_options() -> dict[str, Any]:
    """Return what s3fs is told; credentials and region it finds as every program of AWS does."""
    config: dict[str, Any] = {
        # The other modes give a process an allowance of second tries, which a night of stumbles uses up.
        "retries": {"total_max_attempts": _tries(), "mode": os.environ.get("AWS_RETRY_MODE") or "legacy"},
        "connect_timeout": 10,
        "read_timeout": 60,
    }
    options: dict[str, Any] = {
        "config_kwargs": config,
        # What another process wrote a moment ago has to be seen.
        "use_listings_cache": False,
        "anon": os.environ.get("AWS_NO_SIGN_REQUEST", "").upper() in _YES,
    }
    if endpoint := _endpoint():
        # Private endpoints seldom have a name for each bucket.
        config["s3"] = {"addressing_style": "path"}
        options["endpoint_url"] = endpoint
    return options


@contextlib.contextmanager
def named(where: UPath) -> Iterator[None]:
    """Turn what goes wrong with object storage into an OSError that names the file."""
    from aiohttp import ClientError
    from botocore.exceptions import BotoCoreError

    try:
        yield
    except OSError as error:
        number = error.errno or next((n for kind, n in _NUMBERS if isinstance(error, kind)), errno.EIO)
        raise OSError(number, error.strerror or str(error), str(where)) from error
    except (BotoCoreError, ClientError) as error:
        raise OSError(errno.EIO, str(error), str(where)) from error
