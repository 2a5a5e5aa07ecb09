"""Where the files of a catalog may lie: below its own folder or below a folder that the user allows.

A catalog may come from anyone, and its files are read with the user's rights. `Catalog.read` gives each tile
its `AllowedFolders`. `Tile.paths`, the only way to a tile's files, checks them: no command can forget the
check. Tiles that the program itself has just made have no `AllowedFolders`.

Files and folders are compared with links resolved: a link that leads out of a catalog's folder needs the
permission for its target. GDAL's virtual file systems (``/vsicurl/``) and web addresses are never allowed.
"""

from __future__ import annotations

import posixpath
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.storage.paths import Location, absolute, join, normalise, parse_location, resolved
from flexroad.catalog.text import without_credentials

ADDRESS = re.compile(r"(?!(?i:s3):)[a-zA-Z][a-zA-Z0-9+.-]*:/|/+vsi")
LONGEST_SHOWN = 500
"""Longest path that a message repeats."""
KEPT = 16384
"""Names of files of which the location and the permission are kept: tiles come row by row."""


@dataclass(frozen=True)
class AllowedFolders:
    """The folders below which the files of a catalog may lie."""

    home: str
    """The catalog's own folder, for messages."""
    folders: tuple[str, ...]
    """Folders on disk and addresses ``s3://BUCKET/NAME``, without ``..``; empty: no file may be read."""

    @classmethod
    def of(cls, home: Location | str, more: Sequence[str | Path] = ()) -> AllowedFolders:
        """Return the catalog's own folder and further ones."""
        # Names with and without links are stored in a run: links may lead elsewhere on another machine.
        own = (normalise(str(home)), normalise(str(absolute(parse_location(home)))))
        return cls(str(home), tuple(dict.fromkeys((*own, *(normalise(str(folder)) for folder in more)))))

    def permits(self, name: str) -> bool:
        """Return whether a file may be read, by its full path or address."""
        return _permitted(name, self.folders)

    def refusal(self, subject: str, name: str, folders: Sequence[str] = ()) -> CatalogError:
        """Return the error that a file may not be read, with the options that allow it.

        - `subject`: what names the file: ``tile 1: dsm``.
        - `folders`: the folders to allow; by default the folder of the file.
        """
        if len(name) > LONGEST_SHOWN:
            return CatalogError(
                f"{subject} names {name[:60]}..., a path of {len(name):,} characters outside the catalog's "
                f"folder {self.home}; correct the catalog, or move the file to a shorter path"
            )
        if ADDRESS.match(name):
            return CatalogError(
                f"{subject} names {without_credentials(name)}; only files on disk and in s3:// are read: "
                "fetch it first"
            )
        name, target = normalise(name), resolved(name)
        options = " ".join(
            f"--allow {shlex.quote(folder)}" for folder in folders or [posixpath.dirname(target)]
        )
        file = name if name == target else f"{name}, by a link {target}"
        return CatalogError(
            f"{subject} names {file}, outside the catalog's folder {self.home}; to allow it, begin with "
            f"flexroad {options}"
        )


# Neighbouring tiles list the same files.
@lru_cache(maxsize=KEPT)
def full_name(root: str, file: str) -> str:
    """Return the full path or address of a tile's file."""
    return next((text for text in (file, root) if ADDRESS.match(text)), None) or join(root, file)


def located(name: str) -> Location:
    """Return a file as an absolute location, as GDAL gives ``GTIFF_DIR:1:a.tif`` a special meaning."""
    if name.startswith("/"):
        return _on_disk(name)
    location = parse_location(name)
    return location.absolute() if isinstance(location, Path) else location


@lru_cache(maxsize=KEPT)
def _on_disk(name: str) -> Path:
    return Path(name)


@lru_cache(maxsize=KEPT)
def _permitted(name: str, folders: tuple[str, ...]) -> bool:
    return not ADDRESS.match(name) and resolved(name).startswith(_prefixes(folders))


@lru_cache(maxsize=64)
def _prefixes(folders: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(resolved(folder).rstrip("/") + "/" for folder in folders)
