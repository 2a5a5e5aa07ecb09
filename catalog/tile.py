"""One tile: an id, where its cells lie, and where each of its layers is."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from flexroad.catalog.grid import Grid
from flexroad.catalog.storage.paths import Location, join, parse_location

LAYERS = ("dsm", "dtm", "dop", "road_mask", "reference", "reference_road", "bridges", "roads")
"""Layers a tile can have: digital surface and terrain model (m), orthophoto, road mask, true road and
terrain heights (m) incl. bridges, true road mask, heights of bridge decks alone (m), roads as lines or
areas (vectors)."""


REACH_M = 100.0
"""A tile names the files within this distance of it, so that `load` can read a halo around it."""


@dataclass(frozen=True)
class Layer:
    """Where one layer of a tile is."""

    name: str
    """One of `LAYERS`."""
    files: tuple[str, ...]
    """Files that cover the tile, relative to the tile's root where they lie below it; of files that
    overlap, the first with a value wins."""
    values: tuple[int, ...] = ()
    """Cell values that mean road, for the masks; empty: every value but 0 and nodata."""
    crs: str | None = None
    """CRS of files that carry none themselves."""


@dataclass(frozen=True)
class Tile:
    """A square of ground with the layers known for it."""

    id: str
    """Unique in its catalog; `EASTING_NORTHING` of the south-west corner where we cut the tiles."""
    grid: Grid
    """The tile's core, without halo."""
    layers: tuple[Layer, ...]
    """In the order of `LAYERS`."""
    root: str
    """Folder that relative files are relative to (that of the catalog)."""
    datetime: datetime
    """When the data was taken, with a time zone."""
    datetime_assumed: bool = False
    """True if no tag told the date and the file's time stands in."""
    stratum: str = ""
    """Class of area for reports (urban, suburban, rural), or empty."""
    dataset: str = ""
    """What the tile was taken from, as reports say it ("GeRoD"), or empty where nothing tells."""

    def layer(self, name: str) -> Layer | None:
        """Return the named layer, or None if the tile has none."""
        return next((layer for layer in self.layers if layer.name == name), None)

    def paths(self, layer: Layer) -> tuple[Location, ...]:
        """Return the layer's files as places that can be opened."""
        return tuple(parse_location(join(self.root, file)) for file in layer.files)
