"""Check of all files of a catalog at once, before a command begins, and the options that a catalog needs."""

from __future__ import annotations

import posixpath
from collections.abc import Collection, Iterable, Iterator

from flexroad.catalog.index import Catalog
from flexroad.catalog.storage.paths import Location, resolved
from flexroad.catalog.tile import LAYERS, Layer, Tile
from flexroad.catalog.trust import ADDRESS, AllowedFolders, full_name

MAX_FOLDERS = 4
"""Largest number of folders suggested with --allow; if there are more, parent folders are suggested."""
TOPS = ("/", "s3:/", "s3:")


def check_allowed(catalog: Catalog, layers: Collection[str] = LAYERS) -> None:
    """Raise an error if a tile names a file that may not be read.

    `Tile.paths` raises the same error, but only when the file is needed.

    - `layers`: the layers that will be read; other layers are not checked.
    """
    for tile, layer in _chosen(catalog, layers):
        for name in (full_name(tile.root, file) for file in layer.files):
            if tile.allowed and not tile.allowed.permits(name):
                folders = _needed(catalog, tile.allowed, layers)
                raise tile.allowed.refusal(f"tile {tile.id}: {layer.name}", name, folders)


def needed(catalog: Catalog, folder: Location | str, layers: Collection[str] = LAYERS) -> tuple[str, ...]:
    """Return the folders that must be allowed to read these layers of a catalog stored in ``folder``."""
    return _needed(catalog, AllowedFolders.of(folder), layers)


def _needed(catalog: Catalog, allowed: AllowedFolders, layers: Collection[str]) -> tuple[str, ...]:
    names = {full_name(tile.root, file) for tile, layer in _chosen(catalog, layers) for file in layer.files}
    # Addresses cannot be allowed.
    outside = (name for name in names if not ADDRESS.match(name) and not allowed.permits(name))
    folders = _outermost(posixpath.dirname(resolved(name)) for name in outside)
    while len(folders) > MAX_FOLDERS:
        parents = _outermost(map(posixpath.dirname, folders))
        if not parents.isdisjoint(TOPS):
            break
        folders = parents
    return tuple(sorted(folders))


def _chosen(catalog: Catalog, layers: Collection[str]) -> Iterator[tuple[Tile, Layer]]:
    for tile in catalog.tiles:
        yield from ((tile, layer) for layer in tile.all_layers if layer.name in layers)


def _outermost(folders: Iterable[str]) -> set[str]:
    """Return the folders that lie in none of the others."""
    outermost: list[str] = []
    # Sorting puts a folder before its subfolders.
    for folder in sorted(set(folders), key=lambda folder: folder.rstrip("/") + "/"):
        if not outermost or not folder.startswith(outermost[-1].rstrip("/") + "/"):
            outermost.append(folder)
    return set(outermost)
