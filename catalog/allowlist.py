"""Which files a catalog may name: those below its own folder, and below what the operator allows besides.

A catalog is data that may come from anywhere, and what it names is read with the operator's rights. Names
are judged as they are written, after ``..`` is taken out: a folder of links to data elsewhere stays usable.
What a file refers to in turn (a VRT) is not looked at.
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

MOST = 4
"""Folders to allow that are named one by one; of more, those that they lie in."""
ADDRESS = re.compile(r"(?!s3:)[a-zA-Z][a-zA-Z0-9+.-]*:/")
TOPS = ("/", "s3:/", "s3:")


def check_allowed(
    catalog: Catalog, folder: Location | str, allowed: Sequence[str] = (), layers: Collection[str] = LAYERS
) -> None:
    """Refuse a catalog that names files elsewhere.

    Parameters
    ----------
    folder : Place
        The catalog's own.
    allowed : sequence of str
        Folders or addresses (s3://BUCKET/NAME) below which files may lie besides.
    layers : collection of str
        Those that will be read; what nobody reads may lie anywhere.

    Raises
    ------
    CatalogError
        The line names the tile, the layer, the file and the option that allows it.
    """
    for tile, layer, name in _outside(catalog, folder, allowed, layers):
        where = f"tile {tile}: {layer} names {name}"
        if ADDRESS.match(name):
            raise CatalogError(f"{where}; only files on disk and in s3:// are read: fetch it first")
        option = f"--allow {shlex.quote(posixpath.dirname(name))}"
        raise CatalogError(f"{where}, outside the catalog's folder {folder}; if that is meant, add {option}")


def needed(catalog: Catalog, folder: Location | str, layers: Collection[str] = LAYERS) -> tuple[str, ...]:
    """Return what has to be allowed for a catalog in such a folder if such layers are read: few folders."""
    names = (name for *_, name in _outside(catalog, folder, (), layers) if not ADDRESS.match(name))
    found = _outermost(map(posixpath.dirname, names))
    while len(found) > MOST:
        above = _outermost(map(posixpath.dirname, found))
        if not above.isdisjoint(TOPS):
            break
        found = above
    return tuple(sorted(found))


def _outside(
    catalog: Catalog, folder: Location | str, allowed: Sequence[str], layers: Collection[str]
) -> Iterator[tuple[str, str, str]]:
    """Yield tile, layer and file of all in the layers that lie elsewhere."""
    # The folder by the name it was given, and as it is without links.
    grounds = {
        normalise(str(folder)),
        normalise(str(absolute(parse_location(folder)))),
        *map(normalise, allowed),
    }
    starts = tuple(ground.rstrip("/") + "/" for ground in grounds)
    for tile in catalog.tiles:
        for layer in (layer for layer in tile.layers if layer.name in layers):
            for file in layer.files:
                named = next((text for text in (file, tile.root) if ADDRESS.match(text)), None)
                name = named or normalise(join(tile.root, file))
                if named or not name.startswith(starts):
                    yield tile.id, layer.name, name


def _outermost(folders: Iterable[str]) -> set[str]:
    """Return the folders that lie in none of the others."""
    found: list[str] = []
    # A folder comes before all that lie in it.
    for folder in sorted(set(folders), key=lambda folder: folder.rstrip("/") + "/"):
        if not found or not folder.startswith(found[-1].rstrip("/") + "/"):
            found.append(folder)
    return set(found)
