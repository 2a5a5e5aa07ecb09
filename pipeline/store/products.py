"""The folder of one tile in a run: its products and its marker, which is written last."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage import paths
from flexroad.catalog.storage.paths import FileStat, Location, contained
from flexroad.pipeline.store.records import DONE, FAILED, dump_checked, load_checked

DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError)
"""Errors from reading a damaged marker."""


@dataclass(frozen=True)
class TileProducts:
    """The products of one tile in a run, and the marker that is written when they are complete."""

    path: Location

    @classmethod
    def of(cls, run: Location, tile_id: str) -> TileProducts:
        """Return the tile's folder in a run."""
        return cls(run / "tiles" / safe_name(tile_id))

    def file(self, name: str) -> Location:
        """Return a file of the folder."""
        return contained(self.path / name, self.path.parent.parent)

    def files(self) -> dict[str, FileStat]:
        """Return the files of the folder by name; empty if the folder is a link."""
        linked = isinstance(self.path, Path) and self.path.is_symlink()
        return {} if linked else paths.listing(self.path)

    def marker(self, name: str) -> dict[str, Any] | None:
        """Return the content of a marker; None if it is missing or damaged, or of another tile."""
        try:
            content = load_checked(paths.read(self.file(name)))
            own = safe_name(content["id" if name == DONE else "tile"]) == self.path.name
        except DAMAGED:
            return None
        return content if own else None

    def nodes(self, variant: str) -> dict[str, str]:
        """Return the fingerprint of each stage of a variant when the tile was last finished."""
        item = self.marker(DONE) or {}
        try:
            return dict(item["properties"]["flexroad:nodes"][variant])
        except (KeyError, TypeError, ValueError):
            return {}

    def verified(self) -> bool:
        """Return whether every product in the item still has its checksum."""
        item = self.marker(DONE) or {}
        try:
            return all(
                _checksum(paths.read(self.file(asset["href"]))) == asset["file:checksum"]
                for asset in item["assets"].values()
            )
        except (OSError, KeyError, TypeError, AttributeError):
            return False

    def finish(self, item: dict[str, Any], products: Mapping[str, bytes], flushed: bool = False) -> None:
        """Write the products, then the item that marks the tile as done.

        An existing item is removed first, so that a tile with old and new products is never done. With
        ``flushed`` each of these steps is on the disk before the next step.
        """
        self._unmark(flushed)
        for name, data in products.items():
            paths.write(self.file(name), data)
        if flushed:
            # Flushing all products together takes hardly longer than one of them.
            for name in products:
                paths.flush(self.path / name)
            # Without this, a power failure could leave a new item with an old product of the same size.
            paths.flush_names(self.path)
        self._mark(DONE, item, flushed)
        paths.remove(self.file(FAILED))

    def fail(self, failure: dict[str, Any], flushed: bool = False) -> None:
        """Write failed.json and remove the item, so that the tile is no longer done.

        With ``flushed`` the file is on the disk at the end.
        """
        self._unmark(flushed)
        self._mark(FAILED, failure, flushed)

    def _unmark(self, flushed: bool) -> None:
        """Remove the item; with ``flushed`` also permanently in case of a power failure."""
        paths.remove(self.file(DONE))
        if flushed:
            paths.flush_names(self.path)

    def _mark(self, name: str, content: dict[str, Any], flushed: bool) -> None:
        paths.write(self.file(name), dump_checked(content), flushed)
        if flushed:
            # The tile's folder and the folder of all tiles may be new.
            paths.flush_names(self.path, self.path.parent, self.path.parent.parent)


def file_entry(name: str, data: bytes, media_type: str) -> dict[str, Any]:
    """Return a STAC asset with size and checksum (a sha256 multihash, as the file extension requires)."""
    return {"href": name, "type": media_type, "file:size": len(data), "file:checksum": _checksum(data)}


def _checksum(data: bytes) -> str:
    return "1220" + hashlib.sha256(data).hexdigest()
