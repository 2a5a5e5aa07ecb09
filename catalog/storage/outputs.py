"""Output files on disk: written completely or not at all. They replace only regular files."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path
from stat import S_ISDIR, S_ISREG
from uuid import uuid4


@contextlib.contextmanager
def atomic_path(where: Path, flushed: bool = False) -> Iterator[Path]:
    """Yield a temporary file beside ``where``; rename it to ``where`` at the end of the block.

    With ``flushed`` the content is on the disk before the file has its name.
    """
    target = output_file(where)
    temporary = target.with_name(f".{target.name}.{uuid4().hex}.tmp")
    try:
        yield temporary
        if flushed:
            flush_path(temporary)
        temporary.replace(target)
    except OSError as error:
        # The error of a full disk has no file name, the error of a failed rename has the temporary name.
        number = error.errno or errno.EIO
        raise OSError(number, error.strerror or str(error), str(where)) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def made_folder(where: Path) -> Iterator[None]:
    """Make a folder and its parents if they do not exist; if the block fails, remove empty new folders."""
    new = [folder for folder in (where, *where.parents) if not folder.exists()]
    try:
        where.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for folder in new:
                folder.rmdir()
        raise


def flush_path(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        os.close(opened)


def output_file(where: Path) -> Path:
    """Return the file that is written for a name: the name itself, or the file that a link points to."""
    try:
        target = where.resolve() if where.is_symlink() else where
        mode = target.stat().st_mode
    except FileNotFoundError:
        return target
    except RuntimeError as error:
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(where)) from error
    if S_ISREG(mode):
        return target
    if S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(where))
    raise OSError(errno.EINVAL, "is a device, pipe or socket and is not replaced", str(where))
