"""The catalog: one table of tiles with a fixed schema, kept as STAC items.

GeoParquet (``.parquet``) or a GeoJSON feature collection (``.json``, ``.geojson``), by file name; QGIS
opens both. Projection fields follow the STAC projection extension; fields of our own carry the prefix
``flexroad:``.
"""

from __future__ import annotations

import contextlib
import difflib
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from catalog.errors import CatalogError
from catalog.grid import Bounds, Grid
from catalog.tile import LAYERS, Layer, Tile

Item = dict[str, Any]

STAC_VERSION = "1.1.0"
PROJECTION = "https://stac-extensions.github.io/projection/v2.0.0/schema.json"
JSON_SUFFIXES = (".json", ".geojson")


@dataclass(frozen=True)
class Catalog:
    """The tiles there are, in the order of their ids."""

    tiles: tuple[Tile, ...]

    def __post_init__(self) -> None:
        ids = [tile.id for tile in self.tiles]
        doubled = sorted({i for i in ids if ids.count(i) > 1}) if len(set(ids)) < len(ids) else []
        if doubled:
            raise CatalogError(f"tile ids must be unique, but {', '.join(doubled[:5])} stand more than once")

    @classmethod
    def read(cls, path: Path | str) -> Catalog:
        """Read a catalog that `write` wrote.

        Raises
        ------
        CatalogError
            If the file is missing or is no catalog; the line names the file.
        """
        path = Path(path)
        if not path.exists():
            raise CatalogError(f"catalog {path} does not exist; make one with `flexroad catalog`")
        if path.is_dir():
            raise CatalogError(f"catalog {path} is a folder; name its file, as in {path / 'catalog.parquet'}")
        try:
            items = _read_json(path) if path.suffix in JSON_SUFFIXES else _read_parquet(path)
            folder = str(path.resolve().parent)
            return cls(tuple(_tile(item, folder) for item in items))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CatalogError(
                f"{path} is not a FlexRoad catalog: {error!r}; make one with `flexroad catalog`"
            ) from error

    def write(self, path: Path | str, movable: bool = True) -> None:
        """Write the catalog.

        Parameters
        ----------
        path : Path
            Its name ends in .parquet, .json or .geojson.
        movable : bool
            Name files relative to the catalog's folder where they lie below it, so that both can be moved
            together; else keep the tiles' roots, so that a copy elsewhere names the same files alike.

        Raises
        ------
        CatalogError
            If the name ends neither in .parquet nor in .json or .geojson, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix not in (".parquet", *JSON_SUFFIXES):
            raise CatalogError(f"a catalog's name ends in .parquet, .json or .geojson, unlike {path.name}")
        folder = path.resolve().parent
        items = [item(_rooted(tile, folder), "") if movable else item(tile, tile.root) for tile in self.tiles]
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            (_write_json if path.suffix in JSON_SUFFIXES else _write_parquet)(items, temporary)
            temporary.replace(path)
        except OSError as error:
            raise CatalogError(f"cannot write catalog {path}: {error.strerror or error}") from error
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)

    def select(self, ids: Sequence[str] = (), bbox: Bounds | None = None) -> Catalog:
        """Return the tiles named (all if none is) that touch ``bbox`` (m, in the tiles' CRS).

        Raises
        ------
        CatalogError
            If an id is unknown (the nearest ones are shown) or nothing is left.
        """
        known = {tile.id for tile in self.tiles}
        for wanted in ids:
            if wanted not in known:
                near = difflib.get_close_matches(wanted, known, n=3) or sorted(known)[:3]
                raise CatalogError(f"no tile {wanted!r} in the catalog; did you mean {', '.join(near)}?")
        tiles = [tile for tile in self.tiles if not ids or tile.id in set(ids)]
        if bbox is not None:
            tiles = [tile for tile in tiles if _overlap(tile.grid.bounds, bbox)]
            if not tiles:
                raise CatalogError(f"no tile touches --bbox {' '.join(f'{v:g}' for v in bbox)}")
        return Catalog(tuple(tiles))


def _overlap(a: Bounds, b: Bounds) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _rooted(tile: Tile, root: Path) -> Tile:
    """Return the tile with its files relative to ``root`` where they lie below it, else absolute."""

    def name(path: Path) -> str:
        # normpath, not resolve: a folder of links should stay a folder of links.
        path = Path(os.path.normpath(path.absolute()))
        return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)

    layers = tuple(
        replace(layer, files=tuple(name(path) for path in tile.paths(layer))) for layer in tile.layers
    )
    return replace(tile, layers=layers, root=str(root))


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
        Its files are named as they stand in its layers.
    root : str
        Folder they are relative to; empty: that of the file the item is written to.
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
        "assets": {layer.name: _asset(layer, root) for layer in tile.layers},
        "links": [],
    }


def _asset(layer: Layer, root: str) -> Item:
    return {
        "href": str(Path(root) / layer.files[0]) if root else layer.files[0],
        "roles": ["data"],
        "flexroad:files": list(layer.files),
        "flexroad:values": list(layer.values),
        "flexroad:crs": layer.crs,
    }


def _tile(item: Item, folder: str) -> Tile:
    properties = item["properties"]
    cell, _, west, _, _, north = properties["proj:transform"][:6]
    height, width = properties["proj:shape"]
    crs = properties.get("proj:code") or properties["proj:wkt2"]
    assets = item["assets"]
    return Tile(
        id=item["id"],
        grid=Grid(crs, west, north, cell, int(width), int(height)),
        layers=tuple(_layer(name, assets[name]) for name in LAYERS if assets.get(name)),
        root=properties["flexroad:root"] or folder,
        datetime=datetime.fromisoformat(properties["datetime"]),
        datetime_assumed=bool(properties["flexroad:datetime_assumed"]),
        stratum=properties["flexroad:stratum"],
        # Catalogs written before reports named their data lack it.
        dataset=properties.get("flexroad:dataset") or "",
    )


def _layer(name: str, asset: Item) -> Layer:
    return Layer(
        name=name,
        files=tuple(asset["flexroad:files"]),
        values=tuple(asset["flexroad:values"]),
        crs=asset.get("flexroad:crs"),
    )


def _read_json(path: Path) -> Iterable[Item]:
    features: list[Item] = json.loads(path.read_text())["features"]
    return features


def _write_json(items: Iterable[Item], path: Path) -> None:
    path.write_text(json.dumps({"type": "FeatureCollection", "features": list(items)}, indent=1))


def _read_parquet(path: Path) -> Iterable[Item]:
    import pyarrow.parquet as pq
    from stac_geoparquet.arrow import stac_table_to_items

    items: Iterable[Item] = stac_table_to_items(pq.read_table(path))
    return items


def _write_parquet(items: list[Item], path: Path) -> None:
    from stac_geoparquet.arrow import parse_stac_items_to_arrow, to_parquet

    # Columns are inferred from what the items hold. A first item that has everything, cut off again,
    # makes the schema the same for every catalog.
    table = parse_stac_items_to_arrow([_everything(), *items]).read_all().slice(1)
    to_parquet(table, path)


def _everything() -> Item:
    layers = tuple(Layer(name, ("file",), (1,), "EPSG:25832") for name in LAYERS)
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 1, 1)
    whole = item(Tile("", grid, layers, "", datetime(2000, 1, 1, tzinfo=UTC)))
    whole["properties"]["proj:wkt2"] = ""
    return whole
