"""The catalog: one table of tiles with a fixed schema, stored as STAC items.

The suffix of the file name selects GeoParquet (``.parquet``) or a GeoJSON feature collection (``.json``,
``.geojson``); QGIS opens both. Projection fields follow the STAC projection extension; FlexRoad's own fields
have the prefix ``flexroad:``.
"""

from __future__ import annotations

import difflib
import json
import math
import posixpath
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache, cached_property
from itertools import compress
from pathlib import Path
from typing import Any

from flexroad.catalog import geoparquet, ids
from flexroad.catalog.area import Area
from flexroad.catalog.crs import short, transformer
from flexroad.catalog.entries import TileReader
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.geoparquet import SKIPPED, Item, Unreadable
from flexroad.catalog.grid import Bounds, Grid, overlap, union
from flexroad.catalog.skipped import Skipped, from_fields, to_fields
from flexroad.catalog.storage import paths
from flexroad.catalog.storage.paths import Location, absolute, join, normalise, parse_location, resolved
from flexroad.catalog.text import edges, printable, some
from flexroad.catalog.tile import LAYERS, Layer, Tile
from flexroad.catalog.trust import ADDRESS, AllowedFolders, full_name

STAC_VERSION = "1.1.0"
MAX_BYTES = 2**30
"""Largest file: about 180,000 tiles of six layers in JSON, and millions in GeoParquet."""
PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
JSON_SUFFIXES = (".json", ".geojson")


@dataclass(frozen=True)
class Catalog:
    """The tiles of a data set, in the order of their ids."""

    tiles: tuple[Tile, ...]
    skipped: tuple[Skipped, ...] = ()
    """Files that could not be used when the catalog was made: the tiles lack their cells."""

    def __post_init__(self) -> None:
        ids.check([tile.id for tile in self.tiles])

    @cached_property
    def usable(self) -> tuple[Tile, ...]:
        """The tiles without a `Tile.fault`; only these have a position."""
        return tuple(tile for tile in self.tiles if not tile.fault)

    @cached_property
    def lost(self) -> frozenset[str]:
        """Ids of tiles of a run that are missing in the catalog because their files were skipped."""
        return frozenset(tile for file in self.skipped for tile in file.tiles)

    @classmethod
    def read(cls, path: Location | str, allow: Sequence[str | Path] = ()) -> Catalog:
        """Read a catalog written by `write`, from disk or a bucket.

        Tiles of entries that cannot be used have a `Tile.fault`.

        Parameters
        ----------
        path : Location or str
            The catalog's file. Files of tiles may lie in its folder.
        allow : sequence of str or Path
            Further folders or addresses (s3://BUCKET/NAME) that files of tiles may lie below. `Tile.paths`
            raises an error for all others.

        Raises
        ------
        CatalogError
            If the file is missing or is not a catalog, or if no entry can be used; names the file.
        """
        path = _location(path)
        try:
            file = paths.stat(path)
            if file is not None and file.size > MAX_BYTES:
                size = f"{file.size:,} bytes, more than {MAX_BYTES:,}"
                raise CatalogError(f"{path} has {size}; make several catalogs")
            data = paths.read(path)
        except FileNotFoundError as error:
            raise CatalogError(f"catalog {path} does not exist; make one with `flexroad catalog`") from error
        except IsADirectoryError as error:
            example = path / "catalog.parquet"
            raise CatalogError(f"catalog {path} is a folder; name its file, as in {example}") from error
        except OSError as error:
            raise CatalogError(f"cannot read catalog {path}: {error.strerror or error}") from error
        is_json = path.suffix in JSON_SUFFIXES
        kind = "feature" if is_json else "row"
        allowed = AllowedFolders.of(path.parent, allow)
        reader = TileReader(str(absolute(path).parent), allowed, kind, path.name)
        try:
            entries, files = _from_json(data) if is_json else geoparquet.entries(data)
            tiles, skipped = reader.tiles(entries), from_fields(files, str(absolute(path).parent))
        except ImportError:
            # The installation is at fault, not the file.
            raise
        except CatalogError as error:
            raise _not_a_catalog(path, str(error)) from error
        except Exception as error:
            # Damaged files raise any error in the readers of JSON and Parquet.
            reason = printable(" ".join(str(error).split()))[:200] or type(error).__name__
            raise _not_a_catalog(path, reason) from error
        catalog = cls(tiles, skipped)
        if tiles and not catalog.usable:
            raise _not_a_catalog(path, f"no entry can be used: {tiles[0].fault}")
        return catalog

    def write(self, path: Location | str, movable: bool = True) -> None:
        """Write the catalog.

        Parameters
        ----------
        path : Path
            File to write; its suffix is .parquet, .json or .geojson.
        movable : bool
            True: names of files below the catalog's folder are relative to it, so that catalog and data can
            be moved together. False: the tiles' roots are kept, so that a copy of the catalog in another
            folder names the same files in the same way.

        Raises
        ------
        CatalogError
            If the suffix is not .parquet, .json or .geojson, or the file cannot be written.
        """
        path = _location(path)
        if path.suffix not in (".parquet", *JSON_SUFFIXES):
            raise CatalogError(f"a catalog's name ends in .parquet, .json or .geojson, but not {path.name}")
        folder = absolute(path).parent
        prefix = str(folder).rstrip("/") + "/"

        def written(tile: Tile) -> Item:
            if not movable:
                return item(tile, tile.root)
            # Links are not resolved: a folder of links stays a folder of links.
            return item(tile.renamed(lambda file: normalise(join(tile.root, file)).removeprefix(prefix)))

        items = map(written, self.tiles)
        files = [to_fields(one.below(str(folder)) if movable else one) for one in self.skipped]
        try:
            if path.suffix in JSON_SUFFIXES:
                content = {"type": "FeatureCollection", "features": list(items)}
                data = json.dumps(content | ({SKIPPED: files} if files else {}), indent=1).encode()
            else:
                data = geoparquet.table_bytes(items, _schema(), files)
            paths.write(path, data, flushed=True)
        except OSError as error:
            raise CatalogError(f"cannot write catalog {path}: {error.strerror or error}") from error

    def select(
        self, ids: Sequence[str] = (), bbox: Bounds | None = None, area: Area | None = None
    ) -> Catalog:
        """Return the tiles with the given ids (all if ``ids`` is empty) that touch ``bbox`` and ``area``.

        Parameters
        ----------
        ids : sequence of str
        bbox : Bounds, optional
            West, south, east, north (m, in the tiles' CRS).
        area : Area, optional
            Polygons in any CRS.

        Raises
        ------
        CatalogError
            If an id is not in the catalog (the message suggests similar ids) or no tile touches ``bbox`` or
            ``area``.
        """
        all_ids = {tile.id for tile in self.tiles}
        for tile_id in ids:
            if tile_id not in all_ids:
                near = difflib.get_close_matches(tile_id, all_ids, n=3) or sorted(all_ids)[:3]
                raise CatalogError(f"no tile {tile_id!r} in the catalog; did you mean {', '.join(near)}?")
        wanted = set(ids)
        tiles = [tile for tile in self.tiles if not ids or tile.id in wanted]
        if bbox is not None:
            west, south, east, north = bbox
            if west > east or south > north:
                order = "the order is west south east north"
                raise CatalogError(f"--bbox {edges(bbox)} is empty; {order}; {self._extent()}")
            tiles = [tile for tile in tiles if not tile.fault and overlap(tile.grid.bounds, bbox)]
            if not tiles:
                raise CatalogError(f"no tile touches --bbox {edges(bbox)}; {self._extent()}")
        if area is not None:
            usable = [tile for tile in tiles if not tile.fault]
            tiles = list(compress(usable, area.touched(tile.grid for tile in usable)))
            if not tiles:
                place = f"check its CRS, {short(area.crs)}, and its place"
                raise CatalogError(f"no tile touches --area {area.name}; {place}")
        return replace(self, tiles=tuple(tiles))

    def same_places(self) -> str:
        """Return a note on tiles that lie on the same place; empty without such tiles."""
        ids: dict[tuple[str, Bounds], list[str]] = defaultdict(list)
        for tile in self.usable:
            ids[tile.grid.crs, tile.grid.bounds].append(tile.id)
        shared = [" and ".join(same) for same in ids.values() if len(same) > 1]
        return f"tiles on the same place: {some(shared)}; their results cover each other" if shared else ""

    def _extent(self) -> str:
        """Return where the tiles lie, for a message."""
        corners: dict[str, list[Bounds]] = defaultdict(list)
        for tile in self.usable:
            corners[tile.grid.crs].append(tile.grid.bounds)
        places = [f"{edges(union(bounds))} in {short(crs)}" for crs, bounds in corners.items()]
        return f"the tiles lie within {' and '.join(places)}"


def _location(path: Location | str) -> Location:
    try:
        return parse_location(path)
    except OSError as error:
        raise CatalogError(f"catalog {path}: {error.strerror or error}") from error


def _not_a_catalog(path: Location, reason: str) -> CatalogError:
    return CatalogError(f"{path} is not a FlexRoad catalog: {reason}; make one with `flexroad catalog`")


def item(tile: Tile, root: str = "") -> Item:
    """Return the tile as a STAC item.

    - `tile`: file names are written as they are in its layers.
    - `root`: folder that file names are relative to; empty: the folder of the file that the item is written
      to.
    """
    properties: Item = {
        "datetime": datetime_text(tile.datetime),
        **_placed(tile.grid, known=not tile.fault),
        "flexroad:stratum": tile.stratum,
        "flexroad:dataset": tile.dataset,
        "flexroad:datetime_assumed": tile.datetime_assumed,
        "flexroad:root": root,
    }
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "stac_extensions": [PROJECTION],
        "id": tile.id,
        **(_outline(tile.grid) if not tile.fault else {"geometry": None}),
        "properties": properties | ({"flexroad:fault": tile.fault} if tile.fault else {}),
        "assets": {layer.name: _asset(layer, root) for layer in tile.all_layers},
        "links": [],
    }


def datetime_text(time: datetime) -> str:
    """Return a time as STAC writes it: RFC 3339 in UTC."""
    return time.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def _outline(grid: Grid) -> Item:
    """Return geometry and bbox in degrees; no bbox if the grid has no position in degrees."""
    west, south, east, north = grid.bounds
    to_wgs84 = transformer(grid.crs, "EPSG:4326")
    ring = [(west, south), (east, south), (east, north), (west, north), (west, south)]
    corners = [list(to_wgs84.transform(*corner)) for corner in ring]
    xs, ys = [c[0] for c in corners], [c[1] for c in corners]
    if not all(map(math.isfinite, xs + ys)):
        return {"geometry": None}
    return {
        "geometry": {"type": "Polygon", "coordinates": [corners]},
        "bbox": [min(xs), min(ys), max(xs), max(ys)],
    }


def _placed(grid: Grid, known: bool) -> Item:
    """Return the fields of the projection extension, None if the grid is not known."""
    fields = {
        "proj:code": grid.crs if grid.has_code else None,
        "proj:wkt2": None if grid.has_code else grid.crs,
        "proj:bbox": list(grid.bounds),
        "proj:shape": [grid.height, grid.width],
        "proj:transform": [grid.cell, 0.0, grid.west, 0.0, -grid.cell, grid.north],
    }
    return fields if known else dict.fromkeys(fields)


def _asset(layer: Layer, root: str) -> Item:
    return {
        "href": join(root, layer.files[0]) if root else layer.files[0],
        "roles": ["data"],
        "flexroad:files": list(layer.files),
        "flexroad:values": list(layer.values),
        "flexroad:crs": layer.crs,
        # One flat list, because nested lists take twice as long to read.
        "flexroad:extents": [edge for extent in layer.extents for edge in extent] or None,
        "flexroad:reproject": layer.reproject,
        "flexroad:height_unit": layer.height_unit,
        "flexroad:sublayer": layer.sublayer,
    }


def _from_json(data: bytes) -> tuple[list[Any], Any]:
    """Return the entries of tiles and of skipped files."""
    content = json.loads(data, object_pairs_hook=_unique)
    features = content.get("features") if isinstance(content, dict) else None
    if not isinstance(features, list):
        raise ValueError("it has no list of features")
    return features, content.get(SKIPPED, [])


def _unique(pairs: list[tuple[str, Any]]) -> Item:
    """Return an object of JSON; a repeated name gets a value that no field accepts."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = Counter(name for name, _ in pairs)
        found |= {name: Unreadable("given twice") for name, count in names.items() if count > 1}
    return found


@cache
def _schema() -> Any:
    """Return the columns of every catalog."""
    return geoparquet.schema_of(_full_item())


def _full_item() -> Item:
    """Return an item with all layers and fields."""
    extents = ((0.0, 0.0, 1.0, 1.0),)
    layers = tuple(
        Layer(name, ("file",), (1,), "EPSG:25832", extents, True, "roads", "foot") for name in LAYERS
    )
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 1, 1)
    whole = item(Tile("", grid, layers, "", datetime(2000, 1, 1, tzinfo=UTC)))
    whole["properties"] |= {"proj:wkt2": "", "flexroad:fault": ""}
    return whole


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
                folders = needed(catalog, tile.allowed, layers)
                raise tile.allowed.refusal(f"tile {tile.id}: {layer.name}", name, folders)


def needed(catalog: Catalog, allowed: AllowedFolders, layers: Collection[str] = LAYERS) -> tuple[str, ...]:
    """Return the further folders that must be allowed to read layers of a catalog."""
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
    """Return the folders that are not inside another of the folders."""
    outermost: list[str] = []
    # Sorting puts a folder before its subfolders.
    for folder in sorted(set(folders), key=lambda folder: folder.rstrip("/") + "/"):
        if not outermost or not folder.startswith(outermost[-1].rstrip("/") + "/"):
            outermost.append(folder)
    return set(outermost)
