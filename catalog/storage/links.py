"""Links in a folder that may come from anyone: none that leads out of the folder is followed.

The folder itself may be a link, or lie behind one. In a bucket there are no links.
"""

from __future__ import annotations

import errno
import itertools
import os
from collections.abc import Iterator
from pathlib import Path

from flexroad.catalog.storage.paths import Location


def contained(where: Location, home: Location) -> Location:
    """Return a location in a folder."""
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

    A tile has dozens of such paths, and to resolve both sides takes four times as long.
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
