"""The catalog: one table of tiles with a fixed schema, stored as STAC items.

The suffix of the file name selects GeoParquet (``.parquet``) or a GeoJSON feature collection (``.json``,
``.geojson``); QGIS opens both. Projection fields follow the STAC projection extension; FlexRoad's own fields
have the prefix ``flexroad:``.
"""

from __future__ import annotations

import difflib
import json
import struct
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from sys import intern
from typing import Any

import numpy as np
import shapely
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from flexroad.catalog import ids
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds, Grid, overlap
from flexroad.catalog.storage import paths
from flexroad.catalog.storage.paths import Location, absolute, join, normalise, parse_location
from flexroad.catalog.tile import LAYERS, Layer, Tile, by_cover
from flexroad.catalog.trust import AllowedFolders

Item = dict[str, Any]

STAC_VERSION = "1.1.0"
PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
JSON_SUFFIXES = (".json", ".geojson")


@dataclass(frozen=True)
class Catalog:
    """The tiles of a data set, in the order of their ids."""

    tiles: tuple[Tile, ...]

    def __post_init__(self) -> None:
        ids.check([tile.id for tile in self.tiles])

    @classmethod
    def read(cls, path: Location | str, allow: Sequence[str | Path] = ()) -> Catalog:
        """Read a catalog written by `write`, from disk or a bucket.

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
            If the file is missing or is not a catalog; names the file.
        """
        path = _location(path)
        try:
            data = paths.read(path)
        except FileNotFoundError as error:
            raise CatalogError(f"catalog {path} does not exist; make one with `flexroad catalog`") from error
        except IsADirectoryError as error:
            example = path / "catalog.parquet"
            raise CatalogError(f"catalog {path} is a folder; name its file, as in {example}") from error
        except OSError as error:
            raise CatalogError(f"cannot read catalog {path}: {error.strerror or error}") from error
        try:
            items = _from_json(data) if path.suffix in JSON_SUFFIXES else _from_parquet(data)
            folder, allowed = str(absolute(path).parent), AllowedFolders.of(path.parent, allow)
            return cls(tuple(_tile(item, folder, allowed) for item in items))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CatalogError(
                f"{path} is not a FlexRoad catalog: {error!r}; make one with `flexroad catalog`"
            ) from error

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
        items = [item(_rooted(tile, folder), "") if movable else item(tile, tile.root) for tile in self.tiles]
        make: Callable[[list[Item]], bytes] = _to_json if path.suffix in JSON_SUFFIXES else _to_parquet
        try:
            paths.write(path, make(items))
        except OSError as error:
            raise CatalogError(f"cannot write catalog {path}: {error.strerror or error}") from error

    def select(self, ids: Sequence[str] = (), bbox: Bounds | None = None) -> Catalog:
        """Return the tiles with the given ids (all if ``ids`` is empty) that touch ``bbox``.

        Parameters
        ----------
        ids : sequence of str
        bbox : Bounds, optional
            West, south, east, north (m, in the tiles' CRS).

        Raises
        ------
        CatalogError
            If an id is not in the catalog (the message suggests similar ids) or no tile touches ``bbox``.
        """
        all_ids = {tile.id for tile in self.tiles}
        for tile_id in ids:
            if tile_id not in all_ids:
                near = difflib.get_close_matches(tile_id, all_ids, n=3) or sorted(all_ids)[:3]
                raise CatalogError(f"no tile {tile_id!r} in the catalog; did you mean {', '.join(near)}?")
        tiles = [tile for tile in self.tiles if not ids or tile.id in set(ids)]
        if bbox is not None:
            tiles = [tile for tile in tiles if overlap(tile.grid.bounds, bbox)]
            if not tiles:
                raise CatalogError(f"no tile touches --bbox {' '.join(f'{v:g}' for v in bbox)}")
        return Catalog(tuple(tiles))


def _location(path: Location | str) -> Location:
    try:
        return parse_location(path)
    except OSError as error:
        raise CatalogError(f"catalog {path}: {error.strerror or error}") from error


def _rooted(tile: Tile, root: Location) -> Tile:
    """Return the tile with file names relative to ``root`` where they lie below it, else absolute."""
    prefix = str(root).rstrip("/") + "/"
    # Links are not resolved: a folder of links stays one.
    renamed = tile.renamed(lambda file: normalise(join(tile.root, file)).removeprefix(prefix))
    return replace(renamed, root=str(root))


@lru_cache(maxsize=16)
def _to_wgs84(crs: str) -> Transformer:
    try:
        return Transformer.from_crs(CRS.from_user_input(crs), "EPSG:4326", always_xy=True)
    except CRSError as error:
        raise CatalogError(f"unknown CRS {crs[:60]!r}: {error}") from error


def item(tile: Tile, root: str = "") -> Item:
    """Return the tile as a STAC item.

    Parameters
    ----------
    tile : Tile
        File names are written as they are in its layers.
    root : str
        Folder that file names are relative to; empty: the folder of the file that the item is written to.
    """
    grid = tile.grid
    west, south, east, north = grid.bounds
    to_wgs84 = _to_wgs84(grid.crs)
    ring = [(west, south), (east, south), (east, north), (west, north), (west, south)]
    corners = [list(to_wgs84.transform(*corner)) for corner in ring]
    xs, ys = [c[0] for c in corners], [c[1] for c in corners]
    is_code = grid.crs.upper().startswith("EPSG:")
    return {
        "type": "Feature",
        "stac_version": STAC_VERSION,
        "stac_extensions": [PROJECTION],
        "id": tile.id,
        "geometry": {"type": "Polygon", "coordinates": [corners]},
        "bbox": [min(xs), min(ys), max(xs), max(ys)],
        "properties": {
            "datetime": tile.datetime.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
            "proj:code": grid.crs if is_code else None,
            "proj:wkt2": None if is_code else grid.crs,
            "proj:bbox": list(grid.bounds),
            "proj:shape": [grid.height, grid.width],
            "proj:transform": [grid.cell, 0.0, west, 0.0, -grid.cell, north],
            "flexroad:stratum": tile.stratum,
            "flexroad:dataset": tile.dataset,
            "flexroad:datetime_assumed": tile.datetime_assumed,
            "flexroad:root": root,
        },
        "assets": {layer.name: _asset(layer, root) for layer in tile.all_layers},
        "links": [],
    }


def _asset(layer: Layer, root: str) -> Item:
    return {
        "href": join(root, layer.files[0]) if root else layer.files[0],
        "roles": ["data"],
        "flexroad:files": list(layer.files),
        "flexroad:values": list(layer.values),
        "flexroad:crs": layer.crs,
        # One flat list, because nested lists take twice as long to read.
        "flexroad:extents": [edge for extent in layer.extents for edge in extent] or None,
    }


def _tile(item: Item, folder: str, allowed: AllowedFolders) -> Tile:
    properties = item["properties"]
    cell, _, west, _, _, north = properties["proj:transform"][:6]
    height, width = properties["proj:shape"]
    crs = properties.get("proj:code") or properties["proj:wkt2"]
    assets = item["assets"]
    # JSON may hold whole numbers; fingerprints are of the text of numbers.
    grid = Grid(crs, float(west), float(north), float(cell), int(width), int(height))
    layers, nearby = by_cover([_layer(name, assets[name]) for name in LAYERS if assets.get(name)], grid)
    return Tile(
        id=item["id"],
        grid=grid,
        layers=layers,
        root=properties["flexroad:root"] or folder,
        datetime=_datetime(properties["datetime"]),
        datetime_assumed=bool(properties["flexroad:datetime_assumed"]),
        stratum=properties["flexroad:stratum"],
        # Older catalogs do not have this field.
        dataset=properties.get("flexroad:dataset") or "",
        nearby=nearby,
        allowed=allowed,
    )


def _layer(name: str, asset: Item) -> Layer:
    # Older catalogs do not have this field.
    edges = asset.get("flexroad:extents")
    return Layer(
        name=name,
        # Neighbouring tiles list the same files.
        files=tuple(map(intern, asset["flexroad:files"])),
        values=tuple(asset["flexroad:values"]),
        crs=asset.get("flexroad:crs"),
        extents=() if edges is None else _extents(np.asarray(edges, np.float64).tobytes()),
    )


@lru_cache(maxsize=16)
def _extents(edges: bytes) -> tuple[Bounds, ...]:
    """Return the extents of a layer's files; cached, because a tile's layers often have the same ones."""
    return tuple(struct.iter_unpack("=4d", edges))


def _datetime(value: str | datetime) -> datetime:
    return value if isinstance(value, datetime) else datetime.fromisoformat(value)


def _from_json(data: bytes) -> Iterable[Item]:
    features: list[Item] = json.loads(data)["features"]
    return features


def _to_json(items: list[Item]) -> bytes:
    return json.dumps({"type": "FeatureCollection", "features": items}, indent=1).encode()


def _from_parquet(data: bytes) -> Iterable[Item]:
    """Return the fields of each item that `_tile` needs; reading whole items is many times slower."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file = pq.ParquetFile(pa.BufferReader(data), pre_buffer=False)
    paths = (file.schema.column(number).path.split(".") for number in range(len(file.schema)))
    columns = dict.fromkeys(".".join(path[:3] if path[0] == "assets" else path[:1]) for path in paths)
    plain = [name for name in columns if name.startswith(("id", "proj:", "flexroad:", "datetime"))]
    plain += [
        name for name in columns if name.endswith((".flexroad:files", ".flexroad:values", ".flexroad:crs"))
    ]
    # Reader threads may still be alive when a short process ends, and would abort it.
    rows = file.read(plain, use_threads=False).to_pylist()
    extents = [name for name in columns if name.endswith(".flexroad:extents")]
    if extents:
        _add_extents(rows, file.read(extents, use_threads=False)["assets"].combine_chunks())
    return ({"id": row["id"], "assets": row["assets"], "properties": row} for row in rows)


def _add_extents(rows: list[Item], assets: Any) -> None:
    """Add the extents to the rows' assets as arrays; as lists of numbers they take several times as long."""
    for field in assets.type:
        column = assets.field(field.name).field("flexroad:extents")
        ends, edges = column.offsets.to_numpy().tolist(), column.values.to_numpy()
        for row, begin, end in zip(rows, ends[:-1], ends[1:], strict=True):
            if begin < end:
                row["assets"][field.name]["flexroad:extents"] = edges[begin:end]


def _to_parquet(items: list[Item]) -> bytes:
    """Return the items in the layout of stac-geoparquet; its own conversion is many times slower."""
    import pyarrow as pa
    from stac_geoparquet.arrow import parse_stac_items_to_arrow, to_parquet

    # Columns are inferred from the item. An item with all fields gives every catalog the same schema.
    schema = parse_stac_items_to_arrow([_full_item()]).read_all().schema
    with tempfile.TemporaryDirectory() as folder:
        # `to_parquet` writes only to files.
        file = Path(folder) / "catalog.parquet"
        to_parquet(pa.Table.from_pylist([_row(item) for item in items], schema), file)
        return file.read_bytes()


def _row(item: Item) -> Item:
    """Return an item as a table row: properties as columns, the outline as WKB."""
    row: Item = {name: value for name, value in item.items() if name != "properties"} | item["properties"]
    (ring,) = item["geometry"]["coordinates"]
    corners = ("xmin", "ymin", "xmax", "ymax")
    row |= {
        "geometry": shapely.to_wkb(shapely.Polygon(ring)),
        "bbox": dict(zip(corners, item["bbox"], strict=True)),
        "datetime": _datetime(item["properties"]["datetime"]),
    }
    return row


def _full_item() -> Item:
    """Return an item with all layers and fields."""
    layers = tuple(Layer(name, ("file",), (1,), "EPSG:25832", ((0.0, 0.0, 1.0, 1.0),)) for name in LAYERS)
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 1, 1)
    whole = item(Tile("", grid, layers, "", datetime(2000, 1, 1, tzinfo=UTC)))
    whole["properties"]["proj:wkt2"] = ""
    return whole
