"""Check of a catalog's files: they must lie below its own folder or below a folder the operator allows.

A catalog may come from anyone, and its files are read with the operator's rights. The check compares names
as written, after ``..`` is resolved, and does not follow links: a folder of links to data elsewhere can be
used. Files that a file refers to (a VRT) are not checked.
"""

from __future__ import annotations

import posixpath
import re
import shlex
from collections.abc import Collection, Iterable, Iterator, Sequence

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.index import Catalog
from flexroad.catalog.storage.paths import Location, absolute, join, normalise, parse_location
from flexroad.catalog.tile import LAYERS

MAX_FOLDERS = 4
"""Largest number of folders suggested with --allow; if there are more, parent folders are suggested."""
ADDRESS = re.compile(r"(?!s3:)[a-zA-Z][a-zA-Z0-9+.-]*:/")
TOPS = ("/", "s3:/", "s3:")


def check_allowed(
    catalog: Catalog, folder: Location | str, allowed: Sequence[str] = (), layers: Collection[str] = LAYERS
) -> None:
    """Raise an error if a catalog names files outside the allowed folders.

    Parameters
    ----------
    folder : Location
        The catalog's own folder.
    allowed : sequence of str
        Further folders or addresses (s3://BUCKET/NAME) that files may lie below.
    layers : collection of str
        The layers that will be read; other layers are not checked.

    Raises
    ------
    CatalogError
        Names the tile, the layer, the file and the option that allows it.
    """
    for tile, layer, name in _outside(catalog, folder, allowed, layers):
        subject = f"tile {tile}: {layer} names {name}"
        if ADDRESS.match(name):
            raise CatalogError(f"{subject}; only files on disk and in s3:// are read: fetch it first")
        option = f"--allow {shlex.quote(posixpath.dirname(name))}"
        raise CatalogError(f"{subject}, outside the catalog's folder {folder}; to allow it, add {option}")


def needed(catalog: Catalog, folder: Location | str, layers: Collection[str] = LAYERS) -> tuple[str, ...]:
    """Return the folders that must be allowed to read these layers of a catalog stored in ``folder``."""
    names = (name for *_, name in _outside(catalog, folder, (), layers) if not ADDRESS.match(name))
    folders = _outermost(map(posixpath.dirname, names))
    while len(folders) > MAX_FOLDERS:
        parents = _outermost(map(posixpath.dirname, folders))
        if not parents.isdisjoint(TOPS):
            break
        folders = parents
    return tuple(sorted(folders))


def _outside(
    catalog: Catalog, folder: Location | str, allowed: Sequence[str], layers: Collection[str]
) -> Iterator[tuple[str, str, str]]:
    """Yield tile id, layer and file name of every file outside the allowed folders."""
    # The folder as given, and with links resolved.
    roots = {
        normalise(str(folder)),
        normalise(str(absolute(parse_location(folder)))),
        *map(normalise, allowed),
    }
    prefixes = tuple(root.rstrip("/") + "/" for root in roots)
    for tile in catalog.tiles:
        for layer in (layer for layer in tile.all_layers if layer.name in layers):
            for file in layer.files:
                address = next((text for text in (file, tile.root) if ADDRESS.match(text)), None)
                name = address or normalise(join(tile.root, file))
                if address or not name.startswith(prefixes):
                    yield tile.id, layer.name, name


def _outermost(folders: Iterable[str]) -> set[str]:
    """Return the folders that lie in none of the others."""
    outermost: list[str] = []
    # Sorting puts a folder before its subfolders.
    for folder in sorted(set(folders), key=lambda folder: folder.rstrip("/") + "/"):
        if not outermost or not folder.startswith(outermost[-1].rstrip("/") + "/"):
            outermost.append(folder)
    return set(outermost)
