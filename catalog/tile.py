"""One tile: its id, its grid, and the files of its layers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import lru_cache

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import LATTICE_TOLERANCE, Bounds, Grid, overlap
from flexroad.catalog.storage.paths import Location, stat
from flexroad.catalog.trust import AllowedFolders, full_name, located

HEIGHTS = ("dsm", "dtm", "road_height", "reference", "bridges")
"""Layers with heights in metres."""
LAYERS = ("dsm", "dtm", "road_height", "dop", "road_mask", "reference", "reference_road", "bridges", "roads")
"""Layers a tile can have: digital surface and terrain model (m), heights of hard surfaces without the bias of
the highest point (m, `ROAD_HEIGHT_BANDS`), orthophoto, road mask, true heights of road and terrain including
bridges (m), true road mask, heights of bridge decks only (m), roads as lines or areas (vectors)."""
ROAD_HEIGHT_BANDS = (("height", "m"), ("count", ""), ("spread", "m"))
"""Description and unit of the bands of ``road_height``: mean height of a cell's highest points, their number,
and the standard deviation of their heights. A file may have the first band alone."""
LOADED = ("dsm", "dtm", "road_height", "reference", "bridges", "road_mask", "reference_road")
"""Rasters that `load` reads; it passes on only the names of the other layers' files."""
BORDER_LAYERS = ("dsm", "dtm", "road_height", "dop", "road_mask", "roads")
"""Layers of ground along the borders of tiles (`Tile.around`)."""

REACH_M = 200.0
"""A tile's layers list the files within this distance of it (m): for halos and for ground along borders."""
RECENT = 2**14
"""Number of layers and dates that are kept, so that neighbouring tiles share them."""
MIN_COVER = 0.25
"""Default share of cells with heights. Below it, catalogs leave a tile out, and `load` fails."""
LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""Heights outside are nodata (m)."""
TOUCH_M = 0.001
"""Files that overlap ground by no more than this (m) only touch it."""


@dataclass(frozen=True, slots=True)
class Layer:
    """One layer of a tile and its files."""

    name: str
    """One of `LAYERS`."""
    files: tuple[str, ...]
    """Files within `REACH_M` of the tile, relative to the tile's root where they lie below it; where files
    overlap, the first one with a value is used."""
    values: tuple[int, ...] = ()
    """Cell values that mean road, for the masks; empty: every value but 0 and nodata."""
    crs: str | None = None
    """CRS of files without one."""
    extents: tuple[Bounds, ...] = ()
    """West, south, east and north of each file (m, in the tile's CRS), in the order of ``files``; empty where
    they are unknown (published datasets): each file may then lie anywhere."""
    reproject: bool = False
    """Whether rasters in another CRS than the tile's are warped when they are read, or are an error."""
    sublayer: str | None = None
    """Layer of vector files that have several; None: their only one, or the road layers of the OSM format."""
    height_unit: str | None = None
    """Unit of heights (a key of `to_metres.HEIGHT_UNITS`) of files that declare no unit. None: metres or, for
    a reprojected file, the unit of its eastings."""

    def __post_init__(self) -> None:
        if self.extents and len(self.extents) != len(self.files):
            raise CatalogError(
                f"layer {self.name} has {len(self.files)} files and {len(self.extents)} extents; "
                "give none if they are unknown"
            )

    def reaching(self, bounds: Bounds) -> Layer | None:
        """Return the layer with only the files that overlap an area, or None without such files.

        A layer of unknown extents is returned unchanged.

        - `bounds`: west, south, east, north (m, in the tile's CRS).
        """
        numbers = self._overlapping(bounds)
        if len(numbers) == len(self.files):
            return self
        return self.part(numbers) if numbers else None

    def in_common_order(self, bounds: Bounds) -> Sequence[int]:
        """Return the numbers of the files that overlap an area, in the order that all tiles agree on.

        The files are sorted by name, but of two overlapping files the first stays first, because its values
        are used. If extents are unknown, all files are returned in their order.
        """
        numbers = self._overlapping(bounds)
        if len(numbers) < 2 or not self.extents:
            return numbers
        left = sorted(numbers, key=self.files.__getitem__)
        before = _overlapped(self.extents)
        if not any(before[number].intersection(numbers) for number in numbers):
            return left
        order = []
        while left:
            first = next(number for number in left if before[number].isdisjoint(left))
            left.remove(first)
            order.append(first)
        return order

    def part(self, numbers: Sequence[int]) -> Layer:
        """Return the layer with the files of these numbers, in that order."""
        files = tuple(self.files[number] for number in numbers)
        extents = tuple(self.extents[number] for number in numbers) if self.extents else ()
        return replace(self, files=files, extents=extents)

    def _overlapping(self, bounds: Bounds) -> Sequence[int]:
        return _reaching(self.extents, bounds) if self.extents else range(len(self.files))


# The layers of a tile share their extents, so the results of these functions are cached.
@lru_cache(maxsize=64)
def _reaching(extents: tuple[Bounds, ...], bounds: Bounds) -> tuple[int, ...]:
    """Return the numbers of the files that overlap an area."""
    return tuple(number for number, extent in enumerate(extents) if overlap(extent, bounds, TOUCH_M))


@lru_cache(maxsize=16)
def _overlapped(extents: tuple[Bounds, ...]) -> list[set[int]]:
    """Return for each file the numbers of the files before it that overlap it."""
    before: list[set[int]] = [set() for _ in extents]
    eastward = sorted(range(len(extents)), key=extents.__getitem__)
    for start, one in enumerate(eastward, 1):
        for place in range(start, len(eastward)):
            other = eastward[place]
            if extents[one][2] - extents[other][0] <= TOUCH_M:
                # All further ones begin farther east.
                break
            if overlap(extents[one], extents[other], TOUCH_M):
                before[max(one, other)].add(min(one, other))
    return before


@dataclass(frozen=True, slots=True)
class Tile:
    """A square of ground and its layers."""

    id: str
    """Unique in its catalog; ``EASTING_NORTHING`` of the south-west corner if FlexRoad cut the tiles."""
    grid: Grid
    """The tile's core, without halo."""
    layers: tuple[Layer, ...]
    """Layers that cover the tile, at least in part, in the order of `LAYERS`."""
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
    nearby: tuple[Layer, ...] = ()
    """Layers with files within `REACH_M`, but not on the tile itself, in the order of `LAYERS`."""
    fault: str = ""
    """Why the tile's entry in a catalog cannot be used, or empty. `load` fails with this message. Such a tile
    has no layers, and its grid and date have no meaning (`faulty`)."""
    allowed: AllowedFolders | None = field(default=None, compare=False, repr=False)
    """Where its files may lie; None if the program itself has made the tile and has not read it."""
    missing: frozenset[str] | None = field(default=None, compare=False, repr=False)
    """Full names of its files that were missing when its graph was made; None if that is not known."""

    @property
    def all_layers(self) -> tuple[Layer, ...]:
        """The layers that cover the tile and those nearby, in the order of `LAYERS`."""
        return tuple(sorted((*self.layers, *self.nearby), key=lambda layer: LAYERS.index(layer.name)))

    def layer(self, name: str) -> Layer | None:
        """Return the named layer, or None if none covers the tile."""
        return next((layer for layer in self.layers if layer.name == name), None)

    def layers_on(self, names: Collection[str]) -> list[Layer]:
        """Return the layers of these names with only those files that reach the tile itself."""
        found = (layer.reaching(self.grid.bounds) for layer in self.layers if layer.name in names)
        return [layer for layer in found if layer]

    def paths(self, layer: Layer) -> tuple[Location, ...]:
        """Return the locations of the layer's files.

        Raises
        ------
        CatalogError
            If a file lies outside the folders that the tile may read.
        """
        return tuple(self.path(layer.name, file) for file in layer.files)

    def path(self, layer: str, file: str) -> Location:
        """Return the location of one file of the named layer; raises what `paths` raises."""
        name = full_name(self.root, file)
        if self.allowed and not self.allowed.permits(name):
            raise self.allowed.refusal(f"tile {self.id}: {layer}", name)
        return located(name)

    def lacks(self, path: Location) -> bool:
        """Return whether a file of the tile is missing: when its graph was made, or if unknown, now."""
        return stat(path) is None if self.missing is None else str(path) in self.missing

    def renamed(self, rename: Callable[[str], str]) -> Tile:
        """Return the tile with other names of its files."""
        layers, nearby = (
            tuple(replace(layer, files=tuple(map(rename, layer.files))) for layer in group)
            for group in (self.layers, self.nearby)
        )
        return replace(self, layers=layers, nearby=nearby)

    def within(self, bounds: Bounds) -> Tile:
        """Return the tile with only the files of the rasters in `LOADED` that reach an area.

        If no file of a layer reaches the area, the layer is unchanged, and `load` reports that. All files of
        the photo and the roads stay, because segmenters read them beyond the grid.

        Parameters
        ----------
        bounds : Bounds
            The ground to read: west, south, east, north (m).
        """
        layers = tuple(
            (layer.reaching(bounds) or layer) if layer.name in LOADED else layer for layer in self.layers
        )
        return replace(self, layers=layers)

    def layers_around(self, names: Collection[str] = BORDER_LAYERS) -> list[Layer]:
        """Return the layers of ground along the tile's border (`around`) with one of these names."""
        return [layer for layer in self.all_layers if layer.name in BORDER_LAYERS and layer.name in names]

    def around(self, grid: Grid, reach: Bounds, names: Collection[str] = BORDER_LAYERS) -> Tile:
        """Return a tile of other ground within `REACH_M`, made of this tile's files, with this tile's id.

        Its layers do not depend on the tile from which they are taken, if their extents are known and the
        ground is within `REACH_M` of that tile.

        Parameters
        ----------
        grid : Grid
            The grid of the new tile: rasters keep the files that reach it.
        reach : Bounds
            West, south, east, north (m): photo and roads keep the files that reach this area.
        names : collection of str
            Names of the layers that it has.
        """
        found = files_around(self.layers_around(names), grid.bounds, reach)
        layers = tuple(layer.part(numbers) for layer, numbers in found)
        return replace(self, grid=grid, layers=layers, nearby=())


def files_around(layers: Iterable[Layer], bounds: Bounds, reach: Bounds) -> list[tuple[Layer, Sequence[int]]]:
    """Return the layers with files that reach other ground, and the numbers of these files (`Tile.around`).

    - `layers`: the layers of a tile (`Tile.layers_around`).
    - `bounds`: the ground: files of rasters reach it.
    - `reach`: photo and roads reach this area.
    """
    found = ((layer, layer.in_common_order(bounds if layer.name in LOADED else reach)) for layer in layers)
    return [(layer, numbers) for layer, numbers in found if numbers]


def faulty(tile_id: str, fault: str, root: str) -> Tile:
    """Return a tile whose entry in a catalog cannot be used; ``fault`` is the reason and the remedy."""
    return Tile(
        tile_id, Grid("", 0.0, 0.0, 1.0, 1, 1), (), root, datetime(1970, 1, 1, tzinfo=UTC), fault=fault
    )


def by_cover(layers: Sequence[Layer], grid: Grid) -> tuple[tuple[Layer, ...], tuple[Layer, ...]]:
    """Return the layers that cover a tile, at least in part, and those that are only nearby.

    Layers of unknown extents are taken as covering the tile. So are roads: they are wider than their lines.
    """
    bounds, tolerance = grid.bounds, LATTICE_TOLERANCE * grid.cell
    # The layers of a tile often share their extents.
    distinct = {id(layer.extents): layer.extents for layer in layers}
    beside = {
        key: bool(extents) and not any(overlap(extent, bounds, tolerance) for extent in extents)
        for key, extents in distinct.items()
    }
    nearby = tuple(layer for layer in layers if layer.name != "roads" and beside[id(layer.extents)])
    return tuple(layer for layer in layers if layer not in nearby) if nearby else tuple(layers), nearby
