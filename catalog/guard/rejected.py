"""Source files that are refused before a library opens them, and the first bytes of a file."""

from __future__ import annotations

import os
import stat
from pathlib import Path

HEAD_BYTES = 65536
CHUNK_BYTES = 2**20
ARCHIVES = (b"PK\x03\x04", b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07", b"BZh", b"\xfd7zXZ\0")
"""First bytes of files of archives."""


class InputRejected(OSError):
    """A file that is not opened; the message continues a sentence that begins with its name."""


def head(path: Path) -> bytes:
    """Return the first bytes of a regular file; links are followed."""
    require_regular(path)
    # Opening a pipe would wait for a writer, if one has just taken the file's place.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb", buffering=0) as file:
        return file.read(HEAD_BYTES) or b""


def archive_note(data: bytes) -> str:
    """Return the remedy if a file is an archive, by its first bytes, to end a message; else empty."""
    is_archive = data.startswith(ARCHIVES) or data[257:262] == b"ustar"
    return "; it is an archive: unpack it first" if is_archive else ""


def read_through(path: Path) -> None:
    """Read all bytes of a regular file."""
    require_regular(path)
    with path.open("rb", buffering=0) as file:
        while file.read(CHUNK_BYTES):
            pass


def require_beside(side: Path, path: Path) -> None:
    """Raise an error if a file that a library opens with another one is not a regular file of its folder."""
    if side.is_symlink() and side.resolve().parent not in (path.resolve().parent, path.parent.resolve()):
        raise InputRejected("is a link to another folder; replace it by the file")
    head(side)


def require_regular(path: Path) -> None:
    """Raise an error if a path is not a regular file."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise InputRejected("is not a regular file; replace it by one")
