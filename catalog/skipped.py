"""Files that a catalog leaves out because they cannot be used."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.storage.paths import normalise
from flexroad.catalog.text import count, some
from flexroad.catalog.tile import Tile
from flexroad.catalog.trust import full_name

TEXTS = ("file", "layer", "reason", "root")


@dataclass(frozen=True)
class Skipped:
    """A file, or a folder that cannot be listed, that a catalog leaves out."""

    file: str
    """Relative to ``root``, or absolute; the name of a folder ends in ``/``."""
    layer: str
    """Name of the layer; empty if the reason names the file itself."""
    reason: str
    root: str = ""
    """Folder that a relative name starts from; empty: the catalog's."""
    tiles: tuple[str, ...] = ()
    """Ids of tiles of a run that an earlier catalog made from the file, and that are missing without it."""

    @property
    def path(self) -> str:
        """Full name; the name of a folder ends in ``/``."""
        return _full_name(self.root, self.file) + "/" * self.is_folder

    @property
    def is_folder(self) -> bool:
        """Whether it is a folder, so that files below it are not known."""
        return self.file.endswith("/")

    def below(self, folder: str) -> Skipped:
        """Return the same file with a name relative to a folder if it lies below it, else absolute."""
        return replace(self, file=self.path.removeprefix(f"{folder.rstrip('/')}/"), root="")


def lost(before: Sequence[Tile], tiles: Collection[str], skipped: Sequence[Skipped]) -> tuple[Skipped, ...]:
    """Return skipped files with the tiles of an earlier catalog that are missing without them.

    - `tiles`: ids of the tiles of the catalog that skipped the files.
    """
    gone: dict[str, list[str]] = defaultdict(list)
    for tile in (tile for tile in before if tile.id not in tiles):
        for file in (file for dsm in tile.layers_on(("dsm",)) for file in dsm.files):
            gone[_full_name(tile.root, file)].append(tile.id)
    return tuple(replace(one, tiles=tuple(_tiles(one, gone))) for one in skipped)


def _tiles(skipped: Skipped, gone: Mapping[str, Sequence[str]]) -> Iterator[str]:
    if not skipped.is_folder:
        yield from gone.get(skipped.path, ())
        return
    for path, tiles in gone.items():
        yield from tiles if path.startswith(skipped.path) else ()


def _full_name(root: str, file: str) -> str:
    return normalise(full_name(root, file))


def lines(skipped: Iterable[Skipped]) -> list[str]:
    """Return one line per layer and reason, with the lost tiles of a run."""
    groups: dict[tuple[str, str], list[Skipped]] = defaultdict(list)
    for one in skipped:
        groups[one.layer, one.reason].append(one)
    return [_line(layer, reason, group) for (layer, reason), group in groups.items()]


def _line(layer: str, reason: str, group: Sequence[Skipped]) -> str:
    names = some([f"folder {one.file[:-1]}" if one.is_folder else one.file for one in group])
    tiles = sorted({tile for one in group for tile in one.tiles})
    ending = f"; the run lost {count(len(tiles), 'tile')} with that: {some(tiles)}" if tiles else ""
    return f"skipped {names} ({layer}): {reason}{ending}" if layer else f"skipped {reason}{ending}"


def to_fields(skipped: Skipped) -> dict[str, Any]:
    """Return the content of an entry in a catalog's file."""
    return vars(skipped) | {"tiles": list(skipped.tiles)}


def from_fields(entries: Any, folder: str) -> tuple[Skipped, ...]:
    """Return the files from the entries of `to_fields`; names without a root start from ``folder``."""
    if not isinstance(entries, list) or not all(map(_is_entry, entries)):
        raise CatalogError("its list of skipped files cannot be read")
    return tuple(
        Skipped(one["file"], one["layer"], one["reason"], one["root"] or folder, tuple(one["tiles"]))
        for one in entries
    )


def _is_entry(entry: Any) -> bool:
    if not isinstance(entry, dict) or not isinstance(entry.get("tiles"), list):
        return False
    return bool(entry.get("file")) and all(
        isinstance(text, str) for text in (*map(entry.get, TEXTS), *entry["tiles"])
    )
