"""One tile: its id, its grid, and the files of its layers."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from flexroad.catalog.grid import Grid
from flexroad.catalog.storage.paths import Location, join, parse_location

LAYERS = ("dsm", "dtm", "dop", "road_mask", "reference", "reference_road", "bridges", "roads")
"""Layers a tile can have: digital surface and terrain model (m), orthophoto, road mask, true heights of road
and terrain including bridges (m), true road mask, heights of bridge decks only (m), roads as lines or areas
(vectors)."""


REACH_M = 100.0
"""A tile's layers list the files within this distance of it (m), so that `load` can read a halo."""


@dataclass(frozen=True)
class Layer:
    """One layer of a tile and its files."""

    name: str
    """One of `LAYERS`."""
    files: tuple[str, ...]
    """Files that cover the tile, relative to the tile's root where they lie below it; where files overlap,
    the first one with a value is used."""
    values: tuple[int, ...] = ()
    """Cell values that mean road, for the masks; empty: every value but 0 and nodata."""
    crs: str | None = None
    """CRS of files without one."""


@dataclass(frozen=True)
class Tile:
    """A square of ground and its layers."""

    id: str
    """Unique in its catalog; ``EASTING_NORTHING`` of the south-west corner if FlexRoad cut the tiles."""
    grid: Grid
    """The tile's core, without halo."""
    layers: tuple[Layer, ...]
    """In the order of `LAYERS`."""
    root: str
    """Folder that relative file names start from (the catalog's folder)."""
    datetime: datetime
    """Date of the survey, with a time zone."""
    datetime_assumed: bool = False
    """True if no tag gives the date, so that the file's modification time is used."""
    stratum: str = ""
    """Class of area for reports (urban, suburban, rural), or empty."""
    dataset: str = ""
    """Name of the source dataset in reports ("GeRoD"), or empty if unknown."""

    def layer(self, name: str) -> Layer | None:
        """Return the named layer, or None if the tile has none."""
        return next((layer for layer in self.layers if layer.name == name), None)

    def paths(self, layer: Layer) -> tuple[Location, ...]:
        """Return the locations of the layer's files."""
        return tuple(parse_location(join(self.root, file)) for file in layer.files)
