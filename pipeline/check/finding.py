"""One line of a check before a run, and the tiles that a check looks at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flexroad.catalog import Tile


@dataclass(frozen=True)
class Finding:
    """One line about a catalog."""

    text: str
    fault: bool = False
    """Whether this should be corrected before a run."""
    warning: bool = False
    """Whether this is said as a warning though it may be right; a fault always is."""
    failing: frozenset[str] = frozenset()
    """Ids of the tiles that would fail in a run."""


def evenly(tiles: Sequence[Tile], most: int) -> list[Tile]:
    """Return so many of the tiles at most, spread evenly over them."""
    number = min(most, len(tiles))
    return [tiles[k * len(tiles) // number] for k in range(number)]
