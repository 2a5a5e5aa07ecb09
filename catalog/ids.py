"""Ids of tiles: which texts can be one, and the names of files made from them."""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.text import shown

MAX_BYTES = 100
"""Longest id (bytes in UTF-8). A file name has at most 255 bytes: a changed id adds 9, a temporary file 38.
108 bytes remain for the variant and the ending."""
SAFE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


def problem(tile_id: object) -> str:
    """Return why a value cannot be the id of a tile, ``""`` if it can."""
    if not isinstance(tile_id, str):
        return f"{shown(tile_id)} is not a text"
    if not tile_id.strip():
        return f"{shown(tile_id)} is empty"
    if not tile_id.isprintable():
        return f"{shown(tile_id)} has characters that cannot be printed"
    size = len(tile_id.encode())
    return f"{shown(tile_id)} has {size} bytes, more than {MAX_BYTES}" if size > MAX_BYTES else ""


def check(ids: Sequence[str]) -> None:
    """Check the ids of a catalog."""
    unsafe = [tile_id for tile_id in ids if not (SAFE.fullmatch(tile_id) and len(tile_id) <= MAX_BYTES)]
    for tile_id in unsafe:
        if reason := problem(tile_id):
            raise CatalogError(f"tile id {reason}; rename the tile in its source")
    if len(set(ids)) < len(ids):
        names = ", ".join(same[0] for same in _equal(ids, str))
        raise CatalogError(f"tile ids must be unique, but {names} occur more than once; rename those tiles")
    if not unsafe:
        return
    for key in (lambda text: unicodedata.normalize("NFC", text), safe_name):
        if groups := _equal(ids, key):
            names = ", ".join(map(ascii, groups[0]))
            raise CatalogError(f"tile ids {names} give the same file names; rename one of those tiles")


# The name of a tile is needed for each of its files.
@lru_cache(maxsize=1024)
def safe_name(tile_id: str) -> str:
    """Return the name of a tile's folder and files: its id, changed if it is not a valid file name.

    A name that begins with a minus is changed, because programs take it for an option.
    """
    safe = "".join(c if c.isalnum() or c in "-_." else "-" for c in tile_id).lstrip(".-")
    if safe and safe == tile_id:
        return safe
    return f"{safe}-{hashlib.sha256(tile_id.encode()).hexdigest()[:8]}".lstrip("-")


def _equal(ids: Iterable[str], key: Callable[[str], str]) -> list[list[str]]:
    """Return the first groups of ids with the same key."""
    groups: defaultdict[str, list[str]] = defaultdict(list)
    for tile_id in ids:
        groups[key(tile_id)].append(tile_id)
    return [group for group in groups.values() if len(group) > 1][:5]
